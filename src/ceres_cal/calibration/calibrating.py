"""Calibrate from observations: choose a lens where that is asked for, initialise, and solve (`solving`)."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any

import numpy as np

from ceres_cal.base import at_most, checked, counted, for_small_matrices, meanwhile, numerical, replace
from ceres_cal.base.errors import CalibrationError, DegenerateError, InputError, SolutionError, attempt, or_none
from ceres_cal.calibration import Calibration, LensChoice
from ceres_cal.calibration.outcome import of_closed_form
from ceres_cal.calibration.solving import Task, TaskSolution, explained, known_of, solved_from
from ceres_cal.observations import Observations, Sights, gather_sights, is_bulk
from ceres_cal.observations.validation import odd_sizes, require_filled, unfilled
from ceres_cal.posterior.assess import with_other_lenses
from ceres_cal.problem import (
    EXACT,
    SolveProgress,
    gather_priors,
    make_structure,
    problem_of,
    require_possible_numbers,
)
from ceres_cal.problem.parameters import AUTO, Estimate, Options, Station
from ceres_cal.problem.priors import freed, loosely
from ceres_cal.problem.residuals import residuals
from ceres_cal.robust.as_built import Construction, free_dimensions
from ceres_cal.robust.noise import noise_of_cameras
from ceres_cal.robust.robust import solve_robustly
from ceres_cal.robust.usable import NO_FIT
from ceres_cal.scene.camera import Camera
from ceres_cal.start.initialise import Start, initialise
from ceres_cal.start.listed import require_as_listed, require_at_rest

if TYPE_CHECKING:
    from ceres_cal.calibration.lenses import LensDecisions
    from ceres_cal.robust.bulk import Bulk, Subset


_OTHERWISE = (
    "no calibration agrees with the stated priors, but the observations alone determine one: check the priors and "
    "their units"
)


@checked
@numerical("the calibration")
def calibrate(
    observations: Observations,
    options: Options | None = None,
    progress: SolveProgress | None = None,
    *,
    client: Any = None,
) -> Calibration:
    """Calibrate every camera, station and placement that the observations show.

    For very large data sets of the world, the lens, the outliers and the conflicting statements are determined from a
    subset; then all observations are judged and solved for, in shares (docs/scale.md).

    Args:
        progress: called at every iteration of every solve, in the caller's thread.
        client: a `distributed.Client` whose workers hold the shares, however many observations there are.

    Raises:
        DegenerateError: the observations cannot determine the unknowns; the message names the frame or the numbers.
        SolutionError: the solution is no usable camera.
        InputError: a prior or a fixed number does not exist in the camera's lens; pixels lie outside their image, or in
            one corner of a far larger image; a picture is mirrored; points are listed in another order than their
            target's, or a target moves that may not.
    """
    options = options or Options()
    require_possible_numbers(observations, options)
    require_filled(observations)
    if not is_bulk(observations):
        require_as_listed(observations)
        require_at_rest(observations, NO_FIT)
    observations, options = free_dimensions(observations, options)
    with for_small_matrices(), at_most(options.threads):
        try:
            return _measured(observations, options, progress, client)
        # quiet: a solution that agrees with every statement is an answer, wherever its search began
        except (DegenerateError, SolutionError) as error:
            if odd := next(chain(unfilled(observations), odd_sizes(observations)), None):
                raise type(error)(f"{error}; {odd}") from None
            from ceres_cal.start.same_moments import told_apart

            if apart := next(told_apart(observations), None):
                raise type(error)(f"{apart}: {error}") from None
            free = _without_priors(observations, options)
            if free is None:
                raise _of_a_camera(error, observations, options) from None
            return _from_there(free, observations, options)


def _of_a_camera(failure: CalibrationError, observations: Observations, options: Options) -> CalibrationError:
    """Return the failure of the first camera that fails by itself, too, or else the same one; its message ends with the
    cameras without which the others can be calibrated.
    """
    alone = _alone(observations, options)
    failing = {name: one for name, one in alone.items() if one is not None}
    first, lacking, left_out = next(iter(failing.values()), failure), [*failing], list[str]()
    found: CalibrationError | Calibration | None = first
    while isinstance(found, CalibrationError):
        lacking = lacking or ([found.camera] if found.camera else [])
        if not 0 < len(lacking) < len(observations.cameras) or is_bulk(observations):
            return first
        for name in lacking:
            observations = observations.without_camera(name)
        left_out, lacking = [*left_out, *lacking], []
        found = None
        if not {*observations.cameras} <= {*alone}:  # else each of the others was calibrated by itself
            found = attempt(partial(_measured, observations, options, None, None))  # reads: "... 3 other cameras can"
    those, others = ", ".join(map(repr, left_out)), counted(len(observations.cameras), "other camera")
    can = f"{others} can be calibrated if the observations of {those} are left out"
    return type(first)(f"{first}; {can}", first.camera)


def _alone(observations: Observations, options: Options) -> dict[str, CalibrationError | None]:
    """Return for each camera of a rig that need not see what is placed before others why it cannot be calibrated by
    itself; None where it can. What one camera lacks, the sums of all may hide, and an impossible lens may show it.
    """
    failures = dict[str, CalibrationError | None]()
    if len(observations.cameras) < 2 or is_bulk(observations):
        return failures
    shown = {name: observations.of_camera(name) for name in observations.cameras}
    for name, own in shown.items():
        others = {placement for other, one in shown.items() if other != name for placement in one.placements}
        if others.intersection(own.placements):
            continue
        # reads: "camera 'c1': 11 measured numbers cannot determine 12 unknowns"
        found = attempt(partial(_measured, own, replace(options, priors=own.about_shown(options.priors)), None, None))
        failures[name] = None
        if isinstance(found, CalibrationError):
            failures[name] = type(found)(str(found) if repr(name) in str(found) else f"camera {name!r}: {found}", name)
    return failures


def lenses_by_held_out(observations: Observations, options: Options) -> Mapping[str, LensChoice]:
    """Return each camera's choice of the lens that best predicts held-out observations; the options' is ignored."""
    from ceres_cal.calibration.lens_forms import any_lens

    return calibrate(observations, any_lens(options)).lens_choices


def calibrate_near(camera: Camera, observations: Observations, options: Options, *, knows: bool = True) -> Calibration:
    """Calibrate the only camera of the observations with a named lens, from its approximately known numbers and pose.

    The curvature of the posterior is not evaluated.

    Args:
        knows: whether whole curves are tested for being outliers and a posterior is made. Otherwise phi may end
            anywhere along its valley, and only single observations are rejected.

    Raises:
        CalibrationError: see `calibrate`.
    """
    from ceres_cal.calibration.lens_seen import profiles_of, seen_through

    observations, options = free_dimensions(observations, options)
    sights, (name,), (station,) = gather_sights(observations), observations.cameras, observations.stations
    structure = make_structure(observations.targets, options.tolerances, options.dimensions)
    there = Estimate({name: camera}, {station: Station(name, camera.cam_from_world)}, {}, structure)
    start = Start(seen_through(there, options, profiles_of(there, sights)), {name: "prior"})
    with for_small_matrices(), at_most(options.threads):
        return _of_lens(Task(knows=knows, bends=False), start, sights, options).redrawn()


def _measured(observations: Observations, options: Options, progress: SolveProgress | None, client: Any) -> Calibration:
    """Calibrate, with the dimensions of targets and the noise of cameras as they were found; repeat from there where
    they differ from what was assumed. Very large data sets, of which a subset decides, have one noise.
    """
    # A dimension may differ from its drawing by this share without another solve; beyond it the start and the outliers
    # are those of a wrong drawing. And the largest number of such solves.
    redrawn, most_drawings = 0.005, 4
    for _ in range(most_drawings):
        calibration = _of_same_moments(_calibrated(observations, options, progress, client), observations)
        before = calibration.estimate.structure
        calibration = calibration.redrawn()
        moved = calibration.estimate.structure.drawn_m / before.drawn_m - 1.0
        noise = calibration.fit.of_cameras if is_bulk(observations) else _noise_of_cameras(calibration, observations)
        if float(np.max(np.abs(moved), initial=0.0)) < redrawn and noise == calibration.fit.of_cameras:
            break
        observations = calibration.as_taken(observations).at_noise(noise)
    if not calibration.aspects_alone or is_bulk(observations):
        return calibration
    from ceres_cal.calibration.stretched import beside_stretched

    stretched = partial(_measured, observations, replace(options, free_aspect=True), progress, client)
    return beside_stretched(calibration, observations, stretched)


def _of_same_moments(calibration: Calibration, observations: Observations) -> Calibration:
    """Add a warning where the cameras of a rig contradict one another at most moments.

    Raises:
        SolutionError: they contradict one another by more than noise.
    """
    if len(observations.cameras) < 2 or is_bulk(observations) or not calibration.rounds:
        return calibration
    from ceres_cal.start.same_moments import require_same_moments

    words = require_same_moments(calibration.problem(observations), calibration.estimate)
    return replace(calibration, warnings=(*calibration.warnings, words)) if words else calibration


def _noise_of_cameras(calibration: Calibration, observations: Observations) -> Mapping[str, float]:
    """See `noise_of_cameras`: from all observations except copies and those that were rejected as a whole group."""
    if not calibration.rounds or len({*observations.noise_names}) < 2 or calibration.options.noise_scale == "stated":
        return {}
    masks = zip(calibration.inlier_masks(observations), calibration.outlier_masks(observations), strict=True)
    judged = np.concatenate([inliers | outliers for inliers, outliers in masks])
    return noise_of_cameras(calibration.problem(observations), calibration.estimate, judged)


def _calibrated(
    observations: Observations, options: Options, progress: SolveProgress | None = None, client: Any = None
) -> Calibration:
    """See `calibrate`."""
    observations.require_inside()
    if options.closed_form_only or not (client is not None or is_bulk(observations)):
        return _chosen(Task(progress), observations, options)
    from ceres_cal.robust.bulk import Bulk

    digest, bulk = meanwhile(lambda: observations.digest), Bulk(observations, client)
    try:
        part = _part(bulk, options)
        calibration = _chosen(Task(progress, partial(bulk.settled, part)), part.observations, options)
    finally:
        bulk.close()
    return replace(calibration, digest=digest.result())


def _chosen(task: Task, observations: Observations, options: Options) -> Calibration:
    """Calibrate with the named lens or a chosen one; statements get wide sigmas until everything is explained.

    Otherwise a wrong statement biases the rest: a height 25 % wrong was absorbed by a principal point that moved from
    view to view and by a bent board.
    """
    sights, free = gather_sights(observations), freed(observations, options)

    def as_asked() -> Calibration:
        return _of_lens_asked(task, _started(sights, _named(options)), sights, options)

    little, loose = loosely(observations, free)
    if not options.closed_form_only and (little, loose) != (observations, options):
        asked = replace(task, stated=(observations, options))
        # quiet: without the statements the observations are too few, here and after the start
        start = attempt(partial(_started, sights, _named(free)))
        if isinstance(start, Start):
            little_said = replace(sights, observations=little)
            found = attempt(partial(_of_lens_asked, asked, start, little_said, loose))  # quiet: as for the start
            if isinstance(found, Calibration):
                return _or_as_asked(found, as_asked, observations, is_held=free is not options)
            if free is options:
                return _of_lens_asked(task, start, sights, options)
        elif free is options or isinstance(start, InputError):
            raise start  # there is no other start
    return as_asked()


def _started(sights: Sights, options: Options) -> Start:
    """Find an initial estimate.

    Raises:
        InputError: many curves are far from it, because of their names.
        DegenerateError: see `initialise`.
    """
    # Share of curves near a start. With two exchanged names it was 0 to 0.85 in 17 of 20; else they are outvoted.
    usually = 0.9
    start = initialise(sights, options)
    lengths = residuals(sights, start.estimate).lengths[1]
    for name, camera in start.estimate.cameras.items():
        own = lengths[sights.of_camera(name).curve_rows]
        near = np.count_nonzero(own <= NO_FIT * np.hypot(*camera.image_size))  # NaN is not
        if near < usually * len(own):
            from ceres_cal.calibration.renaming import find_renaming, opposite_names

            shown = sights.observations.of_camera(name)
            if found := find_renaming(shown, options):
                raise InputError(f"{found.words}: correct them, or let `ceres-cal calibrate --mend-labels` do so")
            if words := opposite_names(shown, options):
                raise InputError(f"{words}: correct the names of the one or the other")
    return start


def _or_as_asked(
    found: Calibration, as_asked: Callable[[], Calibration], observations: Observations, *, is_held: bool
) -> Calibration:
    """Return the solution with loose statements, or the one with all as stated where that agrees with the statements.

    A held number that agrees determines others: without it another lens was chosen, a height came out 10 sd off, and an
    outlier among a few lines was kept. A statement may be right that only the lens chosen without it contradicts.
    """
    asks_again = found.lens_choices and not is_held if found.conflicts else is_held
    if not asks_again:
        return found
    again = attempt(as_asked)  # quiet: no solution from that start agrees with the statements; `found` does
    if isinstance(again, CalibrationError) or again.conflicts:
        return found
    if not found.conflicts:
        return again
    from ceres_cal.calibration.likelier import with_lens_that_agrees

    return with_lens_that_agrees(found, again, observations)


def _of_lens_asked(task: Task, start: Start, sights: Sights, options: Options) -> Calibration:
    if options.lens == AUTO:
        return _of_any_lens(replace(task, chosen=True), start, sights, options)
    return _of_lens(task, start, sights, options)


def _named(options: Options) -> Options:
    """Return the options, with the paper's lens where they name none."""
    from ceres_cal.calibration.lens_forms import papers

    return options if options.lens != AUTO else papers(options)


