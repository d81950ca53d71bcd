"""Lenses that move the points of a plane: rays become points of it, and a smooth map takes these to where they are
measured, along the radius by a profile and across it by little.

Maps along a radius with value 0 and slope 1 at 0, polynomials and their ratios: their end, and their inverse.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.polynomial.polynomial import polyval

from ceres_cal.base import AnyArray, Array, Frozen, cached_property
from ceres_cal.kernels import NOTHING, Optics, inverse_of_growing, lens_images, lens_rays
from ceres_cal.scene.lens.base import Lens, unit_rays

STEPS = 60  # a safeguard: Newton needs 4 to 8


def horner(polynomial: Array, x: Array) -> Array:
    """sum c_k x^k, lowest power first."""
    total = np.full_like(x, polynomial[-1])
    for coefficient in polynomial[-2::-1]:
        total *= x
        if coefficient != 0.0:  # every other one is, in most lenses
            total += coefficient
    return total


def derivative(polynomial: Array) -> Array:
    """Its derivative's coefficients, lowest power first."""
    return np.asarray(polynomial[1:] * np.arange(1, len(polynomial)))


def less(polynomial: AnyArray, other: AnyArray) -> Array:
    """Their difference's coefficients, lowest power first."""
    difference = np.zeros(max(len(polynomial), len(other)))
    difference[: len(polynomial)] = polynomial
    difference[: len(other)] -= other
    return difference


def first_root(polynomial: Array) -> float:
    """Where a polynomial with value 1 at 0 (lowest power first) first reaches 0; infinity where it never does."""
    return _first_root(tuple(polynomial.tolist()))


@lru_cache(maxsize=256)  # a camera that is moved and asked anew has the lens that it had
def _first_root(polynomial: tuple[float, ...]) -> float:
    if not all(map(math.isfinite, polynomial)):
        return np.nan
    if min(polynomial) >= 0.0:
        return np.inf
    # The roots of the reversed polynomial are 1 / x: its leading coefficient is 1, however small the last ones are.
    companion = np.eye(len(polynomial) - 1, k=-1)
    companion[0] = np.negative(polynomial[1:])
    inverse = np.linalg.eigvals(companion)
    size = np.abs(inverse)
    real = (np.abs(inverse.imag) <= 1e-9 * size) & (inverse.real > 1e-15 * np.max(size, initial=0.0))
    return 1.0 / float(np.max(inverse.real[real])) if np.any(real) else np.inf


class Profile(Frozen):
    """A map along a radius: value 0 and slope 1 at 0, growing up to its limit.

    Attributes:
        pieces: (K, T) polynomials, lowest power first, side by side, each by the share of its own `width`; the last one
            goes on. below: (Q,) a polynomial that they are divided by; empty for none.
    """

    pieces: Array
    below: Array
    limit: float
    width: float = 1.0

    def value(self, x: Array) -> Array:
        """At x (N,)."""
        total = along_pieces(self.pieces, self.width, x)
        return np.asarray(total / horner(self.below, x)) if len(self.below) else total


def along_pieces(pieces: Array, width: float, x: Array) -> Array:
    """Polynomials side by side, see `Profile`, at x of any shape."""
    places = x / width
    number = np.clip(places, 0.0, len(pieces) - 1.0).astype(int)
    return np.asarray(polyval(places - number, np.moveaxis(pieces[number], -1, 0), tensor=False))


def ratio(above: Array, below: Array = NOTHING, end: float = np.inf) -> Profile:
    """p(x) / q(x) of two polynomials, lowest power first, q(0) = 1, or p alone: up to where it stops growing or q
    reaches 0, or else to its end.
    """
    short = 1e-9  # of a pole: the map is finite before it
    if not len(below):
        return Profile(above[None], below, min(end, first_root(derivative(above))))
    rising = less(np.convolve(derivative(above), below), np.convolve(above, derivative(below)))  # its slope times q^2
    return Profile(above[None], below, min(end, first_root(rising), (1.0 - short) * first_root(below)))


def invert_increasing(profile: Profile, target: Array) -> Array:
    """x up to the limit with profile(x) = target (N,); NaN where none is."""
    places = np.empty(len(target))
    inverse_of_growing(profile.pieces, profile.width, profile.below, profile.limit, target, places)
    return places


def along_radius(profile: Profile, target: Array, *, is_round: bool) -> Array:
    """Points (N, 2) whose image along the radius is `target`, NaN where none is; of a map that is not round, where
    Newton's method may start, by its profile in the direction in which that ends first.
    """
    radius, end = np.hypot(target[:, 0], target[:, 1]), profile.limit
    # Other directions may reach farther than that of the profile: from beyond its rim, start just inside.
    rim = float(profile.value(np.array(end))) if np.isfinite(end) else end
    start = invert_increasing(profile, radius if is_round else np.minimum(radius, rim * (1.0 - 1e-6)))
    return np.asarray(target * np.where(radius > 0.0, start / radius, 1.0)[:, None])


