"""ssl-vision's calibration from four points and the points on lines and arcs, rewritten from its description.

It minimises plain squares over focal length, rotation, tx, ty, principal point and one distortion, r_u = r_d (1 + k
r_d^2) with k >= 0, with tz fixed at the height that the user enters. Each point on a line adds an unknown, its position
along the line (github.com/RoboCup-SSL/ssl-vision, src/shared/util/camera_calibration.cpp,
CameraParameters::calibrate). Here this unknown is eliminated, and the initial estimate is close to the truth; both are
to its advantage. Corners and line points have the same weight, as by its defaults.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import rotation_exp
from ceres_cal.scene.curves import along_curve, nearest_on_curve
from ceres_cal.scene.targets import Target

_ROUNDS = 60
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class SslCamera:
    """f, cx, cy, k, and the pose [R t] of the field relative to the camera."""

    numbers: Array  # (4,) f, cx, cy, k
    rotation: Array
    translation: Array

    def moved(self, step: Any) -> SslCamera:
        """The camera after a step (9,) in f, cx, cy, k, three rotations, tx and ty; k stays at least 0."""
        numbers = self.numbers + step[:4] * (1.0, 1.0, 1.0, 1e-3)
        numbers[3] = max(numbers[3], 0.0)
        shift = self.translation + np.array([*step[7:], 0.0]) * 1e-3
        return SslCamera(numbers, rotation_exp(step[4:7] * 1e-3) @ self.rotation, shift)

    def project(self, places: Array) -> Array:
        """(N, 2) px of places (N, 3) m of the field."""
        f, cx, cy, k = self.numbers
        there = places @ self.rotation.T + self.translation
        flat = there[:, :2] / there[:, 2:]
        far = np.linalg.norm(flat, axis=1)
        near = far.copy()
        for _ in range(40):  # Newton on r_d (1 + k r_d^2) = r_u
            near -= (near * (1.0 + k * near**2) - far) / (1.0 + 3.0 * k * near**2)
        return np.asarray(f * flat * (near / np.maximum(far, 1e-12))[:, None] + (cx, cy))

    def locate(self, pixels: Array, height_m: float) -> Array:
        """(N, 2) m of pixels at a height."""
        f, cx, cy, k = self.numbers
        near = (pixels - (cx, cy)) / f
        flat = near * (1.0 + k * np.sum(near**2, axis=1))[:, None]
        rays = np.column_stack([flat, np.ones(len(flat))]) @ self.rotation
        stands = -self.rotation.T @ self.translation
        return np.asarray((stands + rays * ((height_m - stands[2]) / rays[:, 2])[:, None])[:, :2])


def calibrated(start: SslCamera, field: Target, points: tuple[Array, Array], curves: tuple[Array, Array]) -> SslCamera:
    """The minimum from an initial camera; points and curves are given as features (N,) and pixels (N, 2)."""
    camera, damping = start, 1e-3
    left = _left(camera, field, points, curves)
    for _ in range(_ROUNDS):
        slopes = np.column_stack(
            [(_left(camera.moved(step), field, points, curves) - left) / _STEP for step in _STEP * np.eye(9)]
        )
        normal = slopes.T @ slopes
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), slopes.T @ left)
        trial = camera.moved(step)
        there = _left(trial, field, points, curves)
        if (gain := float(left @ left - there @ there)) > 0.0:
            camera, left, damping = trial, there, 0.1 * damping
            if gain < 1e-6:
                break
        else:
            damping *= 10.0
    return camera


def _left(camera: SslCamera, field: Target, points: tuple[Array, Array], curves: tuple[Array, Array]) -> Array:
    """Residuals: both coordinates of points, and the perpendicular distance of points on curves."""
    feature, pixels = points
    parts = [(camera.project(field.point_array[feature]) - pixels).ravel()]
    every: Sequence[object] = list(field.curves.values())
    feature, pixels = curves
    for number in np.unique(feature):
        own = pixels[feature == number]
        parts.append(_across(camera, every[number], own))
    return np.concatenate(parts)


def _across(camera: SslCamera, curve: object, pixels: Array) -> Array:
    floor = np.column_stack([camera.locate(pixels, 0.0), np.zeros(len(pixels))])
    s = nearest_on_curve(curve, floor)  # type: ignore[arg-type]
    here, there = (camera.project(along_curve(curve, s + d)) for d in (0.0, 1e-4))  # type: ignore[arg-type]
    along = (there - here) / np.linalg.norm(there - here, axis=1)[:, None]
    off = here - pixels
    return np.asarray(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0])
