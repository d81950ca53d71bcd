"""The lens models: between the direction a ray comes from and the place where it is measured.

Everything here is about one camera's optics and knows neither pose nor principal point. Rays are (N, 3) directions in
the camera frame (x right, y down, z forward; any length), offsets are (N, 2) measured pixels from the principal point
on a sensor with square pixels, and phi is the focal length in pixels. Where a model has no answer (behind the camera,
past its monotone radius) the array functions return NaN.

These are the models as one reads them; `kernels` has the same formulas with their derivatives, for the solve.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError

_STEPS = 60  # a safeguard: Newton needs 4 to 8, bisection 53
_BLOCK = 16384  # rows at a time, so that what is worked on stays in the cache


def _horner(polynomial: Array, x: Array) -> Array:
    """sum c_k x^k, lowest power first."""
    total = np.full_like(x, polynomial[-1])
    for coefficient in polynomial[-2::-1]:
        total *= x
        if coefficient != 0.0:  # every other one is, in most lenses
            total += coefficient
    return total


def _slope(polynomial: Array) -> Array:
    return np.asarray(polynomial[1:] * np.arange(1, len(polynomial)))


def _monotone_limit(polynomial: Array) -> float:
    """Where a polynomial with slope 1 at 0 (lowest power first) stops growing; infinity where it never does."""
    slope = _slope(polynomial)
    if not np.all(np.isfinite(slope)):
        return np.nan
    # The roots of the reversed polynomial are 1 / x: its leading coefficient is 1, however small the last ones are.
    inverse = np.roots(slope)
    size = np.abs(inverse)
    real = (np.abs(inverse.imag) <= 1e-9 * size) & (inverse.real > 1e-15 * np.max(size, initial=0.0))
    return 1.0 / float(np.max(inverse.real[real])) if np.any(real) else np.inf


def _reach(polynomial: Array, target: Array, limit: float) -> Array:
    """An x (N,) where the polynomial is not below its target: the limit or, without one, found by doubling."""
    if np.isfinite(limit):
        return np.full_like(target, limit)
    high = target.copy()
    for _ in range(_STEPS):
        short = _horner(polynomial, high) < target
        if not np.any(short):
            break
        high[short] *= 2.0
    return high


def _invert_increasing(polynomial: Array, target: Array, limit: float) -> Array:
    """x in [0, limit] with polynomial(x) = target (N,), by Newton safeguarded with bisection; NaN where there is none.

    The polynomial must increase on [0, limit], with value 0 and slope 1 at 0.
    """
    slope = _slope(polynomial)
    high = _reach(polynomial, target, limit)
    answer = np.full_like(target, np.nan)
    rows = np.flatnonzero((target >= 0.0) & np.isfinite(target) & (target <= _horner(polynomial, high)))
    target, high = target[rows], high[rows]
    low, x, last = np.zeros_like(high), np.minimum(target, high), np.full_like(high, np.inf)
    for _ in range(_STEPS):
        error = _horner(polynomial, x) - target
        low, high = np.where(error < 0.0, x, low), np.where(error > 0.0, x, high)
        move = -error / _horner(slope, x)
        # A step that does not halve the last one may run in a circle.
        good = (x + move >= low) & (x + move <= high) & (np.abs(move) <= 0.5 * last)
        move = np.where(good, move, 0.5 * (low + high) - x)
        move = np.where(np.abs(error) > 1e-15 * target, move, 0.0)
        last, x = np.abs(move), x + move
        moving = last > 1e-13 * x
        answer[rows[~moving]] = x[~moving]
        if not np.any(moving):
            break
        rows = rows[moving]
        target, low, high, x, last = (column[moving] for column in (target, low, high, x, last))
    return answer


def _in_blocks(function: Callable[[Array, float], Array], rows: ArrayLike, phi: float, columns: int) -> Array:
    """A lens's map over rows of any number; NaN in the whole row where the answer is not finite."""
    rows = np.asarray(rows, dtype=float)
    answer = np.empty((len(rows), columns))
    with np.errstate(all="ignore"):  # what overflows or divides by zero on the way ends as NaN
        for start in range(0, len(rows), _BLOCK):
            block = function(rows[start : start + _BLOCK], phi)
            block[~np.isfinite(np.sum(block, axis=1))] = np.nan
            answer[start : start + _BLOCK] = block
    return answer


