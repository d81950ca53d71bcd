"""A lens without a formula: a smooth profile along the radius and a little across it, as rough as the data say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any, ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.scene.lens.base import LinearEquations, Roughness
from ceres_cal.scene.lens.planar import Planar

_INTERVALS, _DEGREE = 8, 5
_COUNT = _INTERVALS + _DEGREE - 2  # of the profile's coefficients: value and slope at the axis are 0
_MOST = 9  # powers across the radius
_CONRADY = 3  # terms of the decentring
_END = 2.0  # rims: nothing is observed farther out
_TINY = 1e-150
_SAMPLES, _TURNS = 400, 48  # radii up to the end, and directions, between which nothing turns
_HEAD = 4  # of the state: the limit, and how much of the rest there is
_TABLE = _INTERVALS * (_DEGREE + 1) ** 2
_START_WEIGHT = 1e-4  # of the roughness of a start beside its equations
# Standard deviations before the data have spoken, in rims: loose, so that a first solve is not held by them. Least ones:
# what the best lenses have, so that a calibration of few observations does not take a lens for perfect.
_LOOSE, _LOOSE_ACROSS, _LEAST, _LEAST_ACROSS = 1000.0, 1e-2, 0.1, 3e-4


def _b_splines(u: Array) -> Array:
    """(N, intervals + degree) all B-splines with equal knots on [0, 1] and ends of full multiplicity (de Boor)."""
    inner = np.arange(_INTERVALS + 1) / _INTERVALS
    knots = np.concatenate([np.zeros(_DEGREE), inner, np.ones(_DEGREE)])
    place = np.minimum((u * _INTERVALS).astype(int), _INTERVALS - 1) + _DEGREE
    values = (place[:, None] == np.arange(len(knots) - 1)).astype(float)
    for degree in range(1, _DEGREE + 1):
        low, high = knots[: len(knots) - degree - 1], knots[degree + 1 :]
        rise, fall = knots[degree:-1] - low, high - knots[1 : len(knots) - degree]
        up = np.where(rise > 0.0, (u[:, None] - low) / np.where(rise > 0.0, rise, 1.0), 0.0)
        down = np.where(fall > 0.0, (high - u[:, None]) / np.where(fall > 0.0, fall, 1.0), 0.0)
        values = up * values[:, :-1] + down * values[:, 1:]
    return values


@cache
def _pieces() -> Array:
    """(intervals, degree + 1, degree + 1): on interval j B-spline j + a is sum_d [j, a, d] t^d, t from 0 to 1 in it."""
    t = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    powers = np.vander(t, increasing=True)
    rows = []
    for j in range(_INTERVALS):
        values = _b_splines((j + t) / _INTERVALS)[:, j : j + _DEGREE + 1]
        rows.append(np.linalg.solve(powers, values).T)
    table = np.array(rows)
    table[0, 2:, :2] = 0.0  # exactly: it is divided by the squared radius
    return table


def _profile_columns(u: Array, derivative: int = 0) -> Array:
    """(N, count) B-splines that are left where value and slope at 0 are 0, or a derivative; straight on beyond 1."""
    inside = np.clip(u, 0.0, 1.0)
    j = np.minimum((inside * _INTERVALS).astype(int), _INTERVALS - 1)
    table, t = _pieces()[j], inside * _INTERVALS - j
    values = np.zeros((len(u), _INTERVALS + _DEGREE))
    slopes = np.zeros_like(values)
    for d in range(_DEGREE, derivative - 1, -1):
        factor = np.prod(np.arange(d - derivative + 1, d + 1)) * float(_INTERVALS) ** derivative
        power = d - derivative
        own = factor * table[:, :, d] * t[:, None] ** power
        rise = own * 0.0 if power == 0 else factor * power * _INTERVALS * table[:, :, d] * t[:, None] ** (power - 1)
        for a in range(_DEGREE + 1):
            values[np.arange(len(u)), j + a] += own[:, a]
            slopes[np.arange(len(u)), j + a] += rise[:, a]
    beyond = np.maximum(u - 1.0, 0.0)[:, None]
    return np.asarray((values + beyond * slopes if derivative == 0 else values)[:, 2:])


@cache
def _bending() -> Array:
    """(count, count) integral of the squared fourth derivative: 0 of u^2 and u^3, which the paper's lens has, too."""
    t, weight = np.polynomial.legendre.leggauss(2)
    places = (np.arange(_INTERVALS)[:, None] + 0.5 + 0.5 * t).ravel() / _INTERVALS
    rows = _profile_columns(places, 4)
    return np.asarray((rows.T * np.tile(weight / (2.0 * _INTERVALS), _INTERVALS)) @ rows)


