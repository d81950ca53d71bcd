"""The paper's lens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from types import MappingProxyType
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import Array, Indices, InputError, cached_property
from ceres_cal.scene.lens.base import Lens, LinearEquations, ahead, required_powers, unit_rays
from ceres_cal.scene.lens.planar import (
    Profile,
    dense_polynomial,
    derivative,
    horner,
    invert_increasing,
    inverted,
    less,
    ratio,
)


@dataclass(frozen=True)
class Radial(Lens):
    """The paper's lens: r' = r + sum a_k r^k from the measured radius r to the ideal one r', both in pixels.

    Section 2 of the paper, with a1 = 1: scaling a1, a2, a3 and phi together changes nothing, so phi is the focal length
    at the centre. `powers` (2, 3) is the paper's own choice, (3,) is ssl-vision's model with a3 = distortion / phi^2.
    The coefficient of power k is named a<k> and has the unit px^(1-k). Brown's optional decentring p1 and p2 also takes
    the measured point to the ideal one, as in his own paper (Decentering Distortion of Lenses, 1966), but with the
    opposite sign, so that p1 and p2 displace what is measured as OpenCV's do; the paper has none.
    """

    powers: tuple[int, ...] = (2, 3)
    terms: tuple[str, ...] = ()
    kind: ClassVar[str] = "radial"
    acts_on_pixels: ClassVar[bool] = True
    may_fold: ClassVar[bool] = False  # the paper's polynomial need not fold
    trial_powers: ClassVar[tuple[tuple[int, ...], ...]] = ((3,), (2, 3), (3, 5), (2, 3, 4), (2, 3, 4, 5))
    missing_powers: ClassVar[tuple[int, ...]] = (2, 3, 4, 5, 6, 7)
    more_terms: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({"tangential": ("p1", "p2")})

    def __post_init__(self) -> None:
        most_power = 30  # the square of 100,000 px to this power does not overflow
        object.__setattr__(self, "powers", required_powers(self.kind, self.powers, most_power, fewest=1))
        super().__post_init__()

    @property
    def names(self) -> tuple[str, ...]:
        return (*(f"a{p}" for p in self.powers), *self.names_of_terms)

    @property
    def orders(self) -> tuple[int, ...]:
        return (*self.powers, *(2 for _ in self.names_of_terms))

    @property
    def lengths(self) -> tuple[int, ...]:
        return (*(1 - power for power in self.powers), *(0 for _ in self.names_of_terms))

    @classmethod
    def blank(cls, powers: Sequence[int]) -> Radial:
        return cls((0.0,) * len(tuple(powers)), tuple(powers))

    @property
    def formula(self) -> str:
        return "r' = r + " + " + ".join(f"a{p}r^{p}" for p in self.powers)

    @property
    def note(self) -> str:
        if self.powers != (2, 3):
            return ""
        return "coefficients use the paper's notation with a1 = 1"

    @classmethod
    def from_paper(cls, a1: float, a2: float, a3: float, phi: float) -> tuple[Radial, float]:
        """Return the paper's triple with its own a1 and its phi, as (lens, phi) in the gauge a1 = 1.

        Raises:
            InputError: a1 is not positive.
        """
        if not a1 > 0.0:
            raise InputError(f"a1 of the paper's polynomial must be positive, not {a1}")
        return cls((a2 / a1, a3 / a1)), phi / a1

    def paper_coefficients(self, a1: float) -> tuple[float, ...]:
        """Return (a1, a2, a3, ...) in the paper's scaling, which belongs to the focal length phi * a1."""
        return (a1, *(a1 * v for v in self._along))

    @property
    def _along(self) -> tuple[float, ...]:
        """The coefficients along the radius."""
        return self.values[: len(self.powers)]

    @property
    def _across(self) -> tuple[float, float]:
        """p1 and p2; 0 where the lens has none."""
        p1, p2 = self.values[len(self.powers) :] or (0.0, 0.0)
        return p1, p2

    @cached_property
    def _polynomial(self) -> Array:
        """The map along a radius, lowest power first: r + sum a_k r^k."""
        return dense_polynomial(self._along, self.powers)

    @lru_cache(maxsize=256)  # noqa: B019 a camera that is moved keeps its lens
    def _profile(self, phi: float) -> Profile:
        """Return that map in units of phi, in the direction in which decentring reduces it most, by 3 |p| r^2."""
        along = dense_polynomial(self._along * phi ** np.subtract(self.powers, 1.0), self.powers)
        return ratio(less(along, np.array([0.0, 0.0, 3.0 * np.hypot(*self._across)])))

    def ideal_radius(self, measured_radius: ArrayLike) -> Array:
        """Return r' of r, both in px (paper, section 2); the monotone radius is not checked."""
        return horner(self._polynomial, np.asarray(measured_radius, dtype=float))

    def measured_radius(self, ideal_radius: ArrayLike) -> Array:
        """Return r of r', both in px: the inverse of `ideal_radius` up to the monotone radius, NaN beyond."""
        ideal = np.asarray(ideal_radius, dtype=float)
        with np.errstate(all="ignore"):
            return invert_increasing(ratio(self._polynomial), ideal.ravel()).reshape(ideal.shape)

    def _distort(self, rays: Array, phi: float) -> Array:
        profile, ideal = self._profile(phi), rays[:, :2] / ahead(rays)
        measured = inverted(profile, ideal, partial(self._mapped, phi=phi) if any(self._across) else None)
        return np.where(np.hypot(measured[:, :1], measured[:, 1:]) <= profile.limit, phi * measured, np.nan)

    def _undistort(self, offsets: Array, phi: float) -> Array:
        ideal = self._ideal(offsets / phi, phi).T
        return unit_rays(np.where(self.shows(offsets, phi)[:, None], ideal, np.nan), 1.0)

    def _ideal(self, flat: Array, phi: float) -> Array:
        """(2, N) ideal points of measured ones (N, 2), both in units of phi."""
        (p1, p2), (x, y) = self._across, flat.T
        ideal = flat.T * horner(self._polynomial[1:], phi * np.hypot(x, y))
        if p1 or p2:  # Brown's decentring
            ideal -= 2.0 * p1 * x * y + p2 * (3.0 * x * x + y * y), p1 * (x * x + 3.0 * y * y) + 2.0 * p2 * x * y
        return ideal

    def _mapped(self, flat: Array, phi: float) -> Array:
        """(2, 3, N) ideal points of measured ones (N, 2) in units of phi, and their derivatives by these x, y."""
        (p1, p2), (x, y), radius = self._across, flat.T, phi * np.hypot(flat[:, 0], flat[:, 1])
        stretch, slope = horner(self._polynomial[1:], radius), horner(derivative(self._polynomial), radius)
        bend = np.where(radius > 0.0, (slope - stretch) / (radius / phi) ** 2, 0.0)
        across, down = p1 * x + p2 * y, p1 * y + p2 * x  # halves of the decentring's derivatives
        xy = bend * x * y - 2.0 * across
        xx = stretch + bend * x * x - 2.0 * (down + 2.0 * p2 * x)
        yy = stretch + bend * y * y - 2.0 * (down + 2.0 * p1 * y)
        ideal_x, ideal_y = self._ideal(flat, phi)
        return np.array([[ideal_x, xx, xy], [ideal_y, xy, yy]])

    def monotone_radius(self, phi: float) -> float:
        return phi * self._profile(phi).limit

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        return {name: measured**power for name, power in zip(self.names, self.powers, strict=False)}, ideal - measured

    def radial_change(self, offsets: Array, phi: float, unit_px: float, powers: Indices) -> Array:
        # The ideal radius grows by r^k, so the measured one shrinks by r^k over the polynomial's slope.
        radius = np.hypot(offsets[:, :1], offsets[:, 1:]) / unit_px
        scaled = (np.asarray(self.values) * self.scales(unit_px))[: len(self.powers)]
        slope = 1.0 + sum(k * a * radius ** (k - 1) for k, a in zip(self.powers, scaled, strict=True))
        return np.asarray(unit_px * radius**powers / np.maximum(slope, 0.05))

    @property
    def form(self) -> Array:
        """The position of p1 among the intrinsics, 0 if absent, and the powers."""
        return np.array([4.0 + len(self.powers) if self.terms else 0.0, *self.powers])
