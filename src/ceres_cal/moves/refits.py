"""Refit after a move: new poses, with the old posterior as a prior of everything else (design, section 10).

The path is that of `calibrate`: from a closed form with the old calibration's lens to solve, reject, solve, assess. The
old posterior is one more prior, as a full matrix.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import CalibrationError, DegenerateError, Pose, SolutionError, attempt, checked, numerical, replace
from ceres_cal.calibration import Calibration, RefitRecord
from ceres_cal.calibration.calibration import loosened
from ceres_cal.calibration.solving import Task, solved_from
from ceres_cal.moves.explanations import (
    WORDS,
    NothingFitsError,
    OtherChangeError,
    Rival,
    explained_nats,
    judged,
    old_poses,
    require_labels,
    require_still,
    supported,
    why_nothing_fits,
    zoomed_search,
)
from ceres_cal.moves.poses import (
    NOISES,
    PoseSearch,
    alike,
    equations,
    found_poses,
    least_moved,
    moved_from,
    moved_words,
    movement,
    pose_candidates,
)
from ceres_cal.moves.refit_lenses import with_lens_of, with_lenses
from ceres_cal.moves.refit_plan import RefitOptions, RefitPlan, make_plan, refit_problem
from ceres_cal.observations import Observations, Sights
from ceres_cal.posterior import with_other_lenses
from ceres_cal.problem import Estimate, SolveProgress, Station, difference
from ceres_cal.start import Start, chained_poses

# Equations with which a pose is unique: six numbers, and two that contradict a wrong one. Nothing changes at half of
# it; at double four corners are refused.
_UNIQUE = 8
_SMALL = (0.3, np.deg2rad(15.0))


@checked
@numerical("the refit")
def refit(
    calibration: Calibration,
    observations: Observations,
    what: str = "auto",
    *,
    moved: Collection[str] | None = None,
    options: RefitOptions | None = None,
    progress: SolveProgress | None = None,
) -> Calibration:
    """Calibrate again after cameras were moved, from few new observations and all that was known.

    Stations that were not observed keep the old posterior, except for those of a camera that was observed elsewhere:
    they are dropped, because the camera is no longer there. Placements are not carried over; only what the new
    observations show is placed. Priors of the old options are in the posterior already; those on the new observations
    count as new. A refit to the observations of the last refit repeats it: the prior is what was known before them, and
    nothing counts twice. The observations of which a calibration was made are refused.

    Args:
        what: "auto" ("pose", or "zoom" or "iris" where the observations say so), "pose" (intrinsics with their
            posterior as a prior), "pose-only" (intrinsics held; their uncertainty still counts in the new posterior),
            "zoom" (phi counts as unknown), "iris" (the lens's coefficients count as unknown), "everything" (all
            intrinsics do).
        moved: observed stations that moved; by default all. The other observed stations keep their posterior as a
            prior.

    Raises:
        InputError: names that do not fit the calibration, a calibration without a posterior, or its own observations.
        DegenerateError: the observations do not determine a pose, or not uniquely after so large a move.
        SolutionError: no explanation fits, or one does that `what` does not allow; the message says which.
    """
    asked = make_plan(calibration, observations, what, moved, options)
    plan = with_lenses(asked, _start)

    def changed(what: str) -> RefitPlan:
        return with_lenses(make_plan(calibration, observations, what, moved, options), _start, plan.lens)

    # reads: "no explanation fits ...", or that something else has changed, where more noise is less likely
    found = attempt(partial(_refitted_as_changed, plan, observations, progress, changed), SolutionError)
    if (least := _least_nats(plan, found)) is not None and (likeliest := _likeliest(plan)) is not plan:
        likeliest = with_lenses(replace(asked, scales=likeliest.scales), _start, plan.lens)
        # quiet: nothing fits at more noise, either, and the answer is what was found before
        noisier = attempt(partial(_refitted, likeliest, observations, progress))
        if isinstance(noisier, Calibration) and _nats(plan, plan.what, noisier) < least:
            times = f"{_noise(plan, noisier):.1f} times as noisy as those of the calibration before"
            return replace(noisier, remarks=(*noisier.remarks, f"the new observations are {times}"))
    if isinstance(found, Calibration):
        return found
    raise found


def _least_nats(plan: RefitPlan, found: Calibration | CalibrationError) -> float | None:
    """Return how unlikely the observations are by what was found, infinite if nothing was; None where more noise would
    not change that: all observations fit as they are, or a refusal has nothing to do with noise.
    """
    if isinstance(found, Calibration):
        assert found.refitted is not None
        what, fits = found.refitted.what, not found.outliers and _noise(plan, found) < NOISES[1]
        return None if fits and what == plan.what else _nats(plan, what, found)
    if isinstance(found, OtherChangeError) and found.found is not None:
        return _nats(plan, found.what, found.found)
    return np.inf if isinstance(found, NothingFitsError) else None


def _refitted_as_changed(
    plan: RefitPlan,
    observations: Observations,
    progress: SolveProgress | None,
    changed: Callable[[str], RefitPlan],
) -> Calibration:
    """Return the refit by what has changed, if that was left open."""
    try:
        return _refitted(plan, observations, progress)
    except OtherChangeError as change:  # reads: "the data show that the zoom was changed", or the error
        if plan.is_stated or change.is_doubtful or change.what == "everything":
            raise
        return _refitted(changed(change.what), observations, progress, change)


def _nats(plan: RefitPlan, what: str, result: Calibration) -> float:
    """Return how unlikely the observations are by a refit, at its own noise, whatever the poses: with more noise more
    of them explain the observations, in proportion to its power for each of their numbers.
    """
    poses = 6.0 * len(plan.moved) * float(np.log(_noise(plan, result)))
    return explained_nats(plan, what, result, result.fit.scales) - poses


def _noise(plan: RefitPlan, result: Calibration) -> float:
    """Return the noise of a refit relative to the calibration's, of points where there are any."""
    fit, (points, curves) = result.fit, plan.scales
    return fit.point_scale / points if fit.points else fit.curve_scale / curves


