"""Lenses that move the points of a plane: rays become points of it, and a smooth map takes these to where they are
measured, along the radius by a profile and across it by small displacements.

Also maps along a radius with value 0 and slope 1 at 0, polynomials and their ratios: their limit, and their inverse.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import ClassVar

import numpy as np

from ceres_cal.base import AnyArray, Array, Frozen, Indices, cached_property
from ceres_cal.kernels import NOTHING, Optics, inverse_of_growing, lens_images, lens_rays
from ceres_cal.scene.lens.base import Lens, LinearEquations, unit_rays

STEPS = 60  # limit as a safeguard: Newton needs 4 to 8


def horner(polynomial: Array, x: Array) -> Array:
    """sum c_k x^k, lowest power first; coefficients are numbers, or arrays like x."""
    total = np.full_like(x, polynomial[-1])
    for coefficient in polynomial[-2::-1]:
        total *= x
        total += coefficient
    return total


def derivative(polynomial: Array) -> Array:
    """Return the coefficients (..., T - 1) of a polynomial's derivative, lowest power first."""
    return np.asarray(polynomial[..., 1:] * np.arange(1, polynomial.shape[-1]))


def less(polynomial: AnyArray, other: AnyArray) -> Array:
    """Return the coefficients of the difference of two polynomials, lowest power first."""
    difference = np.zeros(max(len(polynomial), len(other)))
    difference[: len(polynomial)] = polynomial
    difference[: len(other)] -= other
    return difference


def first_root(polynomial: Array) -> float:
    """Return where a polynomial with value 1 at 0 (lowest power first) first reaches 0; else infinity."""
    return _first_root(tuple(polynomial.tolist()))


@lru_cache(maxsize=256)  # a camera that is moved keeps its lens
def _first_root(polynomial: tuple[float, ...]) -> float:
    if not all(map(math.isfinite, polynomial)):
        return np.nan
    if min(polynomial) >= 0.0:
        return np.inf
    # The roots of the reversed polynomial are 1 / x: its leading coefficient is 1, however small the last ones are.
    inverse = np.roots(polynomial)
    size = np.abs(inverse)
    real = (np.abs(inverse.imag) <= 1e-9 * size) & (inverse.real > 1e-15 * np.max(size, initial=0.0))
    return 1.0 / float(np.max(inverse.real[real])) if np.any(real) else np.inf


class Profile(Frozen):
    """A map along a radius: value 0 and slope 1 at 0, growing up to its limit.

    Attributes:
        pieces: (K, T) polynomials on successive intervals of this `width`, lowest power first, in units of it; the last
            one continues. below: (Q,) a polynomial by which they are divided; empty for none.
    """

    pieces: Array
    below: Array
    limit: float
    width: float = 1.0

    def value(self, x: Array) -> Array:
        """Return the map at x (N,)."""
        total = along_pieces(self.pieces, self.width, x)
        return np.asarray(total / horner(self.below, x)) if len(self.below) else total


def along_pieces(pieces: Array, width: float, x: Array) -> Array:
    """Return polynomials on successive intervals, see `Profile`, at x of any shape."""
    places = x / width
    number = np.clip(places, 0.0, len(pieces) - 1.0).astype(int)
    return horner(np.moveaxis(pieces[number], -1, 0), places - number)


def ratio(above: Array, below: Array = NOTHING, end: float = np.inf) -> Profile:
    """Return p(x) / q(x) of two polynomials, lowest power first, q(0) = 1, or p alone; its limit is where it stops
    growing or q reaches 0, at most the end.
    """
    short = 1e-9  # share of a pole's distance: the map is finite before the pole
    if not len(below):
        return Profile(above[None], below, min(end, first_root(derivative(above))))
    rising = less(np.convolve(derivative(above), below), np.convolve(above, derivative(below)))  # its slope times q^2
    return Profile(above[None], below, min(end, first_root(rising), (1.0 - short) * first_root(below)))


def invert_increasing(profile: Profile, target: Array) -> Array:
    """Return x up to the limit with profile(x) = target (N,); NaN where there is none."""
    places = np.empty(len(target))
    inverse_of_growing(profile.pieces, profile.width, profile.below, profile.limit, target, places)
    return places


