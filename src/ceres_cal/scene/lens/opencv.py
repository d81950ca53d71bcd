"""OpenCV's lenses: Brown's with its extensions, and Kannala and Brandt's, for fisheyes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.scene.lens.base import ahead
from ceres_cal.scene.lens.planar import DecentredLens


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
    always: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3")

    @staticmethod
    def _flat(rays: Array) -> Array:
        return np.asarray(rays[:, :2] / ahead(rays))

    @staticmethod
    def _lifted(flat: Array) -> Array:
        return np.column_stack([flat, np.ones(len(flat))])

    @staticmethod
    def _slopes(flat: Array) -> Array:
        return np.eye(3, 2)[:, :, None]


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
    always: ClassVar[tuple[str, ...]] = above
    _end: ClassVar[float] = np.pi

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
