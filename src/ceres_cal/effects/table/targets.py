"""Effects of targets as built (a displaced line, arc or point, a bent or stretched board), and of the floor: bowed as a
whole, higher at one place than around it, or with a field that is painted out of square.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from ceres_cal.base import Array, Indices, Mask, first_of, replace
from ceres_cal.base.words import with_sd
from ceres_cal.effects.columns import EffectColumns, grouped
from ceres_cal.effects.effect import Case, Effect, Evidence, Finding, Words, amounts
from ceres_cal.effects.evidence import FLOOR_OFF, STRETCHED
from ceres_cal.observations import Observations
from ceres_cal.problem.structure import STRETCH, WARP, dimension_slopes, dimensions_of
from ceres_cal.scene.targets import Arc, Segment, still

# Observations from which on a curve is tested: three numbers describe an arc, and as many equations must be able to
# contradict them. Halving or doubling changes nothing.
_FEWEST_ON_CURVE = 8
# Observations from which on a point is tested: a single one could be an outlier that was just not rejected. Halving or
# doubling changes nothing.
_FEWEST_OF_POINT = 2


def _offsets(places: slice, case: Case, *, curves: bool = False) -> Iterator[EffectColumns]:
    """Offsets of structure numbers that no tolerance solves for, where enough of their equations are used.

    Args:
        places: the columns of `Equations.built` that belong to the numbers. curves: whether curves or points are meant.
    """
    fewest = _FEWEST_ON_CURVE if curves else 2 * _FEWEST_OF_POINT
    equations, structure = case.equations, case.whole_structure
    slot, own = (slots[:, places.start] for slots in case.slots)
    solved = (own >= 0) & (own < case.estimate.structure.own)
    rows = (equations.is_curve == curves) & (slot >= 0) & ~solved
    numbers, group = grouped(slot, rows)
    names = tuple(feature_of(structure.names[number]) for number in numbers)
    yield EffectColumns(equations.built[:, places], _with_enough(group, case.model.used, fewest), names)


def _with_enough(group: Indices, used: Mask, fewest: int) -> Indices:
    """The groups (E,), -1 for none, without those of which fewer than `fewest` equations are used."""
    counts = np.bincount(group[(group >= 0) & used], minlength=int(group.max(initial=-1)) + 2)
    return np.where(counts[group] >= fewest, group, -1)  # index -1 is the last count, which is 0


def _of_each_target(findings: Sequence[Finding]) -> Iterator[Finding]:
    """Combine the findings of a target with several displaced features into one."""
    # Displaced features of one target from which on the target is reported. Two may be lines that were repainted.
    several = 3
    for target in dict.fromkeys(one.subject.partition("/")[0] for one in findings):
        own = [one for one in findings if one.subject.partition("/")[0] == target]
        if len(own) < several:
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
            advice=f"measure it, or let `calibrate` solve for it: without --as-drawn, or with --tolerance {target}",
            effect_px=px, effect_mm=mm, noise_ratio=ratio, amounts=(), observations=int(counts.sum()),
            log10_p=min(one.log10_p for one in own),
        )  # fmt: skip


def feature_of(name: str) -> str:
    """The feature of a structure number: field/CenterCircle.x -> field/CenterCircle."""
    for ending in (".x", ".y", "/bow", "/stretch"):
        name = name.removesuffix(ending)
    return name


def _tolerance(usual_m: float, mm: Array) -> str:
    """A tolerance in metres under which such offsets are found: one of 10 mm holds a line that lies 70 mm off."""
    return f"{max(usual_m, 1e-3 * float(np.max(np.abs(mm)))):.1g}"


def _of_curve(evidence: Evidence) -> Words:
    name = evidence.score.subject
    target, _, feature = name.partition("/")
    curve = evidence.case.problem.observations.targets[target].curves[feature]
    mm, sd = evidence.in_mm
    advice = f"measure it, or solve for it: --tolerance {target}.lines_m={_tolerance(0.01, mm)}"
    if isinstance(curve, Arc):
        how = f"its centre x {mm[0]:+.1f}, y {mm[1]:+.1f} mm and its radius {mm[2]:+.1f} mm off"
        return evidence.words(f"{name} is not painted as drawn: {how}", advice, ("x", "y", "radius"), "mm")
    assert isinstance(curve, Segment)
    along = np.subtract(curve.end, curve.start)[:2]
    x, y = mm[0] * np.array([-along[1], along[0]]) / np.hypot(*along)
    sentence = (
        f"{name} is painted {with_sd(abs(mm[0]), sd[0])} mm off its nominal position (x {x:+.1f}, y {y:+.1f} mm; "
        f"{evidence.size})"
    )
    return Words(sentence, advice, amounts(["left"], mm[:1], sd[:1], "mm"))


def _of_point(evidence: Evidence) -> Words:
    name = evidence.score.subject
    mm, sd = evidence.in_mm
    return evidence.words(
        f"{name} lies x {with_sd(mm[0], sd[0], '+')}, y {with_sd(mm[1], sd[1], '+')} mm from its nominal position",
        f"measure it, or solve for it: --tolerance {name.partition('/')[0]}.points_m={_tolerance(0.005, mm)}",
        "xy",
        "mm",
    )


def _lengths(case: Case) -> Iterator[EffectColumns]:
    """Another value of a target's dimension: many of its lines and points are displaced, in proportion.

    The size of a board that only one station at a time sees cannot be distinguished from its distance, and without a
    field that of all boards of a rig cannot be distinguished from that of its baselines. Neither is tested.
    """
    structure, problem = case.whole_structure, case.problem
    views, targets = problem.observations.shown_views, problem.observations.targets
    is_free = problem.private if any(view.placement is None for view in views) else problem.layout.placements
    told = {view.target for view in views if view.placement not in is_free}
    asked = [name for name in dimensions_of(targets) if name.partition("/")[0] in told]
    asked = [name for name in asked if name not in case.estimate.structure.dimensions]
    slopes = dimension_slopes(structure.names, targets, asked)[1]
    for name, moved in zip(asked, case.equations.built_along(structure, slopes).T, strict=True):
        yield EffectColumns(moved[:, None], np.where(moved != 0.0, 0, -1), (name,))


def _of_length(evidence: Evidence) -> Words:
    name = evidence.score.subject
    target, _, dimension = name.partition("/")
    drawn_m = evidence.case.problem.observations.targets[target].dimensions[dimension]
    by, sd = evidence.score.amount, evidence.score.sd
    sentence = f"{name} is {with_sd(drawn_m + by[0], sd[0])} m, not {drawn_m:g} m as the target says"
    advice = f"measure it and correct the target, or solve for it: --estimate {target}.{dimension}"
    return evidence.words(sentence, advice, (dimension,), "mm")


def _of_board(evidence: Evidence) -> Words:
    # Standard deviations from which on a twist or a wave of a board is reported beside its bows.
    clear = 2.0
    name = evidence.score.subject
    mm, sd = evidence.in_mm
    further = [
        f"{words} {with_sd(a, s, '+')} mm"
        for words, a, s in zip(("twisted by", "waves along x of", "along y of"), mm[2:], sd[2:], strict=True)
        if abs(a) > clear * s
    ]
    return evidence.words(
        f"board {name!r} is not flat: bowed by {with_sd(mm[0], sd[0], '+')} mm along x, "
        f"{with_sd(mm[1], sd[1], '+')} mm along y{''.join(f', {one}' for one in further)}",
        f"mount it on something flat, or solve for it: --tolerance {name}.warp_m={_tolerance(0.002, mm)}",
        WARP,
        "mm",
    )


def _stretched(case: Case) -> Iterator[EffectColumns]:
    """A board that is longer along x and as much shorter along y; a stretch alike along both is visible in no view."""
    for both in _offsets(_STRETCHES, case):
        yield replace(both, columns=both.columns @ np.array([[0.5], [-0.5]]))


def _of_stretch(evidence: Evidence) -> Words:
    name = evidence.score.subject
    size_m = float(np.max(np.ptp(evidence.case.problem.observations.targets[name].box, axis=0)))
    longer, sd = (100.0 * float(one[0]) / size_m for one in (evidence.score.amount, evidence.score.sd))
    sides = "x than along y" if longer > 0.0 else "y than along x"
    sentence = f"board {name!r} is {abs(longer):.2f} ± {sd:.2f} % longer along {sides}"
    advice = f"measure both of its sides, print it undistorted, or solve for it: --tolerance {name}.stretch_m=0.002"
    return evidence.words(sentence, advice, ("x over y",), "mm")


def _bowed(case: Case) -> EffectColumns:
    """A floor that is not plane: it falls or rises towards its edges, or is twisted."""
    target, names, (x, y) = _over_targets(case)
    heights = np.column_stack([x * x, y * y, x * y])
    return EffectColumns(_moved(case, 2)[:, None] * heights, target, names)


def _of_bow(evidence: Evidence) -> Words:
    mm, sd = evidence.in_mm
    return evidence.words(
        f"{evidence.score.subject}: its floor appears {_lower(mm[0], sd[0])} mm at its edges along x than "
        f"in the middle, {_lower(mm[1], sd[1])} mm along y, and twisted by {with_sd(mm[2], sd[2], '+')} mm",
        "measure its height at some points, and give them as points of a custom target with their z",
        ("x", "y", "twist"),
        "mm",
    )


def _sheared(case: Case) -> EffectColumns:
    """A field whose lines along x are not at right angles to those along y."""
    target, names, (x, y) = _over_targets(case)
    return EffectColumns((_moved(case, 0) * y + _moved(case, 1) * x)[:, None], target, names)


def _of_shear(evidence: Evidence) -> Words:
    mm, sd = evidence.in_mm
    lie = f"are shifted by {with_sd(mm[0], sd[0], '+')} mm along themselves"
    advice = "measure its diagonals, and paint it anew, or give it as a custom target with its points as they are"
    return evidence.words(f"{evidence.score.subject} is out of square: its edges {lie}", advice, ("shear",), "mm")


def _lower(mm: float, sd: float) -> str:
    return f"{'higher' if mm > 0.0 else 'lower'} by {with_sd(abs(mm), sd)}"


def _uneven(case: Case) -> EffectColumns:
    """A floor that is higher or lower at one place."""
    # Equations from which on the height of a place is tested: one height, and as many as contradict an outlier.
    # Halving or doubling changes nothing.
    fewest_at_place = 8
    cell_m = 1.0  # size of such a place: a tile, a cable under the carpet; few lines cross a place of half this size
    target, names = _target_of(case)
    cell = np.floor(case.equations.place[:, :2] / cell_m + 0.5).astype(np.int64)
    span = 2 * int(np.abs(cell).max(initial=0)) + 1
    key = (np.maximum(target, 0) * span + cell[:, 0] + span // 2) * span + cell[:, 1] + span // 2
    numbers, group = grouped(key, target >= 0)
    subjects = []
    for number in numbers.tolist():
        rest, y = divmod(number, span)
        of, x = divmod(rest, span)
        at = [(place - span // 2) * cell_m for place in (x, y)]
        subjects.append(f"{names[of]} at x {at[0]:.1f}, y {at[1]:.1f} m")
    enough = _with_enough(group, case.model.used, fewest_at_place)
    return EffectColumns(_moved(case, 2)[:, None], enough, tuple(subjects))


def _of_place(evidence: Evidence) -> Words:
    mm, sd = evidence.in_mm
    high = f"{with_sd(abs(mm[0]), sd[0])} mm {'higher' if mm[0] > 0.0 else 'lower'} than around this place"
    advice = "look for what lies under the carpet, and leave out what was observed there"
    return evidence.words(f"{evidence.score.subject}: the floor is {high}", advice, ["height"], "mm")


def _target_of(case: Case) -> tuple[Indices, tuple[str, ...]]:
    """(E,) number of the immovable target that each equation shows, -1 for a movable one; and the targets' names."""
    observations = case.problem.observations
    names = tuple(still(observations.targets))
    number = {name: place for place, name in enumerate(names)}
    of_view = np.array([number.get(view.target, -1) for view in observations.views], dtype=np.int64)
    return np.asarray(of_view[case.equations.view]), names