def along_radius(profile: Profile, target: Array, *, is_round: bool) -> Array:
    """Return points (N, 2) whose image along the radius is `target`, NaN where there is none. For a map that is not
    round they are starts of Newton's method, by its profile in the direction in which that ends first.
    """
    radius, end = np.hypot(target[:, 0], target[:, 1]), profile.limit
    # Other directions may reach farther than the profile's: for targets beyond its rim, start just inside.
    rim = float(profile.value(np.array(end))) if np.isfinite(end) else end
    start = invert_increasing(profile, radius if is_round else np.minimum(radius, rim * (1.0 - 1e-6)))
    return np.asarray(target * np.where(radius > 0.0, start / radius, 1.0)[:, None])


def inverted(profile: Profile, target: Array, mapped: Callable[[Array], Array] | None) -> Array:
    """Return points (N, 2) whose image is `target`, by Newton's method; NaN where it does not converge.

    Args:
        mapped: returns the map of points (N, 2) and its derivatives by their x and y, (2, 3, N); None for a map along
            the radius.
    """
    flat, limit = along_radius(profile, target, is_round=mapped is None), profile.limit
    if mapped is None:
        return flat
    longest = 0.1  # longest step of Newton's method, as a share of the limit
    exact, rounding = 1e-12, 1e-15  # sufficient error, and error of rounding
    rows, error = np.arange(len(flat)), np.full(len(flat), np.inf)
    size = 1.0 + np.maximum(np.abs(target[:, 0]), np.abs(target[:, 1]))
    for _ in range(STEPS):
        (x, xx, xy), (y, yx, yy) = mapped(flat[rows])
        x, y = x - target[rows, 0], y - target[rows, 1]
        error[rows] = np.maximum(np.abs(x), np.abs(y)) / size[rows]
        step = np.column_stack([yy * x - xy * y, xx * y - yx * x]) / (xx * yy - xy * yx)[:, None]
        # Near the limit the map hardly grows, and whole steps could lead past it.
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
    """A lens by its map of a plane, in a unit of its own. The map is compiled, with its derivatives (`kernels/core`);
    its limit and its inverse are here.
    """

    formulas: ClassVar[str]
    """The kind whose compiled map it uses."""

    def _unit(self, phi: float) -> float:
        """Return the size of the plane's unit in pixels."""
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
        """(3, 2, N) derivatives of `_lifted` by the points' x and y, or (3, 2, 1) where they are the same for all."""

    @property
    @abstractmethod
    def _is_round(self) -> bool:
        """Whether the map is only along the radius."""

    @property
    @abstractmethod
    def _profile(self) -> Profile:
        """The map along the radius, from which its inverse starts."""

    @cached_property
    def _limit(self) -> float:
        """The radius up to which the symmetric part of the map's derivative is positive definite in every direction, so
        that no two points have the same image: where the profile stops growing, if it is that of the worst direction.
        """
        return self._profile.limit

    @cached_property
    def _rim(self) -> float:
        """Measured radius of the map's end, in the direction in which it is nearest."""
        return float(self._profile.value(np.array(self._limit))) if np.isfinite(self._limit) else self._limit

    def _within(self, flat: Array) -> Array:
        """Return points (N, 2), NaN past the limit."""
        return np.where(np.hypot(flat[:, :1], flat[:, 1:]) <= self._limit, flat, np.nan)

    def _optics(self, phi: float) -> Optics:
        """Return the optics on square pixels about the principal point."""
        return Optics(self, self.formulas, self.form, np.array([phi, 1.0, 0.0, 0.0, *self.values, 0.0]), 1.0)

    def _images(self, rays: Array, phi: float) -> Array:
        """(2, 4, N) where rays (N, 3) are measured, px, and the derivatives by the ray's x, y and z; also past the
        limit, where the map has folded.
        """
        images = np.empty((2, 4, len(rays)))
        lens_images(self._optics(phi), rays, images)
        return images

    def _distort(self, rays: Array, phi: float) -> Array:
        inside = self._within(self._flat(rays) * (phi / self._unit(phi)))
        return np.where(np.isnan(inside), np.nan, self._images(rays, phi)[:, 0].T)

    def _undistort(self, offsets: Array, phi: float) -> Array:
        longest = 0.05  # longest step of Newton's method, rad, or share of a limit below 1
        unit = self._unit(phi)
        flat = along_radius(self._profile, offsets / unit, is_round=self._is_round)
        rays = self._lifted(flat * (unit / phi))
        if not self._is_round:
            rays = unit_rays(rays[:, :2], rays[:, 2])
            lens_rays(self._optics(phi), offsets, longest * min(1.0, self._limit), rays)
            flat = self._flat(rays) * (phi / unit)
        return unit_rays(np.where(np.isfinite(self._within(flat)), rays[:, :2], np.nan), rays[:, 2])

    def unlimited(self, rays: Array) -> Array:
        """Return where rays (N, 3) are measured, (N, 2) at focal length 1, also past the limit, where it has folded."""
        return np.where(np.isnan(self._flat(rays)), np.nan, self._images(rays, 1.0)[:, 0].T)

    def mapped(self, flat: Array) -> Array:
        """(2, 3, N) where points (N, 2) are measured, and the derivatives by their x and y."""
        unit = self._unit(1.0)
        images = self._images(self._lifted(flat), unit) / unit
        return np.concatenate([images[:, :1], np.sum(images[:, 1:, None] * self._slopes(flat), axis=1)], axis=1)

    def monotone_radius(self, phi: float) -> float:
        return self._unit(phi) * self._rim