def _likeliest(plan: RefitPlan) -> RefitPlan:
    """Return the plan at the noise that the best poses make most likely."""
    points, curves = plan.scales
    noisier = (replace(plan, scales=(noise * points, noise * curves)) for noise in NOISES if noise != 1.0)
    return min(plan, *noisier, key=_misfit)


def _misfit(plan: RefitPlan) -> float:
    """Return the misfit of the best poses at the noise of the plan, in nats."""
    searches = [PoseSearch(sight, plan.known, plan.scales) for sight in _moved_sights(plan)]
    every = [pose_candidates(search, old_poses(plan, search), patience=0) for search in searches]
    return sum(candidates[0].misfit if candidates else np.inf for candidates in every)


def _refitted(
    plan: RefitPlan, observations: Observations, progress: SolveProgress | None, change: OtherChangeError | None = None
) -> Calibration:
    calibration, what = plan.calibration, plan.what
    estimate = plan.near or _start(plan)
    zoomed = plan.moved_cameras if what in ("zoom", "everything") else ()
    phi_from = {name: "views" if name in zoomed else "posterior" for name in calibration.cameras}

    def solved_with(what: str, start: Estimate, *, tested: bool = True) -> Calibration:
        near, most = 1e-3, 3  # share of phi that moves no coefficient by its standard deviation; number of solves
        for _ in range(most):
            problem, known = refit_problem(plan, what, start)
            task = Task(progress, tested=tested, before=known, scales=plan.scales)
            found = solved_from(task, Start(start, phi_from), problem)
            ratios = [found.cameras[name].phi / start.cameras[name].phi for name in plan.moved_cameras]
            if what != "zoom" or all(abs(ratio - 1.0) < near for ratio in ratios):
                break
            start = found.estimate  # what is known of coefficients depends on the zoom
        return found

    result = solved_with(what, estimate)
    try:
        searches = [PoseSearch(sight, estimate, plan.scales) for sight in _moved_sights(plan)]
        rivals = supported(plan, result, searches, solved_with)
    except SolutionError as error:
        stated = [conflict.words for conflict in result.conflicts if conflict.kind == "prior"]
        if not stated:
            raise
        raise SolutionError(f"{stated[0]}; or else {error}") from None
    _require_known(plan, result)
    if change is not None:
        rivals = change.rivals
    explanation = _explained(plan, result, rivals, WORDS[plan.what] if change else "")
    result = _as_known(plan, _beside_rivals(plan, _with_other_lenses(plan, result), rivals))
    seen = calibration.refitted.digests if calibration.refitted else ()
    if calibration.digest != observations.digest:
        seen = (*seen, calibration.digest)
    refitted = RefitRecord(what, tuple(sorted(plan.moved)), explanation, plan.prior, plan.scales, seen)
    warnings = (*_warnings(plan, result), *([_TWICE] if observations.digest in seen else []))
    remarks = (*result.remarks, *_of_lenses(plan))
    return replace(result, digest=observations.digest, refitted=refitted, warnings=warnings, remarks=remarks)


