"""Calibrate from a start with a named lens: solve, reject, compare explanations, solve for targets as built, assess."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from ceres_cal.base import Array, Frozen, Mask, attempt, cached_property, meanwhile, replace
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.outcome import (
    aspects_alone,
    came_out,
    of_all,
    other_ways_round,
    remarks_of,
    require_lens_told,
    unknown_phi,
    unusual_pixels,
)
from ceres_cal.effects.dependence import Scatter, measure_scatter
from ceres_cal.effects.effect import AsBuilt, EffectEstimate, ShiftsAt
from ceres_cal.effects.table import estimated
from ceres_cal.observations.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.posterior.assess import assess, with_doubts
from ceres_cal.posterior.other_lenses import AGREES, LensResiduals, of_placements, shifts_by_roughness
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem.bundle import Solution, SolveProgress
from ceres_cal.problem.information import Key, over
from ceres_cal.problem.parameters import Estimate, Layout, Options, as_held, make_layout
from ceres_cal.problem.priors import stated_priors
from ceres_cal.problem.problem import Problem, problem_of
from ceres_cal.problem.quantities import difference, moved
from ceres_cal.problem.reduced import ReducedInformation, information
from ceres_cal.problem.residuals import residuals
from ceres_cal.robust.as_built import (
    AS_DRAWN,
    Construction,
    require_measured,
    shifts_as_drawn,
    solve_as_built,
    solve_held,
    taking_part,
    tolerances_of,
)
from ceres_cal.robust.competing import Solver, Subproblem, compete
from ceres_cal.robust.other_minima import least_of_few, seen_alike
from ceres_cal.robust.robust import RobustSolution, solve_robustly
from ceres_cal.robust.stated import Conflicts, statements
from ceres_cal.robust.unsteady import ViewDisplacement, find_unsteady
from ceres_cal.robust.usable import lost_sights, misnamed, require_fits, require_possible, require_usable, shows_all
from ceres_cal.scene.lens import make_lens
from ceres_cal.start.initialise import Start, initialise

if TYPE_CHECKING:
    from concurrent.futures import Future

    from ceres_cal.effects.aside import Explanation
    from ceres_cal.robust.bulk import BulkSolution
    from ceres_cal.robust.effects import EffectsEnd


class Task(Frozen):
    """Settings of a solve: its steps, its callbacks, and prior results.

    Attributes:
        progress: called at each iteration. settle: where the observations are a subset, solves for all of them from the
            end of the subset, see `Bulk.settled`.
        tested: whether each statement is tested against everything else. knows: whether groups are tested for being
            outliers as a whole, and the posterior is made; bends: whether the posterior includes curvature. chosen:
            whether the data chose the lens: what too simple a lens leaves looks like a moving principal point.
        before: in a refit, the layout of all numbers that a posterior knows, including those that the solve holds.
            scales: noise scales of points and curves from an earlier calibration.
    """

    progress: SolveProgress | None = None
    settle: Callable[..., BulkSolution] | None = None
    tested: bool = True
    knows: bool = True
    bends: bool = True
    chosen: bool = False
    before: Layout | None = None
    scales: tuple[float, float] | None = None
    stated: tuple[Observations, Options] | None = None


class TaskSolution(Frozen):
    """The solution of a task, and what explains the observations that it does not fit.

    Attributes:
        explanations: other explanations of groups of observations. as_built: how targets were built.
        beside: effects of the table that were solved for. others: further minima.
        unsteady: displacements of single views. digest: of the observations, which cache it; computed in a thread.
    """

    task: Task
    problem: Problem
    start: Start
    end: RobustSolution
    explanations: tuple[Explanation, ...] = ()
    as_built: tuple[AsBuilt, ...] = ()
    beside: EffectsEnd | None = None
    others: tuple[Solution, ...] = ()
    unsteady: ViewDisplacement | None = None
    digest: Future[str] | None = None

    @cached_property
    def leaving_alike(self) -> tuple[str, ...]:
        """Cameras whose lens leaves similar residuals in one place of all views; of placements if it has a formula."""
        return tuple(filter(self._leaves_alike, self.end.estimate.cameras))

    def _leaves_alike(self, camera: str) -> bool:
        problem = self.end.problem
        every = problem.sights.of_camera(camera)
        asked = every if problem.options.of_camera(camera).is_rough else of_placements(every)
        return bool(len(asked)) and LensResiduals.of_end(self.end, asked).asks_for_more

    @property
    def outlier_masks(self) -> tuple[Mask, Mask]:
        """See `Calibration.outlier_masks`, without those that agree with any lens by chance."""
        inliers, by_chance = self.end.inliers, self.end.by_chance
        if by_chance is None or inliers.rows.all():
            return ~inliers.points, ~inliers.curves
        points, curves = self.came_out.outlier_masks(self.problem.observations)
        return points & ~by_chance[: len(points)], curves & ~by_chance[len(points) :]

    @property
    def scales(self) -> tuple[float, float]:
        """Noise scales of points and curves."""
        return self.end.problem.weighting.scales

    @property
    def came_out(self) -> Calibration:
        """The calibration, without a posterior."""
        if self.digest is not None:
            self.digest.result()
        return came_out(self.start.phi_from, self.problem, self.end, self.explanations)

    @property
    def effects(self) -> tuple[EffectEstimate, ...]:
        """Effects that were solved for beside the problem."""
        moving = self.unsteady.estimates(self.problem.observations) if self.unsteady else ()
        return (*moving, *(self.beside.estimates if self.beside else ()))

    @property
    def shifts_at(self) -> ShiftsAt | None:
        """Returns further contributions to the covariance, as shifts of numbers; None where there are none."""
        beside, anywhere = self.beside, [shifts_as_drawn(self.as_built, self.end)]
        if self.unsteady is not None:
            anywhere.append((self.unsteady.keys, [*self.unsteady.shifts]))
        if beside is None and not any(shifts for _, shifts in anywhere):
            return None
        here = self.problem if self.task.stated else None

        def shifts_at(there: Estimate, other: Problem | None) -> tuple[Sequence[Key], Sequence[Array]]:
            every = [*([beside.shifts_at(there, other or here)] if beside else []), *anywhere]
            keys = tuple(dict.fromkeys(key for own, _ in every for key in own))
            return keys, [over(shift, own, keys) for own, shifts in every for shift in shifts]

        return shifts_at

    @property
    def as_stated(self) -> TaskSolution:
        """The solution with everything as it was stated, starting where statements had little weight."""
        if self.task.stated is None:
            return self
        (observations, options), here = self.task.stated, self.end.estimate
        lenses = {name: camera.lens for name, camera in here.cameras.items()}
        loose = stated_priors(self.problem.observations, self.problem.options, lenses).values()
        known = {key for prior in loose for key in prior.keys}
        others = [prior for prior in (one.without(known) for one in self.problem.priors) if prior.keys]
        stated = {name: getattr(options, name) for name in ("priors", "fixed", "free_principal_point", "free_aspect")}
        options = replace(self.problem.options, **stated)
        every = stated_priors(observations, options, lenses).values()
        sights = replace(self.problem.sights, observations=observations)
        layout = make_layout(observations, options)
        problem = replace(self.problem, sights=sights, layout=layout, options=options, priors=(*every, *others))
        part, elsewhere = taking_part(problem, self.explanations), [as_held(one, options) for one in self.start.others]
        start, is_near = as_held(here, options), layout.size == self.problem.layout.size
        if not is_near:  # the start was moved to held numbers; another minimum may have been the least without them
            start, _ = least_of_few(part, start, elsewhere, is_whole=part is problem)
        solver = partial(solve_robustly, usual=self.task.scales, progress=self.task.progress, is_near=is_near)
        end = solve_held(solver, part, start, self.as_built)
        if part is not problem:
            end = replace(end, residuals=residuals(sights, end.estimate))
        phi_from = dict.fromkeys(self.start.phi_from, "fixed") if "phi" in options.fixed else self.start.phi_from
        begun = replace(self.start, phi_from=phi_from, others=tuple(elsewhere))
        return replace(self, problem=problem, start=begun, end=end).at_least

    @property
    def at_least(self) -> TaskSolution:
        """The solution in the least of few minima."""
        end = self.end
        is_whole = end.problem.sights.equations == self.problem.sights.equations
        least, others = least_of_few(end.problem, end.estimate, self.start.others, is_whole=is_whole)
        if least is not end.estimate:
            end = replace(end.moved_to(least, self.problem), reduced=None)
        return replace(self, end=end, others=others)

    def doubted_as(self, before: TaskSolution) -> TaskSolution:
        """Return a copy in which the less probable of two explanations is as far off as before all was stated."""
        if before.task.stated is None:
            return self
        there, here, keys = before.end.estimate, self.end.estimate, self.end.information.shared.keys

        def other(one: Explanation) -> Estimate:
            return moved(here, keys, difference(one.other, there, keys))

        doubted = (replace(one, other=other(one)) if one.is_doubtful else one for one in self.explanations)
        return replace(self, explanations=tuple(doubted))

    def without(self, conflicts: Conflicts) -> TaskSolution:
        """Return the solution without the statements that everything else contradicts."""
        if conflicts.answer is None:
            return self
        problem = replace(self.problem, priors=conflicts.answer.problem.priors)
        shown = residuals(problem.sights, conflicts.answer.estimate)
        return replace(self, problem=problem, end=replace(conflicts.answer, residuals=shown), others=())


def solved_from(task: Task, start: Start, problem: Problem) -> Calibration:
    """Solve from a start, explain what is left, set aside contradicted statements, and assess.

    Raises:
        CalibrationError: see `calibrate`.
    """
    return known_of(explained(task, start, problem, AS_DRAWN))


def explained(task: Task, start: Start, problem: Problem, built: Construction) -> TaskSolution:
    """Solve and explain the residuals; see `solved_from`."""
    long_to_digest = 20_000  # observations: fewer take less time than a thread and what it needs
    takes_long = problem.observations.rows > long_to_digest
    digest = meanwhile(lambda: problem.observations.digest) if takes_long and task.settle is None else None
    seen, may_move = _solved(task, start, problem, built), task.chosen and not task.settle
    steady = _made_steady(seen, problem) if may_move else None
    if steady is None:
        seen = _explained(seen, problem.sights, built)
        may_move = may_move and bool(seen.explanations or seen.as_built)
        steady = _made_steady(seen, problem) if may_move else None
    return replace(steady or seen, digest=digest)


def known_of(seen: TaskSolution) -> Calibration:
    """Set aside contradicted statements, and assess; see `solved_from`."""
    task, conflicts = seen.task, Conflicts()
    before, seen = seen, seen.as_stated
    near = before.end if task.stated else None
    every = tuple(statements(seen.problem, seen.end.estimate)) if task.tested else ()
    if every:
        from ceres_cal.robust.conflicts import find_conflicts

        part = None if task.before is not None else taking_part(seen.problem, seen.explanations)
        solver = partial(solve_held, partial(solve_robustly, usual=task.scales), every=seen.as_built)
        conflicts = find_conflicts(every, seen.problem, seen.end, solver, part, seen.shifts_at, near)
    seen = seen.without(conflicts).doubted_as(before)
    settled = None
    if task.settle is not None:
        settled = task.settle(seen.problem, seen.end, seen.explanations, task.progress)
        seen = replace(seen, end=settled.end)
    explanations = settled.explanations if settled else seen.explanations
    effects, of_targets = seen.effects, misnamed(seen.as_built, seen.problem.observations.targets)
    solved_for = (one.warning for one in effects if one.is_solved)
    warnings = (*(one.warning for one in explanations), *solved_for, *of_targets)
    groups = [one.rows for one in seen.explanations if one.is_taken]
    lost = [*lost_sights(seen.end.inliers, seen.problem, groups)]
    posterior, alike, alone, remarks = None, dict[str, bool](), dict[str, tuple[float, float]](), tuple[str, ...]()
    if task.tested and task.knows:
        seen, posterior = _known(seen, conflicts)
        of_world = seen.problem.sights.of_world
        alike = dict(seen_alike(seen.others, seen.end.estimate, of_world, posterior.half_width))
        alone = aspects_alone(seen.end, seen.problem, posterior)
        strange = (
            *unusual_pixels(seen.end, seen.problem, alone),
            *other_ways_round(seen.end, seen.problem, [one.key.placement for one in lost]),
        )
        warnings = (*warnings, *conflicts.words, *unknown_phi(seen.end, posterior), *strange, *alike)
        remarks = tuple(remarks_of(seen.end, seen.problem, posterior))
    calibration = seen.came_out
    if settled is not None:
        calibration = of_all(calibration, settled)
    usable = require_usable(seen.end, is_refit=task.before is not None)
    warnings = (*calibration.warnings, *usable, *(one.words for one in lost if not one.is_alone), *warnings)
    remarks = (*remarks, *(one.words for one in lost if one.is_alone))
    calibration = replace(calibration, warnings=warnings, posterior=posterior, conflicts=conflicts.every)
    apart = tuple(text for text, is_apart in alike.items() if is_apart)
    calibration = replace(calibration, remarks=(*calibration.remarks, *remarks), ambiguities=apart)
    tolerances = {**seen.problem.options.tolerances, **tolerances_of(seen.as_built)}
    options = replace(seen.problem.options, tolerances=tolerances)
    return replace(calibration, options=options, as_built=seen.as_built, effects=effects, aspects_alone=alone)


def _made_steady(first: TaskSolution, problem: Problem) -> TaskSolution | None:
    """Subtract displacements of single views and solve, twice, with those found last; None where there are none.

    They are sought before groups are tested for being outliers, because they displace groups, and again afterwards,
    because in few views the target as built hides them. The lens keeps its length: a lens that grew beside them
    predicted other views of a stabilised camera worse by a seventh, and halves with a rolling shutter took a minute
    each. After convergence predictions follow the noise: halves differ by 1.7 of what is stated, after two rounds by
    1.4.
    """
    twice = 2
    task, seen, unsteady = first.task, first, None
    for _ in range(twice):
        unsteady = find_unsteady(seen.problem, seen.end, unsteady)
        if unsteady is None:  # what seemed to move was due to the lens or the target
            return None
        start = replace(seen.end.estimate, structure=first.start.estimate.structure)
        named = first.problem.options
        options = problem.options.with_lenses({name: named.of_camera(name) for name in problem.layout.free})
        again = problem_of(problem.sights, options, start)
        steady = unsteady.taken_off(again)
        end = solve_robustly(steady, start, None, task.progress, is_near=True)
        solved = TaskSolution(task, steady, replace(first.start, estimate=start, is_near=True), end)
        seen = _explained(replace(solved, unsteady=unsteady), steady.sights, AS_DRAWN)
    return seen


def _solved(task: Task, start: Start, problem: Problem, built: Construction) -> TaskSolution:
    """Solve, reject outliers, solve again. Residuals are not yet explained; targets are as `built`."""
    problem = replace(problem, sights=built.held(problem.sights))
    end = solve_robustly(problem, start.estimate, task.scales, task.progress, is_near=start.is_near)
    seen = TaskSolution(task, problem, start, end)
    if task.before is None:
        seen = _as_long_as_asked(seen)
        require_measured(seen.end.problem, seen.end.estimate)
    return seen


def _explained(first: TaskSolution, drawn: Sights, built: Construction) -> TaskSolution:
    """Compare explanations of groups; solve for targets as built, where they differ from drawings, and for effects."""
    task = first.task

    def solved(others: Problem, some: Subproblem) -> RobustSolution:
        return solve_robustly(others, _start_of(others, some, first), task.scales)

    # These solves start with lenses about as smooth as the data say; the problem that is returned leaves that open.
    smooth = replace(first.problem, smoothness=first.end.problem.smoothness)
    end, explanations = compete(smooth, first.end, solved) if task.knows else (first.end, ())
    seen = replace(first, problem=replace(smooth, sights=drawn), end=end, explanations=explanations)
    if task.before is None:
        seen = _of_targets(seen, solved, built)
    require_fits(seen.end, seen.problem)
    require_possible(seen.problem.sights, seen.end.estimate, seen.end.residuals)
    return replace(seen, problem=replace(seen.problem, smoothness={}))


def _of_targets(seen: TaskSolution, solved: Solver, built: Construction) -> TaskSolution:
    """Solve for targets as built, beside effects that have a prior, in the least of few minima."""
    problem, end, explanations, as_built, beside = seen.problem, seen.end, seen.explanations, seen.as_built, seen.beside
    is_asked, views = problem.options.as_built == "estimate", seen.unsteady.of_views if seen.unsteady else None
    if is_asked:
        end, problem, explanations, as_built = solve_as_built(problem, end, explanations, solved, built, views)
    if is_asked and estimated(problem.observations):
        from ceres_cal.robust.effects import solve_beside_effects

        part, is_all = taking_part(problem, explanations), seen.task.settle is None
        beside = solve_beside_effects(problem, part, end, solves=is_all)
        problem, end = beside.problem, beside.end
    now = replace(seen, problem=problem, end=end, explanations=explanations, as_built=as_built, beside=beside)
    return now.at_least


def _known(seen: TaskSolution, conflicts: Conflicts) -> tuple[TaskSolution, Posterior]:
    """Return the posterior of every number, widened by what the lens hides, with all other possibilities included."""
    end, posterior = _assess(seen)
    is_new = seen.task.before is None
    if is_new:
        require_lens_told(end.estimate, posterior)
    known = seen if end is seen.end else replace(seen, end=end)
    if is_new and known.leaving_alike:
        posterior = posterior.widened(*shifts_by_roughness(end, known.leaving_alike))
    return known, with_doubts(posterior, end, conflicts, seen.explanations, seen.others)


def _assess(seen: TaskSolution) -> tuple[RobustSolution, Posterior]:
    """Return the posterior by the observations that took part, at their estimated noise, and the solution.

    Where the observations leave phi so open that the least cost is at no valid lens, the estimate is another one.
    """
    end, before = seen.end, seen.task.before
    known = end.problem if before is None else replace(end.problem, layout=before)
    estimate = end.estimate
    reduced = end.information if before is None else information(known, estimate)

    def scatter_at(there: Estimate, says: ReducedInformation) -> Scatter | None:
        at_end = there is estimate
        found = end.residuals if at_end else residuals(known.sights, there, end.residuals.feet)
        return measure_scatter(known, found, there, says)

    freedom = end.inliers.degrees_of_freedom
    assessed, posterior = assess(known, estimate, reduced, freedom, scatter_at, seen.shifts_at, bends=seen.task.bends)
    return (end if assessed is estimate else end.moved_to(assessed, seen.problem)), posterior


def _start_of(others: Problem, some: Subproblem, first: TaskSolution) -> Estimate:
    """Return a start independent of the other observations; in a refit and for the world it is the first start."""
    alike = set(others.sights.keys) == set(some.problem.sights.keys)
    if first.task.before is not None or not alike or all(key.placement is None for key in others.sights.keys):
        return first.start.estimate  # that of the world was found with outliers among the observations
    return initialise(others.sights, others.options).estimate


def _as_long_as_asked(seen: TaskSolution) -> TaskSolution:
    """Solve with the lenses that the residuals require, where the options leave the powers open.

    A lens without a formula gets all of its terms where residuals of different views agree from place to place. The
    sizes of their numbers are estimated in any case (`effects/smoothness.py`), but they cost time.
    """
    each = {name: seen.problem.options.of_camera(name) for name in seen.problem.layout.free}
    if all(one.powers for one in each.values()):
        return seen
    problem, end = _named(seen.problem), replace(seen.end, problem=_named(seen.end.problem))

    def grown(name: str, one: Options) -> Options:
        may_grow = not one.powers and one.is_rough and one.coefficients is None and not one.terms
        if may_grow and LensResiduals.of_end(end, end.problem.sights.of_camera(name)).in_cells > AGREES:
            return replace(one, terms=tuple(one.blank_lens.more_terms))
        return one

    longer = seen.problem.options.with_lenses({name: grown(name, one) for name, one in each.items()})
    if longer != seen.problem.options:
        near = _seen_longer(end.estimate, longer)
        try_of = problem_of(problem.sights, longer, near)
        # quiet: the lens without these terms stays; what it leaves is diagnosed
        found = attempt(lambda: solve_robustly(try_of, near, progress=seen.task.progress))
        if isinstance(found, RobustSolution) and shows_all(found):
            problem, end = _named(try_of), replace(found, problem=_named(found.problem))
    start = replace(seen.start, estimate=_seen_longer(seen.start.estimate, problem.options))
    return replace(seen, problem=problem, start=start, end=end)


def _named(problem: Problem) -> Problem:
    """Return the problem with the powers of its lenses stated."""
    each = {name: problem.options.of_camera(name) for name in problem.layout.free}
    named = {name: replace(one, powers=one.blank_lens.powers or one.powers) for name, one in each.items()}
    return replace(problem, options=problem.options.with_lenses(named))


def _seen_longer(estimate: Estimate, options: Options) -> Estimate:
    """Return the estimate with the lenses of the options, which contain its own."""
    cameras = dict(estimate.cameras)
    for name, camera in cameras.items():
        one = options.of_camera(name)
        lens = make_lens(one.lens, one.blank_lens.powers, camera.lens.coefficients, one.terms)
        # This only sets the lens's own span.
        cameras[name] = replace(camera, lens=lens.spanning(0.0, camera.phi, 1.0, camera.image_size))
    return replace(estimate, cameras=cameras)
