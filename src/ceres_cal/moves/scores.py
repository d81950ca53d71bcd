"""Scores of cameras on observations that they were not calibrated from: intrinsics held, poses solved for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ceres_cal.base import InputError, Mask, Pose, checked, numerical, replace, rms, two_digits
from ceres_cal.base.tails import log_f_tail
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.solving import Task, solved_from
from ceres_cal.moves.agreement import FALSE_ALARMS, NOISIER, Agreement, Agreements, Misfit, matched, require_stations
from ceres_cal.moves.poses import found_poses
from ceres_cal.observations import Observations, Sights, gather_sights
from ceres_cal.problem import EXACT, Estimate, Options, Problem, Station, gather_priors, make_layout
from ceres_cal.problem.residuals import Residuals, residuals
from ceres_cal.robust.noise import LARGER
from ceres_cal.start import Start, chained_poses


@checked
@numerical("the score")
def score(
    calibration: Calibration, observations: Observations, *, options: Options | None = None, hold_stations: bool = False
) -> Agreements:
    """Score how well new observations of fields or boards agree with a calibration: only poses are solved for.

    Targets are taken as built, by the calibration. A calibration of another program can be scored, too. The answers are
    for its cameras, with the residuals of each view, worst first, and the best poses (`solution`). A camera holds where
    the noise is that of its calibration; `holds` is None where it is somewhat larger, or the calibration has none.

    Args:
        options: loss and rejection; those of the calibration by default.
        hold_stations: whether stations keep the calibration's poses, so that only boards are posed: this also tests the
            poses of a rig's cameras, or of a camera over its field.

    Raises:
        InputError: a camera, or a station that is held, which the calibration does not have.
        DegenerateError: the observations do not determine the pose of the sight that the message names.
        SolutionError: another camera or target than those calibrated, or intrinsics that do not explain them at all.
    """
    observed = matched(calibration, observations)
    of_lens = {name: calibration.options.of_camera(name) for name in calibration.cameras}
    given = replace(options or calibration.options, tolerances={}, dimensions=()).with_lenses(of_lens)
    sights = sights_as_built(observed, calibration)
    if hold_stations:
        require_stations(calibration, observed)
    known = {name: calibration.estimate.stations[name] for name in observed.stations} if hold_stations else {}
    layout = make_layout(observed, given)
    layout = replace(
        layout,
        free={name: np.empty(0, dtype=np.int64) for name in layout.free},
        stations=layout.stations - known.keys(),
    )
    if not layout.size:
        raise InputError("with its stations held, no pose is left to solve for: use `ceres-cal check`")
    start = Start(_start(calibration, sights, known), calibration.phi_from)
    priors = gather_priors(observed, given, EXACT)
    posed = solved_from(Task(tested=False, before=layout), start, Problem(sights, layout, priors, options=given))
    left = residuals(sights, posed.estimate)
    noise = _ratios(posed.fit.noise_px, calibration.fit.noise_px)
    stated, spare = _ratios(posed.fit.scales, calibration.fit.scales), (_spare(posed), _spare(calibration))
    in_world = np.array([view.placement is None for view in observed.views])
    views = [(view.camera, _view(number, observed, left, posed, noise)) for number, view in enumerate(observed.views)]
    views.sort(key=lambda one: -one[1].misfit.all_rms_px)
    answers = {}
    for name in posed.cameras:
        own = np.array([view.camera == name for view in observed.views])
        misfit = _misfit(own, observed, left, posed, noise)
        its = tuple(view for camera, view in views if camera == name)
        parts = (_misfit(own & part, observed, left, posed, noise) for part in (in_world, ~in_world))
        holds, words = _verdict(max(parts, key=lambda one: one.many_out), misfit, stated, spare)
        answers[name] = Agreement(
            name=name, holds=holds, words=words, misfit=misfit, views=its, pose_free=True, solution=posed
        )
    return Agreements(answers)


def sights_as_built(observations: Observations, calibration: Calibration) -> Sights:
    """Return the sights with targets as built, by the calibration."""
    sights = gather_sights(observations)
    built = calibration.options.structure_of(observations.targets).carrying(calibration.estimate.structure)
    return built.built_into(sights)


def _start(calibration: Calibration, sights: Sights, known: Mapping[str, Station]) -> Estimate:
    """Return the poses of all sights with the calibrated lens, chained into stations and placements."""
    stations = {name: Station(camera, Pose.identity()) for name, camera in sights.observations.stations.items()}
    cameras = {name: calibration.cameras[name] for name in sights.observations.cameras}  # some of a rig's
    blank = Estimate(cameras, stations, {}, EXACT)
    old = {name: station.cam_from_world for name, station in calibration.estimate.stations.items()}
    stations, placements = chained_poses(sights, *found_poses(sights, blank, (1.0, 1.0), old), known)
    return Estimate(cameras, stations, placements, EXACT)


def _spare(calibration: Calibration) -> tuple[float, float]:
    """Return the spare equations of points and of curves, those beyond the unknowns, behind their noise."""
    every, unknowns = (2 * calibration.fit.points, calibration.fit.curves), calibration.fit.unknowns
    left = 1.0 - unknowns / max(sum(every), unknowns, 1)
    points, curves = (max(left * one, 1.0) for one in every)
    return points, curves


def _verdict(
    part: Misfit, misfit: Misfit, stated: tuple[float, float], spare: Sequence[tuple[float, float]]
) -> tuple[bool | None, str]:
    """Return whether a camera predicts the scored observations, and the sentence that says so.

    Args:
        part: the observations of the field or of boards, of which more were taken out. stated: noise over the
            calibration's, both in stated sigmas: boards may be observed better than fields, so larger px alone are no
            reason to refuse. spare: equations behind the noise of these and of the calibration's observations; where
            they are few, one is many times the other by chance.
    """
    noise = max((one for one in misfit.noise if one == one), default=np.nan)
    size = f"to {two_digits(max(misfit.points_rms_px, misfit.curves_rms_px))} px"
    for one in (misfit, part):
        if one.many_out:
            out = f"{one.outliers} of {one.count} observations were taken out"
            return False, f"is not good for these observations: {out}: check labels, target and camera"
    much = f"{two_digits(noise)} times the noise of its calibration"
    least = [min(pair) if pair[0] == pair[0] else 0.0 for pair in zip(misfit.noise, stated, strict=True)]
    kind = int(np.argmax(least))
    if least[kind] > NOISIER and log_f_tail(least[kind] ** 2, *(one[kind] for one in spare)) < np.log(FALSE_ALARMS):
        why = "the cause may be noisier clicks or pictures, another focus, zoom or target, or too simple a lens"
        return False, f"is not good for these observations: it predicts them {size}, {much}: {why}"
    if np.isnan(noise):
        return None, f"predicts these observations {size}; its calibration states no noise to compare with"
    if noise > LARGER:
        return None, f"is usable for these observations: it predicts them {size}, {much}"
    return True, f"is good for these observations: it predicts them {size}, as well as those that it was made from"


# ---- what is left ---------------------------------------------------------------------------------------------------


def _ratios(here: tuple[float, float], before: tuple[float, float]) -> tuple[float, float]:
    """Return the noise of points and of curves over that of the calibration; NaN where either has none."""
    points, curves = (new / old if new > 0.0 and old > 0.0 else np.nan for new, old in zip(here, before, strict=True))
    return points, curves


def _view(
    number: int, observations: Observations, left: Residuals, posed: Calibration, noise: tuple[float, float]
) -> Agreement:
    view = observations.views[number]
    name = f"frame {view.frame!r} of station {view.station!r}, {view.target}"
    here = np.arange(len(observations.views)) == number
    return Agreement(name=name, misfit=_misfit(here, observations, left, posed, noise), pose_free=True)


def _misfit(
    views: Mask, observations: Observations, left: Residuals, posed: Calibration, noise: tuple[float, float]
) -> Misfit:
    own = views[observations.points.view], views[observations.curves.view]
    kept = posed.inlier_masks(observations)
    inside = [lengths[mine & used] for lengths, mine, used in zip(left.lengths, own, kept, strict=True)]
    every = np.nan_to_num(
        np.concatenate([lengths[mine] for lengths, mine in zip(left.lengths, own, strict=True)]), nan=np.inf
    )
    points, curves = inside
    outliers = len(every) - len(points) - len(curves)
    return Misfit(len(points), len(curves), outliers, rms(points, 0.0), rms(curves, 0.0), rms(every, 0.0), noise)
