"""Where on the field two calibrations differ, how far the cameras stand apart, and whether their uncertainties explain
it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.tails import upper_tail
from ceres_cal.calibration import Calibration
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.quantities import difference
from ceres_cal.moves.poses import movement
from ceres_cal.uncertainty.maps import ErrorMap, Grid, field_map, visible_pixels
from ceres_cal.uncertainty.uncertainty import field_grid

# Probability below which uncertainty alone does not explain a difference; that often two sound calibrations differ.
# At half of it nothing changes, at double one of six pairs does.
_DOUBTFUL = 0.01


@dataclass(frozen=True, eq=False)
class StationComparison(ErrorMap):
    """One station in two calibrations, a and b, and a map of their difference.

    Attributes:
        moved_mm, turned_deg: from a to b. phi_px: of a and of b.
        difference_mm: (Y, X, 2) where b locates what a sees there, less the place itself; NaN where a does not show it.
        expected_mm: (Y, X) standard deviation of its length if nothing but noise lies between a and b, whose errors
            count as independent; NaN where that cannot be said.
        probability: of numbers as far apart or farther, from their uncertainties alone; None where one of the two does
            not say how well it is known, or has other free numbers.
    """

    station: str
    moved_mm: float
    turned_deg: float
    phi_px: tuple[float, float]
    difference_mm: Array
    expected_mm: Array
    probability: float | None

    @property
    def errors_mm(self) -> Array:
        """(Y, X) length of the difference; NaN where a does not show the place."""
        return np.asarray(np.linalg.norm(self.difference_mm, axis=2))

    @property
    def explained(self) -> bool | None:
        """Whether the uncertainties explain the difference; None where they are not known."""
        return None if self.probability is None else self.probability >= _DOUBTFUL


def compare(
    a: Calibration, b: Calibration, height_m: float = 0.0, station: str | None = None
) -> list[StationComparison]:
    """Compare two calibrations, station by station.

    The two count as independent of each other. Where b is a refit of a they share what was known before, and the
    difference that is to be expected is smaller than stated.

    Raises:
        InputError: no station that both have, or not the one named; no field to draw a map of.
    """
    common = [name for name in a.estimate.stations if name in b.estimate.stations]
    if station is not None and station not in common:
        raise InputError(f"station {station!r} is not in both calibrations: both have {_listed(common)}")
    if not common:
        raise InputError(
            f"no station is in both calibrations: one has {_listed(list(a.estimate.stations))}, the other "
            f"{_listed(list(b.estimate.stations))}"
        )
    return [_compared(a, b, name, height_m) for name in ([station] if station is not None else common)]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names)) or "none"


def _compared(a: Calibration, b: Calibration, station: str, height_m: float) -> StationComparison:
    first, second = a.station(station), b.station(station)
    grid = Grid(height_m, *field_grid(a.targets))
    pixels = visible_pixels(a.estimate, station, grid.places, height_m)
    off = 1e3 * (second.locate(pixels, height_m) - grid.places)
    shift_m, turn = movement(second.cam_from_world, first.cam_from_world)
    known = [c for c in (a, b) if c.posterior is not None and c.posterior.knows_station(station)]
    return StationComparison(
        height_m,
        grid.x_m,
        grid.y_m,
        station,
        1e3 * shift_m,
        float(np.degrees(turn)),
        (first.phi, second.phi),
        off.reshape(*grid.shape, 2),
        _expected_mm(a, b, station, grid) if len(known) == 2 else np.full(grid.shape, np.nan),
        _probability(a, b, station) if len(known) == 2 else None,
    )


def _expected_mm(a: Calibration, b: Calibration, station: str, grid: Grid) -> Array:
    maps = [field_map(c.estimate, c.uncertainty.posterior, station, grid).sd_mm for c in (a, b)]
    return np.asarray(np.hypot(*maps))


def _probability(a: Calibration, b: Calibration, station: str) -> float | None:
    """Of a chi-squared as large: the difference d under (A^-1 + B^-1)^-1 = A (A + B)^+ B, which needs no inverse of
    either information where a direction is unknown.
    """
    keys, others = (c.uncertainty.posterior.keys_of(c.estimate, station) for c in (a, b))
    if set(keys) != set(others):
        return None
    first, second = (c.uncertainty.posterior.information.marginal(keys) for c in (a, b))
    both = first.matrix @ (first + second).inverse @ second.matrix
    off = difference(_only(b, station), _only(a, station), keys)
    degrees = min(first.known_rank, second.known_rank)
    return upper_tail(float(off @ both @ off), degrees) if degrees > 0 else None


def _only(calibration: Calibration, station: str) -> Estimate:
    """One station and its camera."""
    old = calibration.estimate
    camera = old.stations[station].camera
    return Estimate({camera: old.cameras[camera]}, {station: old.stations[station]}, {}, old.structure)
