"""Kannala and Brandt's lens, for fisheyes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.scene.lens.base import Lens, LinearEquations
from ceres_cal.scene.lens.polynomials import dense_polynomial, growing_until, horner, invert_increasing, monotone_limit

_TINY = 1e-150  # its square is still a number


@dataclass(frozen=True)
class KannalaBrandt(Lens):
    """Kannala and Brandt's model as in OpenCV's fisheye: k1..k4 act on the angle from the axis, up to 180 degrees."""

    values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    kind: ClassVar[str] = "kannala-brandt"

    @property
    def names(self) -> tuple[str, ...]:
        return ("k1", "k2", "k3", "k4")

    @property
    def orders(self) -> tuple[int, ...]:
        return 3, 5, 7, 9

    @property
    def _polynomial(self) -> Array:
        """The measured radius over phi of an angle, lowest power first."""
        return dense_polynomial(self.values, self.orders)

    @cached_property
    def _limit(self) -> float:
        """Where that map stops growing, 180 degrees at most."""
        return min(np.pi, monotone_limit(self._polynomial))

    @cached_property
    def _rim(self) -> float:
        """The map's value at its limit."""
        return float(horner(self._polynomial, np.array(self._limit))) if np.isfinite(self._limit) else self._limit

    def _distort(self, rays: Array, phi: float) -> Array:
        across = np.hypot(rays[:, 0], rays[:, 1])
        angle = np.arctan2(across, rays[:, 2])
        measured = np.where(angle <= self._limit, horner(self._polynomial, angle), np.nan)
        stretch = np.where((across == 0.0) & (rays[:, 2] > 0.0), 1.0 / rays[:, 2], measured / across)
        return np.asarray(phi * rays[:, :2] * stretch[:, None])

    def _undistort(self, offsets: Array, phi: float) -> Array:
        measured = offsets / phi
        radius = np.hypot(measured[:, 0], measured[:, 1])
        angle = invert_increasing(self._polynomial, radius, self._limit)
        across = np.where(radius > 0.0, np.sin(angle) / radius, 1.0)
        return np.column_stack([measured * across[:, None], np.cos(angle)])

    def monotone_radius(self, phi: float) -> float:
        return phi * self._rim

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        columns = {name: angle**power for name, power in zip(self.names, self.orders, strict=True)}
        return columns, measured / phi - angle

    def radial_change(self, offsets: Array, phi: float, unit_px: float, power: int) -> Array:
        rays = np.nan_to_num(self.undistort(offsets, phi))
        return np.asarray(phi * np.arctan2(np.linalg.norm(rays[:, :2], axis=1), rays[:, 2]) ** power)

    @property
    def state(self) -> Array:
        """The limit, then the map a (d_0 + d_1 a + ...) of the angle."""
        return np.zeros(10)

    @staticmethod
    def prepare(intrinsics: Any, unit: float, state: Any) -> None:
        state[1] = 1.0
        for k in range(4):
            state[3 + 2 * k] = intrinsics[4 + k]
        state[0] = growing_until(state[1:], np.pi)

    @staticmethod
    def distort_chunk(n: int, intrinsics: Any, unit: float, state: Any, rays: Any, image: Any, work: Any) -> bool:
        limit = state[0]
        phi = intrinsics[0]
        k1, k2, k3, k4 = intrinsics[4], intrinsics[5], intrinsics[6], intrinsics[7]
        good = True
        for i in range(n):
            x, y, z = rays[0, i], rays[1, i], rays[2, i]
            across2 = x * x + y * y
            across = np.sqrt(across2) + _TINY
            range2 = across2 + z * z
            angle = np.arctan2(across, z)
            a2 = angle * angle
            measured = angle * (1.0 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
            slope = 1.0 + a2 * (3.0 * k1 + a2 * (5.0 * k2 + a2 * (7.0 * k3 + a2 * 9.0 * k4)))
            # On the axis measured / across is 1 / z, and the bend's factor x^2 takes it to 0.
            stretch = measured / across if across > 1e-12 * z else 1.0 / z
            bend = (slope * z / range2 - stretch) / (across2 + _TINY) if across > 1e-12 * z else 0.0
            image[0, i], image[1, i] = phi * stretch * x, phi * stretch * y
            image[2, i] = phi * (stretch + bend * x * x)
            image[3, i] = phi * bend * x * y
            image[4, i] = phi * (stretch + bend * y * y)
            image[5, i], image[6, i] = -phi * x * slope / range2, -phi * y * slope / range2
            work[0, i], work[1, i], work[2, i] = x / across, y / across, angle
            good &= (angle < limit) & (range2 > 0.0)
        return good

    @staticmethod
    def differentiate_chunk(
        n: int, intrinsics: Any, unit: float, state: Any, image: Any, work: Any, jacobian: Any
    ) -> None:
        phi, aspect = intrinsics[0], intrinsics[1]
        for k in range(4):
            for i in range(n):
                d = phi * work[2, i] ** (2 * k + 3)
                jacobian[4 + k, 0, i], jacobian[4 + k, 1, i] = d * work[0, i], aspect * d * work[1, i]