def _of_any_lens(task: Task, start: Start, sights: Sights, options: Options) -> Calibration:
    """Calibrate with the lenses that the data choose."""
    from ceres_cal.calibration.lenses import choose_lenses

    if options.closed_form_only:
        return _of_lens(task, start, sights, _named(options))

    def seen_with(lenses: LensDecisions) -> TaskSolution:
        known = (one.among.chosen.of.smoothness for one in lenses.each.values() if one.among)
        smoothness = {name: sd for each in known for name, sd in each.items()}
        problem = replace(problem_of(sights, lenses.options, lenses.start.estimate), smoothness=smoothness)
        return explained(task, lenses.start, problem, lenses.built)

    chosen = choose_lenses(sights, options, start)
    seen, chosen = chosen.first_solved(seen_with)
    too_few = {name for name in seen.leaving_alike if chosen.each[name].choice.share < 1.0}
    anew = [*chosen.each] if seen.as_built and not chosen.built.every else sorted(too_few | chosen.far_better)
    if anew:
        # With targets as built, lenses differ more clearly than with targets as drawn, because only noise remains. What
        # all views leave in the same places need not show in the few views by which lenses were compared. Where only a
        # lens without a formula came near, the others may have ended in a wrong valley, which they leave from here.
        near = replace(seen.end.estimate, structure=EXACT)
        before, built = chosen, Construction(seen.as_built, seen.end.estimate.structure)
        chosen = chosen.anew(anew, near, built, too_few)
        if chosen.labels != before.labels:
            seen, chosen = chosen.first_solved(seen_with)
    said = []
    while other := chosen.instead(seen.outlier_masks, seen.scales):
        # reads: "another lens explains observations that were taken out, ..."
        found = attempt(partial(seen_with, other))
        if isinstance(found, CalibrationError):
            without = "but the calibration with it fails"
            said.append(f"another lens explains observations that were taken out, {without}: {found}")
            break
        seen, chosen = found, other
    last = chosen

    def known_with(lenses: LensDecisions) -> Calibration:
        return known_of(seen if lenses is last else seen_with(lenses))

    calibration, chosen = last.first_solved(known_with)
    if calibration.posterior is not None:
        others = chosen.others(calibration.posterior, calibration.estimate, calibration.options)
        wider = with_other_lenses(calibration.posterior, calibration.estimate, others)
        calibration = replace(calibration, posterior=wider)
        if others.failed:
            without = "the standard deviations do not include the choice of the lens"
            said.append(f"other lenses could not be compared, so {without}: {others.failed}")
    choices = {name: one.choice for name, one in chosen.each.items()}
    return replace(calibration, lens_choices=choices, warnings=(*calibration.warnings, *chosen.caveats, *said))


