"""Lenses that move the points of a plane: rays become points of it, and a smooth map takes these to where they are
measured, along the radius by a profile and across it by little.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.cached import cached_property
from ceres_cal.scene.lens.base import Lens
from ceres_cal.scene.lens.polynomials import STEPS, Profile, Ratio, invert_increasing

_LONGEST = 0.1  # step of Newton's method, of the limit


class Planar(Lens):
    """A lens by its map of a plane, in units of its own."""

    def _unit(self, phi: float) -> float:
        """How many pixels a unit of the plane is."""
        return phi

    @staticmethod
    @abstractmethod
    def _flat(rays: Array) -> Array:
        """Rays (N, 3) -> points (N, 2) of the plane at focal length 1; NaN where a ray has none."""

    @staticmethod
    @abstractmethod
    def _lifted(flat: Array) -> Array:
        """Points (N, 2) of the plane at focal length 1 -> rays (N, 3) of unit length."""

    @abstractmethod
    def _map(self, flat: Array) -> Array:
        """Where points (N, 2) are measured, (N, 2)."""

    @abstractmethod
    def _jacobian(self, flat: Array) -> tuple[Array, Array, Array, Array]:
        """Derivatives xx, xy, yx and yy of `_map`."""

    @property
    @abstractmethod
    def _is_round(self) -> bool:
        """Whether the map is along the radius alone."""

    @property
    @abstractmethod
    def _profile(self) -> Profile:
        """The map along the radius, from which its inverse starts."""

    @cached_property
    def _limit(self) -> float:
        """The radius up to which the symmetric part of the map's derivative is positive definite in every direction, so
        that no two points have one image: where the profile stops growing, if it is that of the worst direction.
        """
        return self._profile.limit

    @cached_property
    def _rim(self) -> float:
        """Where the map ends, in the direction in which that is nearest."""
        return float(self._profile.value(np.array(self._limit))) if np.isfinite(self._limit) else self._limit

    def _within(self, flat: Array) -> Array:
        """Points (N, 2), NaN past the limit."""
        return np.where(np.hypot(flat[:, :1], flat[:, 1:]) <= self._limit, flat, np.nan)

    def _distort(self, rays: Array, phi: float) -> Array:
        unit = self._unit(phi)
        return np.asarray(unit * self._map(self._within(self._flat(rays) * (phi / unit))))

    def _undistort(self, offsets: Array, phi: float) -> Array:
        unit = self._unit(phi)
        measured = offsets / unit
        radius = np.hypot(measured[:, 0], measured[:, 1])
        # Other directions may reach farther than that of the profile: from beyond its rim, start just inside.
        end = self._profile.limit
        rim = float(self._profile.value(np.array(end))) if np.isfinite(end) else end
        start = invert_increasing(self._profile, radius if self._is_round else np.minimum(radius, rim * (1.0 - 1e-6)))
        flat = measured * np.where(radius > 0.0, start / radius, 1.0)[:, None]
        if not self._is_round:
            flat = self._within(self._newton(flat, measured))
        return self._lifted(flat * (unit / phi))

    def _newton(self, start: Array, measured: Array) -> Array:
        """Points (N, 2) whose image is `measured`; NaN where Newton's method does not get there."""
        flat, rows = start.copy(), np.arange(len(start))
        for _ in range(STEPS):
            here = flat[rows]
            error = self._map(here) - measured[rows]
            xx, xy, yx, yy = self._jacobian(here)
            step = np.column_stack([yy * error[:, 0] - xy * error[:, 1], xx * error[:, 1] - yx * error[:, 0]])
            step /= (xx * yy - xy * yx)[:, None]
            # At the limit the map hardly grows, and a whole step would end behind others that lead past it.
            length = np.linalg.norm(step, axis=1)
            step *= np.minimum(1.0, _LONGEST * self._limit / np.maximum(length, 1e-300))[:, None]
            flat[rows] = here - step
            rows = rows[np.any(np.abs(step) > 1e-13, axis=1)]
            if not len(rows):
                break
        error = np.max(np.abs(self._map(flat) - measured), axis=1)
        solved = error <= 1e-12 * (1.0 + np.max(np.abs(measured), axis=1))
        return np.where(solved[:, None], flat, np.nan)

    def monotone_radius(self, phi: float) -> float:
        return self._unit(phi) * self._rim


class Decentred(Planar):
    """A ratio of polynomials along the radius, Brown's decentring (p1, p2) and OpenCV's thin prism (s1 to s4) across.

    Coefficients that a lens does not have are 0.
    """

    above: ClassVar[tuple[str, ...]]
    below: ClassVar[tuple[str, ...]] = ()

    def _named(self, names: Sequence[str]) -> Array:
        known = self.coefficients
        return np.array([known.get(name, 0.0) for name in names])

    @cached_property
    def _radial(self) -> Ratio:
        """Measured over ideal radius, of the squared ideal one."""
        above, below = np.append(1.0, self._named(self.above)), np.append(1.0, self._named(self.below))
        return Ratio(above, below if np.any(below[1:]) else None)

    @cached_property
    def _across(self) -> Array:
        """p1 p2 s1 s2 s3 s4."""
        return self._named(("p1", "p2", "s1", "s2", "s3", "s4"))

    @property
    def _is_round(self) -> bool:
        return not np.any(self._across)

    @cached_property
    def _profile(self) -> Ratio:
        # In the worst direction decentring takes 3 |p| r^2 off the radius, and a thin prism |s| r^2 and |s'| r^4.
        p1, p2, s1, s2, s3, s4 = self._across
        above = np.kron(self._radial.above, (0.0, 1.0))
        below: Array | None = None
        if self._radial.below is not None:
            below = np.asarray(np.kron(self._radial.below, (1.0, 0.0))[:-1], dtype=float)
        worst = np.array([0.0, 0.0, 3.0 * np.hypot(p1, p2) + np.hypot(s1, s3), 0.0, np.hypot(s2, s4)])
        less = worst if below is None else np.convolve(worst, below)
        return Ratio(np.polynomial.polynomial.polysub(above, less), below, self._end)

    _end: ClassVar[float] = np.inf

    def _map(self, flat: Array) -> Array:
        x, y = flat[:, 0], flat[:, 1]
        r2 = x * x + y * y
        radial = self._radial.value(r2)
        p1, p2, s1, s2, s3, s4 = self._across
        return np.column_stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) + r2 * (s1 + r2 * s2),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y + r2 * (s3 + r2 * s4),
            ]
        )

    def _jacobian(self, flat: Array) -> tuple[Array, Array, Array, Array]:
        x, y = flat[:, 0], flat[:, 1]
        r2 = x * x + y * y
        radial, slope = self._radial.value(r2), 2.0 * self._radial.slope(r2)
        p1, p2, s1, s2, s3, s4 = self._across
        first, second = 2.0 * (s1 + 2.0 * r2 * s2), 2.0 * (s3 + 2.0 * r2 * s4)
        both = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        xx = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + first * x
        yy = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x + second * y
        return xx, both + first * y, both + second * x, yy
