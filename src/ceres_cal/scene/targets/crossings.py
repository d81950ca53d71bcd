"""Where a target's lines and arcs cross: places that have names without being named.

The crossing of curves A and B is "A*B", or "B*A". Where they cross twice (a line through a circle, two circles) the two
are "A*B#1" and "A*B#2", counted along the one of them that is a line, or comes first in the target. Lines count as
crossing up to half a width past their ends, so that corners do; curves that meet at less than 10 degrees, or touch, do
not: nobody could say where.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.scene.curves import Arc, Curve, Segment, along_curve

Place = tuple[float, float, float]

MOST_CURVES = 300
"""More than these are no drawing that somebody reads names off: their crossings have none."""
_SAME_M = 1e-6


def crossings(curves: Mapping[str, Curve]) -> dict[str, Place]:
    """Every crossing of two curves, by its name, in the order of the curves."""
    return {names[0]: place for names, place in _named(curves)}


def is_crossing(name: str) -> bool:
    """Whether a point is there only because two curves cross, by its name."""
    return "*" in name


def with_crossings(points: Mapping[str, Place], curves: Mapping[str, Curve]) -> dict[str, Place]:
    """The points, then the crossings at which there is none of them yet."""
    every, places = dict(points), np.array(list(points.values())).reshape(-1, 3)
    for name, place in crossings(curves).items():
        if not np.any(np.max(np.abs(places - place), axis=1, initial=0.0) < _SAME_M) if len(places) else True:
            every[name] = place
            places = np.vstack([places, place])
    return every


def aliases(points: Mapping[str, Place], curves: Mapping[str, Curve]) -> dict[str, str]:
    """Every name of a crossing that is none of the points' own -> the point that lies there."""
    names, places = list(points), np.array(list(points.values())).reshape(-1, 3)
    found: dict[str, str] = {}
    for every, place in _named(curves):
        near = np.flatnonzero(np.max(np.abs(places - place), axis=1) < _SAME_M)
        found |= {alias: names[near[0]] for alias in every if len(near) and alias not in points}
    return found


def _named(curves: Mapping[str, Curve]) -> Iterator[tuple[tuple[str, str], Place]]:
    """Both names of each crossing, and where it is."""
    if len(curves) > MOST_CURVES:
        return
    every = [(name, curve) for name, curve in curves.items() if 0.0 < curve.length_m < np.inf]
    boxes = np.array([_box(curve) for _, curve in every]).reshape(-1, 2, 3)
    for number, (one, curve) in enumerate(every):
        apart = np.any(
            (boxes[number, 0] > boxes[number + 1 :, 1]) | (boxes[number + 1 :, 0] > boxes[number, 1]), axis=1
        )
        for later in number + 1 + np.flatnonzero(~apart):
            other, shape = every[later]
            met = _met(curve, shape)
            for count, place in enumerate(met, start=1):
                which = f"#{count}" if len(met) > 1 else ""
                yield (f"{one}*{other}{which}", f"{other}*{one}{which}"), place


def _box(curve: Curve) -> Array:
    """(2, 3) between which a curve lies, with its paint."""
    margin = 0.5 * curve.width_m + _SAME_M
    if isinstance(curve, Segment):
        return np.array([np.minimum(curve.start, curve.end) - margin, np.maximum(curve.start, curve.end) + margin])
    reach = np.array([curve.radius_m, curve.radius_m, 0.0]) + margin
    return np.array([curve.centre - reach, curve.centre + reach])


