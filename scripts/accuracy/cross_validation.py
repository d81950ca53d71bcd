"""Held-out error: calibrate with some frames and predict the others.

A held-out frame is predicted with the cameras and stations of the other frames. A board that only held-out frames show
needs a pose: its six numbers are fitted to these frames, with everything else fixed. Therefore the error of boards is a
little lower than that of a field, by the same share for every lens.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Mask, rms
from ceres_cal.base.errors import CalibrationError, DegenerateError, InputError, attempt
from ceres_cal.base.frozen import replace
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics.table import error_mm
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, column_of, frames_of, gather_sights
from ceres_cal.problem.bundle import solve
from ceres_cal.problem.parameters import Estimate, Layout, Options
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.residuals import residuals, write_equations
from ceres_cal.problem.structure import make_structure

FOLDS = 5


@dataclass(frozen=True)
class PredictionErrors:
    """Prediction errors; each observation is predicted by a calibration that did not use its frame.

    Attributes:
        folds: number of parts of the frames. failed_folds: parts without which the other frames cannot be calibrated;
            their frames do not count. counted: number of observations that count.
        points_rms_px: of the points' errors (lengths). curves_rms_px: of the distances to curves. rms_px, rms_mm: of
            both, in the image and on the targets' planes; NaN where there are none. fit_rms_px: of the calibration with
            all frames, for the same observations.
    """

    folds: int
    failed_folds: int
    counted: int
    points_rms_px: float
    curves_rms_px: float
    rms_px: float
    rms_mm: float
    fit_rms_px: float


def cross_validate(
    observations: Observations,
    options: Options | None = None,
    k: int = FOLDS,
    *,
    calibration: Calibration | None = None,
) -> PredictionErrors:
    """The error with which frames are predicted by a calibration of the others, k-fold.

    Args:
        calibration: of all the observations with these options, if it exists already.

    Raises:
        InputError: k below 2, or fewer than two frames.
        CalibrationError: the observations cannot be calibrated, as a whole or without more than half of the folds.
    """
    options = options or Options()
    whole = calibration or calibrate(observations, options)
    kept = np.concatenate(whole.inlier_masks(observations))
    names, frame = frames_of(observations)
    if k < 2:
        raise InputError(f"cross-validation needs at least 2 folds, not {k}")
    if len(names) < 2:
        raise InputError("cross-validation by frame needs at least two frames: a single one cannot be held out")
    folds = min(k, len(names))
    fold = np.random.default_rng(0).permutation(len(names))[frame] % folds  # the same every time
    errors = np.full((len(frame), 2), np.nan)
    failed = 0
    parts = [fold == number for number in range(folds)]
    for part in parts:
        found = _without(observations, options, whole, kept, part)
        if isinstance(found, CalibrationError):
            failed += 1
            if 2 * failed > folds:
                raise found
        else:
            errors[part & kept] = found
    kept = kept & np.isfinite(errors[:, 0])
    fit_px = _errors(whole.as_taken(observations), kept, whole.estimate)[kept, 0]
    points = kept & (np.arange(len(kept)) < len(observations.points))
    every = (errors[points, 0], errors[kept & ~points, 0], errors[kept, 0], errors[kept, 1], fit_px)
    return PredictionErrors(folds, failed, int(np.count_nonzero(kept)), *map(rms, every))


def _attempt(observations: Observations, options: Options) -> Calibration | CalibrationError:
    return attempt(lambda: calibrate(observations, options))


# ---- one fold -------------------------------------------------------------------------------------------------------


def _without(
    observations: Observations, options: Options, whole: Calibration, kept: Mask, part: Mask
) -> Array | CalibrationError:
    """Errors (n, 2), px and mm, of the held-out inliers by a calibration without them, or the error that it raised."""
    trained = _attempt(observations.part(*np.split(~part, [len(observations.points)])), options)
    if isinstance(trained, CalibrationError):
        return trained
    held = part & kept
    return _predicted(observations, held, trained, whole)[held]


def _predicted(observations: Observations, held: Mask, trained: Calibration, whole: Calibration) -> Array:
    """Errors (N + M, 2), px and mm, of held-out observations under a calibration without them."""
    estimate, observations = trained.estimate, trained.as_taken(observations)
    sights = gather_sights(observations).used(*np.split(held, [len(observations.points)]))
    new = {key.placement for key in sights.keys if key.placement is not None} - set(estimate.placements)
    missing = {key.station for key in sights.keys} - set(estimate.stations)
    if missing:
        raise DegenerateError(f"station {min(missing)!r} stands in held-out frames only: it cannot be predicted")
    if new:
        placements = {**estimate.placements, **{str(name): whole.estimate.placements[str(name)] for name in new}}
        estimate = replace(estimate, placements=placements)
        of_new = sights.take(sights.numbers(placements=new))
        estimate = replace(estimate, placements=_posed(of_new, estimate, trained, observations))
    return _errors(observations, held, estimate)


def _posed(sights: Sights, estimate: Estimate, trained: Calibration, observations: Observations) -> Mapping[str, Pose]:
    """All placements; those of the sights are fitted with the rest fixed, with targets as the fold built them."""
    built = estimate.structure.built_into(sights)
    start = replace(estimate, structure=make_structure(observations.targets, {}))
    none = {name: np.empty(0, dtype=np.int64) for name in estimate.cameras}
    layout = Layout(none, frozenset(), frozenset(str(key.placement) for key in sights.keys))
    fit, options = trained.fit, trained.options
    weighting = Weighting(fit.point_scale, fit.curve_scale, options.loss, options.loss_scale)
    return solve(Problem(built, layout, weighting=weighting, options=options), start).estimate.placements


def _errors(observations: Observations, rows: Mask, estimate: Estimate) -> Array:
    """Residuals in px and mm, (N + M, 2). A point that the camera cannot show counts 10 sigma in px and NaN in mm."""
    unseen_sigma = 10.0  # residual of an observation that the fold's camera cannot show
    sights = gather_sights(observations).used(*np.split(rows, [len(observations.points)]))
    there = residuals(sights, estimate)
    equations = write_equations(sights, estimate, there)
    px = np.concatenate([np.linalg.norm(there.points, axis=1), np.abs(there.curves)])
    px = np.where(np.isfinite(px), px, unseen_sigma * column_of(observations, "sigma_px"))
    return np.column_stack([px, np.abs(error_mm(equations, equations.residual, len(px)))])
