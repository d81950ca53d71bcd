"""Diagnostics of the target as built: a line, an arc or a point aside, a board that is bent."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.words import first_of
from ceres_cal.diagnostics.diagnostic import Amount, Case, Evidence, Finding, ScoreTest, Tested, Words, amounts
from ceres_cal.diagnostics.scores import Family, grouped
from ceres_cal.problem.structure import WARP, Kind, numbers_by_kind
from ceres_cal.robust.repeats import AsBuilt
from ceres_cal.scene.targets import Arc, Segment

# Observations that say whether a curve lies aside: three numbers of an arc, and as many left to contradict them.
# Nothing changes from half to double.
_FEWEST_ON_CURVE = 8
# Observations that say whether a point lies aside: one could be an outlier that was just not taken out. Nothing
# changes from half to double.
_FEWEST_OF_POINT = 2
# Rejected observations of one line that must agree on its place: two determine it, three more do not by chance.
# Nothing changes from half to double.
_FEWEST_AGREE = 5
# Features aside of one target from which on it is the target. Two may be lines that somebody painted anew.
_SEVERAL = 3
# What lies farther aside is no painting error: its label is wrong. Nothing changes from half to double.
_FAR_M = 0.1
# Standard deviations from which on a twist or a wave of a board is worth a word beside its bows.
_CLEAR = 2.0


class _StructureTest(ScoreTest):
    """What moves some numbers of the structure that no tolerance solves for, where enough equations of it are used.

    Attributes:
        curves: whether of curves, or of points. places: of the numbers, as in `Equations.built`. built: the kind of
            what `calibrate` solves for by itself.
    """

    curves: ClassVar[bool] = False
    places: ClassVar[slice]
    built: ClassVar[Kind]

    @property
    def _fewest(self) -> int:
        return _FEWEST_ON_CURVE if self.curves else 2 * _FEWEST_OF_POINT

    def families(self, case: Case) -> Iterator[Family]:
        equations, structure = case.equations, case.whole_structure
        slot, own = (slots[:, self.places.start] for slots in case.slots)
        solved = (own >= 0) & (own < case.estimate.structure.own)
        rows = (equations.is_curve == self.curves) & (slot >= 0) & ~solved
        numbers, group = grouped(slot, rows)
        counts = np.bincount(group[rows & case.model.used], minlength=len(numbers) + 1)  # group -1 finds the last, 0
        group = np.where(counts[group] >= self._fewest, group, -1)
        names = tuple(_feature_of(structure.names[number]) for number in numbers)
        yield Family(self.kind, equations.built[:, self.places], group, names)

    def findings(self, tested: Tested) -> Iterator[Finding]:
        yield from _of_each_target(list(super().findings(tested)))
        for one in tested.case.as_built:
            if one.kind == self.built and one.probability >= 1.0 - tested.rate:
                yield _solved_for(self.kind, one, tested)


def _of_each_target(findings: Sequence[Finding]) -> Iterator[Finding]:
    """One finding for a target of which several features lie aside."""
    for target in dict.fromkeys(one.subject.partition("/")[0] for one in findings):
        own = [one for one in findings if one.subject.partition("/")[0] == target]
        if len(own) < _SEVERAL:
            yield from own
            continue
        counts = np.array([one.observations for one in own], dtype=float)
        px, mm, ratio = (
            float(np.sqrt(np.average([value**2 for value in values], weights=counts)))
            for values in zip(*((one.effect_px, one.effect_mm, one.noise_ratio) for one in own), strict=True)
        )
        names = first_of([one.subject for one in own], 3)
        yield replace(
            own[0], subject=target, sentence=f"{target} is not as drawn: {names} ({px:.2f} px, {mm:.1f} mm rms)",
            advice=f"measure it, or let `calibrate` solve for it: with --as-built, or --tolerance {target}",
            effect_px=px, effect_mm=mm, noise_ratio=ratio, amounts=(), observations=int(counts.sum()),
            log10_p=min(one.log10_p for one in own),
        )  # fmt: skip


def _solved_for(kind: str, one: AsBuilt, tested: Tested) -> Finding:
    """What the calibration found by itself, and has in it."""
    case, structure = tested.case, tested.case.estimate.structure
    numbers = numbers_by_kind(structure, case.observations.targets)[one.target, one.kind]
    offsets = np.zeros(len(structure.offsets) + 1)
    offsets[numbers] = structure.values[numbers]
    shift = np.sum(case.equations.built * offsets[case.equations.slots(structure)], axis=1)
    rows = (shift != 0.0) & case.model.used
    effect = case.effect(shift, rows)
    most = int(numbers[np.argmax(np.abs(offsets[numbers]))])
    alone = offsets[most] ** 2 > 0.5 * float(offsets @ offsets) and len(numbers) > 2
    return Finding(
        kind, "observations", _feature_of(structure.names[most]) if alone else one.target, None,
        f"{one.target} is not as drawn: {one.words}, most of all {structure.names[most]} by "
        f"{1e3 * offsets[most]:+.2f} mm; it was solved for", "none is needed; a flat, exact target needs fewer views",
        effect.px, effect.mm, effect.px / case.noise_px(tested.selection.model.left_over, rows),
        (Amount("sigma", 1e3 * one.sigma_m, 0.0, "mm"),), float(np.log10(max(1.0 - one.probability, 1e-300))),
        effect.observations,
    )  # fmt: skip


def _feature_of(name: str) -> str:
    """field/CenterCircle.x -> field/CenterCircle"""
    for ending in (".x", ".y"):
        name = name.removesuffix(ending)
    return name.removesuffix("/bow")


class CurveAside(_StructureTest):
    """A line or an arc is not painted as drawn."""

    kind = "curve aside"
    built: ClassVar = "lines"
    curves = True
    places: ClassVar = slice(0, 3)

    def words(self, evidence: Evidence) -> Words:
        name = evidence.score.subject
        target, _, feature = name.partition("/")
        curve = evidence.case.observations.targets[target].curves[feature]
        mm, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
        advice = f"measure it, or solve for it: --tolerance {target}.lines_m=0.01"
        if isinstance(curve, Arc):
            how = f"its centre x {mm[0]:+.1f}, y {mm[1]:+.1f} mm and its radius {mm[2]:+.1f} mm off"
            sentence = f"{name} is not painted as drawn: {how} ({evidence.size})"
            return Words(sentence, advice, amounts(("x", "y", "radius"), mm, sd, "mm"))
        assert isinstance(curve, Segment)
        along = np.subtract(curve.end, curve.start)[:2]
        x, y = mm[0] * np.array([-along[1], along[0]]) / np.hypot(*along)
        sentence = (
            f"{name} is painted {abs(mm[0]):.1f} ± {sd[0]:.1f} mm aside of its drawing (x {x:+.1f}, y {y:+.1f} mm; "
            f"{evidence.size})"
        )
        return Words(sentence, advice, amounts(["left"], mm[:1], sd[:1], "mm"))


class PointAside(_StructureTest):
    """A point does not lie where it is drawn."""

    kind = "point aside"
    built: ClassVar = "points"
    places: ClassVar = slice(0, 2)

    def words(self, evidence: Evidence) -> Words:
        name = evidence.score.subject
        mm, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
        return Words(
            f"{name} lies x {mm[0]:+.1f} ± {sd[0]:.1f}, y {mm[1]:+.1f} ± {sd[1]:.1f} mm from where it is drawn "
            f"({evidence.size})",
            f"measure it, or solve for it: --tolerance {name.partition('/')[0]}.points_m=0.005",
            amounts("xy", mm, sd, "mm"),
        )


class BoardBent(_StructureTest):
    """A board is bowed along its sides, twisted or wavy."""

    kind = "board bent"
    built: ClassVar = "warp"
    places: ClassVar = slice(2, 2 + len(WARP))

    def words(self, evidence: Evidence) -> Words:
        name = evidence.score.subject
        mm, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
        further = [
            f"{words} {a:+.2f} ± {s:.2f} mm"
            for words, a, s in zip(("twisted by", "waves along x of", "along y of"), mm[2:], sd[2:], strict=True)
            if abs(a) > _CLEAR * s
        ]
        return Words(
            f"board {name} is not flat: bowed by {mm[0]:+.2f} ± {sd[0]:.2f} mm along x, {mm[1]:+.2f} ± {sd[1]:.2f} mm "
            f"along y{''.join(f', {one}' for one in further)} ({evidence.size})",
            f"mount it on something flat, or solve for it: --tolerance {name}.warp_m=0.002",
            amounts(WARP, mm, sd, "mm"),
        )


# ---- observations that were taken out and may speak again -----------------------------------------------------------


def recalled(case: Case) -> Mask:
    """(E,) which equations take part when lines and points that were taken out nearly whole may speak too.

    A feature that lies aside is an outlier everywhere. Where more of its observations agree about one place of their
    own than agree with the drawing, those take part instead.
    """
    equations, weight, used = case.equations, case.model.weight, case.model.used.copy()
    open_to_it = ~_mislabelled(case)[equations.observation]
    counted = replace(case, model=replace(case.model, used=open_to_it))
    for family in (*CurveAside().families(counted), *PointAside().families(counted)):
        own = (family.group >= 0) & open_to_it
        rejected = np.bincount(family.group[own & ~used], minlength=len(family.subjects))
        for number in np.flatnonzero(rejected >= _FEWEST_AGREE):
            rows = np.flatnonzero(own & (family.group == number))
            agree = _agreeing(family.columns[rows] * weight[rows, None], equations.residual[rows] * weight[rows],
                              equations.observation[rows], case.problem.options.reject_sigma)  # fmt: skip
            if np.count_nonzero(agree) > max(int(np.count_nonzero(used[rows])), _FEWEST_AGREE - 1):
                used[rows] = agree
    return used


def _mislabelled(case: Case) -> Mask:
    """(N + M,) the observations that a wrong label explains."""
    points = len(case.observations.points)
    explained = np.zeros(len(case.table), dtype=bool)
    for label in case.labels.mislabelled:
        explained[label.rows + (points if label.is_curve else 0)] = True
    return explained


def _agreeing(columns: Array, residual: Array, observation: Indices, reject_sigma: float) -> Mask:
    """(N,) which equations one amount brings within the bound, by least absolute deviations; none if it is too far."""
    columns = columns[:, np.any(columns != 0.0, axis=0)]
    amount: Array = np.zeros(columns.shape[1])
    for _ in range(30):
        sizes = 1.0 / np.sqrt(np.maximum(np.abs(residual + columns @ amount), 1.0))
        amount = -np.asarray(np.linalg.lstsq(columns * sizes[:, None], residual * sizes, rcond=1e-9)[0])
    _, of = np.unique(observation, return_inverse=True)
    lengths = np.sqrt(np.bincount(of, (residual + columns @ amount) ** 2))
    agree = (lengths <= reject_sigma)[of]
    return agree if np.all(np.abs(amount) < _FAR_M) else np.zeros(len(agree), dtype=bool)
