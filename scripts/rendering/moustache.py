"""A lens whose distortion grows and decreases again towards the rim, which no model of the package describes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.scene.lens import Lens

_FARTHEST, _STEPS = 4.0, 200_000  # largest tangent, and number of samples, of its inverse


@dataclass(frozen=True)
class Moustache(Lens):
    """The radius is phi (t - amount t^3 / (1 + (t / bend)^4)), where t is the tangent of the angle from the axis."""

    values: tuple[float, ...] = (0.0, 1.0)
    kind: ClassVar[str] = "moustache"
    names = ("amount", "bend")
    orders = (3, 3)

    def _radius(self, tangent: Array) -> Array:
        amount, bend = self.values
        return np.asarray(tangent - amount * tangent**3 / (1.0 + (tangent / bend) ** 4))

    def _distort(self, rays: Array, phi: float) -> Array:
        across = rays[:, :2] / np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)
        tangent = np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        return np.asarray(phi * across * self._radius(tangent) / tangent)

    def _undistort(self, offsets: Array, phi: float) -> Array:
        tangents = np.linspace(0.0, _FARTHEST, _STEPS)
        radius = np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True) / phi, 1e-12)
        tangent = np.interp(radius, self._radius(tangents), tangents)
        rays = np.column_stack([offsets / phi * tangent / radius, np.ones(len(offsets))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def monotone_radius(self, phi: float) -> float:
        return float(phi * self._radius(np.array(_FARTHEST)))
