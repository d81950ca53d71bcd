"""Findings in words: what each alternative that the residuals speak for means, how much it is, and what to do."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.words import two_digits
from ceres_cal.diagnostics.alternatives import missing_powers, radial_column
from ceres_cal.diagnostics.equations import Equations
from ceres_cal.diagnostics.findings import SMALL, Amount, Finding
from ceres_cal.diagnostics.labels import Mislabelled
from ceres_cal.diagnostics.leftover import Noise
from ceres_cal.diagnostics.linear_model import LinearModel
from ceres_cal.diagnostics.patterns import Selection, amounts_of, gains_of
from ceres_cal.diagnostics.scores import Score
from ceres_cal.diagnostics.table import ResidualTable, plane_shift
from ceres_cal.model.parameters import Estimate, Layout
from ceres_cal.observations import Observations
from ceres_cal.scene.lens import LENSES
from ceres_cal.scene.targets import Arc, Segment

_LN_10 = float(np.log(10.0))
_MOST_NAMED = 5


@dataclass(frozen=True, eq=False)
class Context:
    """What the words are made from. `model` is the model before any alternative was put in; tests: how many."""

    observations: Observations
    estimate: Estimate
    layout: Layout
    equations: Equations
    model: LinearModel
    table: ResidualTable
    tests: int

    def log10_p(self, log_p: float) -> float:
        """Decimal logarithm after Bonferroni."""
        return min(0.0, (log_p + float(np.log(self.tests))) / _LN_10)

    def effect(self, shift: Array, rows: Mask) -> tuple[float, float, int]:
        """Root mean square over observations of a displacement (E,) px, in px and mm, and how many they are."""
        count = len(np.unique(self.equations.observation[rows]))
        with np.errstate(divide="ignore", invalid="ignore"):
            x, y = plane_shift(self.equations, shift)
        twice = np.where(self.equations.is_curve, 1.0, 2.0)  # both equations of a point carry its whole shift in mm
        squared = np.nansum(((x**2 + y**2) / twice)[rows])
        return float(np.sqrt(np.sum(shift[rows] ** 2) / count)), float(np.sqrt(squared / count)), count

    def noise_px(self, left_over: Array, rows: Mask) -> float:
        """Root mean square over observations of what is left over, (E,) in standard deviations, px."""
        count = len(np.unique(self.equations.observation[rows]))
        return float(np.sqrt(np.sum((left_over / self.model.weight)[rows] ** 2) / count))


@dataclass(frozen=True)
class _Said:
    """The parts of a finding that differ by kind."""

    sentence: str
    advice: str
    amounts: tuple[Amount, ...]
    frame: str | None = None
    subject: str | None = None


def pattern_finding(context: Context, selection: Selection, number: int) -> Finding:
    """The finding of one chosen alternative."""
    score, shift = selection.chosen[number], selection.shift[:, number]
    rows = np.any(score.family.of(score.number) != 0.0, axis=1) & context.model.used
    effect_px, effect_mm, count = context.effect(shift, rows)
    others = context.model
    for k, other in enumerate(selection.chosen):
        if k != number:
            others = others.with_columns(other.family.of(other.number) * others.weight[:, None])
    ratio = effect_px / context.noise_px(selection.model.left_over, rows)
    size = f"{effect_px:.2f} px, {effect_mm:.{1 if effect_mm >= 0.1 else 2}f} mm rms, {two_digits(ratio)} of the noise"
    said = _SPEAKERS[score.family.kind](context, others, score, shift, size, ratio)
    name = score.family.names[score.number]
    return Finding(
        score.family.kind, said.subject or name, said.frame, said.sentence, said.advice, effect_px, effect_mm, ratio,
        said.amounts, context.log10_p(score.log_p), count,
    )  # fmt: skip


# ---- the lens -------------------------------------------------------------------------------------------------------


def _most(context: Context, shift: Array) -> float:
    """The largest displacement (px) of an observation that took part."""
    return float(np.max(np.abs(shift[context.model.used])))


def _radius(context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float) -> _Said:
    name = score.family.names[score.number]
    lens = context.estimate.cameras[name].lens
    own = score.family.group == score.number
    powers = missing_powers(context.estimate, context.layout, name)
    columns = [radial_column(context.equations, context.estimate, name, one) * own for one in powers]
    gains = gains_of(others, np.column_stack(columns))
    power, gain = powers[int(np.argmax(gains))], float(np.max(gains))
    whole = amounts_of(others, score.family.of(score.number))[2]
    most, share = _most(context, shift * own), 100.0 * min(1.0, gain / whole)
    judged = "is too short" if ratio >= SMALL else "is too short by little"
    sentence = (
        f"camera {name!r}: residuals follow the radius, up to {most:.2f} px ({size}): the radial polynomial {judged}; "
        f"one more power, r^{power}, explains {share:.0f} % of it"
    )
    held = [key for key, order in zip(lens.names, lens.orders, strict=True) if order == power]
    held = [key for key in held if key not in lens.decentring]
    if lens.powers:
        advice = f"calibrate with --powers {','.join(map(str, sorted({*lens.powers, power})))}"
    elif held:
        advice = f"let {held[0]} free (no --fix {held[0]}=...)"
    else:
        growing = " or ".join(kind for kind, other in LENSES.items() if other.trial_powers)
        advice = f"the {lens.kind} lens has no such power: try another lens or the {growing} one with more powers"
    return _Said(sentence, advice, ())


def _decentring(context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float) -> _Said:
    name = score.family.names[score.number]
    most = _most(context, shift)
    own = context.estimate.cameras[name].lens.decentring
    kind, names = next((kind, lens.decentring) for kind, lens in LENSES.items() if lens.decentring)
    return _Said(
        f"camera {name!r}: its lens is not centred: a tangential displacement of up to {most:.2f} px ({size})",
        f"let {' and '.join(own)} free" if own else f"calibrate with --lens {kind}, which has {' and '.join(names)}",
        (),
    )


def _aspect(context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float) -> _Said:
    name = score.family.names[score.number]
    held = context.estimate.cameras[name].aspect
    return _Said(
        f"camera {name!r}: its pixels are not as wide as high: aspect {held + score.amount[0]:.5f} ± "
        f"{score.sd[0]:.5f}, not {held:g} ({size})",
        "calibrate with --free-aspect",
        (Amount("aspect", float(score.amount[0]), float(score.sd[0]), ""),),
    )


def _principal_point(
    context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float
) -> _Said:
    name = score.family.names[score.number]
    x, y = score.amount
    return _Said(
        f"camera {name!r}: the principal point is held, but the residuals ask for it {x:+.1f}, {y:+.1f} px from there "
        f"({size})",
        "let it free",
        tuple(Amount(f"c{axis}", float(score.amount[k]), float(score.sd[k]), "px") for k, axis in enumerate("xy")),
    )  # fmt: skip


def _phi(context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float) -> _Said:
    name = score.family.names[score.number]
    return _Said(
        f"camera {name!r}: phi is held, but residuals ask for {score.amount[0]:+.2f} ± {score.sd[0]:.2f} px ({size})",
        "let it free, or give it as a prior with a sigma",
        (Amount("phi", float(score.amount[0]), float(score.sd[0]), "px"),),
    )


# ---- the target as built --------------------------------------------------------------------------------------------


def _curve_aside(context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float) -> _Said:
    name = score.family.names[score.number]
    target, _, feature = name.partition("/")
    curve = context.observations.targets[target].curves[feature]
    mm, sd = 1e3 * score.amount, 1e3 * score.sd
    advice = f"measure it, or solve for it: --tolerance {target}.lines_m=0.01"
    if isinstance(curve, Arc):
        amounts = tuple(
            Amount(part, float(v), float(s), "mm") for part, v, s in zip(("x", "y", "radius"), mm, sd, strict=True)
        )
        how = f"its centre x {mm[0]:+.1f}, y {mm[1]:+.1f} mm and its radius {mm[2]:+.1f} mm off"
        return _Said(f"{name} is not painted as drawn: {how} ({size})", advice, amounts)
    assert isinstance(curve, Segment)
    along = np.subtract(curve.end, curve.start)[:2]
    x, y = mm[0] * np.array([-along[1], along[0]]) / np.hypot(*along)
    sentence = (
        f"{name} is painted {abs(mm[0]):.1f} ± {sd[0]:.1f} mm aside of its drawing (x {x:+.1f}, y {y:+.1f} mm; {size})"
    )
    return _Said(sentence, advice, (Amount("left", float(mm[0]), float(sd[0]), "mm"),))


def _point_aside(context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float) -> _Said:
    name = score.family.names[score.number]
    target = name.partition("/")[0]
    mm, sd = 1e3 * score.amount, 1e3 * score.sd
    return _Said(
        f"{name} lies x {mm[0]:+.1f} ± {sd[0]:.1f}, y {mm[1]:+.1f} ± {sd[1]:.1f} mm from where it is drawn ({size})",
        f"measure it, or solve for it: --tolerance {target}.points_m=0.005",
        tuple(Amount(axis, float(v), float(s), "mm") for axis, v, s in zip("xy", mm, sd, strict=True)),
    )


def _board_bent(context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float) -> _Said:
    name = score.family.names[score.number]
    mm, sd = 1e3 * score.amount, 1e3 * score.sd
    return _Said(
        f"board {name} is not flat: bowed by {mm[0]:+.2f} ± {sd[0]:.2f} mm along x, {mm[1]:+.2f} ± {sd[1]:.2f} mm "
        f"along y ({size})",
        f"mount it on something flat, or solve for it: --tolerance {name}.warp_m=0.002",
        tuple(Amount(f"bow.{axis}", float(v), float(s), "mm") for axis, v, s in zip("xy", mm, sd, strict=True)),
    )


# ---- a camera that moved --------------------------------------------------------------------------------------------


def _moved(context: Context, others: LinearModel, score: Score, shift: Array, size: str, ratio: float) -> _Said:
    station, _, frame = score.family.names[score.number].partition("\n")
    when = f"after frame {frame!r}" if score.family.onwards else f"in frame {frame!r} alone"
    columns = score.family.of(score.number)
    turn, turn_sd, turn_gain = amounts_of(others, columns[:, :3])
    step, step_sd, step_gain = amounts_of(others, columns[:, 3:])
    whole = max(amounts_of(others, columns)[2], 1e-300)
    angle, angle_sd = np.degrees(_length(turn, turn_sd))
    mm, mm_sd = 1e3 * np.array(_length(step, step_sd))
    ways = [
        (turn_gain, f"turned by {angle:.3f} ± {angle_sd:.3f} degrees"),
        (step_gain, f"shifted by {mm:.1f} ± {mm_sd:.1f} mm"),
    ]
    ways.sort(key=lambda way: -way[0])
    explanation = " or ".join(f"{text} (explains {100.0 * min(gain / whole, 1.0):.0f} %)" for gain, text in ways)
    names = (*(f"turn about the camera's {axis}" for axis in "xyz"), *(f"shift along {axis}" for axis in "xyz"))
    scale, units = np.array([180.0 / np.pi] * 3 + [1e3] * 3), ["deg"] * 3 + ["mm"] * 3
    amounts = tuple(
        Amount(name, float(v), float(s), unit)
        for name, v, s, unit in zip(names, scale * score.amount, scale * score.sd, units, strict=True)
    )  # fmt: skip
    advice = "give the frames after it a station of their own"
    if not score.family.onwards:
        advice = "leave this frame out, or give it a station of its own"
    return _Said(f"station {station!r} moved {when}: {explanation}; {size}", advice, amounts, frame, station)


def _length(vector: Array, sd: Array) -> tuple[float, float]:
    """Length of a vector, and its standard deviation by that of its parts."""
    length = float(np.linalg.norm(vector))
    known = np.isfinite(sd)
    return length, float(np.linalg.norm(vector[known] * sd[known])) / max(length, 1e-300)


_SPEAKERS: dict[str, Callable[[Context, LinearModel, Score, Array, str, float], _Said]] = {
    "radius": _radius,
    "decentring": _decentring,
    "aspect": _aspect,
    "principal point": _principal_point,
    "phi": _phi,
    "curve aside": _curve_aside,
    "point aside": _point_aside,
    "board bent": _board_bent,
    "moved after": _moved,
    "moved in": _moved,
}


# ---- labels and noise -----------------------------------------------------------------------------------------------


def label_findings(context: Context, labels: Sequence[Mislabelled], log_level: float) -> Iterator[Finding]:
    """One finding for each label that stands for another feature, over all its frames."""
    groups: dict[tuple[bool, str, int, int], list[Mislabelled]] = defaultdict(list)
    for label in labels:
        if label.log_p <= log_level:
            name = context.observations.views[label.view].target
            groups[(label.is_curve, name, label.feature, label.instead)].append(label)
    for (is_curve, target_name, feature, instead), members in groups.items():
        target = context.observations.targets[target_name]
        names = target.curve_names if is_curve else target.point_names
        kind, offset = ("curve", len(context.observations.points)) if is_curve else ("point", 0)
        rows = np.concatenate([member.rows for member in members])
        frames = list(dict.fromkeys(context.observations.views[member.view].frame for member in members))
        listing = ", ".join(map(repr, frames[:_MOST_NAMED])) + (" ..." if len(frames) > _MOST_NAMED else "")
        away = float(np.mean(np.concatenate([member.distance_px for member in members])))
        own = np.abs(context.table.distance_px[rows + offset])
        mm = np.abs(context.table.error_mm[rows + offset])
        sentence = (
            f"frame {listing}: {names[feature]!r} observed where {names[instead]!r} projects ({len(rows)} "
            f"{kind} observation{'s' if len(rows) > 1 else ''}, {away:.2f} px from it)"
        )
        yield Finding(
            "wrong label", f"{target_name}/{names[feature]}", frames[0], sentence,
            "correct the label; it was taken out and did no harm", _mean(own), _mean(mm), _mean(own) / away, (),
            context.log10_p(min(member.log_p for member in members)), len(rows),
            tuple((kind, int(row)) for row in rows),
        )  # fmt: skip


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else float("nan")


def noise_findings(context: Context, noise: Sequence[Noise], log_level: float) -> Iterator[Finding]:
    """Noise larger than stated, and neighbours that agree."""
    for one in noise:
        rows = context.model.used & (context.equations.is_curve == (one.kind == "curves"))
        px, mm, _ = context.effect(context.equations.residual, rows)
        per_px = mm / px if px > 0.0 else float("nan")
        if one.log_p <= log_level:
            sentence = (
                f"the noise of {one.kind} is {one.scale:.2f} times what was stated: {one.sigma_px:.3f} px, not "
                f"{one.sigma_px / one.scale:.3f}"
            )
            amount = Amount("scale", one.scale, one.scale / float(np.sqrt(2.0 * one.observations)), "")
            advice = "state the larger sigma where sigmas are taken as stated; the estimated scale is right already"
            yield Finding(
                "noise", one.kind, None, sentence, advice, one.sigma_px, one.sigma_px * per_px, 1.0, (amount,),
                context.log10_p(one.log_p), one.observations,
            )  # fmt: skip
        if one.correlation_log_p <= log_level:
            sentence = (
                f"neighbouring residuals of {one.kind} agree (correlation {one.correlation:.2f}): {one.observations} "
                f"observations say as much as {one.effective:.0f} independent ones"
            )
            shared = one.sigma_px * float(np.sqrt(max(one.correlation, 0.0)))
            advice = "take every standard deviation of the calibration larger by the square root of that ratio"
            amount = Amount("correlation", one.correlation, 1.0 / float(np.sqrt(one.observations)), "")
            yield Finding(
                "correlated", one.kind, None, sentence, advice, shared, shared * per_px, shared / one.sigma_px,
                (amount,), context.log10_p(one.correlation_log_p), one.observations,
            )  # fmt: skip
