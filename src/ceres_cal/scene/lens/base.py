"""Lens models: the map between the direction of a ray and the place where it is measured.

Everything here is about one camera's optics and is independent of pose and principal point. Rays are (N, 3) directions
in the camera frame (x right, y down, z forward; any length), offsets are (N, 2) measured pixels from the principal
point on a sensor with square pixels, and phi is the focal length in pixels. Where a model has no answer (behind the
camera, past its monotone radius) the array functions return NaN.

The maps of the package's own models are in C++ with derivatives (`kernels/core`), for the solve and for arrays; the
paper's is also written for arrays, as in the paper. For any other model the solve calls its array functions.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from types import MappingProxyType
from typing import Any, ClassVar, TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from ceres_cal.base import Array, Indices, InputError, Mask, cached_property, no_such, replace

LinearEquations = tuple[dict[str, Array], Array]
_BLOCK = 16384  # rows at a time, so that the data stay in the cache
# Central differences of fourth order: at this step their own error and that of rounding are both about 1e-12 of a
# slope.
_STEP, _STENCIL, _WEIGHTS = 3e-4, np.array([-2.0, -1.0, 1.0, 2.0]), np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
_PLACES = np.vstack([np.zeros(3), np.kron(np.eye(3), _STENCIL[:, None])])  # the ray itself, and steps along x, y and z
_DIFFERENCES = np.vstack([np.eye(13)[0], np.pad(np.kron(np.eye(3), _WEIGHTS), ((0, 0), (1, 0)))])


def _in_blocks(function: Callable[[Array, float], Array], rows: ArrayLike, phi: float, columns: int) -> Array:
    """Apply a lens's map to any number of rows; NaN in the whole row where the answer is not finite."""
    rows = np.asarray(rows, dtype=float)
    answer, ones = np.empty((len(rows), columns)), np.ones(columns)
    with np.errstate(all="ignore"):  # overflows and divisions by zero end as NaN
        for start in range(0, len(rows), _BLOCK):
            block = function(rows[start : start + _BLOCK], phi)
            block[~np.isfinite(block @ ones)] = np.nan
            answer[start : start + _BLOCK] = block
    return answer


def ahead(rays: Array) -> Array:
    """Return the depths (N, 1) of the rays, NaN behind the camera."""
    return np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)


def unit_rays(across: Array, depth: Array | float) -> Array:
    """Return (N, 3) directions of unit length from their x and y (N, 2) and their z."""
    rays = np.column_stack([across, np.broadcast_to(depth, len(across))])
    return np.asarray(rays / np.hypot(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2])[:, None])


class Roughness(Struct, frozen=True, eq=False):
    """A quadratic form of some coefficients that is small if the lens is smooth.

    Attributes:
        names: of the coefficients. matrix: (K, K); the form over a variance, which the data determine, is prior
            information.
        loose, least: standard deviations, px: before the data are used, and their lower limit.
    """

    names: tuple[str, ...]
    matrix: Array
    loose: float
    least: float