def _of_lenses(plan: RefitPlan) -> Iterator[str]:
    """Yield which cameras have another lens than before."""
    for name in sorted(plan.moved_cameras) if plan.lens else ():
        before, now = plan.earlier.cameras[name].lens, plan.calibration.cameras[name].lens
        other = f"a {now.kind} lens" if now.kind != before.kind else f"another {now.kind} lens"
        yield f"camera {name!r}: the new observations are far likelier with {other}, which predicted as well before"


_TWICE = "the old calibration was made from these observations, too: they are counted twice now"


def _start(plan: RefitPlan) -> Estimate:
    """Return the poses of everything that is sought, with the old lenses (or zoomed ones, where that is allowed)."""
    require_still(plan)
    poses: dict[str, Pose] = {}
    cameras = dict(plan.known.cameras)
    for sight in _moved_sights(plan):
        search, pose = _sought(plan, PoseSearch(sight, plan.known, plan.scales))
        poses[sight.key.station], cameras[sight.key.camera] = pose, search.camera
    if plan.asked.labels == "check":
        require_labels(plan, poses)
    placed = {name: Station(plan.stations[name], pose) for name, pose in poses.items()}
    estimate = replace(plan.known, cameras=cameras, stations={**plan.known.stations, **placed})
    boards = plan.sights.take(np.flatnonzero([key.placement is not None for key in plan.sights.keys]))
    found = found_poses(boards, estimate, plan.scales, {}, patience=0)
    return replace(estimate, placements=chained_poses(boards, *found, estimate.stations)[1])


def _moved_sights(plan: RefitPlan) -> list[Sights]:
    moved = {name: sight for name, sight in plan.sights.of_world.items() if name in plan.moved}
    for name in sorted(plan.moved - moved.keys()):
        raise DegenerateError(
            f"station {name!r} sees no fixed target: observe lines or points of the field with it "
            "(`ceres-cal score` tests held intrinsics with boards alone)"
        )
    return list(moved.values())


def _sought(plan: RefitPlan, search: PoseSearch) -> tuple[PoseSearch, Pose]:
    """Return the search with the lens that explains it, and the station's pose."""
    old = old_poses(plan, search)
    candidates = pose_candidates(search, old)
    fitting = [one for one in alike(candidates) if one.fits]
    if fitting:
        pose = least_moved(fitting, old).pose
        _require_unique(search, pose, old)
        return search, pose
    if plan.what in ("zoom", "iris", "everything"):
        zoomed = zoomed_search(search, old)
        if zoomed is not None:
            return zoomed[0], zoomed[1].pose
    raise why_nothing_fits(plan, [search])


def _require_unique(search: PoseSearch, pose: Pose, old: list[Pose]) -> None:
    """Raise DegenerateError where too few features do not determine a large move."""
    known = equations(search.sight)
    moves = [movement(pose, before) for before in old]
    if known >= _UNIQUE or any(shift_m < _SMALL[0] and turn < _SMALL[1] for shift_m, turn in moves):
        return
    raise DegenerateError(
        f"station {search.sight.key.station!r}: its points, lines and arcs give {known} equations, enough for a small "
        f"move but not for a large one: observe at least {_UNIQUE} (a point or straight line gives two, an arc three)"
    )


# ---- what came out --------------------------------------------------------------------------------------------------


def _require_known(plan: RefitPlan, result: Calibration) -> None:
    """Raise DegenerateError where the observations leave a pose open."""
    across = result.uncertainty.posterior.across
    for key, sd in zip(across.keys, across.spread.sd.tolist(), strict=True):
        if key.kind == "station" and key.owner in plan.moved and not np.isfinite(sd):
            raise DegenerateError(
                f"station {key.owner!r}: the observations do not determine its {key.quantity.replace('_', ' ')}: "
                "add points, or lines in another direction"
            )
    for name in plan.moved:
        if not np.all(np.isfinite(result.estimate.stations[name].cam_from_world.matrix)):
            raise SolutionError(f"station {name!r}: the solved pose is not finite: check labels and target dimensions")