@dataclass(frozen=True)
class _Monomial:
    """weight c q^m conj(q)^n of the complex place q, or conj(c) for c; c has its real part at `name`."""

    names: tuple[str, str]
    turned: bool
    m: int
    n: int
    weight: float


@cache
def _monomials(powers: tuple[int, ...]) -> tuple[_Monomial, ...]:
    """What displaces by these powers of the radius, but for what the profile and the camera do.

    Of power 2 there are 3 complex terms. Where nothing else bends, q^2 + q conj(q) is what a turn of the camera does beside
    a shift of its principal point: it is left out, and Brown's decentring 2 q conj(q) c + q^2 conj(c) stays, with Conrady's
    further terms, |q|^2 and |q|^4 times as large. Of odd powers q |q|^2k is along the radius, or a twist, which no lens
    has.
    """
    every = []
    for power in powers:
        for k in range(_CONRADY if power == 2 else 0):
            names = (f"p{2 * k + 2}", f"p{2 * k + 1}")
            every.append(_Monomial(names, False, k + 1, k + 1, 2.0 / 3.0))
            every.append(_Monomial(names, True, k + 2, k, 1.0 / 3.0))
        for m in range(power, -1, -1):
            n = power - m
            if m - n != 1 and (power, n) not in ((2, 0), (2, 1)):
                every.append(_Monomial((f"c{m}{n}", f"d{m}{n}"), False, m, n, 1.0))
    return tuple(every)


