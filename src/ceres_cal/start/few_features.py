"""Where a camera of known lens stands by fewer features than a homography takes, such as two lines and an arc.

With the position C = (h q, h) over the features' plane, s = 1 / h, and u what a ray moves in x and y on a step down,
the ray shows the place h v with v = q + u. A point P (v = s P), a straight line (n . v + s c = 0) and an arc
(|v - s m| = s r) then ask for angles, whatever the distance, and but for arcs linearly. Each rotation of a grid gets
its q and s; damped Gauss-Newton steps in all six numbers bring the best to their minima. Where two of these fit, that
is said, and no start is made.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask, distinct
from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.transforms import rotation_exp
from ceres_cal.observations.sights import Sights

_TILTS, _TURNS = np.deg2rad((0.0, 15.0, 30.0, 45.0, 60.0)), 24  # grid: of the axis; its azimuths and rolls about it
_MOST = 24  # points, and observations of a curve, beyond which a start learns nothing more
_KEPT = 80  # rotations that are brought to their minima
_FIRST_STEPS, _STEPS = 5, 30
_DAMPING, _LEAST_DAMPING = 1e-3, 1e-9
_LEAST_DOWN = 0.03  # sine of the angle under the horizon: nearer to it a ray has no place on the floor
_HEIGHTS_M = (0.05, 100.0)
_DETERMINED = 1e-9  # least over largest eigenvalue of the normal equations from which on they determine a pose
_ALIKE, _ALIKE_PX = 3.0, 1.0  # times the least rms, and px beside it: what fits as well
_APART = 0.05  # rad, and of the height: minima that are no farther apart are one
_PRECISION = 1e-3  # of a start: rad
_BEYOND = 0.05  # share of a line's length by which a start may see it beyond its ends
_STEP = 1e-6  # of derivatives


@dataclass(frozen=True, eq=False)
class _Features:
    """What is seen on one plane.

    Attributes:
        rays: (A + B + C, 3) in the camera's frame: of A points, B places on lines and C on arcs. points: (A, 2) m.
        lines: (B, 3) n and c. spans: (B, 3) by which x, y and 1 make 0 and 1 of a line's ends. arcs: (C, 3) centre and
            radius, m. height_m: of the camera over the plane, and its standard deviation; None where it is not known.
    """

    rays: Array
    points: Array
    lines: Array
    spans: Array
    arcs: Array
    height_m: tuple[float, float] | None

    def places(self, rotations: Array) -> tuple[Array, Array]:
        """u (K, N, 2) at frame_from_cam (K, 3, 3), and the least sine under the horizon (K,)."""
        d = np.einsum("kij,nj->kni", rotations, self.rays)
        sine = -d[:, :, 2] / np.linalg.norm(self.rays, axis=1)
        return d[:, :, :2] / np.maximum(-d[:, :, 2], 1e-3 * _LEAST_DOWN)[:, :, None], sine.min(axis=1)

    def within_ends(self, rotations: Array, numbers: Array) -> Mask:
        """(K,) whether what is seen of lines lies between their ends."""
        of_lines = slice(len(self.points), len(self.points) + len(self.lines))
        places = (numbers[:, None, :2] + self.places(rotations)[0][:, of_lines]) / numbers[:, 2, None, None]
        along = np.sum(places * self.spans[:, :2], axis=2) + self.spans[:, 2]
        return np.asarray(np.all(np.abs(along - 0.5) < 0.5 + _BEYOND, axis=1))

    def residuals(self, rotations: Array, numbers: Array) -> Array:
        """(K, 2 A + B + C + 1) rad, about, at frame_from_cam (K, 3, 3) and (q, s) (K, 3)."""
        u, _ = self.places(rotations)
        v, s = numbers[:, None, :2] + u, numbers[:, 2, None, None]
        ends = np.cumsum([len(self.points), len(self.lines)])
        of_points, of_lines, of_arcs = np.split(v / np.sqrt(1.0 + np.sum(u**2, axis=2))[..., None], ends, axis=1)
        shrink = np.split(1.0 / np.sqrt(1.0 + np.sum(u**2, axis=2)), ends, axis=1)
        off = of_points - shrink[0][..., None] * s * self.points
        aside = np.sum(of_lines * self.lines[:, :2], axis=2) + shrink[1] * s[..., 0] * self.lines[:, 2]
        away = np.linalg.norm(of_arcs - shrink[2][..., None] * s * self.arcs[:, :2], axis=2)
        away -= shrink[2] * s[..., 0] * self.arcs[:, 2]
        height = np.zeros((len(v), 1))
        if self.height_m is not None:  # a thousandth of it weighs as much as a thousandth of a radian, at best
            known_m, sigma_m = self.height_m
            height = (numbers[:, 2:] * known_m - 1.0) * _PRECISION / max(sigma_m / known_m, _PRECISION)
        return np.concatenate([off.reshape(len(v), -1), aside, away, height], axis=1)

    def slopes(self, rotations: Array, numbers: Array, turns: bool) -> Array:
        """(K, rows, 3 or 6) derivatives of the residuals by q and s, and by a turn of the camera."""
        steps = _STEP * np.eye(3)
        columns = [self._difference(rotations, numbers, rotations, numbers + step) for step in steps]
        for step in steps if turns else ():
            columns.append(self._difference(rotations, numbers, rotation_exp(step) @ rotations, numbers))
        return np.stack(columns, axis=2)

    def _difference(self, rotations: Array, numbers: Array, turned: Array, moved: Array) -> Array:
        return (self.residuals(turned, moved) - self.residuals(rotations, numbers)) / _STEP


def pose_of_few(
    sight: Sights, rays: tuple[Array, Array], phi: float, height_m: tuple[float, float] | None
) -> Array | None:
    """cam_from_world (3, 4) of a sight of the world, by what lies on the plane of most of its features.

    Args:
        rays: (N, 3) and (M, 3) of its points and curve observations in the camera's frame. phi: px, what an angle is.
        height_m: z of the camera and its standard deviation, where these are known.

    Returns:
        None where the features determine no pose.

    Raises:
        DegenerateError: poses in two places fit.
    """
    plane_m, features = _features(sight, rays, height_m)
    rotations, numbers = _refined(features)
    seen = features.within_ends(rotations, numbers)
    rotations, numbers = rotations[seen], numbers[seen]
    if not len(numbers):
        return None
    rms_px = phi * np.sqrt(np.mean(features.residuals(rotations, numbers) ** 2, axis=1))
    best = int(np.argmin(rms_px))
    slopes = features.slopes(rotations[[best]], numbers[[best]], turns=True)[0]
    sizes = np.linalg.svd(slopes / np.maximum(np.linalg.norm(slopes, axis=0), 1e-12), compute_uv=False)
    if len(slopes) < 6 or sizes[-1] ** 2 < _DETERMINED * sizes[0] ** 2:
        return None
    positions = np.column_stack([numbers[:, :2], np.ones(len(numbers))]) / numbers[:, 2:] + (0.0, 0.0, plane_m)
    _require_one(sight, rotations, positions, rms_px)
    rotation = rotations[best].T
    return np.column_stack([rotation, -rotation @ positions[best]])


def _require_one(sight: Sights, rotations: Array, positions: Array, rms_px: Array) -> None:
    """Raise DegenerateError where a pose elsewhere fits as well as the best."""
    best = int(np.argmin(rms_px))
    turned = np.linalg.norm(rotations - rotations[best], axis=(1, 2)) / np.sqrt(2.0)
    shifted = np.linalg.norm(positions - positions[best], axis=1) / positions[best, 2]
    alike = rms_px <= _ALIKE * rms_px[best] + _ALIKE_PX
    others = np.flatnonzero(alike & ((turned > _APART) | (shifted > _APART)))
    if len(others):
        places = positions[best], positions[others[np.argmin(rms_px[others])]]
        one, two = ("({:.2f}, {:.2f}, {:.2f}) m".format(*place) for place in places)
        raise DegenerateError(
            f"{sight.key}: what it shows is seen alike from {one} and from {two}: add a point or a line, or the "
            "camera's height as a prior"
        )


def _features(
    sight: Sights, rays: tuple[Array, Array], height_m: tuple[float, float] | None
) -> tuple[float, _Features]:
    """z of the plane, and some of what lies on it."""
    starts, along = sight.tracks[:, 0], sight.tracks[:, 1]
    level = (np.abs(along[:, 2]) < 1e-12)[sight.track_index]
    z = np.concatenate([sight.points[:, 2], starts[sight.track_index[level], 2]]).round(9)
    values, counts = np.unique(z, return_counts=True)
    plane_m = float(values[np.argmax(counts)]) if len(values) else 0.0
    on = np.flatnonzero(np.abs(sight.points[:, 2] - plane_m) < 1e-6)
    on = on[_evenly(len(on))]
    tracks = np.flatnonzero(level & (np.abs(starts[sight.track_index, 2] - plane_m) < 1e-6))
    order = tracks[np.argsort(sight.track_index[tracks], kind="stable")]
    ends = np.flatnonzero(np.diff(sight.track_index[order])) + 1
    some = np.concatenate([own[_evenly(len(own))] for own in np.split(order, ends)])
    arc = sight.on_arc[some]
    lines, arcs = some[~arc], some[arc]
    c, a = starts[sight.track_index[lines], :2], along[sight.track_index[lines], :2]
    normal = np.column_stack([-a[:, 1], a[:, 0]]) / np.linalg.norm(a, axis=1, keepdims=True)
    centres, radii = starts[sight.track_index[arcs], :2], along[sight.track_index[arcs], 0]
    return plane_m, _Features(
        np.vstack([rays[0][on], rays[1][lines], rays[1][arcs]]),
        sight.points[on, :2],
        np.column_stack([normal, -np.sum(normal * c, axis=1)]),
        np.column_stack([a, -np.sum(a * c, axis=1)]) / np.sum(a**2, axis=1, keepdims=True),
        np.column_stack([centres, radii]),
        None if height_m is None else (height_m[0] - plane_m, height_m[1]),
    )


def _evenly(count: int) -> Indices:
    return distinct(np.linspace(0, max(count - 1, 0), min(count, _MOST)).round().astype(np.int64))


def _refined(features: _Features) -> tuple[Array, Array]:
    """Minima: frame_from_cam (K, 3, 3), and q and s (K, 3)."""
    rotations = _grid()
    rotations = rotations[features.places(rotations)[1] > _LEAST_DOWN]
    numbers = np.tile([0.0, 0.0, 0.25], (len(rotations), 1))
    for turns, steps in ((False, _FIRST_STEPS), (True, _STEPS)):
        damping = np.full(len(rotations), _DAMPING)
        for _ in range(steps):
            rotations, numbers, damping = _stepped(features, rotations, numbers, damping, turns)
        best = np.argsort(np.sum(features.residuals(rotations, numbers) ** 2, axis=1))[:_KEPT]
        rotations, numbers = rotations[best], numbers[best]
    return rotations, numbers


def _stepped(
    features: _Features, rotations: Array, numbers: Array, damping: Array, turns: bool
) -> tuple[Array, Array, Array]:
    """One step of Levenberg and Marquardt for each; where it leads to more, the damping (K,) grows instead."""
    before, slopes = features.residuals(rotations, numbers), features.slopes(rotations, numbers, turns)
    sizes = np.maximum(np.linalg.norm(slopes, axis=1), _STEP)  # unit diagonal: no number is by nature larger
    slopes /= sizes[:, None]
    normal = np.swapaxes(slopes, 1, 2) @ slopes + np.eye(slopes.shape[2]) * damping[:, None, None]
    step = -np.linalg.solve(normal, np.einsum("krp,kr->kp", slopes, before)[..., None])[..., 0] / sizes
    moved = numbers + step[:, :3]
    moved[:, 2] = np.clip(moved[:, 2], 1.0 / _HEIGHTS_M[1], 1.0 / _HEIGHTS_M[0])
    turned = np.array([rotation_exp(w) for w in step[:, 3:]]) @ rotations if turns else rotations
    after = features.residuals(turned, moved)
    better = np.sum(after**2, axis=1) < np.sum(before**2, axis=1)
    better &= features.places(turned)[1] > _LEAST_DOWN
    moved, turned = np.where(better[:, None], moved, numbers), np.where(better[:, None, None], turned, rotations)
    return turned, moved, np.maximum(damping * np.where(better, 0.3, 5.0), _LEAST_DAMPING)


@cache
def _grid() -> Array:
    """(K, 3, 3) frame_from_cam: axes evenly over the lower half sphere down to some tilt, each with some rolls."""
    turns = np.arange(_TURNS) * (2.0 * np.pi / _TURNS)
    down = np.diag([1.0, -1.0, -1.0])
    rolled = [down @ rotation_exp([0.0, 0.0, turn]) for turn in turns.tolist()]
    axes = [
        rotation_exp([tilt * np.cos(a), tilt * np.sin(a), 0.0])
        for tilt in _TILTS
        for a in turns[:: 2 if tilt else _TURNS]
    ]
    return np.array([axis @ one for axis in axes for one in rolled])