def _moved(case: Case, axis: int) -> Array:
    """(E,) px per metre by which the place of each equation is moved along an axis of the world."""
    along = case.equations.poses[case.equations.sight, :, axis]
    return np.asarray(np.sum(case.equations.motion * along, axis=1))


def _over_targets(case: Case) -> tuple[Indices, tuple[str, ...], Array]:
    """The result of `_target_of`, and (2, E) places relative to the middle of the observed part of each target, in
    units of half of its longer side.
    """
    target, names = _target_of(case)
    over = np.zeros((2, len(target)))
    for number in range(len(names)):
        own = target == number
        middle, reach_m = _extent(case.equations.place[own])
        over[:, own] = (case.equations.place[own, :2] - middle).T / reach_m
    return target, names, over


def _extent(places: Array) -> tuple[Array, float]:
    """Middle (2,) m and half of the longer side, m, of the box around places (N, 3)."""
    if not len(places):
        return np.zeros(2), 1.0
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    return 0.5 * (low + high), max(0.5 * float(np.max(high - low)), 1e-9)


def _has_floor(observations: Observations) -> bool:
    return any(not observations.targets[view.target].movable for view in observations.shown_views)


def _of_floor(
    kind: str, columns: Callable[[Case], EffectColumns], words: Callable[[Evidence], Words], **more: Any
) -> Effect:
    """An effect of floors: it has columns, and concerns observations, only where there are any."""

    def over(case: Case) -> Iterator[EffectColumns]:
        if _has_floor(case.problem.observations):
            yield columns(case)

    return Effect(kind, over, words, absorbed=True, concerns=_has_floor, **more)


