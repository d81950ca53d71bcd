"""By how much what is named as wrong with the model moves a result: places on the field, a camera's own numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.effects.effect import Finding
from ceres_cal.posterior.maps import FieldMap, locate_slopes, visible_pixels
from ceres_cal.posterior.uncertainty import Uncertainty
from ceres_cal.problem.information import Key, over
from ceres_cal.problem.parameters import OF_PIXELS

_WITHIN = 2.0  # times its root mean square, how far what a fault leaves reaches


@dataclass(frozen=True, eq=False)
class FaultyMap:
    """A map of a station at one height, and by how much faults move its places.

    Attributes:
        of: the map. moved_mm: (Y, X). left_mm: what the faults do besides to what was observed, root mean square.
    """

    of: FieldMap
    moved_mm: Array
    left_mm: float

    @property
    def radius_95_mm(self) -> Array:
        """(Y, X) with the faults counted."""
        return np.asarray(np.sqrt(self.of.radius_95_mm**2 + self.moved_mm**2 + (_WITHIN * self.left_mm) ** 2))

    @property
    def sigmas(self) -> float:
        """By how many standard deviations the faults move places, root mean squares over what is known; else 0."""
        known = np.isfinite(self.of.sd_mm) & np.isfinite(self.moved_mm)
        sd = float(np.sqrt(np.sum(self.of.sd_mm[known] ** 2)))
        return float(np.sqrt(np.sum(self.moved_mm[known] ** 2))) / sd if sd > 0.0 else 0.0


def faulty_map(known: Uncertainty, of: FieldMap, faults: Sequence[Finding]) -> FaultyMap:
    """A map with faults counted, which are taken for independent of one another."""
    moved_mm, keys = np.zeros(of.shape), known.posterior.keys
    if faults:
        pixels = visible_pixels(known.estimate, of.station, of.places, of.height_m)
        own = known.posterior.keys_of(known.estimate, of.station)
        slopes = locate_slopes(known.estimate, own, of.station, pixels, of.height_m)
        steps = over(np.array([_step(fault, keys) for fault in faults]), keys, own)
        moved_mm = 1e3 * np.sqrt(np.sum((slopes @ steps.T) ** 2, axis=(1, 2))).reshape(of.shape)
    return FaultyMap(of, moved_mm, float(np.sqrt(np.nansum([fault.effect_mm**2 for fault in faults]))))


def sigmas_of_cameras(known: Uncertainty, faults: Sequence[Finding]) -> float:
    """By how many of its standard deviations the number of a camera that faults move farthest is moved; coefficients
    are not looked at, which trade off against one another.
    """
    keys, sd = known.posterior.keys, known.posterior.sd
    own = np.array([key.kind == "camera" and key.quantity in OF_PIXELS for key in keys], dtype=bool)
    if not (faults and own.any()):
        return 0.0
    squares = np.sum([_step(fault, keys) ** 2 for fault in faults], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.nanmax(np.sqrt(squares[own]) / sd[own]))


def _step(fault: Finding, keys: Sequence[Key]) -> Array:
    """(K,) by how much it moves some numbers."""
    moves = dict(fault.moves)
    return np.array([moves.get(key, 0.0) for key in keys])
