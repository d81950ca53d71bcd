"""The steps: choose a lens (where that is asked for), initialise, solve, reject, solve, compete, as built, assess."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ceres_cal.base.errors import CalibrationError, DegenerateError, SolutionError
from ceres_cal.base.numerical import numerical
from ceres_cal.base.threads import at_most, meanwhile, single_threaded_blas
from ceres_cal.base.typed import checked
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.lens_seen import profiles_of, seen_through
from ceres_cal.calibration.outcome import (
    came_out,
    of_all,
    of_closed_form,
    require_lens_told,
    resting_phi,
    unknown_phi,
)
from ceres_cal.effects.dependence import Scatter, measure_scatter
from ceres_cal.effects.effect import AsBuilt
from ceres_cal.effects.table import estimated
from ceres_cal.observations import Observations
from ceres_cal.observations.bounds import unfilled
from ceres_cal.observations.sights import Sights, gather_sights
from ceres_cal.observations.thinning import is_bulk
from ceres_cal.posterior.assess import assess, with_doubts, with_other_lenses, with_roughness
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem.bundle import Progress, Solution
from ceres_cal.problem.parameters import AUTO, Estimate, Layout, Options, Station
from ceres_cal.problem.priors import gather_priors
from ceres_cal.problem.problem import Problem, problem_of
from ceres_cal.problem.ranges import require_possible_numbers
from ceres_cal.problem.reduced import ReducedInformation, information
from ceres_cal.problem.residuals import residuals
from ceres_cal.problem.structure import EXACT, make_structure
from ceres_cal.robust.as_built import free_dimensions, require_measured, solve_as_built, taking_part, tolerances_of
from ceres_cal.robust.competing import compete
from ceres_cal.robust.conflicts import Conflicts, contradicted_by, find_conflicts
from ceres_cal.robust.groups import Subproblem
from ceres_cal.robust.other_minima import least_of_few, seen_alike
from ceres_cal.robust.robust import RobustSolution, solve_robustly
from ceres_cal.robust.usable import require_fits, require_possible, require_usable
from ceres_cal.scene.camera import Camera
from ceres_cal.start.initialise import Start, initialise

if TYPE_CHECKING:
    from ceres_cal.calibration.lens_choice import Chosen
    from ceres_cal.robust.bulk import Bulk, Settled, Subset


_OTHERWISE = (
    "no calibration agrees with what was stated beforehand, though the observations make one without it: check the "
    "priors and their units"
)


@checked
@numerical("the calibration")
def calibrate(
    observations: Observations,
    options: Options | None = None,
    progress: Callable[[Progress], None] | None = None,
    *,
    client: Any = None,
) -> Calibration:
    """Calibrate every camera, station and placement that the observations show.

    Of very many observations of the world a part decides the lens, what does not belong and which statements are in
    conflict; all of them are judged and solved for, in shares (docs/scale.md).

    Args:
        progress: called at every iteration of every solve, from this thread.
        client: a `distributed.Client` whose workers keep the shares, however many observations there are.

    Raises:
        DegenerateError: the observations cannot determine the unknowns; the message names the frame or the numbers.
        SolutionError: no usable camera came out.
        InputError: a prior or a fixed number that the camera does not have; pixels outside their image.
    """
    options = options or Options()
    require_possible_numbers(observations, options)
    observations, options = free_dimensions(observations, options)
    with single_threaded_blas(), at_most(options.threads):
        try:
            return _measured(observations, options, progress, client)
        except (DegenerateError, SolutionError) as error:
            if odd := next(unfilled(observations), None):
                raise type(error)(f"{error}; {odd}") from None
            free = _without_priors(observations, options)
            if free is None:
                raise
            words = _contradicted(observations, options, free)
            raise SolutionError(words or _OTHERWISE) from None


def calibrate_near(camera: Camera, observations: Observations, options: Options) -> Calibration:
    """Calibrate the one camera that the observations show, with a lens by its name, from about where it is known to be.

    Raises:
        CalibrationError: see `calibrate`.
    """
    observations, options = free_dimensions(observations, options)
    sights, (name,), (station,) = gather_sights(observations), observations.cameras, observations.stations
    structure = make_structure(observations.targets, options.tolerances, options.dimensions)
    there = Estimate({name: camera}, {station: Station(name, camera.cam_from_world)}, {}, structure)
    start = Start(seen_through(there, options, profiles_of(there, sights)), {name: "prior"})
    with single_threaded_blas(), at_most(options.threads):
        return _of_lens(start, observations, sights, options, Watched(bends=False)).redrawn()


def _measured(
    observations: Observations, options: Options, progress: Callable[[Progress], None] | None, client: Any
) -> Calibration:
    """With targets drawn as long as they were found to be; from there again where that is not how they were drawn."""
    # Share of a dimension by which it may come out another than drawn without a second solve from there, whose start
    # and outliers are those of the right drawing; and how many there may be.
    redrawn, most_drawings = 0.005, 4
    for _ in range(most_drawings):
        calibration = _calibrated(observations, options, progress, client)
        before = calibration.estimate.structure
        calibration = calibration.redrawn()
        moved = calibration.estimate.structure.drawn_m / before.drawn_m - 1.0
        if float(np.max(np.abs(moved), initial=0.0)) < redrawn:
            break
        observations = calibration.drawn_alike(observations)
    return calibration


def _calibrated(
    observations: Observations, options: Options, progress: Callable[[Progress], None] | None = None, client: Any = None
) -> Calibration:
    """See `calibrate`."""
    observations.require_inside()
    if options.closed_form_only or not (client is not None or is_bulk(observations)):
        return _chosen(observations, options, Watched(progress))
    from ceres_cal.robust.bulk import Bulk

    digest, bulk = meanwhile(lambda: observations.digest), Bulk(observations, client)
    try:
        part = _part(bulk, options)
        calibration = _chosen(part.observations, options, Watched(progress, partial(bulk.settled, part)))
    finally:
        bulk.close()
    return replace(calibration, digest=digest.result())


def _chosen(observations: Observations, options: Options, watched: Watched) -> Calibration:
    """With the lens that is named, or the one that is chosen."""
    sights = gather_sights(observations)
    if options.lens == AUTO:
        return _of_any_lens(observations, sights, options, watched)
    return _of_lens(initialise(observations, sights, options), observations, sights, options, watched)


def _of_any_lens(observations: Observations, sights: Sights, options: Options, watched: Watched) -> Calibration:
    """With the lens that the data ask for."""
    from ceres_cal.calibration.lens_choice import choose_lens
    from ceres_cal.calibration.lens_forms import papers

    start = initialise(observations, sights, papers(options))
    if options.closed_form_only:
        return _of_lens(start, observations, sights, papers(options), watched)

    def solved(one: Chosen) -> Calibration:
        named = replace(one.options, priors=options.priors)  # which lenses were compared without
        return _of_lens(one.start, observations, sights, named, watched)

    chosen = choose_lens(observations, options, start)
    calibration, chosen = chosen.first_solved(solved, papers(options), start)
    if calibration.as_built:
        # Seen on targets as they are built lenses differ by more than on targets as drawn: by the noise alone.
        near = replace(calibration.estimate, structure=EXACT)
        before, anew = chosen, replace(start, estimate=near)
        chosen = choose_lens(observations, options, anew, calibration.estimate.structure)
        if chosen.choice.chosen != before.choice.chosen:
            calibration, chosen = chosen.first_solved(solved, papers(options), start)
    said = []
    try:
        while other := chosen.instead(*calibration.outlier_masks(observations)):
            calibration, chosen = solved(other), other
    except CalibrationError as error:
        # reads: "another lens explains observations that were taken out, but makes no calibration of all: ..."
        said.append(f"another lens explains observations that were taken out, but makes no calibration of all: {error}")
    if calibration.posterior is not None and (others := chosen.others) is not None:
        wider = with_other_lenses(calibration.posterior, calibration.estimate, others)
        calibration = replace(calibration, posterior=wider)
        if others.failed:
            without = "the standard deviations do not include what they would say"
            said.append(f"other lenses could not be compared, so {without}: {others.failed}")
    warnings = (*calibration.warnings, *filter(None, [chosen.choice.caveat]), *said)
    return replace(calibration, lens_choice=chosen.choice, warnings=warnings)


def _part(bulk: Bulk, options: Options) -> Subset:
    """The part that decides: of the world some views, with those that stand out at a first solution of others."""
    from ceres_cal.calibration.lens_forms import papers

    part, given = bulk.part(), options if options.lens != AUTO else papers(options)
    few, sights = part.observations, gather_sights(part.observations)
    start = initialise(few, sights, given)
    problem = problem_of(few, sights, given, start.estimate)
    return bulk.part(bulk.standing_out(solve_robustly(problem, few, start.estimate, is_near=start.is_near)))


def _of_lens(
    start: Start, observations: Observations, sights: Sights, options: Options, watched: Watched
) -> Calibration:
    """With a lens that is named."""
    options = options.with_first_power(len(sights))
    problem = problem_of(observations, sights, options, start.estimate)
    if options.closed_form_only:
        return of_closed_form(start, observations, problem)
    return solved_from(start, observations, problem, watched=watched)


def _without_priors(observations: Observations, options: Options) -> Calibration | None:
    """None where nothing was stated, or the observations make no calibration by themselves either."""
    if not (observations.priors or options.priors):
        return None
    try:
        return _calibrated(replace(observations, priors=()), replace(options, priors=()))
    except CalibrationError:  # quiet: the caller raises the first failure
        return None


def _contradicted(observations: Observations, options: Options, free: Calibration) -> str | None:
    """What the priors that no calibration came out of contradict, when one comes out without them."""
    stated = gather_priors(observations, replace(free.options, priors=options.priors), free.estimate.structure)
    posterior = free.uncertainty.posterior
    return contradicted_by(stated, free.estimate, posterior.information, posterior.degrees_of_freedom)


@dataclass(frozen=True)
class Again:
    """How a calibration is taken up again after an earlier one.

    Attributes:
        known: the layout of everything that is known by a posterior, also where the solve holds it.
        scales: noise scales of points and curves that were seen before; None for those of these observations alone.
        assessed: whether the posterior is wanted.
    """

    known: Layout
    scales: tuple[float, float] | None
    assessed: bool = True


@dataclass(frozen=True, eq=False)
class Watched:
    """Who is told of the solves, and what solves for all observations where these are a part.

    Attributes:
        progress: called at every iteration. settle: from the end of the part, see `Bulk.settled`.
        bends: whether it matters how the uncertainty bends.
    """

    progress: Callable[[Progress], None] | None = None
    settle: Callable[..., Settled] | None = None
    bends: bool = True


def solved_from(
    start: Start, observations: Observations, problem: Problem, again: Again | None = None, watched: Watched = Watched()
) -> Calibration:
    """Solve, reject, solve, let explanations compete, solve for targets as built, assess, from a start.

    Raises:
        CalibrationError: see `calibrate`.
    """
    long_to_digest = 20_000  # observations: fewer take less than a thread, and what makes one
    takes_long = len(observations.points) + len(observations.curves) > long_to_digest
    digest = meanwhile(lambda: observations.digest) if takes_long and watched.settle is None else None
    usual = again.scales if again else None
    end = solve_robustly(problem, observations, start.estimate, usual, watched.progress, is_near=start.is_near)
    if again is None:
        problem, start, end = _as_long_as_asked(problem, observations, start, end, watched)
        require_measured(end.problem, end.solution.estimate)

    def solved(others: Problem, some: Subproblem) -> RobustSolution:
        return solve_robustly(others, some.observations, _start_of(others, some, start, again), usual)

    end, explanations = compete(problem, observations, end, solved)
    as_built: tuple[AsBuilt, ...] = ()
    if again is None and problem.options.as_built == "estimate":
        end, problem, explanations, as_built = solve_as_built(problem, observations, end, explanations, solved)
    beside = None
    if again is None and watched.settle is None and estimated():
        from ceres_cal.robust.effects import solve_beside_effects

        beside = solve_beside_effects(problem, taking_part(problem, observations, explanations), observations, end)
        problem, end = beside.problem, beside.end
    others: tuple[Solution, ...] = ()
    if again is None and end.problem.sights.equations == problem.sights.equations:
        least, others = least_of_few(end.problem, end.solution.estimate, start.others)
        if least is not end.solution.estimate:
            end = replace(end.moved_to(least, observations, problem), reduced=None)
    require_fits(end, problem)
    require_possible(observations, problem.sights, end.solution.estimate, end.residuals)
    posterior, conflicts, settled = None, Conflicts(), None
    assessed = again is None or again.assessed
    if assessed:
        part = taking_part(problem, observations, explanations) if again is None else None
        conflicts = find_conflicts(problem, observations, end, usual, part)
    if conflicts.answer is not None:
        problem = replace(problem, priors=conflicts.answer.problem.priors)
        shown = residuals(observations, problem.sights, conflicts.answer.solution.estimate)
        end, others = replace(conflicts.answer, residuals=shown), ()
    if watched.settle is not None:
        settled = watched.settle(problem, end, explanations, watched.progress)
        end = settled.end
    warnings = tuple(one.warning for one in (settled.explanations if settled else explanations))
    effects = beside.estimates if beside else ()
    warnings = (*warnings, *(one.warning for one in effects))
    if assessed:
        end, posterior = _assess(end, observations, problem, again, watched.bends)
        if again is None:
            require_lens_told(end.solution.estimate, posterior)
        posterior = posterior.widened(beside.keys, beside.shifts) if beside else posterior
        posterior = with_roughness(posterior, end, observations) if again is None else posterior
        posterior = with_doubts(posterior, end, conflicts, explanations, others)
        warnings = (*warnings, *conflicts.words, *unknown_phi(end, posterior))
        warnings = (
            *warnings,
            *resting_phi(end, problem),
            *seen_alike(others, end.solution.estimate, posterior.half_width),
        )
    if digest is not None:
        digest.result()  # which the observations remember
    calibration = came_out(start.phi_from, observations, problem, end, explanations)
    if settled is not None:
        calibration = of_all(calibration, settled)
    wholes = [one.rows for one in explanations if one.is_taken]
    warnings = (*calibration.warnings, *require_usable(end, problem, wholes), *warnings)
    calibration = replace(calibration, warnings=warnings, posterior=posterior, conflicts=conflicts.every)
    tolerances = {**problem.options.tolerances, **tolerances_of(as_built)}
    options = replace(problem.options, tolerances=tolerances)
    return replace(calibration, options=options, as_built=as_built, effects=effects)


def _as_long_as_asked(
    problem: Problem, observations: Observations, start: Start, end: RobustSolution, watched: Watched
) -> tuple[Problem, Start, RobustSolution]:
    """With a lens whose powers were left open as long as the residuals ask for."""
    if problem.options.powers:
        return problem, start, end
    from ceres_cal.calibration.lens_growing import grown

    return grown(problem, observations, start, end, watched.progress)


def _assess(
    end: RobustSolution, observations: Observations, problem: Problem, again: Again | None, bends: bool
) -> tuple[RobustSolution, Posterior]:
    """What is known of every number, by the observations that took part at the noise that they show.

    Where the observations leave phi so open that their least cost lies at no lens, the estimate is another one.
    """
    known = end.problem if again is None else replace(end.problem, layout=again.known)
    estimate = end.solution.estimate
    reduced = end.reduced if again is None else None
    reduced = reduced or information(known, estimate)

    def scatter_at(there: Estimate, says: ReducedInformation) -> Scatter | None:
        at_end = there is estimate
        found = end.residuals if at_end else residuals(observations, known.sights, there, end.residuals.feet)
        return measure_scatter(observations, known, found, there, says)

    freedom = end.inliers.degrees_of_freedom
    assessed, posterior = assess(known, estimate, reduced, freedom, scatter_at, bends=bends)
    return (end if assessed is estimate else end.moved_to(assessed, observations, problem)), posterior


def _start_of(others: Problem, some: Subproblem, start: Start, again: Again | None) -> Estimate:
    """A start for some of the observations that the rest had no part in; the one there is where it was known before."""
    alike = set(others.sights.keys) == set(some.problem.sights.keys)
    if again is not None or not alike or all(key.placement is None for key in others.sights.keys):
        return start.estimate  # that of the world was found with what does not belong among the rest
    return initialise(some.observations, others.sights, others.options).estimate