@dataclass(frozen=True)
class Lens(ABC):
    """A lens model with its coefficients. A new kind is a subclass with `register`: nothing else has to know it.

    Attributes:
        values: the coefficients, in the order of `names` and in the units of the files and reports.
        kind: its name in files and options. also_called: its names in other programs, in small letters with dashes.
        acts_on_pixels: whether the coefficients act on radii in pixels, not on directions.
        acts_on_tangents: whether they act on x / z and y / z, each with the power of its order.
        may_fold: whether the model may fold in a corner of the image that nobody observed.
        decentring: names of the coefficients that displace tangentially.
        trial_powers: for kinds with a choice of powers, those worth a trial, the simplest first.
        missing_powers: powers of the radius that a diagnosis tries, lowest first.
        more_terms: further terms that it may have, by name, with the coefficients of each.
        set_at_start: names of numbers that say where the model, or a term of it, is defined: they are chosen, not
            solved for.
    """

    values: tuple[float, ...] = ()
    kind: ClassVar[str]
    also_called: ClassVar[tuple[str, ...]] = ()
    acts_on_pixels: ClassVar[bool] = False
    acts_on_tangents: ClassVar[bool] = False
    may_fold: ClassVar[bool] = True
    decentring: ClassVar[tuple[str, ...]] = ()
    trial_powers: ClassVar[tuple[tuple[int, ...], ...]] = ()
    missing_powers: ClassVar[tuple[int, ...]] = (3, 5, 7, 9, 11)
    more_terms: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({})
    set_at_start: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(map(float, self.values)))
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
    def orders(self) -> tuple[int, ...]:
        """The power of the radius (or of the angle) with which the effect of each coefficient grows."""

    @property
    def powers(self) -> tuple[int, ...]:
        """The powers that were chosen; empty for a kind without a choice."""
        return ()

    @property
    def terms(self) -> tuple[str, ...]:
        """Its terms, among `more_terms`."""
        return ()

    @property
    def nodes(self) -> frozenset[str]:
        """Its coefficients of a surface, which have no meaning one by one."""
        return frozenset()

    @property
    def tangential(self) -> tuple[str, ...]:
        """Its coefficients that displace tangentially."""
        return tuple(name for name in (*self.decentring, *self.more_terms.get("tangential", ())) if name in self.names)

    @property
    def listed(self) -> dict[str, float]:
        """The coefficients that are not `nodes`."""
        return {name: value for name, value in self.coefficients.items() if name not in self.nodes}

    @classmethod
    def blank(cls, powers: Sequence[int]) -> Lens:
        """Return the model with every coefficient 0; powers are for kinds with a choice."""
        return cls()

    @property
    def names_of_terms(self) -> tuple[str, ...]:
        """The coefficients of its further terms."""
        return _names_of_terms(type(self), self.terms)

    def with_terms(self, terms: Collection[str]) -> Lens:
        """Return the same model with these further terms; coefficients that it did not have are 0.

        Raises:
            InputError: its kind has no such terms.
        """
        for term in terms:
            if term not in self.more_terms:
                known = ", ".join(self.more_terms) or "none"
                raise InputError(f"lens {self.kind!r} has no terms {term!r}: there are {known}")
        ordered = tuple(term for term in self.more_terms if term in terms)
        if ordered == self.terms:
            return self
        before, count = self.coefficients, len(self.names) - len(self.names_of_terms)
        names = [*self.names[:count], *(name for term in ordered for name in self.more_terms[term])]
        given: dict[str, Any] = {"values": tuple(before.get(name, 0.0) for name in names), "terms": ordered}
        return replace(self, **given)

    @property
    def coefficients(self) -> dict[str, float]:
        """The coefficients by name, in the units of the files: for `radial` the paper's pixels."""
        return dict(zip(self.names, self.values, strict=True))

    def with_values(self, values: ArrayLike) -> Lens:
        """Return the same model with other coefficients."""
        return replace(self, values=np.asarray(values, dtype=float).tolist())

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
        """Return the measured radius (px) up to which the model is monotone and so has a unique answer, or infinity.

        Where it depends on the direction, the least radius is returned.
        """

    def shows(self, offsets: Array, phi: float) -> Mask:
        """(N,) whether the model has an answer at measured offsets (N, 2) px."""
        return np.asarray(np.hypot(offsets[:, 0], offsets[:, 1]) <= self.monotone_radius(phi))

    @cached_property
    def lengths(self) -> tuple[int, ...]:
        """The power of px in each coefficient's unit; 0 for those that act on directions."""
        return tuple([1 - order for order in self.orders]) if self.acts_on_pixels else (0,) * len(self.names)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each coefficient."""
        return tuple(["1" if power == 0 else "px" if power == 1 else f"px^{power}" for power in self.lengths])

    def after_zoom(self, ratio: float) -> tuple[Lens, Lens]:
        """Return the lens after phi has changed by a ratio, if it distorts rays at the same angle as before, as where a
        picture is enlarged, and if it displaces the same places of the picture by as much as before. Zoom lenses do
        something in between.
        """
        powers = np.array(self.orders, dtype=float) - 1.0
        powers = -powers if self.acts_on_pixels else powers
        other = self.with_values(np.array(self.values) * ratio**powers)
        return (other, self) if self.acts_on_pixels else (self, other)

    @property
    def formula(self) -> str:
        """The model in one line, for the report; empty where one line is not enough."""
        return ""

    @property
    def note(self) -> str:
        """What a calibration's summary says about the coefficients; empty where they need no explanation."""
        return ""

    def scales(self, unit_px: float) -> Array:
        """Return factors that bring each coefficient to order one, for the solver (design, section 4)."""
        return np.asarray(float(unit_px) ** -np.array(self.lengths, dtype=float))

    def natural_sizes(self, phi: float, unit_px: float) -> list[float]:
        """Return the size of each coefficient that moves a pixel `unit_px` from the middle by as much."""
        each = zip(self.lengths, self.orders, strict=True)
        return [unit_px**power if power else (unit_px / phi) ** (1 - order) for power, order in each]

    def spanning(self, angle: float, phi: float, beyond: float, image_size: tuple[int, int]) -> Lens:
        """Return the model made for a picture of this size that is seen up to an angle, and `beyond` times as far in
        pixels; a model that was made for a picture before keeps that.
        """
        return self

    @property
    def roughness(self) -> tuple[Roughness, ...]:
        """Quadratic forms that are small if the lens is smooth; none for a formula, which is smooth by itself."""
        return ()

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        """Return columns by coefficient name and the right side of equations that are linear in the coefficients.

        Without columns the solve starts from a lens without distortion.

        Args:
            measured: (N,) radii, px. ideal: (N,) phi times the tangent of the ray's angle to the axis, px, NaN from
                about 90 degrees on. angle: (N,) that angle.
        """
        return {}, np.zeros_like(measured)

    def radial_change(self, offsets: Array, phi: float, unit_px: float, powers: Indices) -> Array:
        """(N, P) px by which offsets (N, 2) grow with one more term of each power, with a coefficient of order one."""
        return np.asarray(unit_px * (np.hypot(offsets[:, :1], offsets[:, 1:]) / unit_px) ** powers)

    # ---- for the solve -----------------------------------------------------------------------------------------------

    @property
    def form(self) -> Array:
        """(F,) numbers that select the compiled formulas of its kind; empty where there are none."""
        return np.empty(0)

    def with_scaled(self, scaled: Array, unit_px: float) -> Lens:
        """Return the same model with other coefficients, given as multiplied by their `scales`."""
        return self.with_values(scaled / self.scales(unit_px))

    def slopes_by_ray(self, rays: Array, phi: float) -> Array:
        """(N, 2, 4) offsets of rays (N, 3), px, and their derivatives by the ray's x, y and z; NaN where there is no
        answer. They are computed by differences, to about 12 digits; a model may have formulas instead.
        """
        step = _STEP * np.sqrt(np.sum(rays * rays, axis=1))
        there = rays + step[:, None] * _PLACES[:, None]
        seen = self.distort(there.reshape(-1, 3), phi).reshape(len(_PLACES), -1)
        slopes = (_DIFFERENCES @ seen).reshape(4, -1, 2)
        slopes[1:] /= step[:, None]
        return np.ascontiguousarray(np.moveaxis(slopes, 0, 2))

    def slopes_by_number(self, rays: Array, phi: float, unit_px: float) -> Array:
        """(N, 2, 1 + K) derivatives of the offsets of rays (N, 3) by phi, and by each coefficient times its scale,
        computed in the same way.
        """
        steps, values = _STEP / self.scales(unit_px), np.array(self.values)
        moved = [[self.distort(rays, phi + k * _STEP * phi) for k in _STENCIL]]
        for own in np.diag(steps):
            moved.append([self.with_values(values + k * own).distort(rays, phi) for k in _STENCIL])
        sizes = np.array([_STEP * phi, *[_STEP] * len(values)])
        return np.asarray(np.einsum("akni,k->nia", np.array(moved), _WEIGHTS) / sizes)


