"""From a start to a calibration with a named lens: solve, reject, compete, solve for targets as built, assess."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future
from typing import TYPE_CHECKING

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import attempt
from ceres_cal.base.frozen import Frozen, cached_property, replace
from ceres_cal.base.threads import meanwhile
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.outcome import (
    came_out,
    of_all,
    require_lens_told,
    resting_phi,
    seen_from_behind,
    unknown_phi,
    unusual_pixels,
)
from ceres_cal.effects.dependence import Scatter, measure_scatter
from ceres_cal.effects.effect import AsBuilt, EffectEstimate, ShiftsAt
from ceres_cal.effects.table import estimated
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.posterior.assess import assess, with_doubts
from ceres_cal.posterior.other_lenses import AGREES, LeftOver, of_placements, shifts_by_roughness
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem.bundle import Progress, Solution
from ceres_cal.problem.information import Key, over
from ceres_cal.problem.parameters import Estimate, Layout, Options
from ceres_cal.problem.priors import GaussianPrior
from ceres_cal.problem.problem import Problem, problem_of
from ceres_cal.problem.reduced import ReducedInformation, information
from ceres_cal.problem.residuals import residuals
from ceres_cal.robust.as_built import AS_DRAWN, Built, require_measured, solve_as_built, taking_part, tolerances_of
from ceres_cal.robust.competing import Subproblem, compete
from ceres_cal.robust.conflicts import Conflicts, find_conflicts
from ceres_cal.robust.effects import EffectsEnd, solve_beside_effects
from ceres_cal.robust.other_minima import least_of_few, seen_alike
from ceres_cal.robust.robust import RobustSolution, solve_robustly
from ceres_cal.robust.unsteady import Unsteady, find_unsteady
from ceres_cal.robust.usable import all_shown, require_fits, require_possible, require_usable
from ceres_cal.scene.lens import make_lens
from ceres_cal.start.initialise import Start, initialise

if TYPE_CHECKING:
    from ceres_cal.effects.aside import Explanation
    from ceres_cal.robust.bulk import Settled


class Again(Frozen, eq=True):
    """How a calibration is taken up again after an earlier one.

    Attributes:
        known: the layout of everything that is known by a posterior, also where the solve holds it.
        scales: noise scales of points and curves that were seen before; None for those of these observations alone.
        assessed: whether the posterior is wanted.
    """

    known: Layout
    scales: tuple[float, float] | None
    assessed: bool = True


class Watched(Frozen):
    """Who is told of the solves, and what solves for all observations where these are a part.

    Attributes:
        progress: called at every iteration. settle: from the end of the part, see `Bulk.settled`.
        knows: whether it is asked what is then known of the numbers. chosen: whether the data chose the lens: what one
            that is too simple leaves looks like a principal point that moves.
    """

    progress: Callable[[Progress], None] | None = None
    settle: Callable[..., Settled] | None = None
    knows: bool = True
    chosen: bool = False


_UNWATCHED = Watched()


class Explained(Frozen):
    """A solution, and what explains the observations that it does not fit.

    Attributes:
        explanations: what else groups of observations may be. as_built: how targets were built.
        beside: effects of the table that were solved for. others: further minima.
        unsteady: what moves single views. digest: of the observations, which remember it, while it is worked out.
    """

    problem: Problem
    start: Start
    end: RobustSolution
    explanations: tuple[Explanation, ...]
    as_built: tuple[AsBuilt, ...] = ()
    beside: EffectsEnd | None = None
    others: tuple[Solution, ...] = ()
    unsteady: Unsteady | None = None
    digest: Future[str] | None = None

    @cached_property
    def leaves_alike(self) -> bool:
        """Whether the lens leaves the same in one place of all views; one with a formula, in views of placements."""
        rough, every = bool(self.end.problem.options.blank_lens.roughness), self.end.problem.sights
        asked = every if rough else of_placements(every)
        return bool(len(asked)) and LeftOver.of_end(self.end, asked).asks_for_more

    def outlier_masks(self, observations: Observations) -> tuple[Mask, Mask]:
        """See `Calibration.outlier_masks`."""
        inliers = self.end.inliers
        if inliers.rows.all():
            return ~inliers.points, ~inliers.curves
        return self.came_out(observations).outlier_masks(observations)

    def came_out(self, observations: Observations) -> Calibration:
        """The calibration, not assessed."""
        if self.digest is not None:
            self.digest.result()
        return came_out(self.start.phi_from, observations, self.problem, self.end, self.explanations)

    def effects(self, observations: Observations) -> tuple[EffectEstimate, ...]:
        """What was solved for beside the problem."""
        moving = self.unsteady.estimates(observations) if self.unsteady else ()
        return (*moving, *(self.beside.estimates if self.beside else ()))

    @property
    def shifts_at(self) -> ShiftsAt | None:
        """By which numbers scatter besides."""
        if self.unsteady is None:
            return self.beside.shifts_at if self.beside else None
        unsteady, beside = self.unsteady, self.beside

        def shifts_at(there: Estimate, priors: Sequence[GaussianPrior] | None) -> tuple[Sequence[Key], Sequence[Array]]:
            keys, shifts = beside.shifts_at(there, priors) if beside else (unsteady.keys, ())
            return keys, [*shifts, *over(unsteady.shifts, unsteady.keys, keys)]

        return shifts_at

    def without(self, conflicts: Conflicts, observations: Observations) -> Explained:
        """The answer without what was stated and everything else contradicts."""
        if conflicts.answer is None:
            return self
        problem = replace(self.problem, priors=conflicts.answer.problem.priors)
        shown = residuals(observations, problem.sights, conflicts.answer.solution.estimate)
        return replace(self, problem=problem, end=replace(conflicts.answer, residuals=shown), others=())


def solved_from(
    start: Start,
    observations: Observations,
    problem: Problem,
    again: Again | None = None,
    watched: Watched = _UNWATCHED,
    built: Built = AS_DRAWN,
) -> Calibration:
    """Solve and explain what is left, set aside what was stated and is contradicted, assess, from a start.

    Args:
        built: how targets seemed to be built before.

    Raises:
        CalibrationError: see `calibrate`.
    """
    return known_of(explained(start, observations, problem, again, watched, built), observations, again, watched)


def explained(
    start: Start, observations: Observations, problem: Problem, again: Again | None, watched: Watched, built: Built
) -> Explained:
    """Solve and explain what is left; see `solved_from`."""
    long_to_digest = 20_000  # observations: fewer take less than a thread, and what makes one
    takes_long = len(observations.points) + len(observations.curves) > long_to_digest
    digest = meanwhile(lambda: observations.digest) if takes_long and watched.settle is None else None
    seen, may_move = _solved(start, observations, problem, again, watched, built), watched.chosen and not watched.settle
    steady = _made_steady(seen, observations, problem, watched) if may_move else None
    if steady is None:
        seen = _explained(seen, observations, problem.sights, again, watched, built)
        may_move = may_move and bool(seen.explanations or seen.as_built)
        steady = _made_steady(seen, observations, problem, watched) if may_move else None
    return replace(steady or seen, digest=digest)


def known_of(seen: Explained, observations: Observations, again: Again | None, watched: Watched) -> Calibration:
    """Set aside what was stated and is contradicted, and assess; see `solved_from`."""
    conflicts, assessed = Conflicts(), again is None or again.assessed
    if assessed:
        part = taking_part(seen.problem, observations, seen.explanations) if again is None else None
        usual = again.scales if again else None
        conflicts = find_conflicts(seen.problem, observations, seen.end, usual, part, seen.shifts_at)
        seen = seen.without(conflicts, observations)
    settled = None
    if watched.settle is not None:
        settled = watched.settle(seen.problem, seen.end, seen.explanations, watched.progress)
        seen = replace(seen, end=settled.end)
    explanations = settled.explanations if settled else seen.explanations
    effects = seen.effects(observations)
    warnings = (*(one.warning for one in explanations), *(one.warning for one in effects if one.is_solved))
    posterior = None
    if assessed and watched.knows:
        seen, posterior = _known(seen, observations, conflicts, again)
        alike = seen_alike(seen.others, seen.end.solution.estimate, posterior.half_width)
        phi = (*unknown_phi(seen.end, posterior), *resting_phi(seen.end, seen.problem))
        strange = (
            *unusual_pixels(seen.end, seen.problem, observations),
            *seen_from_behind(seen.end.solution.estimate, observations),
        )
        warnings = (*warnings, *conflicts.words, *phi, *strange, *alike)
    calibration = seen.came_out(observations)
    if settled is not None:
        calibration = of_all(calibration, settled)
    wholes = [one.rows for one in seen.explanations if one.is_taken]
    warnings = (*calibration.warnings, *require_usable(seen.end, seen.problem, wholes), *warnings)
    calibration = replace(calibration, warnings=warnings, posterior=posterior, conflicts=conflicts.every)
    tolerances = {**seen.problem.options.tolerances, **tolerances_of(seen.as_built)}
    options = replace(seen.problem.options, tolerances=tolerances)
    return replace(calibration, options=options, as_built=seen.as_built, effects=effects)


def _made_steady(first: Explained, observations: Observations, problem: Problem, watched: Watched) -> Explained | None:
    """With what displaces single views taken off, and again as it is found then; None where nothing does.

    It is looked for before groups are asked whether they belong, which it displaces, and after them, for of few views
    it is hidden by how their target is built. The lens stays as long as it was: one that grew beside what was taken off
    predicted other views of a stabilised camera worse by a seventh, and a rolling shutter's halves took a minute each.
    At rest the predictions follow the noise: halves differ by 1.7 of what is stated where they do by 1.4 after twice.
    """
    twice = 2
    seen, unsteady = first, None
    for _ in range(twice):
        unsteady = find_unsteady(seen.problem, observations, seen.end, unsteady)
        if unsteady is None:  # or what seemed to move was what the lens or the target left
            return None
        start = replace(seen.end.solution.estimate, structure=first.start.estimate.structure)
        named = first.problem.options
        options = replace(problem.options, powers=named.powers, terms=named.terms)
        again = problem_of(observations, problem.sights, options, start)
        steady = unsteady.taken_off(again, len(observations.points))
        end = solve_robustly(steady, observations, start, None, watched.progress, is_near=True)
        solved = Explained(steady, replace(first.start, estimate=start, is_near=True), end, ())
        seen = replace(_explained(solved, observations, steady.sights, None, watched, AS_DRAWN), unsteady=unsteady)
    return seen


def _solved(
    start: Start, observations: Observations, problem: Problem, again: Again | None, watched: Watched, built: Built
) -> Explained:
    """Solve, reject, solve: nothing else is explained yet, and targets are drawn as they seemed to be built."""
    usual = again.scales if again else None
    problem = replace(problem, sights=built.held(problem.sights, observations))
    end = solve_robustly(problem, observations, start.estimate, usual, watched.progress, is_near=start.is_near)
    if again is None:
        problem, start, end = _as_long_as_asked(problem, observations, start, end, watched.progress)
        require_measured(end.problem, end.solution.estimate)
    return Explained(problem, start, end, ())


def _explained(
    first: Explained, observations: Observations, drawn: Sights, again: Again | None, watched: Watched, built: Built
) -> Explained:
    """Let explanations compete; solve for targets as built, where they are drawn otherwise, and for effects."""

    def solved(others: Problem, some: Subproblem) -> RobustSolution:
        usual = again.scales if again else None
        return solve_robustly(others, some.observations, _start_of(others, some, first.start, again), usual)

    end, explanations = compete(first.problem, observations, first.end, solved)
    seen = Explained(replace(first.problem, sights=drawn), first.start, end, explanations)
    if again is None:
        seen = _of_targets(seen, observations, solved, watched, built)
    require_fits(seen.end, seen.problem)
    require_possible(observations, seen.problem.sights, seen.end.solution.estimate, seen.end.residuals)
    return seen


def _of_targets(
    seen: Explained,
    observations: Observations,
    solved: Callable[[Problem, Subproblem], RobustSolution],
    watched: Watched,
    built: Built,
) -> Explained:
    """With targets as they were built, beside the effects that have a prior, at the least of few minima."""
    problem, end, explanations, as_built, beside = seen.problem, seen.end, seen.explanations, seen.as_built, seen.beside
    is_asked = problem.options.as_built == "estimate"
    if is_asked:
        end, problem, explanations, as_built = solve_as_built(problem, observations, end, explanations, solved, built)
    if is_asked and estimated(observations):
        part, is_all = taking_part(problem, observations, explanations), watched.settle is None
        beside = solve_beside_effects(problem, part, observations, end, solves=is_all)
        problem, end = beside.problem, beside.end
    others: tuple[Solution, ...] = ()
    if end.problem.sights.equations == problem.sights.equations:
        least, others = least_of_few(end.problem, end.solution.estimate, seen.start.others)
        if least is not end.solution.estimate:
            end = replace(end.moved_to(least, observations, problem), reduced=None)
    return Explained(problem, seen.start, end, explanations, as_built, beside, others)


def _known(
    seen: Explained, observations: Observations, conflicts: Conflicts, again: Again | None
) -> tuple[Explained, Posterior]:
    """What is known of every number, with what the lens hides and whatever else may be."""
    end, posterior = _assess(seen, observations, again)
    if again is None:
        require_lens_told(end.solution.estimate, posterior)
    known = seen if end is seen.end else replace(seen, end=end)
    if again is None and known.leaves_alike:
        posterior = posterior.widened(*shifts_by_roughness(end, observations))
    return known, with_doubts(posterior, end, conflicts, seen.explanations, seen.others)


def _assess(seen: Explained, observations: Observations, again: Again | None) -> tuple[RobustSolution, Posterior]:
    """What is known of every number, by the observations that took part at the noise that they show.

    Where the observations leave phi so open that their least cost lies at no lens, the estimate is another one.
    """
    end = seen.end
    known = end.problem if again is None else replace(end.problem, layout=again.known)
    estimate = end.solution.estimate
    reduced = end.reduced if again is None else None
    reduced = reduced or information(known, estimate)

    def scatter_at(there: Estimate, says: ReducedInformation) -> Scatter | None:
        at_end = there is estimate
        found = end.residuals if at_end else residuals(observations, known.sights, there, end.residuals.feet)
        return measure_scatter(observations, known, found, there, says)

    freedom = end.inliers.degrees_of_freedom
    assessed, posterior = assess(known, estimate, reduced, freedom, scatter_at, seen.shifts_at)
    return (end if assessed is estimate else end.moved_to(assessed, observations, seen.problem)), posterior


def _start_of(others: Problem, some: Subproblem, start: Start, again: Again | None) -> Estimate:
    """A start for some of the observations that the rest had no part in; the one there is where it was known before."""
    alike = set(others.sights.keys) == set(some.problem.sights.keys)
    if again is not None or not alike or all(key.placement is None for key in others.sights.keys):
        return start.estimate  # that of the world was found with what does not belong among the rest
    return initialise(some.observations, others.sights, others.options).estimate


def _as_long_as_asked(
    problem: Problem,
    observations: Observations,
    start: Start,
    end: RobustSolution,
    progress: Callable[[Progress], None] | None,
) -> tuple[Problem, Start, RobustSolution]:
    """The problem with the lens that the residuals ask for where nothing is stated of its powers, its start and end.

    A lens without a formula has all of its terms where residuals of different views agree from place to place. How
    large their numbers are the data say in any case (`effects/smoothness.py`): they cost time.
    """
    options = problem.options
    if options.powers:
        return problem, start, end
    problem, end = _named(problem), replace(end, problem=_named(end.problem))
    longer = replace(options, terms=tuple(options.blank_lens.more_terms))
    may_grow = bool(options.blank_lens.roughness) and options.coefficients is None and not options.terms
    if may_grow and LeftOver.of_end(end).in_cells > AGREES:
        near = _seen_longer(end.solution.estimate, longer)
        try_of = problem_of(observations, problem.sights, longer, near)
        # quiet: the lens without these terms stays; what it leaves is diagnosed
        found = attempt(lambda: solve_robustly(try_of, observations, near, progress=progress))
        if isinstance(found, RobustSolution) and _shows_all(found):
            problem, end = _named(try_of), replace(found, problem=_named(found.problem))
    return problem, replace(start, estimate=_seen_longer(start.estimate, problem.options)), end


def _named(problem: Problem) -> Problem:
    """The same with the powers of its lens stated."""
    return replace(problem, options=replace(problem.options, powers=problem.options.blank_lens.powers))


def _seen_longer(estimate: Estimate, options: Options) -> Estimate:
    """The estimate with the lens of the options, which holds its own."""
    cameras = dict(estimate.cameras)
    for name, camera in cameras.items():
        lens = make_lens(options.lens, options.blank_lens.powers, camera.lens.coefficients, options.terms)
        # Its own span is set, and nothing else is asked for.
        cameras[name] = replace(camera, lens=lens.spanning(0.0, camera.phi, 1.0, camera.image_size))
    return replace(estimate, cameras=cameras)


def _shows_all(end: RobustSolution) -> bool:
    """Whether no lens folds inside what was observed."""
    sights = end.problem.sights
    cameras = end.solution.estimate.cameras.items()
    return all(all_shown(camera, sights.of_camera(name).about(camera)) for name, camera in cameras)
