"""Lines on real floors that do not belong to the field, or differ from its rules."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from msgspec import structs

from ceres_cal.scene.curves import Arc, Curve, Segment
from ceres_cal.scene.targets import Target, ssl_field

Painter = Callable[[dict[str, Curve], Target, np.random.Generator], dict[str, Curve]]


def with_boundary(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """A line around the field."""
    length, width = field.dimensions["field_length_m"], field.dimensions["field_width_m"]
    x, y = np.array([length, width]) / 2.0 + rng.uniform(0.15, 0.4)
    corners: list[tuple[float, float, float]] = [(-x, -y, 0.0), (x, -y, 0.0), (x, y, 0.0), (-x, y, 0.0)]
    sides = zip(corners, [*corners[1:], corners[0]], strict=True)
    return curves | {f"boundary {n}": Segment(a, b, rng.uniform(0.015, 0.025)) for n, (a, b) in enumerate(sides)}


def with_cables(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """White cables across the field: straight ones, and arcs of large circles."""
    cables: dict[str, Curve] = {}
    for number in range(int(rng.integers(2, 5))):
        middle, direction = rng.uniform((-3.5, -2.2), (3.5, 2.2)), rng.uniform(0.0, np.pi)
        way = np.array([np.cos(direction), np.sin(direction)])
        half = rng.uniform(1.5, 4.0)
        if number % 2:
            a, b = middle - half * way, middle + half * way
            cables[f"cable {number}"] = Segment((a[0], a[1], 0.0), (b[0], b[1], 0.0), 0.012)
        else:
            radius = rng.uniform(6.0, 20.0)
            centre = middle + radius * np.array([-way[1], way[0]])
            turn, span = float(np.arctan2(-way[0], way[1])), half / radius
            here = (float(centre[0]), float(centre[1]), 0.0)
            cables[f"cable {number}"] = Arc(here, radius, turn - span, turn + span, 0.012)
    return curves | cables


def worn(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """A third to a half of every line is worn off, piece by piece."""
    kept: dict[str, Curve] = {}
    share = rng.uniform(0.5, 0.7)
    for name, curve in curves.items():
        at, number = 0.0, 0
        low, high = curve.parameter_range
        while at < 1.0:
            on, off = rng.exponential(0.35 * share, 2) * (1.0, (1.0 - share) / share) / curve.length_m + 0.02
            first, last = low + (high - low) * np.array([at, min(at + on, 1.0)])
            kept[f"{name} {number}"] = _part(curve, float(first), float(last))
            at, number = at + on + off, number + 1
    return kept


def _part(curve: Curve, first: float, last: float) -> Curve:
    if isinstance(curve, Arc):
        return structs.replace(curve, from_rad=first, to_rad=last)
    a, b = np.array(curve.start), np.array(curve.end)
    start, end = a + first * (b - a), a + last * (b - a)
    return structs.replace(curve, start=tuple(start.tolist()), end=tuple(end.tolist()))


def askew(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """Three lines are displaced by 15 to 30 mm."""
    moved = dict(curves)
    names = [name for name, curve in curves.items() if isinstance(curve, Segment)]
    for name in rng.choice(names, 3, replace=False):
        line = curves[name]
        assert isinstance(line, Segment)
        along = np.subtract(line.end, line.start) / line.length_m
        off = rng.choice([-1.0, 1.0]) * rng.uniform(0.015, 0.03) * np.array([-along[1], along[0], 0.0])
        start, end = (tuple((np.array(one) + off).tolist()) for one in (line.start, line.end))
        moved[str(name)] = structs.replace(line, start=start, end=end)
    return moved


def with_another_sport(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """Wide lines of another sport, parallel to the field's and across it."""
    length, width = field.dimensions["field_length_m"], field.dimensions["field_width_m"]
    wide, others = rng.uniform(0.02, 0.05), dict(curves)
    for number in range(int(rng.integers(2, 5))):
        x, y = rng.uniform(-0.5, 0.5) * length, 0.5 * width + rng.uniform(-0.4, 0.4)
        others[f"other across {number}"] = Segment((x, -y, 0.0), (x, y, 0.0), wide)
    for number in range(int(rng.integers(2, 4))):
        x, y = 0.5 * length + rng.uniform(-0.4, 0.4), rng.uniform(-0.5, 0.5) * width
        others[f"other along {number}"] = Segment((-x, y, 0.0), (x, y, 0.0), wide)
    return others


def with_old_field(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """Remains of another field: smaller, displaced, and with the same paint."""
    smaller, moved = rng.uniform(0.75, 0.95, 2), rng.uniform(-0.4, 0.4, 2)
    lengths = {
        f"{name}_m": smaller[n] * field.dimensions[f"{name}_m"]
        for n, name in enumerate(("field_length", "field_width"))
    }
    others = dict(curves)
    for name, curve in ssl_field("B", **lengths).curves.items():
        if isinstance(curve, Segment) and rng.uniform() < 0.8:
            ends = [tuple((np.array(one) + np.append(moved, 0.0)).tolist()) for one in (curve.start, curve.end)]
            others[f"old {name}"] = structs.replace(curve, start=ends[0], end=ends[1])
    return others


def as_farmers_do(curves: dict[str, Curve], field: Target, rng: np.random.Generator) -> dict[str, Curve]:
    """Every line of a large pitch is displaced by centimetres, with a standard deviation of half the width of its
    paint. Circles and arcs, which are drawn with a rope around a peg, have centres and radii with such errors.
    """
    moved = dict(curves)
    for name, line in curves.items():
        off = rng.normal(0.0, 0.5 * line.width_m, 1 if isinstance(line, Segment) else 3)
        if isinstance(line, Segment):
            along = np.subtract(line.end, line.start) / line.length_m
            aside = off * np.array([-along[1], along[0], 0.0])
            start, end = (tuple((np.array(one) + aside).tolist()) for one in (line.start, line.end))
            moved[name] = structs.replace(line, start=start, end=end)
        elif isinstance(line, Arc):
            middle = tuple((np.array(line.centre) + np.append(off[:2], 0.0)).tolist())
            moved[name] = structs.replace(line, centre=middle, radius_m=line.radius_m + float(off[2]))
    return moved