def _met(one: Curve, other: Curve) -> list[Place]:
    """The places at which two curves of one height cross, in their order along the first, or along the line."""
    least_sine = 0.17  # of the angle between them
    if isinstance(one, Arc) and isinstance(other, Segment):
        return _met(other, one)
    heights = {place[2] for curve in (one, other) for place in _levels(curve)}
    if max(heights) - min(heights) > _SAME_M:
        return []
    slack = 0.5 * max(one.width_m, other.width_m) + _SAME_M
    if isinstance(one, Segment):
        lines = _on_line(one, other) if isinstance(other, Segment) else _on_circle(one, other)
        s = np.sort(lines)
    else:
        s = np.sort(np.mod(_on_both(one, other) - one.from_rad, 2.0 * np.pi)) + one.from_rad  # type: ignore[arg-type]
    there = along_curve(one, s)
    kept = (
        _between_ends(one, there, slack) & _between_ends(other, there, slack) & (_sine(one, other, there) > least_sine)
    )
    return [(float(x), float(y), float(z)) for x, y, z in there[kept]]


def _levels(curve: Curve) -> tuple[Place, ...]:
    return (curve.start, curve.end) if isinstance(curve, Segment) else (curve.centre,)


# ---- the whole lines and circles ------------------------------------------------------------------------------------


def _on_line(one: Segment, other: Segment) -> Array:
    """(1,) parameter of where the first meets the other; none where they are parallel."""
    along, across = np.subtract(one.end, one.start)[:2], np.subtract(other.end, other.start)[:2]
    turn = _cross(along, across)
    if abs(turn) < 1e-12 * max(one.length_m * other.length_m, 1e-300):
        return np.empty(0)
    return np.array([_cross(np.subtract(other.start, one.start)[:2], across) / turn])


def _on_circle(one: Segment, other: Arc) -> Array:
    """(2,) parameters of where a line meets a circle; none where it passes by."""
    along, away = np.subtract(one.end, one.start)[:2], np.subtract(one.start, other.centre)[:2]
    a, b, c = along @ along, away @ along, away @ away - other.radius_m**2
    root = b * b - a * c
    return np.array([-b - np.sqrt(root), -b + np.sqrt(root)]) / a if root > 0.0 and a > 0.0 else np.empty(0)


def _on_both(one: Arc, other: Arc) -> Array:
    """(2,) angles on the first of where two circles meet; none where they do not."""
    away = np.subtract(other.centre, one.centre)[:2]
    far = float(np.hypot(*away))
    if far < _SAME_M:
        return np.empty(0)
    cosine = (far**2 + one.radius_m**2 - other.radius_m**2) / (2.0 * far * one.radius_m)
    if abs(cosine) >= 1.0:
        return np.empty(0)
    return np.asarray(np.arctan2(away[1], away[0]) + np.arccos(cosine) * np.array([-1.0, 1.0]))


# ---- their ends -----------------------------------------------------------------------------------------------------


def _between_ends(curve: Curve, there: Array, slack_m: float) -> Mask:
    """(N,) whether places on a whole line or circle lie between the curve's ends, or no farther past them."""
    if isinstance(curve, Segment):
        along = np.subtract(curve.end, curve.start) / curve.length_m
        s = (there - curve.start) @ along
        return (s > -slack_m) & (s < curve.length_m + slack_m)
    turned = np.arctan2(there[:, 1] - curve.centre[1], there[:, 0] - curve.centre[0]) - curve.from_rad
    slack = slack_m / curve.radius_m
    return np.asarray(np.mod(turned + slack, 2.0 * np.pi) < curve.to_rad - curve.from_rad + 2.0 * slack)


def _sine(one: Curve, other: Curve, there: Array) -> Array:
    """(N,) of the angle at which they cross."""
    return np.abs(_cross(_way(one, there).T, _way(other, there).T))


def _way(curve: Curve, there: Array) -> Array:
    """(N, 2) of length 1."""
    if isinstance(curve, Segment):
        return np.broadcast_to(np.subtract(curve.end, curve.start)[:2] / curve.length_m, (len(there), 2))
    out = (there - curve.centre)[:, :2] / curve.radius_m
    return np.column_stack([-out[:, 1], out[:, 0]])


def _cross(one: Array, other: Array) -> Array:
    return np.asarray(one[0] * other[1] - one[1] * other[0])