def _dense(values: Sequence[float], powers: Sequence[int]) -> Array:
    """x + sum values_k x^powers_k as a polynomial, lowest power first."""
    polynomial = np.zeros(max(powers) + 1)
    polynomial[1] = 1.0
    polynomial[list(powers)] = values
    return polynomial


def _ahead(rays: Array) -> Array:
    """Depths (N, 1) of the rays, NaN behind the camera."""
    return np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)


def _unit_rays(across: Array, depth: Array | float) -> Array:
    """(N, 3) directions of unit length from their x and y (N, 2) and their z."""
    rays = np.column_stack([across, np.broadcast_to(depth, len(across))])
    return np.asarray(rays / np.hypot(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])[:, None])


@dataclass(frozen=True)
class Lens(ABC):
    """A lens model with its coefficients.

    Attributes:
        values: the coefficients, in the order of `names` and in the units of the files and reports.
    """

    values: tuple[float, ...]
    kind: ClassVar[str]

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(float(v) for v in self.values))
        if len(self.values) != len(self.names):
            raise InputError(
                f"lens {self.kind!r} has coefficients {', '.join(self.names)}: give {len(self.names)} numbers, "
                f"not {len(self.values)}"
            )

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the coefficients."""

    @property
    @abstractmethod
    def radius_powers(self) -> tuple[int, ...]:
        """Powers, above 1, of the polynomial along a radius (an angle with `kannala-brandt`)."""

    @property
    def coefficients(self) -> dict[str, float]:
        """The coefficients by name, in the units of the files: for `radial` the paper's pixels."""
        return dict(zip(self.names, self.values, strict=True))

    def with_values(self, values: ArrayLike) -> Lens:
        """The same model with other coefficients."""
        return replace(self, values=tuple(float(v) for v in np.asarray(values, dtype=float)))

    @property
    @abstractmethod
    def _polynomial(self) -> Array:
        """The model's map along a radius, lowest power first: x + sum c_k x^k."""

    @cached_property
    def _limit(self) -> float:
        """Where that map stops growing; infinity where it never does."""
        return _monotone_limit(self._polynomial)

    @cached_property
    def _rim(self) -> float:
        """The map's value at its limit."""
        return float(_horner(self._polynomial, np.array(self._limit))) if np.isfinite(self._limit) else self._limit

    def distort(self, rays: ArrayLike, phi: float) -> Array:
        """Rays (N, 3) -> measured offsets (N, 2) px; NaN where the model has no answer."""
        return _in_blocks(self._distort, rays, phi, 2)

    def undistort(self, offsets: ArrayLike, phi: float) -> Array:
        """Measured offsets (N, 2) px -> rays (N, 3) of unit length; NaN where the model has no answer."""
        return _in_blocks(self._undistort, offsets, phi, 3)

    @abstractmethod
    def _distort(self, rays: Array, phi: float) -> Array: ...

    @abstractmethod
    def _undistort(self, offsets: Array, phi: float) -> Array: ...

    @abstractmethod
    def monotone_radius(self, phi: float) -> float:
        """Measured radius (px) up to which the model is monotone and so has one answer; infinity where it always has.

        For `brown` it is that of the direction in which the decentring terms make it least.
        """

    def scales(self, unit_px: float) -> Array:
        """What to multiply each coefficient with so that it is of order one, for the solver (design, section 4)."""
        return np.ones(len(self.names))


