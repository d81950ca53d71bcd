"""The paper's lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array
from ceres_cal.base.cached import cached_property
from ceres_cal.base.errors import InputError
from ceres_cal.scene.lens.base import Lens, LinearEquations, ahead, unit_rays
from ceres_cal.scene.lens.planar import Ratio, dense_polynomial, horner, invert_increasing

_MOST_POWER = 30  # 100,000 px to this power has a square that a computer holds


@dataclass(frozen=True)
class Radial(Lens):
    """The paper's lens: r' = r + sum a_k r^k from the measured radius r to the ideal one r', both in pixels.

    Section 2 of the paper, with a1 = 1: scaling a1, a2, a3 and phi together changes nothing, so phi is the focal length
    at the centre. `powers` (2, 3) is the paper's own choice, (3,) is ssl-vision's model with a3 = distortion / phi^2.
    The coefficient of power k is named a<k> and has the unit px^(1-k).
    """

    powers: tuple[int, ...] = (2, 3)
    kind: ClassVar[str] = "radial"
    acts_on_pixels: ClassVar[bool] = True
    may_fold: ClassVar[bool] = False  # the paper's polynomial can be had without a fold
    trial_powers: ClassVar[tuple[tuple[int, ...], ...]] = ((3,), (2, 3), (3, 5), (2, 3, 4), (2, 3, 4, 5))
    missing_powers: ClassVar[tuple[int, ...]] = (2, 3, 4, 5, 6, 7)

    def __post_init__(self) -> None:
        powers = tuple(int(p) for p in self.powers)
        distinct = powers and len(set(powers)) == len(powers) and powers == tuple(self.powers)
        if not distinct or not all(2 <= power <= _MOST_POWER for power in powers):
            raise InputError(
                f"powers of the radial lens must be different whole numbers from 2 to {_MOST_POWER}, not {self.powers}"
            )
        object.__setattr__(self, "powers", powers)
        super().__post_init__()

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"a{p}" for p in self.powers)

    @property
    def orders(self) -> tuple[int, ...]:
        return self.powers

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
        return "these are the paper's, with its a1 = 1: another a1 goes with a1 a2, a1 a3 and a1 phi"

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
        """The map along a radius, lowest power first: r + sum a_k r^k."""
        return dense_polynomial(self.values, self.powers)

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
        return np.asarray(ideal * shrink[:, None])

    def _undistort(self, offsets: Array, phi: float) -> Array:
        radius = np.hypot(offsets[:, 0], offsets[:, 1])
        stretch = np.where(radius <= self._limit, horner(self._polynomial[1:], radius), np.nan)
        return unit_rays(offsets * stretch[:, None], phi)

    def monotone_radius(self, phi: float) -> float:
        return self._limit

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        return {name: measured**power for name, power in zip(self.names, self.powers, strict=True)}, ideal - measured

    def radial_change(self, offsets: Array, phi: float, unit_px: float, power: int) -> Array:
        # The ideal radius grows by r^k: the measured one shrinks by the polynomial's slope.
        radius = np.hypot(offsets[:, 0], offsets[:, 1]) / unit_px
        scaled = np.asarray(self.values) * self.scales(unit_px)
        slope = 1.0 + sum(k * a * radius ** (k - 1) for k, a in zip(self.powers, scaled, strict=True))
        return np.asarray(unit_px * radius**power / np.maximum(slope, 0.05))

    @property
    def form(self) -> Array:
        """The powers."""
        return np.array(self.powers, dtype=float)
