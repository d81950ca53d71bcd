"""The paper's lens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import Array, Indices, InputError, cached_property
from ceres_cal.scene.lens.base import Lens, LinearEquations, ahead, unit_rays
from ceres_cal.scene.lens.planar import Ratio, dense_polynomial, horner, invert_increasing


@dataclass(frozen=True)
class Radial(Lens):
    """The paper's lens: r' = r + sum a_k r^k from the measured radius r to the ideal one r', both in pixels.

    Section 2 of the paper, with a1 = 1: scaling a1, a2, a3 and phi together changes nothing, so phi is the focal length
    at the centre. `powers` (2, 3) is the paper's own choice, (3,) is ssl-vision's model with a3 = distortion / phi^2.
    The coefficient of power k is named a<k> and has the unit px^(1-k). Brown's decentring p1 and p2 of the ideal point
    (x/z, y/z), where they are asked for, displaces what is measured; the paper has none.
    """

    powers: tuple[int, ...] = (2, 3)
    terms: tuple[str, ...] = ()
    kind: ClassVar[str] = "radial"
    acts_on_pixels: ClassVar[bool] = True
    may_fold: ClassVar[bool] = False  # the paper's polynomial can be had without a fold
    trial_powers: ClassVar[tuple[tuple[int, ...], ...]] = ((3,), (2, 3), (3, 5), (2, 3, 4), (2, 3, 4, 5))
    missing_powers: ClassVar[tuple[int, ...]] = (2, 3, 4, 5, 6, 7)
    more_terms: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({"tangential": ("p1", "p2")})

    def __post_init__(self) -> None:
        most_power = 30  # 100,000 px to this power has a square that a computer holds
        powers = tuple(int(p) for p in self.powers)
        distinct = powers and len(set(powers)) == len(powers) and powers == tuple(self.powers)
        if not distinct or not all(2 <= power <= most_power for power in powers):
            raise InputError(
                f"powers of the radial lens must be different whole numbers from 2 to {most_power}, not {self.powers}"
            )
        object.__setattr__(self, "powers", powers)
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
        """The paper's triple with its own a1 and its phi, as (lens, phi) in the gauge a1 = 1.

        Raises:
            InputError: a1 is not positive.
        """
        if not a1 > 0.0:
            raise InputError(f"a1 of the paper's polynomial must be positive, not {a1}")
        return cls((a2 / a1, a3 / a1)), phi / a1

    def paper_coefficients(self, a1: float) -> tuple[float, ...]:
        """(a1, a2, a3, ...) in the paper's scaling; it goes with phi * a1."""
        return (a1, *(a1 * v for v in self._along))

    @property
    def _along(self) -> tuple[float, ...]:
        """The coefficients along the radius."""
        return self.values[: len(self.powers)]

    @property
    def _across(self) -> tuple[float, ...]:
        """p1 and p2; nothing where they are 0."""
        across = self.values[len(self.powers) :]
        return across if any(across) else ()

    def _decentring(self, flat: Array) -> Array:
        """By how much ideal points (N, 2) are displaced, at focal length 1."""
        (p1, p2), (x, y) = self._across, flat.T
        both, r2 = 2.0 * x * y, x * x + y * y
        return np.column_stack([p1 * both + p2 * (r2 + 2.0 * x * x), p1 * (r2 + 2.0 * y * y) + p2 * both])

    @property
    def _polynomial(self) -> Array:
        """The map along a radius, lowest power first: r + sum a_k r^k."""
        return dense_polynomial(self._along, self.powers)

    @cached_property
    def _profile(self) -> Ratio:
        """That map, as it is inverted."""
        return Ratio(self._polynomial)

    @property
    def _limit(self) -> float:
        """Where it stops growing; infinity where it never does."""
        return self._profile.limit

    def ideal_radius(self, measured_radius: ArrayLike) -> Array:
        """r' of r, both in px (paper, section 2); no check of the monotone radius."""
        return horner(self._polynomial, np.asarray(measured_radius, dtype=float))

    def measured_radius(self, ideal_radius: ArrayLike) -> Array:
        """r of r', both in px: the inverse of `ideal_radius` up to the monotone radius, NaN beyond."""
        ideal = np.asarray(ideal_radius, dtype=float)
        with np.errstate(all="ignore"):
            return invert_increasing(self._profile, ideal.ravel()).reshape(ideal.shape)

    def _distort(self, rays: Array, phi: float) -> Array:
        ideal = phi * rays[:, :2] / ahead(rays)
        radius = np.hypot(ideal[:, 0], ideal[:, 1])
        shrink = np.where(radius > 0.0, self.measured_radius(radius) / radius, 1.0)
        measured = np.asarray(ideal * shrink[:, None])
        return measured + phi * self._decentring(ideal / phi) if self._across else measured

    def _undistort(self, offsets: Array, phi: float) -> Array:
        steps = 30  # of a fixed point, each of which gains some two digits
        ideal = self._ideal(offsets)
        if self._across:
            for _ in range(steps):
                before, ideal = ideal, self._ideal(offsets - phi * self._decentring(ideal / phi))
                if not np.nanmax(np.abs(ideal - before), initial=0.0) > 1e-12 * phi:
                    break
            ideal[np.any(np.abs(ideal - before) > 1e-9 * phi, axis=1)] = np.nan
        return unit_rays(ideal, phi)

    def _ideal(self, measured: Array) -> Array:
        """Ideal points (N, 2) of measured ones along the radius alone, px; NaN beyond the limit."""
        radius = np.hypot(measured[:, 0], measured[:, 1])
        stretch = np.where(radius <= self._limit, horner(self._polynomial[1:], radius), np.nan)
        return np.asarray(measured * stretch[:, None])

    def monotone_radius(self, phi: float) -> float:
        return self._limit

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        return {name: measured**power for name, power in zip(self.names, self.powers, strict=False)}, ideal - measured

    def radial_change(self, offsets: Array, phi: float, unit_px: float, powers: Indices) -> Array:
        # The ideal radius grows by r^k: the measured one shrinks by the polynomial's slope.
        radius = np.hypot(offsets[:, :1], offsets[:, 1:]) / unit_px
        scaled = (np.asarray(self.values) * self.scales(unit_px))[: len(self.powers)]
        slope = 1.0 + sum(k * a * radius ** (k - 1) for k, a in zip(self.powers, scaled, strict=True))
        return np.asarray(unit_px * radius**powers / np.maximum(slope, 0.05))

    @property
    def form(self) -> Array:
        """The place of p1 among the intrinsics, 0 for none, and the powers."""
        return np.array([4.0 + len(self.powers) if self.terms else 0.0, *self.powers])
