"""Maps along a radius with value 0 and slope 1 at 0, polynomials and their ratios: their end, and their inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.cached import cached_property

STEPS = 60  # a safeguard: Newton needs 4 to 8, bisection 53
_FAR_STEPS = 96
_SHORT = 1e-9  # of a pole: the map is finite before it


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


def first_root(polynomial: Array) -> float:
    """Where a polynomial with value 1 at 0 (lowest power first) first reaches 0; infinity where it never does."""
    return _first_root(tuple(polynomial.tolist()))


@lru_cache(maxsize=256)  # a camera that is moved and asked anew has the lens that it had
def _first_root(polynomial: tuple[float, ...]) -> float:
    if not np.all(np.isfinite(polynomial)):
        return np.nan
    # The roots of the reversed polynomial are 1 / x: its leading coefficient is 1, however small the last ones are.
    inverse = np.roots(polynomial)
    size = np.abs(inverse)
    real = (np.abs(inverse.imag) <= 1e-9 * size) & (inverse.real > 1e-15 * np.max(size, initial=0.0))
    return 1.0 / float(np.max(inverse.real[real])) if np.any(real) else np.inf


class Profile(Protocol):
    """A map along a radius: value 0 and slope 1 at 0, growing up to its limit."""

    @property
    def limit(self) -> float: ...
    def value(self, x: Array) -> Array: ...
    def slope(self, x: Array) -> Array: ...


@dataclass(frozen=True, eq=False)
class Ratio:
    """p(x) / q(x): a profile of two polynomials, lowest power first, q(0) = 1; without the second, p alone.

    Attributes:
        above, below: p and q. end: it is asked for up to there.
    """

    above: Array
    below: Array | None = None
    end: float = np.inf

    def value(self, x: Array) -> Array:
        """At x (N,)."""
        total = horner(self.above, x)
        return total if self.below is None else np.asarray(total / horner(self.below, x))

    def slope(self, x: Array) -> Array:
        """Its derivative at x (N,)."""
        total = horner(self._rising, x)
        return total if self.below is None else np.asarray(total / horner(self.below, x) ** 2)

    @cached_property
    def _rising(self) -> Array:
        """Its derivative times q^2."""
        if self.below is None:
            return derivative(self.above)
        return np.asarray(np.polynomial.polynomial.polysub(
            np.convolve(derivative(self.above), self.below), np.convolve(self.above, derivative(self.below))
        ))  # fmt: skip

    @cached_property
    def limit(self) -> float:
        """Where it stops growing or q reaches 0, or else its end."""
        limit = min(self.end, first_root(self._rising))
        return limit if self.below is None else min(limit, (1.0 - _SHORT) * first_root(self.below))


def _reach(profile: Profile, target: Array) -> Array:
    """An x (N,) where the profile is not below its target: its limit or, without one, found by doubling."""
    if np.isfinite(profile.limit):
        return np.full_like(target, profile.limit)
    high = target.copy()
    for _ in range(STEPS):
        short = profile.value(high) < target
        if not np.any(short):
            break
        high[short] *= 2.0
    return high


def invert_increasing(profile: Profile, target: Array) -> Array:
    """x up to the limit with profile(x) = target (N,), by Newton safeguarded with bisection; NaN where none is."""
    high = _reach(profile, target)
    answer = np.full_like(target, np.nan)
    rows = np.flatnonzero((target >= 0.0) & np.isfinite(target) & (target <= profile.value(high)))
    target, high = target[rows], high[rows]
    low, x, last = np.zeros_like(high), np.minimum(target, high), np.full_like(high, np.inf)
    for _ in range(STEPS):
        error = profile.value(x) - target
        low, high = np.where(error < 0.0, x, low), np.where(error > 0.0, x, high)
        move = -error / profile.slope(x)
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


def dense_polynomial(values: Sequence[float], powers: Sequence[int]) -> Array:
    """x + sum values_k x^powers_k as a polynomial, lowest power first."""
    polynomial = np.zeros(max(powers) + 1)
    polynomial[1] = 1.0
    polynomial[list(powers)] = values
    return polynomial


# ---- for the solve: plain numbers and loops, which the kernels compile ----------------------------------------------


def radial_slope(dense: Any, x: float) -> float:
    """d/dx of x (d_0 + d_1 x + d_2 x^2 ...)."""
    total = 0.0
    for k in range(len(dense) - 1, -1, -1):
        total = total * x + (k + 1) * dense[k]
    return total


def growing_until(dense: Any, far: float) -> float:
    """Where x (d_0 + d_1 x + d_2 x^2 ...) first stops growing, or `far`, the end of what can be observed."""
    step = far / _FAR_STEPS
    low, high = 0.0, far
    for i in range(1, _FAR_STEPS + 1):
        if radial_slope(dense, i * step) <= 0.0:
            low, high = (i - 1) * step, i * step
            break
        low = i * step
    if high < far or radial_slope(dense, far) <= 0.0:
        for _ in range(50):
            middle = 0.5 * (low + high)
            if radial_slope(dense, middle) > 0.0:
                low = middle
            else:
                high = middle
    return low
