"""Held-out error: calibrate on some frames, predict the others; and the choice of lens that follows from it.

A frame that is held out is predicted by cameras and stations of the others. A board that only held-out frames show is
posed from them, everything else held: its six numbers are no part of the camera. So the error of boards is a little
below that of a field, by the same share whatever the lens.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ceres_cal.base.arrays import AnyArray, Array, Indices, Mask
from ceres_cal.base.errors import CalibrationError, DegenerateError, InputError
from ceres_cal.base.transforms import Pose
from ceres_cal.calibrating import calibrate
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.table import error_mm
from ceres_cal.model.equations import write_equations
from ceres_cal.model.parameters import Estimate, Layout, Options
from ceres_cal.model.residuals import residuals
from ceres_cal.model.structure import make_structure
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, gather_sights
from ceres_cal.solve import Problem, Weighting, solve

FOLDS = 5
MOST_OBSERVATIONS = 10_000
_FEWEST_FRAMES = 40
_UNSEEN_SIGMA = 10.0  # what an observation counts that the fold's camera cannot show at all
_FEWEST_COEFFICIENTS = 2


@dataclass(frozen=True, eq=False)
class HeldOut:
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


@dataclass(frozen=True, eq=False)
class Choice:
    """Which lens the held-out error speaks for.

    Attributes:
        candidates: each tried lens, fewest coefficients first. options: of each.
        best: index of the least squared error in stated sigmas. chosen: the one of fewest coefficients whose error is
            above that by no more than one standard error of their difference, frame by frame (the one-standard-error
            rule of Breiman et al. 1984, paired). current: the one that was asked about.
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
) -> HeldOut:
    """The error with which frames are predicted by a calibration of the others, k-fold.

    Args:
        calibration: of all the observations with these options, where it is there already.
        counted: (N + M,) which observations count, points by row, then curves; those that the calibration of all kept.

    Raises:
        InputError: k below 2, or fewer than two frames.
        CalibrationError: the observations cannot be calibrated, as a whole or without each of most of the folds.
    """
    options = options or Options()
    whole = calibration or calibrate(observations, options)
    kept = _inliers(whole, observations) if counted is None else counted
    names, frame = _frames(observations)
    if k < 2:
        raise InputError(f"cross-validation needs at least 2 folds, not {k}")
    if len(names) < 2:
        raise InputError("cross-validation by frame needs at least two frames: a single one cannot be held out")
    folds = min(k, len(names))
    fold = np.random.default_rng(0).permutation(len(names))[frame] % folds  # the same every time
    errors = np.full((len(frame), 2), np.nan)
    failed = 0
    for number in range(folds):
        held = (fold == number) & kept
        try:
            trained = calibrate(_part(observations, fold != number), options)
        except CalibrationError:
            failed += 1
            if 2 * failed > folds:
                raise
            continue
        errors[held] = _predicted(observations, held, trained, whole)[held]
    kept = kept & np.isfinite(errors[:, 0])
    fit_px = _errors(observations, kept, whole.estimate)[kept, 0]
    squares, counts = np.zeros(len(names)), np.zeros(len(names))
    np.add.at(squares, frame[kept], (errors[kept, 0] / _columns(observations, "sigma_px")[kept]) ** 2)
    np.add.at(counts, frame[kept], 1.0)
    points = kept & (np.arange(len(kept)) < len(observations.points))
    return HeldOut(
        label or label_of(options), _coefficients(options), folds, failed, _rms(errors[points, 0]),
        _rms(errors[kept & ~points, 0]), _rms(errors[kept, 0]), _rms(errors[kept, 1]), _rms(fit_px), names,
        squares, counts,
    )  # fmt: skip


def choose(observations: Observations, options: Options, k: int = FOLDS, *, most: int = MOST_OBSERVATIONS) -> Choice:
    """The lens powers or coefficients that predict best, among those of the same kind of lens.

    All candidates are judged on the same observations: those that the calibration with any of them keeps.

    Args:
        most: of more observations, evenly spread frames and rows take part.

    Raises:
        InputError: fewer than two frames. DegenerateError: no candidate can be calibrated.
    """
    few = thinned(observations, most)
    if len(_frames(few)[0]) < 2:
        raise InputError("cross-validation by frame needs at least two frames: a single one cannot be held out")
    tried = candidates(options)
    wholes: list[Calibration | str] = [_attempt(few, one) for one in tried]
    good = [whole for whole in wholes if isinstance(whole, Calibration)]
    if not good:
        raise DegenerateError(f"no lens can be calibrated: {wholes[0]}")
    counted = np.any([_inliers(whole, few) for whole in good], axis=0)
    errors = []
    for one, whole in zip(tried, wholes, strict=True):
        if isinstance(whole, str):
            errors.append(HeldOut(label_of(one), _coefficients(one), failed=whole))
            continue
        try:
            errors.append(cross_validate(few, one, k, calibration=whole, counted=counted))
        except CalibrationError as error:
            errors.append(HeldOut(label_of(one), _coefficients(one), failed=str(error)))
    best, chosen = _decide(errors)
    share = (len(few.points) + len(few.curves)) / (len(observations.points) + len(observations.curves))
    current = next(i for i, one in enumerate(tried) if label_of(one) == label_of(options))
    return Choice(tuple(errors), tuple(tried), best, chosen, current, share)


def _attempt(observations: Observations, options: Options) -> Calibration | str:
    try:
        return calibrate(observations, options)
    except CalibrationError as error:
        return str(error)


