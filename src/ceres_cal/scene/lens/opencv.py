"""OpenCV's lenses: Brown's with its extensions, and Kannala and Brandt's, for fisheyes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.scene.lens.base import LinearEquations, ahead
from ceres_cal.scene.lens.planar import DecentredLens

_ORDERS = {"k1": 3, "k2": 5, "p1": 2, "p2": 2, "k3": 7, "k4": 3, "k5": 5, "k6": 7, "s1": 2, "s2": 4, "s3": 2, "s4": 4}


@dataclass(frozen=True)
class Brown(DecentredLens):
    """Brown's model as in OpenCV: k1 k2 p1 p2 k3 act on the ideal point (x/z, y/z). Optional terms are k4 to k6 in the
    denominator (OpenCV's rational model) and s1 to s4 (its thin prism).
    """

    values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    terms: tuple[str, ...] = ()
    kind: ClassVar[str] = "brown"
    also_called: ClassVar[tuple[str, ...]] = (
        *("brown-conrady", "conrady", "opencv", "full-opencv", "pinhole", "plumb-bob", "radtan", "rational-polynomial"),
    )
    formulas: ClassVar[str] = "brown"
    acts_on_tangents: ClassVar[bool] = True
    decentring: ClassVar[tuple[str, ...]] = ("p1", "p2")
    more_terms: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType(
        {"rational": ("k4", "k5", "k6"), "prism": ("s1", "s2", "s3", "s4")}
    )
    above: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3")
    below: ClassVar[tuple[str, ...]] = ("k4", "k5", "k6")

    @property
    def names(self) -> tuple[str, ...]:
        return ("k1", "k2", "p1", "p2", "k3", *self.names_of_terms)

    @property
    def orders(self) -> tuple[int, ...]:
        return tuple(map(_ORDERS.__getitem__, self.names))

    @staticmethod
    def _flat(rays: Array) -> Array:
        return np.asarray(rays[:, :2] / ahead(rays))

    @staticmethod
    def _lifted(flat: Array) -> Array:
        return np.column_stack([flat, np.ones(len(flat))])

    @staticmethod
    def _slopes(flat: Array) -> Array:
        return np.eye(3, 2)[:, :, None]

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        u = ideal / phi
        return {name: u**power for name, power in (("k1", 3), ("k2", 5), ("k3", 7))}, measured / phi - u

    def radial_change(self, offsets: Array, phi: float, unit_px: float, powers: Indices) -> Array:
        x, y, z = np.nan_to_num(self.undistort(offsets, phi)).T[:, :, None]
        return np.asarray(phi * (np.hypot(x, y) / np.maximum(z, 0.05)) ** powers)

    @property
    def form(self) -> Array:
        """The positions of k4 and s1 among the intrinsics, 0 if absent."""
        return np.array([4.0 + self.names.index(name) if name in self.names else 0.0 for name in ("k4", "s1")])


@dataclass(frozen=True)
class KannalaBrandt(DecentredLens):
    """Kannala and Brandt's model as in OpenCV's fisheye: k1..k4 act on the angle from the axis, up to 180 degrees.
    Optional p1 and p2 displace tangentially, as in COLMAP's THIN_PRISM_FISHEYE.
    """

    values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    terms: tuple[str, ...] = ()
    kind: ClassVar[str] = "kannala-brandt"
    also_called: ClassVar[tuple[str, ...]] = ("fisheye", "opencv-fisheye", "thin-prism-fisheye", "equidistant", "equi")
    formulas: ClassVar[str] = "kannala-brandt"
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
        """Return points in the direction of the rays, at their angles as distances."""
        across = np.hypot(rays[:, 0], rays[:, 1])
        angle = np.arctan2(across, rays[:, 2])
        stretch = np.where((across == 0.0) & (rays[:, 2] > 0.0), 1.0 / rays[:, 2], angle / across)
        return np.asarray(rays[:, :2] * stretch[:, None])

    @staticmethod
    def _lifted(flat: Array) -> Array:
        angle = np.hypot(flat[:, 0], flat[:, 1])
        across = np.where(angle > 0.0, np.sin(angle) / angle, 1.0)
        return np.column_stack([flat * across[:, None], np.cos(angle)])

    @staticmethod
    def _slopes(flat: Array) -> Array:
        x, y = flat.T
        angle = np.maximum(np.hypot(x, y), 1e-9)
        across = np.sin(angle) / angle
        bend = (np.cos(angle) - across) / angle**2
        both = bend * x * y
        return np.array([[across + bend * x * x, both], [both, across + bend * y * y], [-across * x, -across * y]])

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        columns = {name: angle**power for name, power in zip(self.above, self.orders, strict=False)}
        return columns, measured / phi - angle

    def radial_change(self, offsets: Array, phi: float, unit_px: float, powers: Indices) -> Array:
        x, y, z = np.nan_to_num(self.undistort(offsets, phi)).T[:, :, None]
        return np.asarray(phi * np.arctan2(np.hypot(x, y), z) ** powers)

    @property
    def form(self) -> Array:
        """The position of p1 among the intrinsics, 0 if absent."""
        return np.array([8.0 if self.terms else 0.0])
