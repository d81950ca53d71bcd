"""Kannala and Brandt's lens, for fisheyes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.scene.lens.base import LinearEquations
from ceres_cal.scene.lens.planar import Decentred


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
    def form(self) -> Array:
        """The place of p1 among the intrinsics, 0 for none."""
        return np.array([8.0 if self.terms else 0.0])