@cache
def _names_of_terms(model: type[Lens], terms: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for term, names in model.more_terms.items() if term in terms for name in names)


def required_powers(kind: str, powers: Sequence[int], most: int, fewest: int = 0) -> tuple[int, ...]:
    """Return the powers of a lens; InputError where they are not different whole numbers from 2 on, or too few."""
    whole = tuple(map(int, powers))
    distinct = len({*whole}) == len(whole) >= fewest and whole == tuple(powers)
    if not distinct or not all(2 <= power <= most for power in whole):
        raise InputError(
            f"powers of the {kind} lens must be different whole numbers from 2 to {most}, not {tuple(powers)}"
        )
    return whole


_L = TypeVar("_L", bound=Lens)
LENSES: dict[str, type[Lens]] = {}
"""Every kind of lens, by its name: options, files, diagnosis and command line offer these."""


def register(lens: type[_L]) -> type[_L]:
    """Add a kind of lens to the table; this is a decorator.

    Raises:
        InputError: the table has another lens with that name.
    """
    if LENSES.setdefault(lens.kind, lens) is not lens:
        raise InputError(f"there is a lens {lens.kind!r} already: give the new one a kind of its own")
    return lens


def lens_class(kind: str, also: Sequence[str] = ()) -> type[Lens]:
    """Return the lens model with a name.

    Args:
        also: other words that may stand there.

    Raises:
        InputError: there is none; the message says which lens has this name in other programs.
    """
    if kind not in LENSES:
        common = str(kind).lower().replace("_", "-")
        here = [one for one, lens in LENSES.items() if common in lens.also_called]
        raise InputError(
            f"there is no lens {kind!r}: here it is {here[0]!r}" if here else no_such("lens", kind, (*also, *LENSES))
        )
    return LENSES[kind]


def make_lens(
    kind: str,
    powers: Sequence[int] = (2, 3),
    coefficients: Mapping[str, float] | None = None,
    terms: Collection[str] = (),
) -> Lens:
    """Return a lens by the name of its model, with the terms that are requested or have a coefficient; coefficients
    that are not given are 0.

    Raises:
        InputError: an unknown kind, term or coefficient, or powers that make no lens.
    """
    given = dict(coefficients or {})
    model = lens_class(kind)
    named = {term for term, names in model.more_terms.items() if {*names} & {*given}}
    blank = _blank(model, tuple(powers), frozenset({*terms, *named}))
    for name in given:
        if name not in blank.names:
            raise InputError(f"lens {kind!r} has no coefficient {name!r}: it has {', '.join(blank.names)}")
    return blank.with_values([given.get(name, 0.0) for name in blank.names]) if given else blank


@lru_cache(maxsize=64)
def _blank(model: type[Lens], powers: tuple[int, ...], terms: frozenset[str]) -> Lens:
    return model.blank(powers).with_terms(terms)
