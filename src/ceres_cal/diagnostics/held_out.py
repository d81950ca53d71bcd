"""Held-out error: calibrate on some frames, predict the others; and the choice of lens that follows from it.

A frame that is held out is predicted by cameras and stations of the others. A board that only held-out frames show is
posed from them, everything else held: its six numbers are no part of the camera. So the error of boards is a little
below that of a field, by the same share whatever the lens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Array, Mask, rms
from ceres_cal.base.errors import CalibrationError, DegenerateError, InputError, attempt
from ceres_cal.base.executing import each
from ceres_cal.base.frozen import Frozen, field, replace
from ceres_cal.base.progress import StepProgress
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.lens_forms import any_lens, candidates, coefficients_of, decide, label_of, size_of, surprise
from ceres_cal.diagnostics.table import error_mm
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, column_of, frames_of, gather_sights, thinned
from ceres_cal.problem.bundle import solve
from ceres_cal.problem.parameters import Estimate, Layout, Options
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.residuals import residuals, write_equations
from ceres_cal.problem.structure import make_structure

if TYPE_CHECKING:
    from concurrent.futures import Executor

FOLDS = 5


class HeldOut(Frozen):
    """Errors of prediction, each observation by a calibration that did not see its frame.

    Attributes:
        label: what was calibrated. coefficients: how many the lens solves for. folds: into how many parts the frames
            went; failed_folds: those without which nothing usable came out: their frames do not count. failed: why
            there is no answer, "" where there is.
        points_rms_px: of the lengths of the points' errors; curves_rms_px: of distances to curves; rms_mm: of both on
            the targets' planes; NaN where there are none. fit_rms_px: the same of the calibration on all frames, over
            points and curves together, on the same observations; rms_px: of the held-out errors.
        frames: names; frame_squares: (F,) sum of squared errors in stated sigmas; frame_counts: (F,) observations.
    """

    label: str
    coefficients: int
    folds: int = 0
    failed_folds: int = 0
    points_rms_px: float = np.nan
    curves_rms_px: float = np.nan
    rms_px: float = np.nan
    rms_mm: float = np.nan
    fit_rms_px: float = np.nan
    frames: tuple[str, ...] = ()
    frame_squares: Array = field(default_factory=lambda: np.empty(0))
    frame_counts: Array = field(default_factory=lambda: np.empty(0))
    failed: str = ""


class Choice(Frozen):
    """Which lens the held-out error speaks for.

    Attributes:
        candidates: each tried lens, fewest coefficients first. options: of each.
        best: index of the least squared error in stated sigmas. chosen: the simplest that is as good (see
            `lens_choice.decide`), frame by frame. current: the one that was asked about.
        thinned: share of the observations that took part.
    """

    candidates: tuple[HeldOut, ...]
    options: tuple[Options, ...]
    best: int
    chosen: int
    current: int
    thinned: float


def cross_validate(
    observations: Observations,
    options: Options | None = None,
    k: int = FOLDS,
    *,
    calibration: Calibration | None = None,
    counted: Mask | None = None,
    label: str | None = None,
    executor: Executor | None = None,
) -> HeldOut:
    """The error with which frames are predicted by a calibration of the others, k-fold.

    Args:
        calibration: of all the observations with these options, where it is there already.
        counted: (N + M,) which observations count, points by row, then curves; those that the calibration of all kept.
        executor: over which the folds go; the same errors whatever it is.

    Raises:
        InputError: k below 2, or fewer than two frames.
        CalibrationError: the observations cannot be calibrated, as a whole or without each of most of the folds.
    """
    options = options or Options()
    whole = calibration or calibrate(observations, options)
    kept = _inliers(whole, observations) if counted is None else counted
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
    one_fold = partial(_without, observations, options, whole, kept)
    for part, found in zip(parts, each(one_fold, parts, executor=executor), strict=True):
        if isinstance(found, CalibrationError):
            failed += 1
            if 2 * failed > folds:
                raise found
        else:
            errors[part & kept] = found
    kept = kept & np.isfinite(errors[:, 0])
    fit_px = _errors(whole.drawn_alike(observations), kept, whole.estimate)[kept, 0]
    squares, counts = np.zeros(len(names)), np.zeros(len(names))
    np.add.at(squares, frame[kept], (errors[kept, 0] / column_of(observations, "sigma_px")[kept]) ** 2)
    np.add.at(counts, frame[kept], 1.0)
    points = kept & (np.arange(len(kept)) < len(observations.points))
    return HeldOut(
        label or label_of(options), coefficients_of(options), folds, failed, rms(errors[points, 0]),
        rms(errors[kept & ~points, 0]), rms(errors[kept, 0]), rms(errors[kept, 1]), rms(fit_px), names,
        squares, counts,
    )  # fmt: skip


def choose(
    observations: Observations,
    options: Options,
    k: int = FOLDS,
    *,
    progress: StepProgress | None = None,
    executor: Executor | None = None,
) -> Choice:
    """The lens that predicts best, among those of the same kind and the one that all kinds together would choose.

    All candidates are judged on the same observations: those that the calibration with any of them keeps.

    Args:
        progress: called before each lens.
        executor: over which lenses and folds go; the same choice whatever it is.

    Raises:
        InputError: fewer than two frames. DegenerateError: no candidate can be calibrated.
    """
    most = 10_000  # observations: of more evenly spread frames and rows take part
    few = thinned(observations, most)
    if len(frames_of(few)[0]) < 2:
        raise InputError("cross-validation by frame needs at least two frames: a single one cannot be held out")
    tried = candidates(options)
    other = _attempt(few, any_lens(options))
    if isinstance(other, Calibration) and label_of(other.options) not in map(label_of, tried):
        tried = sorted([*tried, other.options], key=coefficients_of)
    wholes = list(each(partial(_attempt, few), tried, executor=executor))
    good = [whole for whole in wholes if isinstance(whole, Calibration)]
    if not good:
        raise DegenerateError(f"no lens can be calibrated: {wholes[0]}")
    counted = np.any([_inliers(whole, few) for whole in good], axis=0)
    errors = []
    for number, (one, whole) in enumerate(zip(tried, wholes, strict=True)):
        if progress is not None:
            progress(number, len(tried), f"held out: {label_of(one)}")
        if isinstance(whole, CalibrationError):
            errors.append(HeldOut(label_of(one), coefficients_of(one), failed=str(whole)))
            continue
        tell = partial(cross_validate, few, one, k, calibration=whole, counted=counted, executor=executor)
        told = attempt(tell)  # reads: "..." in the row of that lens
        if isinstance(told, CalibrationError):
            told = HeldOut(label_of(one), coefficients_of(one), failed=str(told))
        errors.append(told)
    best, chosen = _decide(errors, tried)
    share = (len(few.points) + len(few.curves)) / (len(observations.points) + len(observations.curves))
    current = next(i for i, one in enumerate(tried) if label_of(one) == label_of(options))
    return Choice(tuple(errors), tuple(tried), best, chosen, current, share)


def _attempt(observations: Observations, options: Options) -> Calibration | CalibrationError:
    return attempt(lambda: calibrate(observations, options))  # reads: "..." in the row of that lens


def _decide(tried: Sequence[HeldOut], options: Sequence[Options]) -> tuple[int, int]:
    """Indices of the best candidate and of the simplest that is as good, on the frames that all predict."""
    common = np.all([one.frame_counts > 0 for one in tried if not one.failed], axis=0)
    known = [None if one.failed else (one.frame_squares[common], one.frame_counts[common]) for one in tried]
    noise = min((float(s.sum() / n.sum()) for s, n in filter(None, known)), default=0.0) or 1.0  # of the best
    squares = [None if one is None else surprise(one[0] / noise, one[1]) for one in known]
    return decide([one.label for one in tried], list(map(size_of, options)), squares)


# ---- one fold -------------------------------------------------------------------------------------------------------


def _without(
    observations: Observations, options: Options, whole: Calibration, kept: Mask, part: Mask
) -> Array | CalibrationError:
    """Errors (n, 2), px and mm, of a part's rows that count, by a calibration without it; or why there is none."""
    trained = _attempt(observations.part(*np.split(~part, [len(observations.points)])), options)
    if isinstance(trained, CalibrationError):
        return trained
    held = part & kept
    return _predicted(observations, held, trained, whole)[held]