@dataclass(frozen=True)
class Radial(Lens):
    """The paper's lens: r' = r + sum a_k r^k from the measured radius r to the ideal one r', both in pixels.

    Section 2 of the paper, with a1 = 1: scaling a1, a2, a3 and phi together changes nothing, so phi is the focal length
    at the centre. `powers` (2, 3) is the paper's own choice, (3,) is ssl-vision's model with a3 = distortion / phi^2.
    The coefficient of power k is named a<k> and has the unit px^(1-k).
    """

    powers: tuple[int, ...] = (2, 3)
    kind: ClassVar[str] = "radial"

    def __post_init__(self) -> None:
        powers = tuple(int(p) for p in self.powers)
        if not powers or min(powers) < 2 or len(set(powers)) != len(powers) or powers != tuple(self.powers):
            raise InputError(f"powers of the radial lens must be different whole numbers from 2 on, not {self.powers}")
        object.__setattr__(self, "powers", powers)
        super().__post_init__()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"a{p}" for p in self.powers)

    @property
    def radius_powers(self) -> tuple[int, ...]:
        return self.powers

    @classmethod
    def from_paper(cls, a1: float, a2: float, a3: float, phi: float) -> tuple[Radial, float]:
        """The paper's triple with its own a1 and its phi, as (lens, phi) in the gauge a1 = 1.

        Raises:
            InputError: a1 is not positive.
        """
        if not a1 > 0.0:
            raise InputError(f"a1 of the paper's polynomial must be positive, not {a1}")
        return cls((a2 / a1, a3 / a1)), phi / a1

    def paper_coefficients(self, a1: float) -> tuple[float, ...]:
        """(a1, a2, a3, ...) in the paper's scaling; it goes with phi * a1."""
        return (a1, *(a1 * v for v in self.values))

    @property
    def _polynomial(self) -> Array:
        return _dense(self.values, self.radius_powers)

    def ideal_radius(self, measured_radius: ArrayLike) -> Array:
        """r' of r, both in px (paper, section 2); no check of the monotone radius."""
        return _horner(self._polynomial, np.asarray(measured_radius, dtype=float))

    def measured_radius(self, ideal_radius: ArrayLike) -> Array:
        """r of r', both in px: the inverse of `ideal_radius` up to the monotone radius, NaN beyond."""
        ideal = np.asarray(ideal_radius, dtype=float)
        with np.errstate(all="ignore"):
            return _invert_increasing(self._polynomial, ideal.ravel(), self._limit).reshape(ideal.shape)

    def _distort(self, rays: Array, phi: float) -> Array:
        ideal = phi * rays[:, :2] / _ahead(rays)
        radius = np.hypot(ideal[:, 0], ideal[:, 1])
        shrink = np.where(radius > 0.0, self.measured_radius(radius) / radius, 1.0)
        return np.asarray(ideal * shrink[:, None])

    def _undistort(self, offsets: Array, phi: float) -> Array:
        radius = np.hypot(offsets[:, 0], offsets[:, 1])
        stretch = np.where(radius <= self._limit, _horner(self._polynomial[1:], radius), np.nan)
        return _unit_rays(offsets * stretch[:, None], phi)

    def monotone_radius(self, phi: float) -> float:
        return self._limit

    def scales(self, unit_px: float) -> Array:
        return np.asarray(float(unit_px) ** (np.asarray(self.powers) - 1.0))