def _has_few_boards(observations: Observations) -> bool:
    """Whether there are boards whose stretch may be invisible in so few views: from 7 views on, 0.2 % is visible."""
    most_views = 14  # twice as many, for any noise: with 20 views it took a fifth of the time
    boards = sum(observations.targets[view.target].bows for view in observations.shown_views)
    return 0 < boards <= most_views


def _longer_m(columns: EffectColumns, number: int, case: Case) -> float:
    return float(np.max(np.ptp(case.problem.observations.targets[columns.subjects[number]].box, axis=0)))


def _reach_m(columns: EffectColumns, number: int, case: Case) -> float:
    return _extent(case.equations.place[columns.group == number])[1]


_of_target = partial(Effect, together=_of_each_target)
CURVE_ASIDE = _of_target("curve aside", partial(_offsets, slice(0, 3), curves=True), _of_curve, built="lines")
"""A line or an arc is not painted as drawn."""
POINT_ASIDE = _of_target("point aside", partial(_offsets, slice(0, 2)), _of_point, built="points")
"""A point does not lie where it is drawn."""
BOARD_BENT = _of_target("board bent", partial(_offsets, slice(2, 2 + len(WARP))), _of_board, built="warp")
"""A board is bowed along its sides, twisted or wavy."""
_STRETCHES = slice(-len(STRETCH), None)
BOARD_STRETCHED = _of_target(
    "board stretched",
    _stretched,
    _of_stretch,
    built="stretch",
    prior=STRETCHED,
    reach=_longer_m,
    concerns=_has_few_boards,
)
"""A board is printed longer one way than the other."""
_of_whole_floor = partial(_of_floor, prior=FLOOR_OFF, reach=_reach_m)
EFFECTS = (
    _of_whole_floor("floor bowed", _bowed, _of_bow),
    _of_floor("floor uneven", _uneven, _of_place),
    _of_whole_floor("field sheared", _sheared, _of_shear),
    Effect("other length", _lengths, _of_length),
    CURVE_ASIDE,
    POINT_ASIDE,
    BOARD_BENT,
    BOARD_STRETCHED,
)