def _inliers(calibration: Calibration, observations: Observations) -> Mask:
    return np.concatenate(calibration.inlier_masks(observations))


def _predicted(observations: Observations, held: Mask, trained: Calibration, whole: Calibration) -> Array:
    """Errors (N + M, 2), px and mm, of held-out observations under a calibration that did not see them."""
    estimate, observations = trained.estimate, trained.drawn_alike(observations)
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
    """All placements, those of the sights in their best pose, everything else held; targets as the fold built them."""
    built = estimate.structure.built_into(sights)
    start = replace(estimate, structure=make_structure(observations.targets, {}))
    none = {name: np.empty(0, dtype=np.int64) for name in estimate.cameras}
    layout = Layout(none, frozenset(), frozenset(str(key.placement) for key in sights.keys))
    fit, options = trained.fit, trained.options
    weighting = Weighting(fit.point_scale, fit.curve_scale, options.loss, options.loss_scale)
    return solve(Problem(built, layout, weighting=weighting, options=options), start).estimate.placements


def _errors(observations: Observations, rows: Mask, estimate: Estimate) -> Array:
    """Lengths in px and mm of the residuals, (N + M, 2); what is not seen counts 10 sigma in px, NaN in mm."""
    unseen_sigma = 10.0  # what an observation counts that the fold's camera cannot show at all
    sights = gather_sights(observations).used(*np.split(rows, [len(observations.points)]))
    there = residuals(observations, sights, estimate)
    equations = write_equations(observations, sights, estimate, there)
    px = np.concatenate([np.linalg.norm(there.points, axis=1), np.abs(there.curves)])
    px = np.where(np.isfinite(px), px, unseen_sigma * column_of(observations, "sigma_px"))
    return np.column_stack([px, np.abs(error_mm(equations, equations.residual, len(px)))])