@dataclass(frozen=True)
class Spline(Planar):
    """A quintic spline along the radius and polynomials across it.

    The ideal place q is phi 2 tan(angle / 2) over `rim`, the radius (px) that the knots go up to, set at the start; it is
    measured at rim q + G(|q|) q / |q| + sum c q^m conj(q)^n, all coefficients in px. G has value and slope 0 at the axis,
    so that phi is the focal length there. The powers are those of the displacements across.
    """

    values: tuple[float, ...] = ()
    powers: tuple[int, ...] = (2, 3)
    kind: ClassVar[str] = "spline"
    acts_on_pixels: ClassVar[bool] = True
    trial_powers: ClassVar[tuple[tuple[int, ...], ...]] = ((2, 3), (2, 3, 4, 5))
    missing_powers: ClassVar[tuple[int, ...]] = ()
    set_at_start: ClassVar[tuple[str, ...]] = ("rim",)
    work_rows: ClassVar[int] = 3 + 2 * (_MOST + 1) + 2

    def __post_init__(self) -> None:
        powers = tuple(int(p) for p in self.powers)
        if len(set(powers)) != len(powers) or powers != tuple(self.powers) or not all(2 <= p <= _MOST for p in powers):
            raise InputError(f"powers of the spline lens must be different whole numbers from 2 to {_MOST}, not {powers}")
        object.__setattr__(self, "powers", powers)
        object.__setattr__(self, "values", tuple(self.values) or (0.0,) * len(self.names))
        super().__post_init__()

    @property
    def names(self) -> tuple[str, ...]:
        across = dict.fromkeys(name for one in _monomials(self.powers) for name in one.names)
        return ("rim", *(f"g{k}" for k in range(1, _COUNT + 1)), *across)

    @property
    def orders(self) -> tuple[int, ...]:
        return (0,) * len(self.names)

    @property
    def units(self) -> tuple[str, ...]:
        return ("px",) * len(self.names)

    @classmethod
    def blank(cls, powers: Sequence[int]) -> Spline:
        return cls((), tuple(powers))

    @property
    def formula(self) -> str:
        return "r = R + G(R) along the radius, R = 2 phi tan(angle / 2), and polynomials across it"

    @property
    def note(self) -> str:
        return f"displacements in px at {self.values[0]:.0f} px from the axis; g1, g2, ... are a spline's: no number of theirs alone"

    def scales(self, unit_px: float) -> Array:
        return np.full(len(self.names), 1.0 / unit_px)

    def natural_sizes(self, phi: float, unit_px: float) -> list[float]:
        return [unit_px] * len(self.names)

    # ---- its start and its roughness ---------------------------------------------------------------------------------

    def spanning(self, angle: float, phi: float, beyond: float) -> Spline:
        rim = 2.0 * phi * np.tan(0.5 * angle) * beyond
        return self if self.values[0] > 0.0 else replace(self, values=(float(rim), *self.values[1:]))

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        rim = self._rim_px
        u = 2.0 * phi * np.tan(0.5 * angle) / rim
        sizes, directions = np.linalg.eigh(_bending())
        bending = directions * np.sqrt(np.maximum(sizes, 0.0)) * _START_WEIGHT
        rows = np.vstack([_profile_columns(np.nan_to_num(u)), bending.T])
        return {f"g{k + 1}": rows[:, k] for k in range(_COUNT)}, np.append(measured - rim * u, np.zeros(_COUNT))

    @property
    def roughness(self) -> tuple[Roughness, ...]:
        rim, names = self._rim_px, self.names
        bending = Roughness(names[1 : 1 + _COUNT], _bending(), _LOOSE * rim, _LEAST * rim)
        across = []
        for power in self.powers:
            own = tuple(dict.fromkeys(n for one in _monomials((power,)) for n in one.names))
            across.append(Roughness(own, np.eye(len(own)), _LOOSE_ACROSS * rim, _LEAST_ACROSS * rim))
        return (bending, *across)

    # ---- in arrays ---------------------------------------------------------------------------------------------------

    @property
    def _rim_px(self) -> float:
        return self.values[0] if self.values[0] > 0.0 else 1.0

    def _unit(self, phi: float) -> float:
        return self._rim_px

    @staticmethod
    def _flat(rays: Array) -> Array:
        length = np.sqrt(np.sum(rays * rays, axis=1))
        depth = length + rays[:, 2]
        return np.asarray(2.0 * rays[:, :2] / np.where(depth > 1e-12 * length, depth, np.nan)[:, None])

    @staticmethod
    def _lifted(flat: Array) -> Array:
        quarter = 0.25 * np.sum(flat * flat, axis=1)
        return np.column_stack([flat, 1.0 - quarter]) / (1.0 + quarter)[:, None]

    @property
    def _along(self) -> Array:
        """The profile's coefficients in rims."""
        return np.array(self.values[1 : 1 + _COUNT]) / self._rim_px

    @cached_property
    def _across(self) -> list[tuple[_Monomial, complex]]:
        named = self.coefficients
        both = [(one, complex(named[one.names[0]], named[one.names[1]])) for one in _monomials(self.powers)]
        rim = self._rim_px
        return [(one, (c.conjugate() if one.turned else c) * one.weight / rim) for one, c in both if c != 0.0]

    @property
    def _is_round(self) -> bool:
        return not self._across

    @cached_property
    def _profile(self) -> _Growth:
        return _Growth(self._along)

    @property
    def _directions(self) -> Array:
        turns = np.linspace(0.0, 2.0 * np.pi, 1 if self._is_round else _TURNS, endpoint=False)
        return np.column_stack([np.cos(turns), np.sin(turns)])

    @cached_property
    def _limit(self) -> float:
        return _first_fall(self._least_growth)

    @cached_property
    def _rim(self) -> float:
        return float(np.min(np.linalg.norm(self._map(self._limit * self._directions), axis=1)))

    def _least_growth(self, u: Array) -> Array:
        """(N,) least eigenvalue of the symmetric part of the map's derivative on each circle."""
        xx, xy, yx, yy = self._jacobian((u[:, None, None] * self._directions).reshape(-1, 2))
        least = 0.5 * (xx + yy) - np.hypot(0.5 * (xx - yy), 0.5 * (xy + yx))
        return np.asarray(np.min(least.reshape(len(u), -1), axis=1))

    def _map(self, flat: Array) -> Array:
        u = np.hypot(flat[:, 0], flat[:, 1])
        outward = 1.0 + _profile_columns(u) @ self._along / np.maximum(u, _TINY)
        answer = flat * outward[:, None]
        q = flat[:, 0] + 1j * flat[:, 1]
        for one, c in self._across:
            z = c * q**one.m * np.conj(q) ** one.n
            answer += np.column_stack([z.real, z.imag])
        return answer

    def _jacobian(self, flat: Array) -> tuple[Array, Array, Array, Array]:
        x, y = flat[:, 0], flat[:, 1]
        u = np.maximum(np.hypot(x, y), _TINY)
        stretch, slope = _profile_columns(u) @ self._along / u, _profile_columns(u, 1) @ self._along
        bend = (slope - stretch) / (u * u)
        q = x + 1j * y
        first, second = np.zeros_like(q), np.zeros_like(q)  # derivatives by q and by its conjugate
        for one, c in self._across:
            if one.m:
                first += c * one.m * q ** (one.m - 1) * np.conj(q) ** one.n
            if one.n:
                second += c * one.n * q**one.m * np.conj(q) ** (one.n - 1)
        both, other = first + second, first - second
        xx, yy = 1.0 + stretch + bend * x * x + both.real, 1.0 + stretch + bend * y * y + other.real
        return xx, bend * x * y - other.imag, bend * x * y + both.imag, yy

    # ---- for the solve -----------------------------------------------------------------------------------------------

    @property
    def state(self) -> Array:
        """The limit, how many monomials and powers there are, a spare; the table of `_pieces`; the profile's polynomial
        on each interval; of each monomial the place of its coefficient among the intrinsics, whether that is
        conjugated, m, n and weight.
        """
        names = self.names
        rows = [
            [4.0 + names.index(one.names[0]), float(one.turned), float(one.m), float(one.n), one.weight]
            for one in _monomials(self.powers)
        ]
        head = [0.0, float(len(rows)), float(max((one.m for one in _monomials(self.powers)), default=0)), 0.0]
        room = np.zeros(_INTERVALS * (_DEGREE + 1))
        return np.concatenate([head, _pieces().ravel(), room, np.array(rows).ravel()])

    @staticmethod
    def prepare(intrinsics: Any, unit: float, state: Any) -> None:
        for j in range(_INTERVALS):
            for d in range(_DEGREE + 1):
                total = 0.0
                for a in range(_DEGREE + 1):
                    if j + a >= 2:
                        total += intrinsics[5 + j + a - 2] * state[_HEAD + ((j * (_DEGREE + 1)) + a) * (_DEGREE + 1) + d]
                state[_HEAD + _TABLE + j * (_DEGREE + 1) + d] = total
        rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
        state[0] = _END
        for k in range(1, 8 * _INTERVALS + 1):
            u = k / (8.0 * _INTERVALS)
            if rim + _piecewise(state, u)[1] <= 0.0:
                state[0] = u
                break

    @staticmethod
    def distort_chunk(n: int, intrinsics: Any, unit: float, state: Any, rays: Any, image: Any, work: Any) -> bool:
        limit = state[0]
        phi = intrinsics[0]
        rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
        most = int(state[2])
        scale = 2.0 * phi / (unit * rim)
        for i in range(n):
            x, y, z = rays[0, i], rays[1, i], rays[2, i]
            s = scale / (np.sqrt(x * x + y * y + z * z) + z)
            work[0, i], work[1, i] = s * x, s * y
            work[2, i] = np.sqrt(work[0, i] * work[0, i] + work[1, i] * work[1, i])
            work[3, i], work[4, i] = 1.0, 0.0
        for k in range(1, most + 1):
            for i in range(n):
                a, b = work[1 + 2 * k, i], work[2 + 2 * k, i]
                work[3 + 2 * k, i] = a * work[0, i] - b * work[1, i]
                work[4 + 2 * k, i] = a * work[1, i] + b * work[0, i]
        for k in range(6):
            for i in range(n):
                image[k, i] = 0.0
        for k in range(int(state[1])):
            row = _HEAD + _TABLE + _INTERVALS * (_DEGREE + 1) + 5 * k
            _add_monomial(n, intrinsics, state[row : row + 5], work, image)
        good = True
        for i in range(n):
            x, y, z = rays[0, i], rays[1, i], rays[2, i]
            u, v, radius = work[0, i], work[1, i], work[2, i]
            value, slope = _piecewise(state, radius)
            stretch = value / (radius + _TINY)
            bend = (slope - stretch) / (radius * radius + _TINY)
            # Derivatives by q (rows 2, 3) and by its conjugate (rows 4, 5) become those by x and y.
            first_x, first_y = image[2, i] + image[4, i], image[3, i] + image[5, i]
            second_x, second_y = image[2, i] - image[4, i], image[3, i] - image[5, i]
            jxx, jyy = rim + stretch + bend * u * u + first_x, rim + stretch + bend * v * v + second_x
            jxy, jyx = bend * u * v - second_y, bend * u * v + first_y
            length = np.sqrt(x * x + y * y + z * z)
            s = scale / (length + z)
            f = s / (length * (length + z))
            ax, ab, by = s - f * x * x, -f * x * y, s - f * y * y
            image[0, i] = unit * ((rim + stretch) * u + image[0, i])
            image[1, i] = unit * ((rim + stretch) * v + image[1, i])
            xy = unit * (jxx * ab + jxy * by)
            image[2, i], image[3, i], image[4, i] = unit * (jxx * ax + jxy * ab), xy, unit * (jyx * ab + jyy * by)
            image[7, i] = unit * (jyx * ax + jyy * ab) - xy
            along_x, along_y = unit * (jxx * u + jxy * v), unit * (jyx * u + jyy * v)
            image[5, i], image[6, i] = -along_x / length, -along_y / length
            work[2 * _MOST + 5, i], work[2 * _MOST + 6, i] = along_x / phi, along_y / phi
            good &= (length + z > 1e-9 * length) & (radius < limit) & (jxx * jyy > jxy * jyx) & (jxx + jyy > 0.0)
        return good

    @staticmethod
    def differentiate_chunk(
        n: int, intrinsics: Any, unit: float, state: Any, image: Any, work: Any, jacobian: Any
    ) -> None:
        phi, aspect, last = intrinsics[0], intrinsics[1], len(intrinsics)
        rim = intrinsics[4] if intrinsics[4] > 0.0 else 1.0
        for i in range(n):
            jacobian[0, 0, i], jacobian[0, 1, i] = work[2 * _MOST + 5, i], aspect * work[2 * _MOST + 6, i]
            jacobian[4, 0, i] = unit * work[0, i] - phi * work[2 * _MOST + 5, i] / rim
            jacobian[4, 1, i] = aspect * (unit * work[1, i] - phi * work[2 * _MOST + 6, i] / rim)
        for k in range(5, last):
            for i in range(n):
                jacobian[k, 0, i], jacobian[k, 1, i] = 0.0, 0.0
        for i in range(n):
            radius = work[2, i]
            inside = min(radius, 1.0)
            j = min(int(inside * _INTERVALS), _INTERVALS - 1)
            t = inside * _INTERVALS - j
            x, y = unit * work[0, i] / (radius + _TINY), aspect * unit * work[1, i] / (radius + _TINY)
            for a in range(_DEGREE + 1):
                if j + a >= 2:
                    row = _HEAD + (j * (_DEGREE + 1) + a) * (_DEGREE + 1)
                    value, slope = _polynomial(state, row, t)
                    value += _INTERVALS * slope * max(radius - 1.0, 0.0)
                    jacobian[3 + j + a, 0, i], jacobian[3 + j + a, 1, i] = value * x, value * y
        for k in range(int(state[1])):
            row = _HEAD + _TABLE + _INTERVALS * (_DEGREE + 1) + 5 * k
            at, m, p, weight = int(state[row]), int(state[row + 2]), int(state[row + 3]), unit * state[row + 4]
            sign = -1.0 if state[row + 1] > 0.0 else 1.0
            for i in range(n):
                a, b, c, d = work[3 + 2 * m, i], work[4 + 2 * m, i], work[3 + 2 * p, i], work[4 + 2 * p, i]
                x, y = weight * (a * c + b * d), weight * (b * c - a * d)
                jacobian[at, 0, i] += x
                jacobian[at, 1, i] += aspect * y
                jacobian[at + 1, 0, i] -= sign * y
                jacobian[at + 1, 1, i] += sign * aspect * x


