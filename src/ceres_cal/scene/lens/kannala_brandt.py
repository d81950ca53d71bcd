"""Kannala and Brandt's lens, for fisheyes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.scene.lens.base import LinearEquations
from ceres_cal.scene.lens.planar import Decentred
from ceres_cal.scene.lens.polynomials import growing_until

_TINY = 1e-150  # its square is still a number


@dataclass(frozen=True)
class KannalaBrandt(Decentred):
    """Kannala and Brandt's model as in OpenCV's fisheye: k1..k4 act on the angle from the axis, up to 180 degrees; p1
    and p2, where they are asked for, displace tangentially, as in COLMAP's THIN_PRISM_FISHEYE.
    """

    values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    terms: tuple[str, ...] = ()
    kind: ClassVar[str] = "kannala-brandt"
    more_terms: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({"tangential": ("p1", "p2")})
    above: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")
    _end: ClassVar[float] = np.pi

    @property
    def names(self) -> tuple[str, ...]:
        return ("k1", "k2", "k3", "k4", *self.names_of_terms)

    @property
    def orders(self) -> tuple[int, ...]:
        return (3, 5, 7, 9, 2, 2)[: len(self.names)]

    @staticmethod
    def _flat(rays: Array) -> Array:
        """In the direction of the ray, as far out as its angle."""
        across = np.hypot(rays[:, 0], rays[:, 1])
        angle = np.arctan2(across, rays[:, 2])
        stretch = np.where((across == 0.0) & (rays[:, 2] > 0.0), 1.0 / rays[:, 2], angle / across)
        return np.asarray(rays[:, :2] * stretch[:, None])

    @staticmethod
    def _lifted(flat: Array) -> Array:
        angle = np.hypot(flat[:, 0], flat[:, 1])
        across = np.where(angle > 0.0, np.sin(angle) / angle, 1.0)
        return np.column_stack([flat * across[:, None], np.cos(angle)])

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        columns = {name: angle**power for name, power in zip(self.above, self.orders, strict=False)}
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
        tangential = len(intrinsics) > 8
        p1, p2 = (intrinsics[8], intrinsics[9]) if tangential else (0.0, 0.0)
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
        if tangential:
            for i in range(n):
                x, y, z = rays[0, i], rays[1, i], rays[2, i]
                across2 = x * x + y * y
                range2 = across2 + z * z
                across = np.sqrt(across2) + _TINY
                away = work[2, i] / across if across > 1e-12 * z else 1.0 / z
                bend = (z / range2 - away) / (across2 + _TINY) if across > 1e-12 * z else 0.0
                a, b = away * x, away * y
                ax, ab, by = away + bend * x * x, bend * x * y, away + bend * y * y
                xx, xy, yy = 2.0 * p1 * b + 6.0 * p2 * a, 2.0 * p1 * a + 2.0 * p2 * b, 6.0 * p1 * b + 2.0 * p2 * a
                image[0, i] += phi * (2.0 * p1 * a * b + p2 * (3.0 * a * a + b * b))
                image[1, i] += phi * (p1 * (a * a + 3.0 * b * b) + 2.0 * p2 * a * b)
                image[2, i] += phi * (xx * ax + xy * ab)
                image[3, i] += phi * (xx * ab + xy * by)
                image[4, i] += phi * (xy * ab + yy * by)
                image[5, i] -= phi * (xx * x + xy * y) / range2
                image[6, i] -= phi * (xy * x + yy * y) / range2
                image[7, i] = phi * ((xy * ax + yy * ab) - (xx * ab + xy * by))
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
        if len(intrinsics) > 8:
            for i in range(n):
                a, b = work[2, i] * work[0, i], work[2, i] * work[1, i]
                jacobian[8, 0, i], jacobian[8, 1, i] = 2.0 * phi * a * b, aspect * phi * (a * a + 3.0 * b * b)
                jacobian[9, 0, i], jacobian[9, 1, i] = phi * (3.0 * a * a + b * b), 2.0 * aspect * phi * a * b
