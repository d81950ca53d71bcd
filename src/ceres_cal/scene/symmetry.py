"""A target turned or mirrored: which of its features coincide, and which turns leave it unchanged."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ceres_cal.base import Array, Codes, Indices32, Pose, rotation_exp
from ceres_cal.scene.curves import Arc, Curve, curve_points, distance_to_curve
from ceres_cal.scene.targets import Target

_SAME_M = 1e-6
_PIECES = 32  # of a curve, whose ends must lie on another one
TURNED, MIRRORED = np.array([-1.0, -1.0, 1.0]), np.array([-1.0, 1.0, 1.0])
"""Factors on x, y, z for half a turn about the middle of the world, and for its mirror image."""


# ---- feature by feature ---------------------------------------------------------------------------------------------


def counterparts(target: Target, image: Array) -> tuple[Indices32, Indices32, Codes]:
    """Return for each point and each curve the one to which x, y, z times `image` (3,) sends it (-1: none), and 1 or -1
    for the curve's side.
    """
    places = target.point_array
    to_point = np.full(len(places), -1, dtype=np.int32)
    for number, sent in enumerate(places * image):
        near = np.flatnonzero(np.all(np.abs(places - sent) < _SAME_M, axis=1))
        to_point[number] = near[0] if len(near) else -1
    curves = list(target.curves.values())
    to_curve, flips = np.full(len(curves), -1, dtype=np.int32), np.ones(len(curves), dtype=np.int8)
    mirrored = np.sign(image[0] * image[1])
    for number, curve in enumerate(curves):
        sent = curve_points(curve, 0, _PIECES) * image
        for other, candidate in enumerate(curves):
            if _is_along(curve, sent, candidate):
                same_way = np.allclose(sent[0], curve_points(candidate, 0, 1)[0], atol=_SAME_M)
                to_curve[number] = other
                flips[number] = 1 if isinstance(curve, Arc) else mirrored * (1 if same_way else -1)
                break
    return to_point, to_curve, flips


def is_seen_turned(target: Target, points: Collection[int], curves: Collection[tuple[int, int]]) -> bool:
    """Return whether a half turn about the middle of the world sends all of these points, by number, and curves, by
    number and side, onto themselves: then a camera cannot be distinguished from a turned one.
    """
    every, places = list(target.curves.values()), target.point_array[list(points)]
    if np.any(np.abs(places * TURNED - places) > _SAME_M):
        return False
    sided = any(side and not isinstance(every[number], Arc) for number, side in curves)  # their edges change places
    return not sided and all(
        _is_along(curve, curve_points(curve, 0, _PIECES) * TURNED, curve) for curve in (every[n] for n, _ in curves)
    )


def _is_along(curve: Curve, sent: Array, other: Curve) -> bool:
    """Return whether a curve, with its places sent to (N, 3), coincides with another one, in either direction."""
    as_long = type(curve) is type(other) and abs(curve.length_m - other.length_m) < _SAME_M
    return as_long and bool(np.max(distance_to_curve(other, sent)) < _SAME_M)


# ---- as painted -----------------------------------------------------------------------------------------------------


def turns_of(target: Target, curves: Collection[str]) -> list[Pose]:
    """Return the turns about the vertical through its middle that keep the painted curves; the first is no turn."""
    counts = np.arange(12, 1, -1)  # largest first
    painted = _painted(target, curves)
    middle, places = middle_of(target, curves), samples(painted)
    sent = np.array([_turn(2.0 * np.pi / count, middle).transform(places) for count in counts])
    away = np.min([distance_to_curve(curve, sent.reshape(-1, 3)) for curve in painted], axis=0).reshape(len(counts), -1)
    same = np.max(away, axis=1) < _SAME_M * np.maximum(1.0, np.max(np.abs(sent), axis=(1, 2)))
    count = int(counts[same].max(initial=1))
    return [_turn(2.0 * np.pi * number / count, middle) for number in range(count)]


def middle_of(target: Target, curves: Collection[str]) -> Array:
    """(3,) m, the middle of the box around the painted curves."""
    places = samples(_painted(target, curves))
    return np.asarray(0.5 * (places.min(axis=0) + places.max(axis=0)))


def size_of(target: Target, curves: Collection[str]) -> float:
    """Longest side of the box around the painted curves, m."""
    return float(np.max(np.ptp(samples(_painted(target, curves)), axis=0)))


def _painted(target: Target, curves: Collection[str]) -> list[Curve]:
    return [curve for name, curve in target.curves.items() if name in curves and curve.width_m > 0.0]


def samples(curves: Collection[Curve]) -> Array:
    """(N, 3) m, places evenly along each curve, including its ends and the outermost places of a circle."""
    return np.concatenate([curve_points(curve, 0, _PIECES) for curve in curves])


def _turn(angle_rad: float, middle: Array) -> Pose:
    rotation = rotation_exp([0.0, 0.0, angle_rad])
    return Pose(rotation, middle - rotation @ middle)
