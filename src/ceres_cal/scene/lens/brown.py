"""Brown's lens, with what OpenCV has added to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.scene.lens.base import LinearEquations, ahead, unit_rays
from ceres_cal.scene.lens.planar import Decentred
from ceres_cal.scene.lens.polynomials import growing_until

_FAR = 6.0  # ideal radii: nothing is observed farther out


@dataclass(frozen=True)
class Brown(Decentred):
    """Brown's model as in OpenCV: k1 k2 p1 p2 k3 act on the ideal point (x/z, y/z), and so do, where they are asked
    for, k4 to k6 under the line (its rational model) and s1 to s4 (its thin prism).
    """

    values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    terms: tuple[str, ...] = ()
    kind: ClassVar[str] = "brown"
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
        order = {"k1": 3, "k2": 5, "p1": 2, "p2": 2, "k3": 7, "k4": 3, "k5": 5, "k6": 7}
        return tuple(order.get(name, 2 if name in ("s1", "s3") else 4) for name in self.names)

    @staticmethod
    def _flat(rays: Array) -> Array:
        return np.asarray(rays[:, :2] / ahead(rays))

    @staticmethod
    def _lifted(flat: Array) -> Array:
        return unit_rays(flat, 1.0)

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        u = ideal / phi
        return {name: u**power for name, power in (("k1", 3), ("k2", 5), ("k3", 7))}, measured / phi - u

    def radial_change(self, offsets: Array, phi: float, unit_px: float, power: int) -> Array:
        rays = np.nan_to_num(self.undistort(offsets, phi))
        return np.asarray(phi * (np.linalg.norm(rays[:, :2], axis=1) / np.maximum(rays[:, 2], 0.05)) ** power)

    @property
    def state(self) -> Array:
        """The limit, the places of k4 and s1 among the intrinsics (0: none), k1 to k6, s1 to s4, and room for two
        polynomials u (d_0 + d_1 u + ...) of the ideal radius.
        """
        places = [4 + self.names.index(name) if name in self.names else 0 for name in ("k4", "s1")]
        return np.array([0.0, *places, *[0.0] * (10 + 13 + 7)])

    @staticmethod
    def prepare(intrinsics: Any, unit: float, state: Any) -> None:
        state[3], state[4], state[5] = intrinsics[4], intrinsics[5], intrinsics[8]
        rational, prism = int(state[1]), int(state[2])
        for k in range(3):
            state[6 + k] = intrinsics[rational + k] if rational > 0 else 0.0
        for k in range(4):
            state[9 + k] = intrinsics[prism + k] if prism > 0 else 0.0
        _fill_slopes(state[3:6], state[6:9], state[13:26], state[26:33])
        state[0] = min(growing_until(state[13:26], _FAR), growing_until(state[26:33], _FAR))

    @staticmethod
    def distort_chunk(n: int, intrinsics: Any, unit: float, state: Any, rays: Any, image: Any, work: Any) -> bool:
        limit = state[0]
        phi, p1, p2 = intrinsics[0], intrinsics[6], intrinsics[7]
        k1, k2, k3, k4, k5, k6 = state[3], state[4], state[5], state[6], state[7], state[8]
        s1, s2, s3, s4 = state[9], state[10], state[11], state[12]
        good = True
        for i in range(n):
            iz = 1.0 / rays[2, i]
            u, v = rays[0, i] * iz, rays[1, i] * iz
            r2 = u * u + v * v
            below = 1.0 / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
            radial = below * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
            bend = 2.0 * below * (
                k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3) - radial * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))
            )  # fmt: skip
            first, second = 2.0 * (s1 + 2.0 * r2 * s2), 2.0 * (s3 + 2.0 * r2 * s4)
            both = u * v * bend + 2.0 * p1 * u + 2.0 * p2 * v
            scale = phi * iz
            xx = scale * (radial + u * u * bend + 2.0 * p1 * v + 6.0 * p2 * u + first * u)
            xy, yx = scale * (both + first * v), scale * (both + second * u)
            yy = scale * (radial + v * v * bend + 6.0 * p1 * v + 2.0 * p2 * u + second * v)
            image[0, i] = phi * (u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u) + r2 * (s1 + r2 * s2))
            image[1, i] = phi * (v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v + r2 * (s3 + r2 * s4))
            image[2, i], image[3, i], image[4, i], image[7, i] = xx, xy, yy, yx - xy
            image[5, i], image[6, i] = -(xx * u + xy * v), -(yx * u + yy * v)
            work[0, i], work[1, i], work[2, i], work[3, i], work[4, i] = u, v, r2, below, radial
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
            a, b = work[3, i] * x, work[3, i] * y
            jacobian[4, 0, i], jacobian[4, 1, i] = a * r2, b * r2
            jacobian[5, 0, i], jacobian[5, 1, i] = a * r4, b * r4
            jacobian[6, 0, i], jacobian[6, 1, i] = 2.0 * x * v, aspect * phi * (r2 + 2.0 * v * v)
            jacobian[7, 0, i], jacobian[7, 1, i] = phi * (r2 + 2.0 * u * u), 2.0 * u * y
            jacobian[8, 0, i], jacobian[8, 1, i] = a * r2 * r4, b * r2 * r4
        rational, prism = int(state[1]), int(state[2])
        if rational > 0:
            for k in range(3):
                row = 8 if k == 2 else 4 + k  # k1, k2 and k3 have the same powers over the line
                for i in range(n):
                    jacobian[rational + k, 0, i] = -work[4, i] * jacobian[row, 0, i]
                    jacobian[rational + k, 1, i] = -work[4, i] * jacobian[row, 1, i]
        if prism > 0:
            for i in range(n):
                d, r2 = phi * work[2, i], work[2, i]
                jacobian[prism, 0, i], jacobian[prism, 1, i] = d, 0.0
                jacobian[prism + 1, 0, i], jacobian[prism + 1, 1, i] = d * r2, 0.0
                jacobian[prism + 2, 0, i], jacobian[prism + 2, 1, i] = 0.0, aspect * d
                jacobian[prism + 3, 0, i], jacobian[prism + 3, 1, i] = 0.0, aspect * d * r2


def _fill_slopes(above: Any, below: Any, rising: Any, under: Any) -> None:
    """Polynomials u (d_0 + d_1 u + ...) whose slopes are the radial slope times q^2, and q, with q what is under the
    line.
    """
    rising[:] = 0.0
    under[:] = 0.0
    for j in range(4):
        p, q = (above[j - 1] if j > 0 else 1.0), (below[j - 1] if j > 0 else 1.0)
        under[2 * j] = q / (2.0 * j + 1.0)
        for k in range(4):
            other = below[k - 1] if k > 0 else 1.0
            rising[2 * (j + k)] += p * other * (2.0 * j + 1.0 - 2.0 * k) / (2.0 * (j + k) + 1.0)
