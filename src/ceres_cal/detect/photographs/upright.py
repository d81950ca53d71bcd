"""Lens, focal length and rotation of a camera above a floor whose lines run in two perpendicular directions.

Only the strokes of paint in one photograph are known. A stroke and the camera's centre span a plane; the direction of a
line on the floor lies in the planes of all of its strokes. So the strokes vote for two perpendicular directions, for a
focal length, and for the one coefficient of a lens

    ray = (p / phi, 1 + c |p|^2),    p in half image diagonals from the image's middle,

that straightens them. If the floor is seen from straight above, no line determines the focal length: a usual one is
taken.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, replace, rotation_exp
from ceres_cal.kernels import shares_along
from ceres_cal.start.initialise import USUAL_PHI, USUAL_PHI_FACTOR

BENDS = (0.05, -0.05, -0.15, -0.25, -0.35, -0.45, -0.6, -0.75)
_MOST_BENT = -0.75  # with more distortion, the floor seen farther out lies behind the camera
PHIS = (0.8, 1.15, 1.6)
_USUAL_BEND, _BEND_SIGMA = -0.15, 0.35
# Prior standard deviation of the tilt of cameras over fields, rad. Nothing changes from 0.33 to 0.67.
_USUAL_TILT = 0.5
# Penalty at one standard deviation, as a share of all strokes: it decides only where strokes do not. Nothing changes
# from half to double.
_PRIOR_WEIGHT = 0.03
# Tilt in degrees, and number of directions of the tilt.
_RINGS_DEG = ((0.0, 1), (11.0, 6), (22.0, 12), (33.0, 16), (44.0, 20), (54.0, 24), (63.0, 26), (71.0, 28))
_ROUGH, _FINE = 0.06, 0.015  # sine of the angle by which a stroke may be off, in the first and the last round
# Least share of the strokes in the direction that has fewer, as a floor needs both. Nothing changes from half to
# double. And the same as a share of what the target has there: fields without touch lines have little.
_LEAST_SHARE, _LEAST_OF_OWN = 0.06, 0.3
_DOWN = np.diag([1.0, -1.0, -1.0])
_FROM_EACH, _REFINED = 2, 14  # number of rotations kept for each lens and focal length; number refined in all
# Angle between two solutions' verticals, rad, below which they count as one. Nothing changes from half to double.
_APART = 0.1


class Upright(Frozen):
    """One solution for lens, focal length and rotation.

    Attributes:
        bend: c, the lens's coefficient. phi: focal length in half image diagonals.
        rotation: (3, 3) camera from floor; the floor's x and y run along the lines, its z up.
        share: share of the strokes that run along x or y.
    """

    bend: float
    phi: float
    rotation: Array
    share: float

    def rays(self, offsets: Array) -> Array:
        """(N, 3) rays in the camera's frame for offsets (N, 2) from the image's middle in half image diagonals."""
        return np.column_stack([offsets / self.phi, 1.0 + self.bend * np.sum(offsets**2, axis=1)])

    def floor(self, offsets: Array) -> Array:
        """(N, 2) where the rays meet the floor, in camera heights from below the camera; NaN above the horizon."""
        d = self.rays(offsets) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(d[:, 2:] < -0.05, d[:, :2] / -d[:, 2:], np.nan)


def find_upright(ends: Array, weights: Array, most: int, own_share: float = 1.0) -> list[Upright]:
    """Return the best solutions for strokes with these ends (N, 2, 2), in half image diagonals from the middle, best
    first.

    Args:
        weights: (N,) of the strokes. most: largest number of solutions.
        own_share: share of the target's lines in the direction that has fewer.
    """
    least = min(_LEAST_SHARE, _LEAST_OF_OWN * own_share)
    scored: list[tuple[float, Upright]] = []
    rotations = _rotations()
    lean = _PRIOR_WEIGHT * (np.arccos(np.clip(-rotations[:, 2, 2], -1.0, 1.0)) / _USUAL_TILT) ** 2
    for bend in BENDS:
        for phi in PHIS:
            optics = Upright(bend, phi, _DOWN, 0.0)
            value = _score(_normals(bend, phi, ends)[0], weights, rotations, _ROUGH, least) - lean
            for best in np.argsort(-value)[:_FROM_EACH]:
                turned = replace(optics, rotation=rotations[best].astype(float))
                scored.append((float(value[best]) - _penalty(optics), turned))
    scored.sort(key=lambda one: -one[0])
    refined = _refined([one for _, one in scored[:_REFINED]], ends, weights, least)
    refined.sort(key=lambda one: -(one.share - _penalty(one)))
    chosen: list[Upright] = []
    for one in refined:
        if len(chosen) < most and all(_apart(one, other) for other in chosen):
            chosen.append(one)
    return chosen


def best_score(ends: Array, weights: Array, own_share: float) -> float:
    """Return the share of the strokes that the best solution straightens, less its penalty: see `find_upright`."""
    return max((one.share - _penalty(one) for one in find_upright(ends, weights, 1, own_share)), default=0.0)


def _rotations() -> Array:
    """(B, 3, 3) a grid of all rotations relative to the floor, except for quarter turns about the vertical."""
    step_deg = 5.0
    rolls = np.array([rotation_exp([0.0, 0.0, roll]) for roll in np.deg2rad(np.arange(-45.0, 45.0, step_deg))])
    ways = [(tilt, 2.0 * np.pi * number / count) for tilt, count in _RINGS_DEG for number in range(count)]
    leans = [rotation_exp(np.deg2rad(tilt) * np.array([np.cos(way), np.sin(way), 0.0])) for tilt, way in ways]
    return np.asarray((np.array(leans)[:, None] @ _DOWN @ rolls).reshape(-1, 3, 3), dtype=np.float32)


def _normals(bend: Array | float, phi: Array | float, ends: Array) -> tuple[Array, Array]:
    """(..., N, 3) normals, of any length, of the planes through the camera and the strokes, and their derivatives by
    bend; bend and phi are (...), or one number.
    """
    (x, y), (u, v) = ends[:, 0].T, ends[:, 1].T
    near, far = x**2 + y**2, u**2 + v**2
    phi, bend = np.asarray(phi)[..., None], np.asarray(bend)[..., None, None]
    by_bend = np.stack([y * far - v * near, u * near - x * far, np.zeros(len(ends))], axis=-1)
    flat = np.stack(np.broadcast_arrays(y - v, u - x, (x * v - u * y) / phi), axis=-1)
    return flat + bend * by_bend, by_bend


def _score(normals: Array, weights: Array, rotations: Array, tolerance: float, least: float) -> Array:
    """(B,) share of the strokes that run along x or y; 0 where hardly any runs along one of them."""
    planes = normals / (tolerance * np.linalg.norm(normals, axis=1, keepdims=True))
    shares, axes = np.empty(len(rotations)), np.swapaxes(rotations[:, :, :2], 1, 2)
    single = np.float32  # twice as fast, and good enough for a share
    shares_along(planes.T.astype(single), (weights / weights.sum()).astype(single), axes.astype(single), least, shares)
    return shares


def _penalty(optics: Upright) -> float:
    phi = np.log(optics.phi / USUAL_PHI) / np.log(USUAL_PHI_FACTOR)
    tilt = np.arccos(np.clip(-optics.rotation[2, 2], -1.0, 1.0)) / _USUAL_TILT
    return float(_PRIOR_WEIGHT * (phi**2 + ((optics.bend - _USUAL_BEND) / _BEND_SIGMA) ** 2 + tilt**2))


def _refined(starts: Sequence[Upright], ends: Array, weights: Array, least: float) -> list[Upright]:
    """Refine all starts at once by Gauss-Newton on rotation, bend and log phi, robust and with decreasing tolerance."""
    bend, phi = np.array([(one.bend, one.phi) for one in starts]).T
    rotation, share = np.array([one.rotation for one in starts]), weights / weights.sum()
    prior = _PRIOR_WEIGHT * np.array([0.0, 0.0, 0.0, _BEND_SIGMA**-2, np.log(USUAL_PHI_FACTOR) ** -2])
    for tolerance in np.geomspace(_ROUGH, _FINE, num=12):
        base, columns = _deviation(bend, phi, rotation, ends)
        weighted = columns * (share * np.exp(-((base / tolerance) ** 2)) / tolerance**2)[:, None]
        off = np.stack([0.0 * bend, 0.0 * bend, 0.0 * bend, bend - _USUAL_BEND, np.log(phi / USUAL_PHI)], axis=1)
        normal = weighted @ np.swapaxes(columns, 1, 2) + np.diag(prior + 1e-9)
        right = -(weighted @ base[:, :, None])[:, :, 0] - prior * off
        step = np.clip(np.linalg.solve(normal, right[:, :, None])[:, :, 0], -0.1, 0.1)
        bend, phi = np.maximum(bend + step[:, 3], _MOST_BENT), phi * np.exp(step[:, 4])
        rotation = rotation @ np.array([rotation_exp(turn) for turn in step[:, :3]])
    normals, _ = _normals(bend, phi, ends)
    found = [_score(n, weights, r[None], 2.0 * _FINE, least)[0] for n, r in zip(normals, rotation, strict=True)]
    every = zip(bend.tolist(), phi.tolist(), rotation, map(float, found), strict=True)
    return [Upright(*one) for one in every]


def _deviation(bend: Array, phi: Array, rotation: Array, ends: Array) -> tuple[Array, Array]:
    """(B, N) sine of the angle between each stroke and the nearer direction of each of B solutions, and (B, 5, N) its
    derivatives by rotation, bend and log phi.
    """
    normals, by_bend = _normals(bend, phi, ends)
    length = np.linalg.norm(normals, axis=2, keepdims=True)
    normals = normals / length
    x, y, z = np.moveaxis(normals @ rotation, 2, 0)
    is_x, none = np.abs(x) <= np.abs(y), np.zeros_like(x)
    base = np.where(is_x, x, y)
    turns = np.where(is_x, [none, -z, y], [z, none, -x])  # derivative of the axis, w x e
    axis = np.where(is_x[..., None], rotation[:, None, :, 0], rotation[:, None, :, 1])
    by_phi = np.where([False, False, True], -normals, 0.0)
    others = [
        np.sum(change * axis, axis=2) - base * np.sum(change * normals, axis=2) for change in (by_bend / length, by_phi)
    ]
    return base, np.stack([*turns, *others], axis=1)


def _apart(one: Upright, other: Upright) -> bool:
    """Whether two solutions are distinct, apart from quarter turns."""
    away = np.linalg.norm(one.rotation[:, 2] - other.rotation[:, 2])
    return bool(away > _APART or abs(one.bend - other.bend) > 0.05 or abs(np.log(one.phi / other.phi)) > 0.15)
