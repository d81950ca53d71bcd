"""Checks of a diagnosis besides the effects: wrong labels, larger noise, correlated neighbours, and a calibration that
does not hold on new observations; also the case that is diagnosed.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import AnyArray, Array, Frozen, Indices, Mask, first_of, log_chi2_tail, log_f_tail, rms
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.labels import WrongLabel
from ceres_cal.diagnostics.table import ResidualTable
from ceres_cal.effects import Amount, AsBuilt, Case, EffectEstimate, Finding, Linearised, Selection, Words
from ceres_cal.effects.table.targets import feature_of
from ceres_cal.problem.structure import numbers_by_kind
from ceres_cal.robust.noise import LARGER, Inliers
from ceres_cal.robust.usable import is_another
from ceres_cal.scene.curves import nearest_on_track

# Fewest pairs of neighbours: 20 determine the correlation to 0.2. Nothing changes from half to double.
_FEWEST_PAIRS = 20


class Noise(Frozen, eq=True):
    """The noise of points or of curves, with the named causes subtracted.

    Attributes:
        kind: "points" or "curves". observations: number of inliers. sigma_px: typical standard deviation (of each
            coordinate of a point, of the distance to a curve). scale: factor on the stated sigmas; stated_px: their
            root mean square, NaN where nobody stated one (all are 1).
        log_p: natural logarithm of the probability of so much noise, if it were LARGER times what was stated.
        correlation: of neighbouring residuals (along a line, between a board's corners), NaN where there are too few.
        correlation_log_p: natural logarithm of the probability of so much correlation in white noise. effective: number
            of independent observations with as much information.
    """

    kind: str
    observations: int
    sigma_px: float
    scale: float
    stated_px: float
    log_p: float
    correlation: float
    correlation_log_p: float
    effective: float

    @property
    def inflation(self) -> float:
        """Number of observations that weigh as much as one independent one."""
        return self.observations / self.effective if self.observations else 1.0


def measure_noise(model: Linearised, before: Linearised, inliers: Inliers) -> tuple[Noise, ...]:
    """Return the noise of points and of curves, where there are any.

    Args:
        model: with the named causes subtracted. before: the calibration's own. inliers: with its noise scales.
    """
    answer = []
    for is_curve, kind, scale in ((False, "points", inliers.point_scale), (True, "curves", inliers.curve_scale)):
        rows = model.used & (model.equations.is_curve == is_curve)
        if np.any(rows):
            own = before.variance(before.used & (before.equations.is_curve == is_curve))
            answer.append(_noise_of(model, kind, rows, scale, own))
    return tuple(answer)


def _noise_of(model: Linearised, kind: str, rows: Mask, own_scale: float, own_variance: float) -> Noise:
    observations = model.equations.sights.observations
    column = observations.curves if kind == "curves" else observations.points
    variance, spare = model.variance(rows), model.spare_of(rows)
    scale = own_scale * float(np.sqrt(variance / own_variance)) if own_variance > 0.0 else own_scale
    count = int(np.count_nonzero(rows)) // (1 if kind == "curves" else 2)
    stated = float("nan") if np.all(column.sigma_px == 1.0) else rms(column.sigma_px)
    log_p = 0.0
    if np.isfinite(stated) and spare >= 1.0:
        log_p = float(log_chi2_tail(variance * spare * own_scale**2 / LARGER**2, spare))
    typical = scale * rms(column.sigma_px)
    correlation, pairs_log_p = _correlation(model, _neighbours(model, kind), variance)
    agree = max(correlation, 0.0) if np.isfinite(correlation) and pairs_log_p < np.log(0.01) else 0.0
    effective = count * (1.0 - agree) / (1.0 + agree)  # of a first-order autoregression
    return Noise(kind, count, typical, scale, stated, log_p, correlation, pairs_log_p, effective)


def _neighbours(model: Linearised, kind: str) -> tuple[Indices, Indices]:
    """Return pairs of used equations: neighbours along a line of one view, or on one row of a board."""
    equations = model.equations
    if kind == "curves":
        rows = np.flatnonzero(model.used & equations.is_curve)
        track = equations.feature[rows]
        along = nearest_on_track(equations.sights.tracks[track], equations.sights.is_arc[track], equations.place[rows])
        first, second = _successive(rows, along, track, equations.view[rows])
        near = equations.feature[first] == equations.feature[second]
    else:
        observations = equations.sights.observations
        grids = [observations.targets[view.target].grid for view in observations.views]
        columns = np.array([0 if grid is None else grid.columns for grid in grids])
        rows = np.flatnonzero(model.used & ~equations.is_curve & (columns[equations.view] > 0))
        component = (equations.direction[rows, 1] > 0.5).astype(int)
        first, second = _successive(rows, equations.feature[rows], component, equations.view[rows])
        near = equations.feature[second] - equations.feature[first] == 1
        near &= np.all(equations.direction[first] == equations.direction[second], axis=1)
        column = observations.points.feature[equations.observation[second]] % columns[equations.view[second]]
        near &= column > 0  # not from the end of a row to the next one
    near &= equations.view[first] == equations.view[second]
    return first[near], second[near]


def _successive(rows: Indices, *keys: AnyArray) -> tuple[Indices, Indices]:
    """Return rows and their successors in the order of the last key, then the one before it, and so on."""
    order = rows[np.lexsort(keys)]
    return order[:-1], order[1:]


def _correlation(model: Linearised, pairs: tuple[Indices, Indices], variance: float) -> tuple[float, float]:
    """Return the correlation of neighbouring residuals beyond that of fitted white noise, and log P of so much."""
    first, second = pairs
    if len(first) < _FEWEST_PAIRS:
        return float("nan"), 0.0
    left, leverage = model.left_over, np.minimum(model.leverage, 1.0)
    overlap = model.overlap(first, second)
    total = float(np.sum(left[first] * left[second] + variance * overlap))
    kept = (1.0 - leverage[first]) * (1.0 - leverage[second])
    z = total / (variance * np.sqrt(np.sum(kept + overlap**2)))
    log_p = log_chi2_tail(z * z, 1.0) - np.log(2.0) if z > 0.0 else 0.0
    return float(total / (variance * max(float(np.sum(np.sqrt(kept))), 1e-9))), float(log_p)


class DiagnosisCase(Case):
    """The case that is diagnosed.

    Attributes:
        labels: groups of observations that another feature explains. labels_tried: number of groups examined.
        calibration: from other observations, which may not hold on these; None where these are its own.
        as_built, effects: what the calibration found to differ from drawings, and other effects that displace the
            observations; both were solved for. solved: the model before rejected observations were recalled.
    """

    inliers: Inliers
    table: ResidualTable
    labels: Sequence[WrongLabel]
    labels_tried: int
    calibration: Calibration | None
    as_built: tuple[AsBuilt, ...] = ()
    effects: tuple[EffectEstimate, ...] = ()
    solved: Linearised | None = None

    @property
    def as_solved(self) -> Linearised:
        return self.solved or self.model


class TestResults(Frozen):
    """A case, the effects that its residuals support, the noise that these leave, and the rate of false alarms."""

    case: DiagnosisCase
    selection: Selection
    noise: tuple[Noise, ...]
    rate: float


def wrong_labels(tested: TestResults) -> Iterator[Finding]:
    """Yield findings of labels that stand for another feature, each over all its frames."""
    groups: dict[tuple[bool, str, int, int], list[WrongLabel]] = defaultdict(list)
    for label in tested.case.labels:
        if label.log_p <= tested.selection.log_level:
            name = tested.case.problem.observations.views[label.view].target
            groups[label.is_curve, name, label.feature, label.instead].append(label)
    for (_, target, _, _), labels in groups.items():
        yield _wrong_label(tested, target, labels)


def _wrong_label(tested: TestResults, target: str, labels: list[WrongLabel]) -> Finding:
    observations, table, one = tested.case.problem.observations, tested.case.table, labels[0]
    described = observations.targets[target]
    names = described.curve_names if one.is_curve else described.point_names
    kind = "curve" if one.is_curve else "point"
    rows = np.concatenate([label.rows for label in labels])
    at = rows + (len(observations.points) if one.is_curve else 0)
    frames = list(dict.fromkeys(observations.views[label.view].frame for label in labels))
    listing = first_of(list(map(repr, frames)), 5)
    away = float(np.mean(np.concatenate([label.distance_px for label in labels])))
    px, mm = _mean(np.abs(table.distance_px[at])), _mean(np.abs(table.error_mm[at]))
    sentence = (
        f"frame {listing}: {names[one.feature]!r} observed where {names[one.instead]!r} projects ({len(rows)} "
        f"{kind} observation{'s' if len(rows) > 1 else ''}, {away:.2f} px from it)"
    )
    return Finding(
        "wrong label", "observations", f"{target}/{names[one.feature]}", frames[0], sentence,
        "correct the label; it was taken out and does not affect the result", px, mm, px / away, (),
        tested.selection.log10_p(min(label.log_p for label in labels)), len(rows),
        tuple((kind, int(row)) for row in rows),
    )  # fmt: skip


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else float("nan")


def _of_noise(
    kind: str, about: Callable[[Noise], tuple[float, float, Words]], tested: TestResults
) -> Iterator[Finding]:
    """Yield findings about the noise of points and of curves.

    Args:
        about: returns log P of so much by chance, its size in px, and its words, for either.
    """
    case = tested.case
    for noise in tested.noise:
        log_p, px, words = about(noise)
        if log_p <= tested.selection.log_level:
            rows = case.model.used & (case.equations.is_curve == (noise.kind == "curves"))
            all_px, all_mm, _ = case.effect(case.equations.residual, rows)
            mm = px * all_mm / all_px if all_px > 0.0 else float("nan")
            yield Finding(
                kind, "observations", noise.kind, None, words.sentence, words.advice, px, mm, px / noise.sigma_px,
                words.amounts, tested.selection.log10_p(log_p), noise.observations,
            )  # fmt: skip


def larger(noise: Noise) -> tuple[float, float, Words]:
    """Return log P, size in px and words of noise beyond what was stated."""
    sentence = (
        f"the noise of {noise.kind} is {noise.scale:.2f} times what was stated: {noise.sigma_px:.3f} px, not "
        f"{noise.sigma_px / noise.scale:.3f}"
    )
    amount = Amount("scale", noise.scale, noise.scale / float(np.sqrt(2.0 * noise.observations)), "")
    advice = "state the larger sigma if sigmas are used as stated; an estimated noise scale includes this already"
    return noise.log_p, noise.sigma_px, Words(sentence, advice, (amount,))


def correlated(noise: Noise) -> tuple[float, float, Words]:
    """Return log P, size in px and words of the correlation of neighbouring residuals."""
    sentence = (
        f"neighbouring residuals of {noise.kind} are correlated (coefficient {noise.correlation:.2f}): "
        f"{noise.observations} observations count as much as {noise.effective:.0f} independent ones"
    )
    amount = Amount("correlation", noise.correlation, 1.0 / float(np.sqrt(noise.observations)), "")
    advice = "look for what displaces whole features; the standard deviations include this already"
    shared_px = noise.sigma_px * float(np.sqrt(max(noise.correlation, 0.0)))
    return noise.correlation_log_p, shared_px, Words(sentence, advice, (amount,))


def does_not_hold(tested: TestResults) -> Iterator[Finding]:
    """Yield a finding where a refit to new observations would fit them better than chance explains.

    The gain of a refit is chi-square if the calibration is exact; its own uncertainty adds as much again for every time
    that the new observations are as many as those it was made from. This holds where both see the same part of the
    image: differences at places that the calibration never saw count against it.
    """
    case, model = tested.case, tested.case.model
    step, used = model.step, model.used
    if case.calibration is None or not len(step):
        return
    own = 2 * case.calibration.fit.points + case.calibration.fit.curves
    inflation = 1.0 + np.count_nonzero(used) / max(own, 1)
    left = model.left_over
    variance = float(left @ left) / max(model.spare, 1)
    statistic = float(step @ step) / (inflation * len(step) * variance)
    log_p = float(log_f_tail(statistic, len(step), max(model.spare, 1)))
    if log_p > tested.selection.log_level:
        return
    px, mm, count = case.effect(np.where(used, (model.shared @ step) / model.weight, 0.0), used)
    sentence = (
        f"the calibration does not fit these observations: a refit would move them by {px:.2f} px, {mm:.1f} mm rms"
    )
    yield Finding(
        "does not hold", "calibration", ", ".join(case.problem.observations.stations), None, sentence,
        "run `ceres-cal check` to see whether the camera was moved, then refit", px, mm,
        px / case.noise_px(left, used), (), tested.selection.log10_p(log_p), count,
    )  # fmt: skip


CHECKS: dict[str, tuple[Callable[[TestResults], Iterator[Finding]], Callable[[DiagnosisCase], int]]] = {
    "wrong label": (wrong_labels, lambda case: case.labels_tried),
    "noise": (partial(_of_noise, "noise", larger), lambda case: 2),
    "correlated": (partial(_of_noise, "correlated", correlated), lambda case: 2),
    "does not hold": (does_not_hold, lambda case: 1),
}
"""Kinds of findings that are no columns over the equations: what yields those whose probability is at most the
selection's level, and the number of tests on a case, which share the rate of false alarms with the effects."""


def solved_for(kind: str, one: AsBuilt, tested: TestResults) -> Finding:
    """Return the finding of an effect that the calibration found and solved for."""
    case, structure = tested.case, tested.case.estimate.structure
    targets = case.problem.observations.targets
    numbers = numbers_by_kind(structure, targets)[one.target, one.kind]
    advice = "nothing to do; with a flat and exact target fewer views are needed"
    if is_another(one, targets[one.target]):
        advice = "check the order of its points, and its kind, columns, rows and dimensions"
    offsets = np.zeros(len(structure.offsets) + 1)
    offsets[numbers] = structure.values[numbers]
    shift = np.sum(case.equations.built * offsets[case.equations.slots(structure)], axis=1)
    rows = (shift != 0.0) & case.model.used
    px, mm, observations = case.effect(shift, rows)
    most = int(numbers[np.argmax(np.abs(offsets[numbers]))])
    alone = offsets[most] ** 2 > 0.5 * float(offsets @ offsets) and len(numbers) > 2
    return Finding(
        kind, "observations", feature_of(structure.names[most]) if alone else one.target, None,
        f"{one.target} is not as drawn: {one.words}, most of all {structure.names[most]} by "
        f"{1e3 * offsets[most]:+.2f} mm; it was solved for", advice,
        px, mm, px / case.noise_px(tested.selection.model.left_over, rows),
        (Amount("sigma", 1e3 * one.sigma_m, 0.0, "mm"),), float(np.log10(max(1.0 - one.probability, 1e-300))),
        observations,
    )  # fmt: skip