def _with_other_lenses(plan: RefitPlan, result: Calibration) -> Calibration:
    """Widen the posterior by lenses that predicted as well before, as they see the new observations: one picture
    determines a lens's numbers, but not which lens it is.
    """
    if result.posterior is None or plan.others is None:
        return result
    _, *said = refit_problem(plan, "pose-only", result.estimate)[0].priors
    # Each lens has its own phi: the prior of phi is from the chosen lens, and does not limit that of another one.
    stated, told = result.posterior.stated, {key for one in said for key in one.keys}
    phi = [key for key in stated.keys if key.quantity == "phi" and key not in told]
    posterior = replace(result.posterior, stated=stated.without(phi))
    return replace(result, posterior=with_other_lenses(posterior, result.estimate, plan.others))


def _beside_rivals(plan: RefitPlan, result: Calibration, rivals: Sequence[Rival]) -> Calibration:
    """Add the other explanations to the posterior, each by its probability."""
    posterior, so_far = result.posterior, 1.0 - sum(one.probability for one in rivals)
    for what, probability, found in rivals:
        so_far += probability
        if posterior is not None and found.posterior is not None:
            step = difference(found.estimate, result.estimate, posterior.keys)
            let_go = plan.loosened(what) - plan.loosened(plan.what)
            posterior = posterior.beside(found.posterior.normal, step, probability / so_far, let_go)
    return replace(result, posterior=posterior)


def _as_known(plan: RefitPlan, result: Calibration) -> Calibration:
    """Restore cameras that were not observed, and all that was known of them: their prior was a single normal
    distribution, which is wider.
    """
    kept = [name for name in result.cameras if name not in plan.stations.values()]
    if result.posterior is None or not kept:
        return result
    before, known = plan.earlier.estimate, plan.earlier.uncertainty.posterior
    stations = {name: before.stations[name] for name in plan.stays if before.stations[name].camera in kept}
    estimate = replace(
        result.estimate,
        cameras={**result.cameras, **{name: before.cameras[name] for name in kept}},
        stations={**result.estimate.stations, **stations},
    )
    mixtures = dict(result.posterior.mixtures)
    for name in kept:
        owners = {("camera", name), *(("station", one) for one, its in stations.items() if its.camera == name)}
        own = known.mixture(name).marginal([key for key in result.posterior.keys if key[:2] in owners])
        mixtures[name] = own if result.posterior.lenses else replace(own, lenses={})
    dependence, past = result.posterior.dependence, known.dependence
    if dependence is not None and past is not None:
        dependence = replace(dependence, inverse_freedom=max(dependence.inverse_freedom, past.inverse_freedom))
    posterior = replace(result.posterior, mixtures=mixtures, dependence=dependence)
    return replace(result, estimate=estimate, posterior=posterior)


def _explained(plan: RefitPlan, result: Calibration, rivals: Sequence[Rival], change: str) -> str:
    words, moves = [f"the data show that {change}"] if change else [], movements(plan.calibration, result, plan.what)
    for name in sorted(plan.moved):
        how = moved_words(*moves[name]) if name in moves else "is new"
        words.append(f"station {name!r} {how}")
    if plan.what in ("zoom", "everything"):
        for name in sorted(plan.moved_cameras):
            before, after = plan.calibration.cameras[name].phi, result.cameras[name].phi
            words.append(f"phi of camera {name!r} went from {before:.2f} to {after:.2f} px")
    words += [f"or {WORDS[one.what]} ({one.probability:.0%})" for one in rivals]
    return "; ".join(words)


def movements(before: Calibration, after: Calibration, what: str = "pose") -> dict[str, tuple[float, float]]:
    """Return how far (m; NaN where unknown) and by how much (degrees) each station that both have was moved, by a refit
    of `what`.
    """
    moves = {}
    for name in filter(before.estimate.stations.__contains__, after.estimate.stations):
        camera = before.estimate.stations[name].camera
        earlier = with_lens_of(before, after.cameras[camera], camera)
        known, old = earlier.uncertainty.posterior, earlier.estimate
        let_go = loosened(what, camera, old.cameras[camera].lens)
        shift_m, turn = (
            moved_from(earlier.prior_of(tuple(set(known.keys_of(old, name)) - let_go)), known, name, after.estimate)
            if known.knows_station(name)
            else movement(after.estimate.stations[name].cam_from_world, old.stations[name].cam_from_world)
        )
        moves[name] = (shift_m, float(np.degrees(turn)))
    return moves


def _warnings(plan: RefitPlan, result: Calibration) -> tuple[str, ...]:
    judgement = judged(plan, plan.what, result)
    noisy = f"the noise is {judgement.noise:.1f} times that of the previous calibration"
    return (*result.warnings, noisy) if judgement.noisy else result.warnings
