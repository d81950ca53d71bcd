"""A lens without a formula: a smooth profile along the radius and a little across it, as rough as the data require."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain
from types import MappingProxyType
from typing import ClassVar

import numpy as np

from ceres_cal.base import Array, Mask, cached_property, eigh, grid_places, rms, two_digits
from ceres_cal.kernels import NOTHING
from ceres_cal.scene.lens.base import Lens, LinearEquations, Roughness, required_powers
from ceres_cal.scene.lens.planar import Planar, Profile, along_pieces, derivative, horner

_GRID = COLUMNS, ROWS = 16, 12  # of a surface's nodes
EXTENTS = ("wide", "high")
NODES = tuple(f"{axis}{i:02d}{j:02d}" for i in range(COLUMNS) for j in range(ROWS) for axis in "xy")
"""Names of the surface's coefficients: axis, column, row."""
_TURNS = 48  # directions in which limits are evaluated: these vary little in between
# Standard deviations of coefficients, in rims. Before the data are used they are loose, so that they do not hold a
# first solve. The least ones are those of usual lenses, halved by each power, so that uninformative data do not suggest
# a perfect lens.
_LOOSE, _LOOSE_ACROSS, _LEAST, _LEAST_ACROSS = 1000.0, 1e-2, 0.1, 3e-3
_BEYOND = 1.15  # size of a surface over the picture's: places move by less than the margin


@cache
def _monomials(power: int) -> Mapping[tuple[str, str], tuple[int, int]]:
    """Displacements by a power of the radius, except for those of the profile, of the camera, and Conrady's decentring:
    m and n of each c q^m conj(q)^n of the complex place q, by the names of the real and the imaginary part of c.

    Power 2 has 3 complex terms. Without other distortion, q^2 + q conj(q) is the effect of a turn of the camera beside
    a shift of its principal point: it is left out, and Brown's decentring 2 q conj(q) c + q^2 conj(c) is kept, with
    Conrady's further terms, |q|^2 and |q|^4 times as large. For odd powers, q |q|^2k is along the radius, or a twist,
    which no lens has.
    """
    orders = ((power - n, n) for n in range(power + 1))
    kept = ((m, n) for m, n in orders if m - n != 1 and (power, n) not in ((2, 0), (2, 1)))
    return {(f"c{m}{n}", f"d{m}{n}"): (m, n) for m, n in kept}


@cache
def _names_across(power: int) -> tuple[str, ...]:
    conrady = ("p2", "p1", "p4", "p3", "p6", "p5") if power == 2 else ()
    return (*conrady, *chain.from_iterable(_monomials(power)))


@cache
def _names(powers: tuple[int, ...]) -> tuple[str, ...]:
    return ("rim", *(f"g{k}" for k in range(1, COUNT + 1)), *chain.from_iterable(map(_names_across, powers)))


def _shorter(places: Array, ends: Array) -> Mask:
    """(N,) whether places (N, 2) are nearer than the ends (T,) of both neighbouring directions, evenly all around."""
    turn = np.arctan2(places[:, 1], places[:, 0]) / (2.0 * np.pi) * len(ends)
    first = np.floor(np.nan_to_num(turn)).astype(int)
    end = np.minimum(ends[first % len(ends)], ends[(first + 1) % len(ends)])
    return np.asarray(np.hypot(places[:, 0], places[:, 1]) <= end)


# ---- quintic B-splines along a radius, with value and slope 0 at the axis and straight on beyond the last knot -------

INTERVALS, DEGREE = 8, 5
COUNT = INTERVALS + DEGREE - 2  # number of B-splines: value and slope at the axis are 0
END = 2.0  # rims: nothing is observed farther out


def _b_splines(u: Array) -> Array:
    """(N, intervals + degree) all B-splines with equal knots on [0, 1] and end knots of full multiplicity (de Boor)."""
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


def profile_columns(u: Array, order: int = 0) -> Array:
    """(N, count) B-splines that remain if value and slope at 0 are 0, or derivatives of some order; linear beyond 1."""
    inside = np.clip(u, 0.0, 1.0)
    j = np.minimum((inside * INTERVALS).astype(int), INTERVALS - 1)
    table, t = pieces()[j], np.repeat((inside * INTERVALS - j)[:, None], DEGREE + 1, axis=1)
    for _ in range(order):
        table = INTERVALS * derivative(table)
    own = horner(np.moveaxis(table, -1, 0), t)
    if order == 0:
        own += np.maximum(u - 1.0, 0.0)[:, None] * horner(np.moveaxis(INTERVALS * derivative(table), -1, 0), t)
    values = np.zeros((len(u), INTERVALS + DEGREE))
    np.put_along_axis(values, j[:, None] + np.arange(DEGREE + 1), own, axis=1)
    return values[:, 2:]


@cache
def bending() -> Array:
    """(count, count) integral of the squared fourth derivative: 0 for u^2 and u^3, which the paper's lens has, too."""
    t = np.array([-1.0, 1.0]) / np.sqrt(3.0)  # Gauss's nodes, of weight 1
    places = (np.arange(INTERVALS)[:, None] + 0.5 + 0.5 * t).ravel() / INTERVALS
    rows = profile_columns(places, 4)
    return np.asarray(rows.T @ rows / (2.0 * INTERVALS))