@dataclass(frozen=True, eq=False)
class _Growth:
    """The profile u + G(u) in rims."""

    along: Array

    def value(self, x: Array) -> Array:
        """At x (N,) or one."""
        u = np.atleast_1d(x)
        return np.asarray((u + _profile_columns(u) @ self.along).reshape(np.shape(x)))

    def slope(self, x: Array) -> Array:
        """Its derivative at x (N,)."""
        return np.asarray(1.0 + _profile_columns(x, 1) @ self.along)

    @cached_property
    def limit(self) -> float:
        """Where it stops growing, `_END` at most."""
        return _first_fall(self.slope)


def _first_fall(growth: Callable[[Array], Array]) -> float:
    """Where a growth (N,) at radii (N,) is first not above 0, `_END` at most."""
    places = np.linspace(0.0, _END, _SAMPLES + 1)
    falling = np.flatnonzero(growth(places) <= 0.0)
    if not len(falling):
        return _END
    low, high = places[max(falling[0] - 1, 0)], places[falling[0]]
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if growth(np.array([middle]))[0] > 0.0 else (low, middle)
    return float(low)


# ---- plain functions, which the kernels compile -----------------------------------------------------------------------


def _polynomial(state: Any, row: int, t: float) -> tuple[float, float]:
    """Value and slope at t of a polynomial of the state."""
    value, slope = state[row + _DEGREE], 0.0
    for d in range(_DEGREE - 1, -1, -1):
        slope = slope * t + value
        value = value * t + state[row + d]
    return value, slope


