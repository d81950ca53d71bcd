"""Segments and arcs as painted on a target, places along them, and the place on them that is nearest to something.

Curves lie in a plane of constant z; sides are named as seen from above (from +z).

The crossings of a target's lines and arcs are places with names, too. The crossing of curves A and B is "A*B", or
"B*A". Where they cross twice (a line through a circle, two circles) the two are "A*B#1" and "A*B#2", counted along the
one that is a line, or that comes first in the target. Lines count as crossing up to half a width past their ends, so
that corners do. Curves that meet at less than 10 degrees, or touch, do not: the place would be undetermined.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import Array, InputError, Mask, dots
from ceres_cal.base.typed import numbers_in

SIDES = {"centre": 0, "left": 1, "right": -1}
"""Which part of a painted curve was observed. Left and right are seen by somebody who walks along it: from `start` to
`end` of a segment, counter-clockwise on an arc (so left is the inside)."""


def xyz(values: Sequence[float], name: str) -> tuple[float, float, float]:
    """Return three plain floats, from numbers of any type; InputError naming the place for anything else."""
    given = numbers_in(values, name)
    if given.shape != (3,):
        raise InputError(f"{name} must be three numbers (x, y, z) in metres, not {values!r}")
    x, y, z = given.tolist()
    return x, y, z


class Segment(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"start": "from", "end": "to"}
):  # names in files
    """A straight line from `start` to `end`, (x, y, z) m; `width_m` is that of the paint, 0 for a bare edge."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    width_m: float = 0.0

    def __post_init__(self) -> None:
        _with_plain_floats(self, "start", "end")

    @property
    def parameter_range(self) -> tuple[float, float]:
        return 0.0, 1.0

    @property
    def length_m(self) -> float:
        return math.dist(self.start, self.end)

    def track(self, side: int = 0) -> Array:
        """(3, 3) rows c, a, b of C(s) = c + s a, s from 0 to 1; b is 0 for a segment."""
        start, along = np.asarray(self.start, dtype=float), np.subtract(self.end, self.start)
        left = np.array([-along[1], along[0], 0.0])
        norm = math.hypot(along[0], along[1])
        offset = side * 0.5 * self.width_m * left / norm if norm > 0.0 else np.zeros(3)
        return np.array([start + offset, along, np.zeros(3)])