@dataclass(frozen=True)
class Brown(Lens):
    """Brown's model as in OpenCV: k1 k2 p1 p2 k3 act on the ideal point (x/z, y/z)."""

    values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    kind: ClassVar[str] = "brown"

    @property
    def names(self) -> tuple[str, ...]:
        return ("k1", "k2", "p1", "p2", "k3")

    @property
    def radius_powers(self) -> tuple[int, ...]:
        return 3, 5, 7

    @property
    def _polynomial(self) -> Array:
        # In the worst direction the decentring terms take 3 |p| r^2 off the radius. While what is left grows, the
        # derivative of the whole map, which is symmetric, is positive definite in every direction: no two answers.
        k1, k2, p1, p2, k3 = self.values
        return _dense((-3.0 * np.hypot(p1, p2), k1, k2, k3), (2, *self.radius_powers))

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
        return np.asarray(phi * self._map(self._within(rays[:, :2] / _ahead(rays))))

    def _undistort(self, offsets: Array, phi: float) -> Array:
        measured = offsets / phi
        radius = np.hypot(measured[:, 0], measured[:, 1])
        # Other directions reach farther than the worst: from beyond its rim, start just inside.
        start = _invert_increasing(self._polynomial, np.minimum(radius, self._rim * (1.0 - 1e-6)), self._limit)
        ideal = self._newton(measured * np.where(radius > 0.0, start / radius, 1.0)[:, None], measured)
        return _unit_rays(self._within(ideal), 1.0)

    def _newton(self, start: Array, measured: Array) -> Array:
        """Ideal points (N, 2) whose image is `measured`; NaN where Newton's method does not get there."""
        ideal, rows = start.copy(), np.arange(len(start))
        for _ in range(_STEPS):
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


@dataclass(frozen=True)
class KannalaBrandt(Lens):
    """Kannala and Brandt's model as in OpenCV's fisheye: k1..k4 act on the angle from the axis, up to 180 degrees."""

    values: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    kind: ClassVar[str] = "kannala-brandt"

    @property
    def names(self) -> tuple[str, ...]:
        return ("k1", "k2", "k3", "k4")

    @property
    def radius_powers(self) -> tuple[int, ...]:
        return 3, 5, 7, 9

    @property
    def _polynomial(self) -> Array:
        return _dense(self.values, self.radius_powers)

    @cached_property
    def _limit(self) -> float:
        return min(np.pi, _monotone_limit(self._polynomial))

    def _distort(self, rays: Array, phi: float) -> Array:
        across = np.hypot(rays[:, 0], rays[:, 1])
        angle = np.arctan2(across, rays[:, 2])
        measured = np.where(angle <= self._limit, _horner(self._polynomial, angle), np.nan)
        stretch = np.where((across == 0.0) & (rays[:, 2] > 0.0), 1.0 / rays[:, 2], measured / across)
        return np.asarray(phi * rays[:, :2] * stretch[:, None])

    def _undistort(self, offsets: Array, phi: float) -> Array:
        measured = offsets / phi
        radius = np.hypot(measured[:, 0], measured[:, 1])
        angle = _invert_increasing(self._polynomial, radius, self._limit)
        across = np.where(radius > 0.0, np.sin(angle) / radius, 1.0)
        return np.column_stack([measured * across[:, None], np.cos(angle)])

    def monotone_radius(self, phi: float) -> float:
        return phi * self._rim


LENS_KINDS = ("radial", "brown", "kannala-brandt")


def make_lens(kind: str, powers: Sequence[int] = (2, 3), coefficients: Mapping[str, float] | None = None) -> Lens:
    """A lens by the name of its model; coefficients that are not named are 0.

    Raises:
        InputError: unknown kind, unknown coefficient name, or powers that make no lens.
    """
    given = dict(coefficients or {})
    blank: Lens
    if kind == "radial":
        blank = Radial((0.0,) * len(tuple(powers)), tuple(powers))
    elif kind == "brown":
        blank = Brown()
    elif kind == "kannala-brandt":
        blank = KannalaBrandt()
    else:
        raise InputError(f"unknown lens {kind!r}: choose one of {', '.join(LENS_KINDS)}")
    for name in given:
        if name not in blank.names:
            raise InputError(f"lens {kind!r} has no coefficient {name!r}: it has {', '.join(blank.names)}")
    return blank.with_values([given.get(name, 0.0) for name in blank.names])
