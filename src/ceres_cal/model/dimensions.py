"""The lengths that targets are drawn by, and how another value of one moves points and curves."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.scene.targets import Arc, Segment, Target, target_from_spec

_STEP = 1e-3  # of a dimension: features move in proportion


def dimensions_of(targets: Mapping[str, Target]) -> dict[str, float]:
    """The lengths, m, of all targets, as "target/dimension"."""
    return {f"{name}/{one}": length for name, target in targets.items() for one, length in target.dimensions.items()}


def dimension_slopes(
    offsets: Sequence[str], targets: Mapping[str, Target], dimensions: Collection[str]
) -> tuple[Array, Array]:
    """Lengths (D,) of dimensions, m, and how they move features: (Q, D) metres of each offset per metre.

    Raises:
        InputError: a dimension that no target has.
    """
    place, known = {name: row for row, name in enumerate(offsets)}, dimensions_of(targets)
    columns = np.zeros((len(offsets), len(dimensions)))
    for column, name in enumerate(dimensions):
        if name not in known:
            raise InputError(f"there is no dimension {name!r} to be solved for: there are {', '.join(known) or 'none'}")
        target, _, dimension = name.partition("/")
        spec = targets[target].spec
        other = target_from_spec({**spec, dimension: (1.0 + _STEP) * known[name]}, target)
        for feature, moved_m in _differences(target, targets[target], other):
            if feature in place:
                columns[place[feature], column] = moved_m / (_STEP * known[name])
    return np.array([known[name] for name in dimensions]), columns


def features_of(target: Target, dimension: str) -> frozenset[str]:
    """The points and curves that lie elsewhere with another value of a dimension."""
    other = redrawn(target, {dimension: (1.0 + _STEP) * target.dimensions[dimension]})
    moved = (name for name, moved_m in _differences("", target, other) if moved_m != 0.0)
    return frozenset(name[1:].partition(".")[0] for name in moved)


def redrawn(target: Target, lengths_m: Mapping[str, float]) -> Target:
    """A target with other dimensions."""
    return target_from_spec({**target.spec, **lengths_m}, "target") if lengths_m else target


def _differences(name: str, target: Target, other: Target) -> Iterator[tuple[str, float]]:
    """By how much each number of one target's structure brings it to another, m."""
    for feature, curve in target.curves.items():
        there = other.curves[feature]
        if isinstance(curve, Arc) and isinstance(there, Arc):
            x, y = np.subtract(there.centre, curve.centre)[:2]
            yield f"{name}/{feature}.x", float(x)
            yield f"{name}/{feature}.y", float(y)
            yield f"{name}/{feature}.radius", there.radius_m - curve.radius_m
        elif isinstance(curve, Segment) and isinstance(there, Segment):
            x, y = np.subtract(curve.end, curve.start)[:2] / curve.length_m
            yield f"{name}/{feature}", float(np.subtract(there.start, curve.start)[:2] @ (-y, x))
    for feature, place in target.points.items():
        x, y = np.subtract(other.points[feature], place)[:2]
        yield f"{name}/{feature}.x", float(x)
        yield f"{name}/{feature}.y", float(y)