_ACROSS = {"p1": 2, "p2": 2, "s1": 2, "s2": 4, "s3": 2, "s4": 4}
"""Coefficients of Brown's decentring and of OpenCV's thin prism, with their orders."""


class DecentredLens(Planar):
    """A ratio of polynomials along the radius, with Brown's decentring (p1, p2) and OpenCV's thin prism (s1 to s4)
    across.

    Coefficients that a lens does not have count as 0.
    """

    above: ClassVar[tuple[str, ...]]
    below: ClassVar[tuple[str, ...]] = ()
    always: ClassVar[tuple[str, ...]]
    """Names of the coefficients that it has without further terms."""
    _end: ClassVar[float] = np.inf

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.always, *self.names_of_terms)

    @property
    def orders(self) -> tuple[int, ...]:
        along = {name: 2 * k + 3 for part in (self.above, self.below) for k, name in enumerate(part)}
        return tuple(map((_ACROSS | along).__getitem__, self.names))

    def _named(self, names: Iterable[str]) -> list[float]:
        known = self.coefficients
        return [known.get(name, 0.0) for name in names]

    @cached_property
    def _across(self) -> list[float]:
        """The values of p1 p2 s1 s2 s3 s4."""
        return self._named(_ACROSS)

    @property
    def _is_round(self) -> bool:
        return not any(self._across)

    @cached_property
    def _profile(self) -> Profile:
        # In the worst direction decentring reduces the radius by 3 |p| r^2, and a thin prism by |s| r^2 and |s'| r^4.
        p1, p2, s1, s2, s3, s4 = self._across
        above = dense_polynomial(self._named(self.above), range(3, 2 * len(self.above) + 2, 2))
        worst = np.array([0.0, 0.0, 3.0 * math.hypot(p1, p2) + math.hypot(s1, s3), 0.0, math.hypot(s2, s4)])
        if not any(under := self._named(self.below)):
            return ratio(less(above, worst), end=self._end)
        below = np.array([1.0, *(part for one in under for part in (0.0, one))])
        return ratio(less(above, np.convolve(worst, below)), below, self._end)

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        reach = ideal / phi if self.acts_on_tangents else angle
        return {name: reach ** (2 * k + 3) for k, name in enumerate(self.above)}, measured / phi - reach

    def radial_change(self, offsets: Array, phi: float, unit_px: float, powers: Indices) -> Array:
        x, y, z = np.nan_to_num(self.undistort(offsets, phi)).T[:, :, None]
        across = np.hypot(x, y)
        reach = across / np.maximum(z, 0.05) if self.acts_on_tangents else np.arctan2(across, z)
        return np.asarray(phi * reach**powers)

    @property
    def form(self) -> Array:
        """The positions among the intrinsics of the first coefficient of each further term, 0 if absent."""
        names, firsts = self.names, [own[0] for own in self.more_terms.values()]
        return np.array([4.0 + names.index(first) if first in names else 0.0 for first in firsts])