class Arc(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A circular arc around `centre` (x, y, z) m, counter-clockwise from `from_rad` to `to_rad` in the plane of z."""

    centre: tuple[float, float, float]
    radius_m: float
    from_rad: float = 0.0
    to_rad: float = 2.0 * np.pi
    width_m: float = 0.0

    def __post_init__(self) -> None:
        _with_plain_floats(self, "centre")

    @property
    def parameter_range(self) -> tuple[float, float]:
        return self.from_rad, self.to_rad

    @property
    def length_m(self) -> float:
        return self.radius_m * (self.to_rad - self.from_rad)

    def track(self, side: int = 0) -> Array:
        """(3, 3) rows c, a, b of C(s) = c + a cos s + b sin s."""
        radius = self.radius_m - side * 0.5 * self.width_m
        return np.array([self.centre, (radius, 0.0, 0.0), (0.0, radius, 0.0)], dtype=float)


Curve = Segment | Arc


def _with_plain_floats(curve: Curve, *places: str) -> None:
    """Convert the numbers of a frozen curve, of any type, to plain floats, as a file would give them."""
    for name, value in msgspec.structs.asdict(curve).items():
        said = f"{type(curve).__name__}({name}=...)"
        try:
            plain = xyz(value, said) if name in places else float(value)
        except (TypeError, ValueError):
            raise InputError(f"{said}: {value!r} is not a number") from None
        msgspec.structs.force_setattr(curve, name, plain)


# ---- along a curve --------------------------------------------------------------------------------------------------


def along_track(track: ArrayLike, is_arc: bool | Mask, s: ArrayLike) -> Array:
    """(N, 3) m, C(s) on one track (3, 3) or on one track for each s (N, 3, 3); other shapes are broadcast."""
    tracks, s = np.asarray(track, dtype=float), np.asarray(s, dtype=float)
    turns = np.broadcast_to(is_arc, s.shape)
    first, second = s.copy(), np.zeros(s.shape)
    first[turns], second[turns] = np.cos(s[turns]), np.sin(s[turns])
    c, a, b = tracks[..., 0, :], tracks[..., 1, :], tracks[..., 2, :]
    return np.asarray(c + first[..., None] * a + second[..., None] * b)


def along_curve(curve: Curve, s: ArrayLike, side: int = 0) -> Array:
    """(N, 3) m on one curve."""
    return along_track(curve.track(side), isinstance(curve, Arc), s)


def curve_points(curve: Curve, side: int, pieces: int) -> Array:
    """(pieces + 1, 3) m, evenly along a curve."""
    return along_curve(curve, np.linspace(*curve.parameter_range, pieces + 1), side)


# ---- the nearest place ----------------------------------------------------------------------------------------------


def nearest_on_track(tracks: Array, is_arc: bool | Mask, points: Array) -> Array:
    """Parameter s (N,) of the place on one track (3, 3), or on each track (N, 3, 3), nearest to each point (N, 3).

    It may lie past the curve's ends; an arc's is from -pi to pi.
    """
    c, a, b = tracks[..., 0, :], tracks[..., 1, :], tracks[..., 2, :]
    away = points - c
    along = dots(away, a)
    straight = along / dots(a, a)
    return np.asarray(np.where(is_arc, np.arctan2(dots(away, b), along), straight)) if np.any(is_arc) else straight


def nearest_to_rays(tracks: Array, is_arc: bool | Mask, origin: Array, rays: Array) -> Array:
    """Parameter s (N,) of the place on a track (3, 3) or (N, 3, 3) that each ray (N, 3) from `origin` (3,) passes
    nearest.

    For an arc it is where the ray meets the arc's plane, for a segment the foot of the common perpendicular; 0 where
    there is none.
    """
    c, a = tracks[..., 0, :], tracks[..., 1, :]
    away = origin - c
    with np.errstate(divide="ignore", invalid="ignore"):
        on_plane = away - (away[..., 2] / rays[:, 2])[:, None] * rays
        turned = np.arctan2(on_plane[:, 1], on_plane[:, 0])
        aa, ar, rr = dots(a, a), dots(a, rays), dots(rays, rays)
        straight = (dots(a, away) * rr - dots(rays, away) * ar) / (aa * rr - ar * ar)
    return np.nan_to_num(np.where(is_arc, turned, straight), posinf=0.0, neginf=0.0)


def turned_on(curve: Curve, s: Array) -> Array:
    """Return an arc's parameters (N,) of the same places within a full turn from its beginning; a segment's as is."""
    return np.asarray(curve.from_rad + np.mod(s - curve.from_rad, 2.0 * np.pi)) if isinstance(curve, Arc) else s


def nearest_on_curve(curve: Curve, points: Array) -> Array:
    """Parameter s (N,) of the place between the curve's ends nearest to each point (N, 3)."""
    low, high = curve.parameter_range
    s = turned_on(curve, nearest_on_track(curve.track(), isinstance(curve, Arc), points))
    if isinstance(curve, Arc):  # a place past its end is nearest to one of its two ends
        s = np.where(s <= high, s, np.where(s - high < low + 2.0 * np.pi - s, high, low))
    return np.asarray(np.clip(s, low, high))


def distance_to_curve(curve: Curve, points: Array) -> Array:
    """(N,) m from each point (N, 3) to the nearest place between the curve's ends."""
    return np.asarray(np.linalg.norm(points - along_curve(curve, nearest_on_curve(curve, points)), axis=1))


Place = tuple[float, float, float]

MOST_CURVES = 300
"""Largest number of curves whose crossings have names: nobody reads names off a drawing with more."""
_SAME_M = 1e-6


def crossings(curves: Mapping[str, Curve]) -> dict[str, Place]:
    """Return every crossing of two curves by its name, in the order of the curves."""
    return {names[0]: place for names, place in _named(curves)}


def is_crossing(name: str) -> bool:
    """Return whether a point exists only because two curves cross, by its name."""
    return "*" in name


def with_crossings(points: Mapping[str, Place], curves: Mapping[str, Curve]) -> dict[str, Place]:
    """Return the points, then the crossings at which none of the points lies."""
    every, places = dict(points), np.array(list(points.values())).reshape(-1, 3)
    for name, place in crossings(curves).items():
        if not np.any(np.max(np.abs(places - place), axis=1, initial=0.0) < _SAME_M) if len(places) else True:
            every[name] = place
            places = np.vstack([places, place])
    return every


def aliases(points: Mapping[str, Place], curves: Mapping[str, Curve]) -> dict[str, str]:
    """Return every name of a crossing that is not a point's own name -> the point that lies there."""
    names, places = list(points), np.array(list(points.values())).reshape(-1, 3)
    found: dict[str, str] = {}
    for every, place in _named(curves):
        near = np.flatnonzero(np.max(np.abs(places - place), axis=1) < _SAME_M)
        found |= {alias: names[near[0]] for alias in every if len(near) and alias not in points}
    return found


def _named(curves: Mapping[str, Curve]) -> Iterator[tuple[tuple[str, str], Place]]:
    """Yield both names of each crossing, and its place."""
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
    """(2, 3) lowest and highest corner of the box around a curve, including its paint."""
    margin = 0.5 * curve.width_m + _SAME_M
    if isinstance(curve, Segment):
        return np.array([np.minimum(curve.start, curve.end) - margin, np.maximum(curve.start, curve.end) + margin])
    reach = np.array([curve.radius_m, curve.radius_m, 0.0]) + margin
    return np.array([curve.centre - reach, curve.centre + reach])


def _met(one: Curve, other: Curve) -> list[Place]:
    """Return the places at which two curves of one height cross, in order along the first, or along the line.

    It uses plain numbers: for two curves NumPy takes four times as long.
    """
    least_sine = 0.17  # of the smallest angle between them
    if isinstance(one, Arc) and isinstance(other, Segment):
        return _met(other, one)
    heights = {place[2] for curve in (one, other) for place in _levels(curve)}
    if max(heights) - min(heights) > _SAME_M:
        return []
    slack = 0.5 * max(one.width_m, other.width_m) + _SAME_M
    every = [_place_at(one, s) for s in sorted(_meeting(one, other))]
    return [
        place
        for place in every
        if _is_between_ends(one, place, slack)
        and _is_between_ends(other, place, slack)
        and abs(_cross(_way(one, place), _way(other, place))) > least_sine
    ]


def _levels(curve: Curve) -> tuple[Place, ...]:
    return (curve.start, curve.end) if isinstance(curve, Segment) else (curve.centre,)


def _place_at(curve: Curve, s: float) -> Place:
    """Return what `along_curve` gives for one parameter."""
    if isinstance(curve, Segment):
        x, y, z = (a + s * (b - a) for a, b in zip(curve.start, curve.end, strict=True))
        return x, y, z
    x, y, z = curve.centre
    return x + math.cos(s) * curve.radius_m, y + math.sin(s) * curve.radius_m, z


# ---- the whole lines and circles ------------------------------------------------------------------------------------


def _meeting(one: Curve, other: Curve) -> list[float]:
    """Return the parameters at which the first curve meets the other; an arc's are after its beginning."""
    if isinstance(one, Arc):
        turned = _on_both(one, other) if isinstance(other, Arc) else []
        return [one.from_rad + (angle - one.from_rad) % (2.0 * math.pi) for angle in turned]
    return _on_line(one, other) if isinstance(other, Segment) else _on_circle(one, other)


def _on_line(one: Segment, other: Segment) -> list[float]:
    """Return the parameter of the crossing of two lines; none where they are parallel."""
    across = _from(other.start, other.end)
    turn = _cross(_from(one.start, one.end), across)
    if abs(turn) < 1e-12 * max(one.length_m * other.length_m, 1e-300):
        return []
    return [_cross(_from(one.start, other.start), across) / turn]


def _on_circle(one: Segment, other: Arc) -> list[float]:
    """Return the parameters where a line meets a circle; none where it does not."""
    (x, y), (u, v) = _from(one.start, one.end), _from(other.centre, one.start)
    a, b, c = x * x + y * y, u * x + v * y, u * u + v * v - other.radius_m**2
    root = b * b - a * c
    return [(-b - math.sqrt(root)) / a, (-b + math.sqrt(root)) / a] if root > 0.0 and a > 0.0 else []


def _on_both(one: Arc, other: Arc) -> list[float]:
    """Return the angles on the first of two circles where they meet; none where they do not."""
    x, y = _from(one.centre, other.centre)
    far = math.hypot(x, y)
    if far < _SAME_M:
        return []
    cosine = (far**2 + one.radius_m**2 - other.radius_m**2) / (2.0 * far * one.radius_m)
    if abs(cosine) >= 1.0:
        return []
    return [math.atan2(y, x) + side * math.acos(cosine) for side in (-1.0, 1.0)]


# ---- their ends -----------------------------------------------------------------------------------------------------


def _is_between_ends(curve: Curve, place: Place, slack_m: float) -> bool:
    """Return whether a place on a whole line or circle lies between the curve's ends, or at most so far past them."""
    if isinstance(curve, Segment):
        s = sum((p - a) * (b - a) for p, a, b in zip(place, curve.start, curve.end, strict=True)) / curve.length_m
        return -slack_m < s < curve.length_m + slack_m
    x, y = _from(curve.centre, place)
    slack = slack_m / curve.radius_m
    turned = (math.atan2(y, x) - curve.from_rad + slack) % (2.0 * math.pi)
    return turned < curve.to_rad - curve.from_rad + 2.0 * slack


def _way(curve: Curve, there: Place) -> tuple[float, float]:
    """Return the direction of a curve at a place, of length 1."""
    if isinstance(curve, Segment):
        x, y = _from(curve.start, curve.end)
        return x / curve.length_m, y / curve.length_m
    x, y = _from(curve.centre, there)
    return -y / curve.radius_m, x / curve.radius_m


def _from(start: Place, end: Place) -> tuple[float, float]:
    return end[0] - start[0], end[1] - start[1]


def _cross(one: tuple[float, float], other: tuple[float, float]) -> float:
    return one[0] * other[1] - one[1] * other[0]
