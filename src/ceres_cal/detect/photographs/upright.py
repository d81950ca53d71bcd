"""How a camera looks at a floor whose lines run in two directions at right angles: lens, focal length and turn.

Nothing is known beforehand but the strokes of paint in one photograph. A stroke and the camera's centre span a plane;
the direction of a line on the floor lies in the planes of all of its strokes. So the strokes vote for two directions at
right angles, for a focal length, and for the one coefficient of a lens

    ray = (p / phi, 1 + c |p|^2),    p in half image diagonals from the image's middle,

that straightens them. Of a floor that is seen from straight above no line tells the focal length: a usual one is taken.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.frozen import Frozen, replace
from ceres_cal.base.transforms import rotation_exp
from ceres_cal.start.initialise import USUAL_PHI, USUAL_PHI_FACTOR

BENDS = (0.05, -0.05, -0.15, -0.25, -0.35, -0.45, -0.6, -0.75)
_MOST_BENT = -0.75  # a floor that is seen farther out than that lies behind the camera
PHIS = (0.8, 1.15, 1.6)
_USUAL_BEND, _BEND_SIGMA = -0.15, 0.35
# rad: a standard deviation of the tilts that cameras over fields have. Nothing changes from 0.33 to 0.67.
_USUAL_TILT = 0.5
# Of all strokes, at one standard deviation: it decides only where strokes do not. Nothing changes from half to
# double.
_PRIOR_WEIGHT = 0.03
_RINGS_DEG = ((0.0, 1), (11.0, 6), (22.0, 12), (33.0, 16), (44.0, 20), (54.0, 24))  # tilt, directions of it
_ROLL_DEG = 5.0
_ROUGH, _FINE = 0.06, 0.015  # sine of the angle by which a stroke may be off
_ROUNDS = 12
_STEP = 1e-5  # of bend and log phi, for slopes
# Of the strokes, in the direction that has fewer: a floor needs both. Nothing changes from half to double. And of what
# the target has there: fields without touch lines have little.
_LEAST_SHARE, _LEAST_OF_OWN = 0.06, 0.3
_DOWN = np.diag([1.0, -1.0, -1.0])
_FROM_EACH, _REFINED = 2, 14  # of each lens and focal length, and of all
# Of two answers' uprights, rad: nearer ones count as one. Nothing changes from half to double.
_APART = 0.1


class Upright(Frozen):
    """One answer.

    Attributes:
        bend: c. phi: in half image diagonals.
        rotation: (3, 3) camera from floor; the floor's x and y run along the lines, its z up.
        share: of the strokes, those that run along x or y.
    """

    bend: float
    phi: float
    rotation: Array
    share: float

    def rays(self, offsets: Array) -> Array:
        """(N, 3) of offsets (N, 2) from the image's middle in half image diagonals, in the camera's frame."""
        return np.column_stack([offsets / self.phi, 1.0 + self.bend * np.sum(offsets**2, axis=1)])

    def floor(self, offsets: Array) -> Array:
        """(N, 2) where they meet the floor, in camera heights from below the camera; NaN above the horizon."""
        d = self.rays(offsets) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(d[:, 2:] < -0.05, d[:, :2] / -d[:, 2:], np.nan)

    def offsets(self, floor: Array) -> Array:
        """(..., 2) of places (..., 2) on the floor: the other way; NaN behind the camera."""
        u, v = floor[..., 0], floor[..., 1]
        across, down, ahead = (u * x + v * y - z for x, y, z in self.rotation.astype(floor.dtype))
        with np.errstate(divide="ignore", invalid="ignore"):
            ideal = self.phi / np.where(ahead > 0.0, ahead, np.nan) * np.stack([across, down])
            # p = ideal (1 + c p^2): the root that is near ideal for small c.
            root = np.sqrt(1.0 - 4.0 * self.bend * (ideal[0] ** 2 + ideal[1] ** 2))
            return np.moveaxis(2.0 * ideal / (1.0 + root), 0, -1)


def find_upright(ends: Array, weights: Array, most: int, own_share: float = 1.0) -> list[Upright]:
    """The best answers for strokes with these ends (N, 2, 2), in half image diagonals from the middle, best first.

    Args:
        own_share: of the target's lines, those in the direction that has fewer.
    """
    least = min(_LEAST_SHARE, _LEAST_OF_OWN * own_share)
    scored: list[tuple[float, Upright]] = []
    rotations = _rotations()
    lean = _PRIOR_WEIGHT * (np.arccos(np.clip(-rotations[:, 2, 2], -1.0, 1.0)) / _USUAL_TILT) ** 2
    for bend in BENDS:
        for phi in PHIS:
            optics = Upright(bend, phi, _DOWN, 0.0)
            value = _score(_normals(optics, ends), weights, rotations, _ROUGH, least) - lean
            for best in np.argsort(-value)[:_FROM_EACH]:
                turned = replace(optics, rotation=rotations[best].astype(float))
                scored.append((float(value[best]) - _penalty(optics), turned))
    scored.sort(key=lambda one: -one[0])
    refined = [_refined(one, ends, weights, least) for _, one in scored[:_REFINED]]
    refined.sort(key=lambda one: -(one.share - _penalty(one)))
    chosen: list[Upright] = []
    for one in refined:
        if len(chosen) < most and all(_apart(one, other) for other in chosen):
            chosen.append(one)
    return chosen


def best_score(ends: Array, weights: Array, own_share: float) -> float:
    """How many of the strokes the best answer straightens, less what speaks against it: see `find_upright`."""
    return max((one.share - _penalty(one) for one in find_upright(ends, weights, 1, own_share)), default=0.0)


def _rotations() -> Array:
    """(B, 3, 3) every way to look at the floor, but for quarter turns about the upright."""
    rolls = np.deg2rad(np.arange(-45.0, 45.0, _ROLL_DEG))
    rotations = []
    for tilt, count in _RINGS_DEG:
        for direction in 2.0 * np.pi * np.arange(count) / count:
            lean = rotation_exp(np.deg2rad(tilt) * np.array([np.cos(direction), np.sin(direction), 0.0]))
            rotations += [lean @ _DOWN @ rotation_exp([0.0, 0.0, roll]) for roll in rolls]
    return np.array(rotations, dtype=np.float32)


def _normals(optics: Upright, ends: Array) -> Array:
    """(N, 3) unit normals of the planes through the camera and the strokes."""
    (a, b, c), (x, y, z) = optics.rays(ends[:, 0]).T, optics.rays(ends[:, 1]).T
    normal = np.column_stack([b * z - c * y, c * x - a * z, a * y - b * x])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _score(normals: Array, weights: Array, rotations: Array, tolerance: float, least: float) -> Array:
    """(B,) share of the strokes that run along x or y, none where hardly any runs along one of them."""
    single = np.float32  # twice as fast, and good enough for a share
    axes = np.moveaxis(rotations[:, :, :2].astype(single), 2, 0).reshape(-1, 3)
    off = (axes @ normals.T.astype(single) / single(tolerance)).reshape(2, len(rotations), -1)
    along, weight = np.exp(-(off**2)), (weights / weights.sum()).astype(single)  # (2, B, N), (N,)
    least_share = np.minimum(*(along @ weight))
    return np.asarray(np.where(least_share > least, np.maximum(*along) @ weight, 0.0))


def _penalty(optics: Upright) -> float:
    phi = np.log(optics.phi / USUAL_PHI) / np.log(USUAL_PHI_FACTOR)
    tilt = np.arccos(np.clip(-optics.rotation[2, 2], -1.0, 1.0)) / _USUAL_TILT
    return float(_PRIOR_WEIGHT * (phi**2 + ((optics.bend - _USUAL_BEND) / _BEND_SIGMA) ** 2 + tilt**2))


def _moved(one: Upright, step: Array) -> Upright:
    return replace(
        one,
        bend=max(one.bend + float(step[3]), _MOST_BENT),
        phi=one.phi * float(np.exp(step[4])),
        rotation=one.rotation @ rotation_exp(step[:3]),
    )


def _refined(one: Upright, ends: Array, weights: Array, least: float) -> Upright:
    """Gauss-Newton on turn, bend and log phi, robust and ever finer."""
    for tolerance in np.geomspace(_ROUGH, _FINE, _ROUNDS):
        base, columns = _deviation(one, ends)
        weight = weights / weights.sum() * np.exp(-((base / tolerance) ** 2)) / tolerance**2
        prior = _PRIOR_WEIGHT * np.diag([0.0, 0.0, 0.0, _BEND_SIGMA**-2, np.log(USUAL_PHI_FACTOR) ** -2])
        off = np.array([0.0, 0.0, 0.0, one.bend - _USUAL_BEND, np.log(one.phi / USUAL_PHI)])
        normal = (columns * weight) @ columns.T + prior + 1e-9 * np.eye(5)
        step = np.linalg.solve(normal, -(columns * weight) @ base - prior @ off)
        one = _moved(one, np.clip(step, -0.1, 0.1))
    normals = _normals(one, ends)
    return replace(one, share=float(_score(normals, weights, one.rotation[None], 2.0 * _FINE, least)[0]))


def _deviation(one: Upright, ends: Array) -> tuple[Array, Array]:
    """(N,) sine of the angle between each stroke and the nearer direction, and (5, N) its slopes by turn, bend and log
    phi.
    """
    off = _normals(one, ends) @ one.rotation
    x, y, z = off.T
    is_x, none = np.abs(x) <= np.abs(y), np.zeros(len(off))
    base = np.where(is_x, x, y)
    turns = np.where(is_x, [none, -z, y], [z, none, -x])  # of the axis, w x e
    others = []
    for step in _STEP * np.eye(5)[3:]:
        there = _normals(_moved(one, step), ends) @ one.rotation[:, :2]
        others.append((np.where(is_x, *there.T) - base) / _STEP)
    return base, np.vstack([turns, others])


def _apart(one: Upright, other: Upright) -> bool:
    """Whether two answers are two, but for quarter turns."""
    away = np.linalg.norm(one.rotation[:, 2] - other.rotation[:, 2])
    return bool(away > _APART or abs(one.bend - other.bend) > 0.05 or abs(np.log(one.phi / other.phi)) > 0.15)
