"""The floor: bowed as a whole, higher at one place than around it, or with a field that is painted out of square."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.effects.columns import EffectColumns, grouped
from ceres_cal.effects.effect import Case, Effect, Evidence, Words, amounts
from ceres_cal.effects.evidence import FLOOR_OFF, SizePrior
from ceres_cal.observations import Observations


class _Floor(Effect):
    """What moves the places of targets that are part of the world."""

    absorbed = True

    def concerns(self, observations: Observations) -> bool:
        return any(not target.movable for target in observations.targets.values())

    def prior_of(self, columns: EffectColumns, number: int, case: Case) -> SizePrior | None:
        _, reach_m = _extent(case.equations.place[columns.group == number])
        return self.prior and self.prior.times(reach_m)


class FloorBowed(_Floor):
    """The floor is no plane: it sinks or rises towards its edges, or is twisted."""

    kind = "floor bowed"
    prior = FLOOR_OFF

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        target, names = _target_of(case)
        x, y = _over_extent(case, target, len(names)).T
        heights = np.column_stack([x * x, y * y, x * y])
        yield EffectColumns(self.kind, _moved(case, 2)[:, None] * heights, target, names)

    def words(self, evidence: Evidence) -> Words:
        mm, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
        return Words(
            f"{evidence.score.subject}: its floor appears {_lower(mm[0])} ± {sd[0]:.1f} mm at its edges along x than "
            f"in the middle, {_lower(mm[1])} ± {sd[1]:.1f} mm along y, and twisted by {mm[2]:+.1f} ± {sd[2]:.1f} mm "
            f"({evidence.size})",
            "measure its height at some points, and give them as points of a custom target with their z",
            amounts(("x", "y", "twist"), mm, sd, "mm"),
        )


class FieldSheared(_Floor):
    """What runs along x is not at right angles to what runs along y."""

    kind = "field sheared"
    prior = FLOOR_OFF

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        target, names = _target_of(case)
        x, y = _over_extent(case, target, len(names)).T
        yield EffectColumns(self.kind, (_moved(case, 0) * y + _moved(case, 1) * x)[:, None], target, names)

    def words(self, evidence: Evidence) -> Words:
        mm, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
        return Words(
            f"{evidence.score.subject} is out of square: its edges lie {mm[0]:+.1f} ± {sd[0]:.1f} mm along themselves "
            f"({evidence.size})",
            "measure its diagonals, and paint it anew, or give it as a custom target with its points as they are",
            amounts(("shear",), mm, sd, "mm"),
        )


def _lower(mm: float) -> str:
    return f"{'higher' if mm > 0.0 else 'lower'} by {abs(mm):.1f}"


class FloorUneven(_Floor):
    """The floor is higher or lower at one place."""

    kind = "floor uneven"

    def columns(self, case: Case) -> Iterator[EffectColumns]:
        # Equations that say how high a place is: one height, and as many as an outlier needs to be contradicted.
        # Nothing changes from half to double.
        fewest_at_place = 8
        cell_m = 1.0  # of a place that may be higher: a tile, a cable under the carpet; of half of it lines cross few
        target, names = _target_of(case)
        cell = np.floor(case.equations.place[:, :2] / cell_m + 0.5).astype(np.int64)
        span = 2 * int(np.abs(cell).max(initial=0)) + 1
        key = (np.maximum(target, 0) * span + cell[:, 0] + span // 2) * span + cell[:, 1] + span // 2
        numbers, group = grouped(key, target >= 0)
        counts = np.bincount(group[(group >= 0) & case.model.used], minlength=len(numbers) + 1)
        group = np.where((group >= 0) & (counts[group] >= fewest_at_place), group, -1)
        subjects = []
        for number in numbers.tolist():
            rest, y = divmod(number, span)
            of, x = divmod(rest, span)
            at = [(place - span // 2) * cell_m for place in (x, y)]
            subjects.append(f"{names[of]} at x {at[0]:.1f}, y {at[1]:.1f} m")
        yield EffectColumns(self.kind, _moved(case, 2)[:, None], group, tuple(subjects))

    def words(self, evidence: Evidence) -> Words:
        mm, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
        return Words(
            f"{evidence.score.subject} the floor is {abs(mm[0]):.0f} ± {sd[0]:.0f} mm "
            f"{'higher' if mm[0] > 0.0 else 'lower'} than around it ({evidence.size})",
            "look for what lies under the carpet, and leave out what was observed there",
            amounts(["height"], mm, sd, "mm"),
        )


def _target_of(case: Case) -> tuple[Indices, tuple[str, ...]]:
    """(E,) which target that is part of the world each equation shows, -1 for a movable one; and their names."""
    observations = case.observations
    names = tuple(name for name, target in observations.targets.items() if not target.movable)
    number = {name: place for place, name in enumerate(names)}
    of_view = np.array([number.get(view.target, -1) for view in observations.views], dtype=np.int64)
    return np.asarray(of_view[case.equations.view]), names


def _moved(case: Case, axis: int) -> Array:
    """(E,) px per metre that the place of each equation is moved along an axis of the world."""
    along = case.equations.poses[case.equations.sight, :, axis]
    return np.asarray(np.sum(case.equations.motion * along, axis=1))


def _over_extent(case: Case, target: Indices, count: int) -> Array:
    """(E, 2) places on so many targets, from the middle of what was observed of each over half of its longer side."""
    over = np.zeros((len(target), 2))
    for number in range(count):
        own = target == number
        middle, reach_m = _extent(case.equations.place[own])
        over[own] = (case.equations.place[own, :2] - middle) / reach_m
    return over


def _extent(places: Array) -> tuple[Array, float]:
    """Middle (2,) and half of the longer side of the box around places (N, 3), m."""
    if not len(places):
        return np.zeros(2), 1.0
    low, high = places[:, :2].min(axis=0), places[:, :2].max(axis=0)
    return 0.5 * (low + high), max(0.5 * float(np.max(high - low)), 1e-9)


EFFECTS = (FloorBowed(), FloorUneven(), FieldSheared())