def _part(bulk: Bulk, options: Options) -> Subset:
    """Return the subset that decides: some views of the world, with those that stand out at a solution of others."""
    sights, options = gather_sights(bulk.part().observations), _named(options)
    start = initialise(sights, options)
    problem = problem_of(sights, options, start.estimate)
    return bulk.part(bulk.standing_out(solve_robustly(problem, start.estimate, is_near=start.is_near)))


def _of_lens(task: Task, start: Start, sights: Sights, options: Options) -> Calibration:
    """Calibrate with a named lens."""
    options = options.with_first_power(len(sights))
    problem = problem_of(sights, options, start.estimate)
    if options.closed_form_only:
        return of_closed_form(start, problem)
    return solved_from(task, start, problem)


@or_none  # quiet: the caller raises the first failure
def _without_priors(observations: Observations, options: Options) -> Calibration | None:
    """A calibration without any priors; None where there are no priors, or where it fails without them, too."""
    if not (observations.priors or options.priors):
        return None
    return _calibrated(replace(observations, priors=()), replace(options, priors=()))


def _from_there(free: Calibration, observations: Observations, options: Options) -> Calibration:
    """Return the calibration that agrees with the statements, started where the observations alone lead.

    Raises:
        SolutionError: the observations contradict a statement, or no solution from that start agrees with all of them.
    """
    from ceres_cal.calibration.lens_seen import profiles_of, seen_through
    from ceres_cal.robust.conflicts import contradicted_by

    stated = gather_priors(observations, replace(free.options, priors=options.priors), free.estimate.structure)
    posterior = free.uncertainty.posterior
    words = contradicted_by(stated, free.estimate, posterior.information, posterior.degrees_of_freedom)
    if words:
        raise SolutionError(words) from None
    sights = gather_sights(observations)

    def from_there() -> Calibration:
        # Lenses are chosen from a start with the paper's lens, not with those that were chosen without the statements.
        there = seen_through(free.estimate, _named(options), profiles_of(free.estimate, sights))
        return _of_lens_asked(Task(), Start(there, free.phi_from), sights, options)

    found = attempt(from_there)  # reads: "no calibration agrees with the stated priors, but ..."
    if isinstance(found, CalibrationError):
        raise SolutionError(_OTHERWISE) from None
    return found.redrawn()
