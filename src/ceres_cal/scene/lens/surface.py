"""A surface over the picture: cubic B-splines on a grid, which follow what no term of a lens does, as smooth as the
data say (`effects/smoothness.py`).

Polynomials that are long enough to do that bend where nothing was observed; here each place is displaced by the sixteen
nodes around it, and beyond the observations by no more than a smooth continuation (thin plates; Wahba, Spline Models
for Observational Data, SIAM 1990).

Quintic B-splines along a radius, with value and slope 0 at the axis and straight on beyond the last knot.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np
from msgspec import Struct

from ceres_cal.base.arrays import Array, median
from ceres_cal.base.frozen import Frozen, cached_property

INTERVALS, DEGREE = 8, 5
COUNT = INTERVALS + DEGREE - 2  # of the B-splines: value and slope at the axis are 0
END = 2.0  # rims: nothing is observed farther out


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
    t = np.array([-1.0, 1.0]) / np.sqrt(3.0)  # Gauss' places, of weight 1
    places = (np.arange(INTERVALS)[:, None] + 0.5 + 0.5 * t).ravel() / INTERVALS
    rows = profile_columns(places, 4)
    return np.asarray(rows.T @ rows / (2.0 * INTERVALS))


class Growth(Frozen):
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
    refined = 8  # steps to where growth ends
    samples = 100  # radii up to the end, between which nothing turns
    places = np.linspace(0.0, END, samples + 1)
    values = growth(np.repeat(places[:, None], directions, axis=1))
    falling = values <= 0.0
    first, all_of = np.argmax(falling, axis=0), np.arange(directions)
    before = np.maximum(first - 1, 0)
    low, high, above, below = places[before], places[first], values[before, all_of], values[first, all_of]
    for _ in range(refined if np.any(falling) else 0):  # by the rule of false position (Illinois), from both sides
        share = above / np.where(above > below, above - below, 1.0)
        middle = low + np.clip(share, 0.01, 0.99) * (high - low)
        value = growth(middle[None])[0]
        grows = value > 0.0
        below, above = np.where(grows, 0.5 * below, value), np.where(grows, value, 0.5 * above)
        low, high = np.where(grows, middle, low), np.where(grows, high, middle)
    return np.where(np.any(falling, axis=0), low, END)


COLUMNS, ROWS = 16, 12  # of nodes
EXTENTS = ("wide", "high")
NODES = tuple(f"{axis}{i:02d}{j:02d}" for i in range(COLUMNS) for j in range(ROWS) for axis in "xy")
"""Names of the coefficients: axis, column, row."""
_SPLINES = np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]) / 6.0
# Powers of the place that other terms of the lens and the camera displace by are none of the surface's: it has a
# thousandth of its size in them.
_DEGREE, _WITHOUT = 3, 1e-3


class Surface(Struct, frozen=True, eq=False):
    """Displacements of the places of a plane.

    Attributes:
        extents: (2,) half its width and height. heights: (columns, rows, 2), the displacement of each node.
    """

    extents: Array
    heights: Array

    def at(self, flat: Array) -> tuple[Array, Array]:
        """Displacements (N, 2) at places (N, 2), and their derivatives (N, 2, 2): the same beyond the grid's edge."""
        (column, x, dx), (row, y, dy) = (_cells(flat[:, k] / self.extents[k], (COLUMNS, ROWS)[k]) for k in (0, 1))
        answer, slopes = np.zeros((len(flat), 2)), np.zeros((len(flat), 2, 2))
        for i in range(4):  # of arrays of all sixteen nodes most of the time would be spent on memory
            down, slope_down = np.zeros((2, len(flat), 2))
            for j in range(4):
                node = self.heights[column + i, row + j]
                down += y[:, j, None] * node
                slope_down += dy[:, j, None] * node
            answer += x[:, i, None] * down
            slopes[:, :, 0] += dx[:, i, None] * down
            slopes[:, :, 1] += x[:, i, None] * slope_down
        return answer, slopes / self.extents

    def size(self, part: float) -> float:
        """Root mean square of the displacements over such a part of its sides."""
        x, y = (part * np.linspace(-1.0, 1.0, 4 * count) for count in (COLUMNS, ROWS))
        places = np.column_stack([one.ravel() for one in np.meshgrid(x, y)]) * self.extents
        return float(np.sqrt(np.mean(np.sum(self.at(places)[0] ** 2, axis=1))))


def _cells(place: Array, count: int) -> tuple[Array, Array, Array]:
    """Of places from -1 to 1: the first of the four nodes, their weights (N, 4) and the slopes of these."""
    place = np.nan_to_num(place)
    inside, cells = np.clip(place, -1.0, 1.0), 0.5 * (count - 3)
    first = np.minimum(((inside + 1.0) * cells).astype(int), count - 4)
    t = ((inside + 1.0) * cells - first)[:, None]
    slopes = np.hstack([t**0, 2.0 * t, 3.0 * t * t]) @ _SPLINES[:, 1:].T
    return first, np.hstack([t**0, t, t * t, t**3]) @ _SPLINES.T, slopes * (cells * (inside == place))[:, None]


@cache
def _products(count: int) -> tuple[tuple[Array, ...], Array]:
    """Along one axis from -1 to 1: integrals (count, count) of products of the B-splines, of their slopes and of their
    second derivatives; (degree + 1, count) mean products with Legendre's polynomials of root mean square 1.
    """
    cells = 0.5 * (count - 3)
    t, weight = np.polynomial.legendre.leggauss(5)
    t, weight = 0.5 + 0.5 * t, 0.5 * weight / cells
    powers = np.vander(t, 4, increasing=True)
    orders = [powers, np.column_stack([0.0 * t, t**0, 2.0 * t, 3.0 * t * t]) * cells]
    orders.append(np.column_stack([0.0 * t, 0.0 * t, 2.0 * t**0, 6.0 * t]) * cells**2)
    grams = [np.zeros((count, count)) for _ in orders]
    moments = np.zeros((_DEGREE + 1, count))
    sizes = np.sqrt(2.0 * np.arange(_DEGREE + 1) + 1.0)[:, None]
    for first in range(count - 3):
        nodes = slice(first, first + 4)
        for gram, order in zip(grams, orders, strict=True):
            values = order @ _SPLINES.T
            gram[nodes, nodes] += (values.T * weight) @ values
        legendre = sizes * np.polynomial.legendre.legvander((first + t) / cells - 1.0, _DEGREE).T
        moments[:, nodes] += 0.5 * (legendre * weight) @ (powers @ _SPLINES.T)
    return tuple(grams), moments


@lru_cache(maxsize=8)
def roughness(wide: float, high: float) -> Array:
    """(K, K) over the names of `NODES`: bending of the x and y displacements, each by itself, over a picture of these
    half sides; variances of its inverse have a median of 1.
    """
    (across, slope_x, bend_x), moments_x = _products(COLUMNS)
    (down, slope_y, bend_y), moments_y = _products(ROWS)
    bending = np.kron(bend_x, down) / wide**4 + np.kron(across, bend_y) / high**4
    bending += 2.0 * np.kron(slope_x, slope_y) / (wide * high) ** 2
    low = [np.kron(moments_x[i], moments_y[j]) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    without = np.transpose(low) @ np.array(low)
    free = np.linalg.inv(bending + 1.0 / _WITHOUT**2 * np.trace(bending) * without)
    own = median(np.diag(free)) * bending + without / _WITHOUT**2
    return np.asarray(np.kron(own, np.eye(2)))