def inverted(profile: Profile, target: Array, mapped: Callable[[Array], Array] | None) -> Array:
    """Points (N, 2) whose image is `target`, by Newton's method; NaN where it does not get there.

    Args:
        mapped: the map of points (N, 2) and its derivatives by their x and y, (2, 3, N); None of one along the radius.
    """
    flat, limit = along_radius(profile, target, is_round=mapped is None), profile.limit
    if mapped is None:
        return flat
    longest = 0.1  # step of Newton's method, of the limit
    exact, rounding = 1e-12, 1e-15  # errors that will do, and that nothing makes smaller
    rows, error = np.arange(len(flat)), np.full(len(flat), np.inf)
    size = 1.0 + np.maximum(np.abs(target[:, 0]), np.abs(target[:, 1]))
    for _ in range(STEPS):
        (x, xx, xy), (y, yx, yy) = mapped(flat[rows])
        x, y = x - target[rows, 0], y - target[rows, 1]
        error[rows] = np.maximum(np.abs(x), np.abs(y)) / size[rows]
        step = np.column_stack([yy * x - xy * y, xx * y - yx * x]) / (xx * yy - xy * yx)[:, None]
        # At the limit the map hardly grows, and a whole step would end behind others that lead past it.
        length = np.hypot(step[:, 0], step[:, 1])
        step *= np.minimum(1.0, longest * limit / np.maximum(length, 1e-300))[:, None]
        flat[rows] -= step
        rows = rows[(error[rows] > rounding) & ((length > 1e-13) | (error[rows] > exact))]
        if not len(rows):
            break
    return np.where((error <= exact)[:, None], flat, np.nan)


def dense_polynomial(values: Sequence[float], powers: Sequence[int]) -> Array:
    """x + sum values_k x^powers_k as a polynomial, lowest power first."""
    polynomial = np.zeros(max(powers) + 1)
    polynomial[1] = 1.0
    polynomial[list(powers)] = values
    return polynomial


class Planar(Lens):
    """A lens by its map of a plane, in units of its own. The map is compiled (`kernels/core`), with its derivatives:
    here are its limit, and its inverse.
    """

    formulas: ClassVar[str]
    """The kind whose compiled map it is."""

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
        """Points (N, 2) of the plane at focal length 1 -> rays (N, 3)."""

    @staticmethod
    @abstractmethod
    def _slopes(flat: Array) -> Array:
        """(3, 2, N) derivatives of `_lifted` by the points' x and y, or (3, 2, 1) of all."""

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

    def _optics(self, phi: float) -> Optics:
        """On square pixels about the principal point."""
        return Optics(self, self.formulas, self.form, np.array([phi, 1.0, 0.0, 0.0, *self.values, 0.0]), 1.0)

    def _images(self, rays: Array, phi: float) -> Array:
        """(2, 4, N) where rays (N, 3) are measured, px, and the derivatives of that by the ray's x, y and z; also past
        the limit, where the map has folded.
        """
        images = np.empty((2, 4, len(rays)))
        lens_images(self._optics(phi), rays, images)
        return images

    def _distort(self, rays: Array, phi: float) -> Array:
        inside = self._within(self._flat(rays) * (phi / self._unit(phi)))
        return np.where(np.isnan(inside), np.nan, self._images(rays, phi)[:, 0].T)

    def _undistort(self, offsets: Array, phi: float) -> Array:
        longest = 0.05  # rad, of a step of Newton's method, or of a limit below 1
        unit = self._unit(phi)
        flat = along_radius(self._profile, offsets / unit, is_round=self._is_round)
        rays = self._lifted(flat * (unit / phi))
        if not self._is_round:
            rays = unit_rays(rays[:, :2], rays[:, 2])
            lens_rays(self._optics(phi), offsets, longest * min(1.0, self._limit), rays)
            flat = self._flat(rays) * (phi / unit)
        return unit_rays(np.where(np.isfinite(self._within(flat)), rays[:, :2], np.nan), rays[:, 2])

    def unlimited(self, rays: Array) -> Array:
        """Where rays (N, 3) are measured, (N, 2) at focal length 1, also past the limit, where the map has folded."""
        return np.where(np.isnan(self._flat(rays)), np.nan, self._images(rays, 1.0)[:, 0].T)

    def mapped(self, flat: Array) -> Array:
        """(2, 3, N) where points (N, 2) are measured, and the derivatives of that by their x and y."""
        unit = self._unit(1.0)
        images = self._images(self._lifted(flat), unit) / unit
        return np.concatenate([images[:, :1], np.sum(images[:, 1:, None] * self._slopes(flat), axis=1)], axis=1)

    def monotone_radius(self, phi: float) -> float:
        return self._unit(phi) * self._rim


class DecentredLens(Planar):
    """A ratio of polynomials along the radius, Brown's decentring (p1, p2) and OpenCV's thin prism (s1 to s4) across.

    Coefficients that a lens does not have are 0.
    """

    above: ClassVar[tuple[str, ...]]
    below: ClassVar[tuple[str, ...]] = ()

    def _named(self, names: Sequence[str]) -> list[float]:
        known = self.coefficients
        return [known.get(name, 0.0) for name in names]

    @cached_property
    def _across(self) -> list[float]:
        """p1 p2 s1 s2 s3 s4."""
        return self._named(("p1", "p2", "s1", "s2", "s3", "s4"))

    @property
    def _is_round(self) -> bool:
        return not any(self._across)

    @cached_property
    def _profile(self) -> Profile:
        # In the worst direction decentring takes 3 |p| r^2 off the radius, and a thin prism |s| r^2 and |s'| r^4.
        p1, p2, s1, s2, s3, s4 = self._across
        above = dense_polynomial(self._named(self.above), range(3, 2 * len(self.above) + 2, 2))
        worst = np.array([0.0, 0.0, 3.0 * math.hypot(p1, p2) + math.hypot(s1, s3), 0.0, math.hypot(s2, s4)])
        if not any(under := self._named(self.below)):
            return ratio(less(above, worst), end=self._end)
        below = np.array([1.0, *(part for one in under for part in (0.0, one))])
        return ratio(less(above, np.convolve(worst, below)), below, self._end)

    _end: ClassVar[float] = np.inf
