"""Segments and arcs as painted on a target, places along them, and the place that lies nearest to something.

Curves lie in a plane of constant z, seen from above (from +z) when sides are named.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import InputError

SIDES = {"centre": 0, "left": 1, "right": -1}
"""Which part of a painted curve was observed. Left and right are those of someone walking along it: from `start` to
`end` of a segment, counter-clockwise on an arc (so left is the inside)."""


def xyz(values: Sequence[float]) -> tuple[float, float, float]:
    """Three plain floats, whatever kinds of numbers they were."""
    x, y, z = (float(v) for v in values)
    return x, y, z


class Segment(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"start": "from", "end": "to"}
):  # as files have it
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
    """Plain floats in a frozen curve, whatever kinds of numbers it was made of: what a file would give back."""
    for name, value in msgspec.structs.asdict(curve).items():
        try:
            plain = xyz(value) if name in places else float(value)
        except (TypeError, ValueError):
            raise InputError(f"{type(curve).__name__}({name}=...): {value!r} is no number, or no three") from None
        msgspec.structs.force_setattr(curve, name, plain)


# ---- along a curve --------------------------------------------------------------------------------------------------


def along_track(track: ArrayLike, is_arc: bool | Mask, s: ArrayLike) -> Array:
    """C(s) on one track (3, 3) or on one track per s (N, 3, 3): (N, 3) m."""
    tracks, s = np.asarray(track, dtype=float), np.asarray(s, dtype=float)
    first = np.where(is_arc, np.cos(s), s)
    second = np.where(is_arc, np.sin(s), 0.0)
    c, a, b = tracks[..., 0, :], tracks[..., 1, :], tracks[..., 2, :]
    return np.asarray(c + first[:, None] * a + second[:, None] * b)


def along_curve(curve: Curve, s: ArrayLike, side: int = 0) -> Array:
    """(N, 3) m on one curve."""
    return along_track(curve.track(side), isinstance(curve, Arc), s)


def curve_points(curve: Curve, side: int, pieces: int) -> Array:
    """(pieces + 1, 3) m, evenly along a curve."""
    return along_curve(curve, np.linspace(*curve.parameter_range, pieces + 1), side)


# ---- the nearest place ----------------------------------------------------------------------------------------------


def nearest_on_track(tracks: Array, is_arc: bool | Mask, points: Array) -> Array:
    """Parameter s (N,) of the place on one track (3, 3), or on each track (N, 3, 3), nearest to each point (N, 3).

    Past the curve's ends, too; of an arc from -pi to pi.
    """
    c, a, b = tracks[..., 0, :], tracks[..., 1, :], tracks[..., 2, :]
    away = points - c
    straight = np.sum(away * a, axis=1) / np.sum(a * a, axis=-1)
    turned = np.arctan2(np.sum(away * b, axis=1), np.sum(away * a, axis=1))
    return np.asarray(np.where(is_arc, turned, straight))


def nearest_to_rays(tracks: Array, is_arc: bool | Mask, origin: Array, rays: Array) -> Array:
    """Parameter s (N,) of where each ray (N, 3) from `origin` (3,) passes a track (3, 3) or (N, 3, 3) nearest.

    Of an arc it is where the ray meets the arc's plane, of a segment the foot of the common perpendicular; 0 where
    there is none.
    """
    c, a = tracks[..., 0, :], tracks[..., 1, :]
    away = origin - c
    with np.errstate(divide="ignore", invalid="ignore"):
        on_plane = away - (away[..., 2] / rays[:, 2])[:, None] * rays
        turned = np.arctan2(on_plane[:, 1], on_plane[:, 0])
        aa, ar, rr = np.sum(a * a, -1), np.sum(a * rays, 1), np.sum(rays * rays, 1)
        straight = (np.sum(a * away, -1) * rr - np.sum(rays * away, 1) * ar) / (aa * rr - ar * ar)
    return np.nan_to_num(np.where(is_arc, turned, straight), posinf=0.0, neginf=0.0)


def turned_on(curve: Curve, s: Array) -> Array:
    """The same places with an arc's parameter (N,) from its beginning to a full turn on; a segment's as it is."""
    return np.asarray(curve.from_rad + np.mod(s - curve.from_rad, 2.0 * np.pi)) if isinstance(curve, Arc) else s


def nearest_on_curve(curve: Curve, points: Array) -> Array:
    """Parameter s (N,) of the place between the curve's ends nearest to each point (N, 3)."""
    low, high = curve.parameter_range
    s = turned_on(curve, nearest_on_track(curve.track(), isinstance(curve, Arc), points))
    if isinstance(curve, Arc):  # what lies past its end is nearer to one of its two ends
        s = np.where(s <= high, s, np.where(s - high < low + 2.0 * np.pi - s, high, low))
    return np.asarray(np.clip(s, low, high))


def distance_to_curve(curve: Curve, points: Array) -> Array:
    """(N,) m from each point (N, 3) to the nearest place between the curve's ends."""
    return np.asarray(np.linalg.norm(points - along_curve(curve, nearest_on_curve(curve, points)), axis=1))
