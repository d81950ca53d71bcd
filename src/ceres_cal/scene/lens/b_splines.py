"""Quintic B-splines along a radius, with value and slope 0 at the axis and straight on beyond the last knot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.cached import cached_property
from ceres_cal.scene.lens.spline_kernel import DEGREE, END, INTERVALS

_SAMPLES = 100  # radii up to the end, between which nothing turns
_REFINED = 8  # steps to where growth ends


def _b_splines(u: Array) -> Array:
    """(N, intervals + degree) all B-splines with equal knots on [0, 1] and ends of full multiplicity (de Boor)."""
    inner = np.arange(INTERVALS + 1) / INTERVALS
    knots = np.concatenate([np.zeros(DEGREE), inner, np.ones(DEGREE)])
    place = np.minimum((u * INTERVALS).astype(int), INTERVALS - 1) + DEGREE
    values = (place[:, None] == np.arange(len(knots) - 1)).astype(float)
    for degree in range(1, DEGREE + 1):
        low, high = knots[: len(knots) - degree - 1], knots[degree + 1 :]
        rise, fall = knots[degree:-1] - low, high - knots[1 : len(knots) - degree]
        up = np.where(rise > 0.0, (u[:, None] - low) / np.where(rise > 0.0, rise, 1.0), 0.0)
        down = np.where(fall > 0.0, (high - u[:, None]) / np.where(fall > 0.0, fall, 1.0), 0.0)
        values = up * values[:, :-1] + down * values[:, 1:]
    return np.asarray(values)


@cache
def pieces() -> Array:
    """(intervals, degree + 1, degree + 1): on interval j B-spline j + a is sum_d [j, a, d] t^d, t from 0 to 1 in it."""
    t = 0.5 - 0.5 * np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
    powers = np.vander(t, increasing=True)
    rows = []
    for j in range(INTERVALS):
        values = _b_splines((j + t) / INTERVALS)[:, j : j + DEGREE + 1]
        rows.append(np.linalg.solve(powers, values).T)
    table = np.array(rows)
    table[0, 2:, :2] = 0.0  # exactly: it is divided by the squared radius
    return table


def profile_columns(u: Array, derivative: int = 0) -> Array:
    """(N, count) B-splines that are left where value and slope at 0 are 0, or a derivative; straight on beyond 1."""
    inside = np.clip(u, 0.0, 1.0)
    j = np.minimum((inside * INTERVALS).astype(int), INTERVALS - 1)
    table, t = pieces()[j], inside * INTERVALS - j
    values = np.zeros((len(u), INTERVALS + DEGREE))
    slopes = np.zeros_like(values)
    for d in range(DEGREE, derivative - 1, -1):
        factor = np.prod(np.arange(d - derivative + 1, d + 1)) * float(INTERVALS) ** derivative
        power = d - derivative
        own = factor * table[:, :, d] * t[:, None] ** power
        rise = own * 0.0 if power == 0 else factor * power * INTERVALS * table[:, :, d] * t[:, None] ** (power - 1)
        for a in range(DEGREE + 1):
            values[np.arange(len(u)), j + a] += own[:, a]
            slopes[np.arange(len(u)), j + a] += rise[:, a]
    beyond = np.maximum(u - 1.0, 0.0)[:, None]
    return np.asarray((values + beyond * slopes if derivative == 0 else values)[:, 2:])


@cache
def bending() -> Array:
    """(count, count) integral of the squared fourth derivative: 0 of u^2 and u^3, which the paper's lens has, too."""
    t, weight = np.polynomial.legendre.leggauss(2)
    places = (np.arange(INTERVALS)[:, None] + 0.5 + 0.5 * t).ravel() / INTERVALS
    rows = profile_columns(places, 4)
    return np.asarray((rows.T * np.tile(weight / (2.0 * INTERVALS), INTERVALS)) @ rows)


@dataclass(frozen=True, eq=False)
class Growth:
    """The profile u + G(u) in rims."""

    along: Array

    @cached_property
    def _polynomials(self) -> Array:
        """(degree + 1, intervals) of G, lowest power first."""
        every = np.concatenate([np.zeros(2), self.along])
        own = np.lib.stride_tricks.sliding_window_view(every, DEGREE + 1)
        return np.asarray(np.einsum("ja,jad->dj", own, pieces()))

    def bent(self, u: Array) -> tuple[Array, Array]:
        """G and its slope at u, straight on beyond the last knot."""
        inside = np.minimum(u, 1.0) * INTERVALS
        j = np.minimum(np.nan_to_num(inside).astype(int), INTERVALS - 1)
        t, value, slope = inside - j, self._polynomials[DEGREE][j], np.zeros(np.shape(u))
        for polynomial in self._polynomials[DEGREE - 1 :: -1]:
            slope = slope * t + value
            value = value * t + polynomial[j]
        slope *= INTERVALS
        return value + slope * np.maximum(u - 1.0, 0.0), slope

    def value(self, x: Array) -> Array:
        """At x (N,) or one."""
        return np.asarray(x + self.bent(x)[0])

    def slope(self, x: Array) -> Array:
        """Its derivative at x (N,)."""
        return np.asarray(1.0 + self.bent(x)[1])

    @cached_property
    def limit(self) -> float:
        """Where it stops growing, `END` at most."""
        return float(first_falls(self.slope)[0])


def first_falls(growth: Callable[[Array], Array], directions: int = 1) -> Array:
    """(T,) where a growth (N, T) at radii (N, T) is first not above 0 in each direction, `END` at most."""
    places = np.linspace(0.0, END, _SAMPLES + 1)
    values = growth(np.repeat(places[:, None], directions, axis=1))
    falling = values <= 0.0
    first, all_of = np.argmax(falling, axis=0), np.arange(directions)
    before = np.maximum(first - 1, 0)
    low, high, above, below = places[before], places[first], values[before, all_of], values[first, all_of]
    for _ in range(_REFINED if np.any(falling) else 0):  # by the rule of false position (Illinois), from both sides
        share = above / np.where(above > below, above - below, 1.0)
        middle = low + np.clip(share, 0.01, 0.99) * (high - low)
        value = growth(middle[None])[0]
        grows = value > 0.0
        below, above = np.where(grows, 0.5 * below, value), np.where(grows, value, 0.5 * above)
        low, high = np.where(grows, middle, low), np.where(grows, high, middle)
    return np.where(np.any(falling, axis=0), low, END)
