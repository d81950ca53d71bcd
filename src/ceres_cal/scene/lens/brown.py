"""Brown's lens."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.scene.lens.base import Lens, LinearEquations, ahead, unit_rays
from ceres_cal.scene.lens.polynomials import (
    STEPS,
    dense_polynomial,
    growing_until,
    horner,
    invert_increasing,
    monotone_limit,
)

_FAR = 6.0  # ideal radii: nothing is observed farther out


@dataclass(frozen=True)
class Brown(Lens):
    """Brown's model as in OpenCV: k1 k2 p1 p2 k3 act on the ideal point (x/z, y/z)."""

    values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    kind: ClassVar[str] = "brown"
    decentring: ClassVar[tuple[str, ...]] = ("p1", "p2")

    @property
    def names(self) -> tuple[str, ...]:
        return ("k1", "k2", "p1", "p2", "k3")

    @property
    def orders(self) -> tuple[int, ...]:
        return 3, 5, 2, 2, 7

    @property
    def _polynomial(self) -> Array:
        # In the worst direction the decentring terms take 3 |p| r^2 off the radius. While what is left grows, the
        # derivative of the whole map, which is symmetric, is positive definite in every direction: no two answers.
        k1, k2, p1, p2, k3 = self.values
        return dense_polynomial((-3.0 * np.hypot(p1, p2), k1, k2, k3), (2, 3, 5, 7))

    @cached_property
    def _limit(self) -> float:
        """Where that map stops growing; infinity where it never does."""
        return monotone_limit(self._polynomial)

    @cached_property
    def _rim(self) -> float:
        """The map's value at its limit."""
        return float(horner(self._polynomial, np.array(self._limit))) if np.isfinite(self._limit) else self._limit

    def _map(self, ideal: Array) -> Array:
        k1, k2, p1, p2, k3 = self.values
        x, y = ideal[:, 0], ideal[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.column_stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ]
        )

    def _jacobian(self, ideal: Array) -> tuple[Array, Array, Array]:
        """Derivatives xx, xy = yx and yy of `_map`."""
        k1, k2, p1, p2, k3 = self.values
        x, y = ideal[:, 0], ideal[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        xy = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        return xx, xy, yy

    def _within(self, ideal: Array) -> Array:
        """Ideal points (N, 2), NaN past the limit."""
        return np.where(np.hypot(ideal[:, :1], ideal[:, 1:]) <= self._limit, ideal, np.nan)

    def _distort(self, rays: Array, phi: float) -> Array:
        return np.asarray(phi * self._map(self._within(rays[:, :2] / ahead(rays))))

    def _undistort(self, offsets: Array, phi: float) -> Array:
        measured = offsets / phi
        radius = np.hypot(measured[:, 0], measured[:, 1])
        # Other directions reach farther than the worst: from beyond its rim, start just inside.
        start = invert_increasing(self._polynomial, np.minimum(radius, self._rim * (1.0 - 1e-6)), self._limit)
        ideal = self._newton(measured * np.where(radius > 0.0, start / radius, 1.0)[:, None], measured)
        return unit_rays(self._within(ideal), 1.0)

    def _newton(self, start: Array, measured: Array) -> Array:
        """Ideal points (N, 2) whose image is `measured`; NaN where Newton's method does not get there."""
        ideal, rows = start.copy(), np.arange(len(start))
        for _ in range(STEPS):
            here = ideal[rows]
            error = self._map(here) - measured[rows]
            xx, xy, yy = self._jacobian(here)
            step = np.column_stack([yy * error[:, 0] - xy * error[:, 1], xx * error[:, 1] - xy * error[:, 0]])
            step /= (xx * yy - xy * xy)[:, None]
            ideal[rows] = here - step
            rows = rows[np.any(np.abs(step) > 1e-13, axis=1)]
            if not len(rows):
                break
        error = np.max(np.abs(self._map(ideal) - measured), axis=1)
        solved = error <= 1e-12 * (1.0 + np.max(np.abs(measured), axis=1))
        return np.where(solved[:, None], ideal, np.nan)

    def monotone_radius(self, phi: float) -> float:
        return phi * self._rim

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        u = ideal / phi
        return {name: u**power for name, power in (("k1", 3), ("k2", 5), ("k3", 7))}, measured / phi - u

    def radial_change(self, offsets: Array, phi: float, unit_px: float, power: int) -> Array:
        rays = np.nan_to_num(self.undistort(offsets, phi))
        return np.asarray(phi * (np.linalg.norm(rays[:, :2], axis=1) / np.maximum(rays[:, 2], 0.05)) ** power)

    @property
    def state(self) -> Array:
        """The limit, then the map u (d_0 + d_1 u + ...) of the ideal radius without decentring."""
        return np.zeros(8)

    @staticmethod
    def prepare(intrinsics: Any, unit: float, state: Any) -> None:
        state[1], state[3], state[5], state[7] = 1.0, intrinsics[4], intrinsics[5], intrinsics[8]
        state[0] = growing_until(state[1:], _FAR)

    @staticmethod
    def distort_chunk(n: int, intrinsics: Any, unit: float, state: Any, rays: Any, image: Any, work: Any) -> bool:
        limit = state[0]
        phi = intrinsics[0]
        k1, k2, p1, p2, k3 = intrinsics[4], intrinsics[5], intrinsics[6], intrinsics[7], intrinsics[8]
        good = True
        for i in range(n):
            iz = 1.0 / rays[2, i]
            u, v = rays[0, i] * iz, rays[1, i] * iz
            r2 = u * u + v * v
            radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
            slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
            xx = phi * (radial + u * u * slope + 2.0 * p1 * v + 6.0 * p2 * u) * iz
            xy = phi * (u * v * slope + 2.0 * p1 * u + 2.0 * p2 * v) * iz
            yy = phi * (radial + v * v * slope + 6.0 * p1 * v + 2.0 * p2 * u) * iz
            image[0, i] = phi * (u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u))
            image[1, i] = phi * (v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v)
            image[2, i], image[3, i], image[4, i] = xx, xy, yy
            image[5, i], image[6, i] = -(xx * u + xy * v), -(xy * u + yy * v)
            work[0, i], work[1, i], work[2, i] = u, v, r2
            good &= (rays[2, i] > 0.0) & (r2 < limit * limit)
        return good

    @staticmethod
    def differentiate_chunk(
        n: int, intrinsics: Any, unit: float, state: Any, image: Any, work: Any, jacobian: Any
    ) -> None:
        phi, aspect = intrinsics[0], intrinsics[1]
        for i in range(n):
            u, v, r2 = work[0, i], work[1, i], work[2, i]
            x, y, r4 = phi * u, aspect * phi * v, r2 * r2
            jacobian[4, 0, i], jacobian[4, 1, i] = x * r2, y * r2
            jacobian[5, 0, i], jacobian[5, 1, i] = x * r4, y * r4
            jacobian[6, 0, i], jacobian[6, 1, i] = 2.0 * x * v, aspect * phi * (r2 + 2.0 * v * v)
            jacobian[7, 0, i], jacobian[7, 1, i] = phi * (r2 + 2.0 * u * u), 2.0 * u * y
            jacobian[8, 0, i], jacobian[8, 1, i] = x * r2 * r4, y * r2 * r4