def _piecewise(state: Any, u: float) -> tuple[float, float]:
    """G and its slope, straight on beyond the last knot."""
    inside = min(u, 1.0)
    j = min(int(inside * _INTERVALS), _INTERVALS - 1)
    value, slope = _polynomial(state, _HEAD + _TABLE + j * (_DEGREE + 1), inside * _INTERVALS - j)
    return value + _INTERVALS * slope * max(u - 1.0, 0.0), _INTERVALS * slope


def _add_monomial(n: int, intrinsics: Any, one: Any, work: Any, image: Any) -> None:
    """c q^m conj(q)^n added to rows 0 and 1 of the image, its derivatives by q and by its conjugate to 2, 3 and 4, 5."""
    at, m, p = int(one[0]), int(one[2]), int(one[3])
    real = one[4] * intrinsics[at]
    imaginary = one[4] * (-intrinsics[at + 1] if one[1] > 0.0 else intrinsics[at + 1])
    for i in range(n):
        a, b, c, d = work[3 + 2 * m, i], work[4 + 2 * m, i], work[3 + 2 * p, i], work[4 + 2 * p, i]
        x, y = a * c + b * d, b * c - a * d
        image[0, i] += real * x - imaginary * y
        image[1, i] += real * y + imaginary * x
    if m > 0:
        for i in range(n):
            a, b, c, d = work[1 + 2 * m, i], work[2 + 2 * m, i], work[3 + 2 * p, i], work[4 + 2 * p, i]
            x, y = m * (a * c + b * d), m * (b * c - a * d)
            image[2, i] += real * x - imaginary * y
            image[3, i] += real * y + imaginary * x
    if p > 0:
        for i in range(n):
            a, b, c, d = work[3 + 2 * m, i], work[4 + 2 * m, i], work[1 + 2 * p, i], work[2 + 2 * p, i]
            x, y = p * (a * c + b * d), p * (b * c - a * d)
            image[4, i] += real * x - imaginary * y
            image[5, i] += real * y + imaginary * x