def _decide(tried: Sequence[HeldOut]) -> tuple[int, int]:
    """Indices of the best candidate and of the simplest that is as good within one standard error."""
    good = [i for i, one in enumerate(tried) if not one.failed]
    if not good:
        raise DegenerateError(f"no lens can be calibrated without one of the folds: {tried[0].failed}")
    common = np.all([tried[i].frame_counts > 0 for i in good], axis=0)
    squares = {i: tried[i].frame_squares[common] for i in good}
    best = min(good, key=lambda i: float(squares[i].sum()))
    for i in sorted(good, key=lambda i: (tried[i].coefficients, float(squares[i].sum()))):
        more = squares[i] - squares[best]
        error = float(np.sqrt(len(more)) * np.std(more, ddof=1))
        if float(more.sum()) <= error:
            return best, i
    return best, best


# ---- candidates -----------------------------------------------------------------------------------------------------


def candidates(options: Options) -> list[Options]:
    """Options with every sensible lens of the same kind, fewest coefficients first; the given one is among them."""
    lens = options.blank_lens
    if lens.powers:
        powers = sorted({*lens.trial_powers, options.powers}, key=lambda p: (len(p), p))
        if set(lens.names) & set(options.fixed):  # a held coefficient belongs to its own powers alone
            powers = [options.powers]
        return [replace(options, powers=one) for one in powers]
    by_order = sorted(zip(lens.orders, lens.names, strict=True))
    names = [name for _, name in by_order if name not in lens.decentring]
    held = {name: value for name, value in options.fixed.items() if name not in names}
    shorter = []
    for count in range(_FEWEST_COEFFICIENTS, len(names) + 1):
        shorter.append(replace(options, fixed={**held, **dict.fromkeys(names[count:], 0.0)}))
    if all(label_of(one) != label_of(options) for one in shorter):
        shorter.append(options)
    return shorter


def label_of(options: Options) -> str:
    """How a lens is called: "radial 2,3" or "brown k1 k2 p1 p2"."""
    if options.blank_lens.powers:
        return f"{options.lens} {','.join(map(str, options.powers))}"
    return " ".join([options.lens, *(name for name in options.blank_lens.names if name not in options.fixed)])


# ---- one fold -------------------------------------------------------------------------------------------------------


def _columns(observations: Observations, name: str) -> AnyArray:
    """(N + M,) one column of the points, then of the curves."""
    return np.concatenate([getattr(observations.points, name), getattr(observations.curves, name)])


def _inliers(calibration: Calibration, observations: Observations) -> Mask:
    return np.concatenate(calibration.inlier_masks(observations))


def _frames(observations: Observations) -> tuple[tuple[str, ...], Indices]:
    """Names of the frames that show anything, and (N + M,) the frame's number of each observation."""
    views = _columns(observations, "view")
    names = dict.fromkeys(observations.views[int(view)].frame for view in np.unique(views))
    order = {name: number for number, name in enumerate(names)}
    return tuple(names), np.array([order.get(view.frame, -1) for view in observations.views])[views]


def _part(observations: Observations, rows: Mask) -> Observations:
    return observations.part(*np.split(rows, [len(observations.points)]))


def thinned(observations: Observations, most: int) -> Observations:
    """Evenly spread frames, and of these evenly spread observations, about `most` in all."""
    total = len(observations.points) + len(observations.curves)
    if total <= most:
        return observations
    names, frame = _frames(observations)
    count = max(min(_FEWEST_FRAMES, len(names)), int(len(names) * most / total))
    chosen = np.isin(frame, np.linspace(0, len(names) - 1, count).round())
    step = max(1, round(np.count_nonzero(chosen) / most))
    for mask in np.split(chosen, [len(observations.points)]):
        mask[np.flatnonzero(mask)[np.arange(np.count_nonzero(mask)) % step > 0]] = False
    return _part(observations, chosen)


def _predicted(observations: Observations, held: Mask, trained: Calibration, whole: Calibration) -> Array:
    """Errors (N + M, 2), px and mm, of held-out observations under a calibration that did not see them."""
    estimate = trained.estimate
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
    built = replace(sights, points=estimate.structure.points(sights), tracks=estimate.structure.tracks(sights))
    start = replace(estimate, structure=make_structure(observations.targets, {}))
    none = {name: np.empty(0, dtype=np.int64) for name in estimate.cameras}
    layout = Layout(none, frozenset(), frozenset(str(key.placement) for key in sights.keys))
    fit, options = trained.fit, trained.options
    weighting = Weighting(fit.point_scale, fit.curve_scale, options.loss, options.loss_scale)
    return solve(Problem(built, layout, weighting=weighting, options=options), start).estimate.placements


def _errors(observations: Observations, rows: Mask, estimate: Estimate) -> Array:
    """Lengths in px and mm of the residuals, (N + M, 2); what is not seen counts 10 sigma in px, NaN in mm."""
    sights = gather_sights(observations).used(*np.split(rows, [len(observations.points)]))
    there = residuals(observations, sights, estimate)
    equations = write_equations(observations, sights, estimate, there)
    px = np.concatenate([np.linalg.norm(there.points, axis=1), np.abs(there.curves)])
    px = np.where(np.isfinite(px), px, _UNSEEN_SIGMA * _columns(observations, "sigma_px"))
    return np.column_stack([px, np.abs(error_mm(equations, equations.residual, len(px)))])


def _coefficients(options: Options) -> int:
    return len(set(options.blank_lens.names) - set(options.fixed))


def _rms(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