def growing(coefficients: Array) -> Profile:
    """Return the profile u + G(u) in rims by the coefficients (count,) of G: the polynomials of the intervals, and a
    straight line beyond the last knot. Its limit is where it stops growing, at most `END`.
    """
    each, width = np.append(np.zeros(2), coefficients), 1.0 / INTERVALS
    own = np.array([each[j : j + DEGREE + 1] @ table for j, table in enumerate(pieces())])
    own[:, 0] += np.arange(INTERVALS) * width
    own[:, 1] += width
    beyond = np.zeros(DEGREE + 1)
    beyond[:2] = np.sum(own[-1]), own[-1] @ np.arange(DEGREE + 1)
    every = np.vstack([own, beyond])
    slopes = derivative(every)
    return Profile(every, NOTHING, float(first_falls(partial(along_pieces, slopes, width))[0]), width)


def first_falls(growth: Callable[[Array], Array], directions: int = 1) -> Array:
    """(T,) first radius at which a growth (N, T) at radii (N, T) is not above 0 in each direction, at most `END`."""
    refined = 8  # steps of refinement
    samples = 100  # radii up to the end: growth varies little in between
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


@dataclass(frozen=True)
class Spline(Planar):
    """A quintic spline along the radius and polynomials across it.

    The ideal place q is phi 2 tan(angle / 2) over `rim`, the radius (px) of the last knot, which is set at the start.
    It is measured at rim q + G(|q|) q / |q| + sum c q^m conj(q)^n, with all coefficients in px. G has value and slope 0
    at the axis, so that phi is the focal length there. The powers are those of the displacements across. An optional
    surface (see `surface`) is added, whose half sides, in rims, are set at the start, too.
    """

    values: tuple[float, ...] = ()
    powers: tuple[int, ...] = (2, 3)
    terms: tuple[str, ...] = ()
    kind: ClassVar[str] = "spline"
    formulas: ClassVar[str] = "spline"
    acts_on_pixels: ClassVar[bool] = True
    trial_powers: ClassVar[tuple[tuple[int, ...], ...]] = ((2, 3),)
    missing_powers: ClassVar[tuple[int, ...]] = ()
    more_terms: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({"surface": (*EXTENTS, *NODES)})
    set_at_start: ClassVar[tuple[str, ...]] = ("rim", *EXTENTS)

    def __post_init__(self) -> None:
        most = 9  # highest power across the radius
        object.__setattr__(self, "powers", required_powers(self.kind, self.powers, most))
        object.__setattr__(self, "values", tuple(self.values) or (0.0,) * len(self.names))
        super().__post_init__()

    @cached_property
    def names(self) -> tuple[str, ...]:
        return (*_names(self.powers), *self.names_of_terms)

    @cached_property
    def orders(self) -> tuple[int, ...]:
        return tuple([int(name in EXTENTS) for name in self.names])

    @classmethod
    def blank(cls, powers: Sequence[int]) -> Spline:
        return cls((), tuple(powers))

    @property
    def formula(self) -> str:
        return "r = R + G(R) along the radius, R = 2 phi tan(angle / 2), and polynomials across it"

    @property
    def note(self) -> str:
        said = "g1, g2, ... are displacements (px) along the radius from the axis to rim, the others across it at rim"
        if not self.terms:
            return said
        x, y = (side / _BEYOND * np.linspace(-1.0, 1.0, 4 * n) for side, n in zip(self._extents, _GRID, strict=True))
        plain = Spline(self.values[: len(_names(self.powers))], self.powers)
        with_it, without = (lens.mapped(grid_places(x, y))[:, 0] for lens in (self, plain))
        size_px = self.rim_px * rms(np.linalg.norm(with_it - without, axis=0))
        size = f"{two_digits(size_px)} px (rms over the picture)"
        return f"{said}; a surface of {len(NODES) // 2} nodes adds {size}"

    @property
    def nodes(self) -> frozenset[str]:
        return frozenset(NODES) if self.terms else frozenset()

    # ---- its start and its roughness ---------------------------------------------------------------------------------

    def spanning(self, angle: float, phi: float, beyond: float, image_size: tuple[int, int]) -> Lens:
        steps = 8  # of rims, within a factor 2: half a step is less than their margin beyond the image
        given = self.coefficients
        if given["rim"] <= 0.0:
            # In steps, so that the numbers of two calibrations of one camera have the same meaning.
            rim = 2.0 ** (np.rint(steps * np.log2(2.0 * phi * np.tan(0.5 * angle) * beyond)) / steps)
            given["rim"] = float(rim)
        for name, side in zip(EXTENTS, image_size, strict=True) if self.terms else ():
            given[name] = given[name] or float(_BEYOND * side / np.hypot(*image_size))
        return self.with_values(list(given.values()))

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        start_weight = 1e-4  # weight of a start's roughness beside its equations
        rim = self.rim_px
        u = 2.0 * phi * np.tan(0.5 * angle) / rim
        sizes, directions = eigh(bending())
        rough = directions * np.sqrt(np.maximum(sizes, 0.0)) * start_weight
        rows = np.vstack([profile_columns(np.nan_to_num(u)), rough.T])
        return {f"g{k + 1}": rows[:, k] for k in range(COUNT)}, np.append(measured - rim * u, np.zeros(COUNT))

    @cached_property
    def roughness(self) -> tuple[Roughness, ...]:
        loose_surface, least_surface = 1e-3, 1e-5
        rim, names = self.rim_px, self.names
        along = Roughness(names[1 : 1 + COUNT], bending(), _LOOSE * rim, _LEAST * rim)
        across = []
        for power in self.powers:
            own = _names_across(power)
            least = _LEAST_ACROSS * rim / 2.0 ** (power - 2)
            across.append(Roughness(own, np.eye(len(own)), _LOOSE_ACROSS * rim, least))
        if self.terms:
            from ceres_cal.scene.lens.surface import roughness

            matrix = roughness(*self._extents, COLUMNS, ROWS)
            across.append(Roughness(NODES, matrix, loose_surface * rim, least_surface * rim))
        return (along, *across)

    # ---- its plane ---------------------------------------------------------------------------------------------------

    @property
    def rim_px(self) -> float:
        """Radius of the last knot, px; 1 where it is not set yet."""
        return self.values[0] if self.values[0] > 0.0 else 1.0

    def _unit(self, phi: float) -> float:
        return self.rim_px

    @staticmethod
    def _flat(rays: Array) -> Array:
        length = np.sqrt(np.sum(rays * rays, axis=1))
        depth = length + rays[:, 2]
        return np.asarray(2.0 * rays[:, :2] / np.where(depth > 1e-12 * length, depth, np.nan)[:, None])

    @staticmethod
    def _lifted(flat: Array) -> Array:
        quarter = 0.25 * np.sum(flat * flat, axis=1)
        return np.column_stack([flat, 1.0 - quarter])

    @staticmethod
    def _slopes(flat: Array) -> Array:
        x, y = flat.T
        one, none = np.ones_like(x), np.zeros_like(x)
        return np.array([[one, none], [none, one], [-0.5 * x, -0.5 * y]])

    @property
    def _extents(self) -> tuple[float, ...]:
        """Half sides of the surface, in rims; 1 where they are not set yet."""
        return tuple(self.coefficients[name] or 1.0 for name in EXTENTS)

    @cached_property
    def _is_round(self) -> bool:
        own = {*_names(()), *EXTENTS}
        return not any(value for name, value in self.coefficients.items() if name not in own)

    @cached_property
    def _profile(self) -> Profile:
        return growing(np.array(self.values[1 : 1 + COUNT]) / self.rim_px)

    @property
    def _directions(self) -> Array:
        turns = np.linspace(0.0, 2.0 * np.pi, 1 if self._is_round else _TURNS, endpoint=False)
        return np.column_stack([np.cos(turns), np.sin(turns)])

    @cached_property
    def _limits(self) -> Array:
        """(T,) `_limit` of each direction: where nothing was observed the map may end earlier than elsewhere."""
        return first_falls(self._least_growth, len(self._directions))

    @cached_property
    def _rims(self) -> Array:
        """(T,) where the map ends in each direction."""
        return np.asarray(np.linalg.norm(self.mapped(self._limits[:, None] * self._directions)[:, 0], axis=0))

    @property
    def _limit(self) -> float:
        return float(np.min(self._limits))

    @property
    def _rim(self) -> float:
        return float(np.min(self._rims))

    def _least_growth(self, u: Array) -> Array:
        """(N, T) least eigenvalue of the symmetric part of the map's derivative at radii (N, T)."""
        (_, xx, xy), (_, yx, yy) = self.mapped((u[:, :, None] * self._directions).reshape(-1, 2))
        least = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), 0.5 * (xy + yx))
        return np.asarray(least.reshape(u.shape))

    def _within(self, flat: Array) -> Array:
        return np.where(_shorter(flat, self._limits)[:, None], flat, np.nan)

    def shows(self, offsets: Array, phi: float) -> Mask:
        return _shorter(offsets, self._unit(phi) * self._rims)

    # ---- for the solve -----------------------------------------------------------------------------------------------

    @property
    def form(self) -> Array:
        """The positions among the intrinsics of Conrady's decentring and the surface, 0 if absent; the B-splines'
        polynomials on each interval, by power; for each monomial the position of its coefficient, m and n.
        """
        names = self.names
        every = chain.from_iterable(_monomials(power).items() for power in self.powers)
        rows = [(4.0 + names.index(real), *map(float, orders)) for (real, _), orders in every]
        conrady = 4.0 + names.index("p2") if 2 in self.powers else 0.0
        surface = 4.0 + names.index(EXTENTS[0]) if self.terms else 0.0
        return np.concatenate([[conrady, surface], np.swapaxes(pieces(), 1, 2).ravel(), np.array(rows).ravel()])
