"""Where two calibrations differ, on the field and over the image, how far the cameras stand apart, and whether their
uncertainties explain it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, median
from ceres_cal.base.errors import InputError
from ceres_cal.base.numerical import numerical
from ceres_cal.base.tails import upper_tail
from ceres_cal.base.transforms import nearest_rotation, rotation_log
from ceres_cal.calibration import Calibration
from ceres_cal.moves.poses import movement
from ceres_cal.posterior.maps import ErrorMap, FieldGrid, field_map, visible_pixels
from ceres_cal.posterior.uncertainty import field_grid
from ceres_cal.problem.information import Key
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.quantities import difference
from ceres_cal.problem.structure import EXACT

# Probability below which uncertainty alone does not explain a difference; that often two sound calibrations differ.
# At half of it nothing changes, at double one of six pairs does.
_DOUBTFUL = 0.01
_COLUMNS = 41  # of the grid over an image
_ROUNDS = 20  # of reweighting


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


@numerical("the comparison")
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
    grid = FieldGrid(height_m, *field_grid(a.targets))
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


def _expected_mm(a: Calibration, b: Calibration, station: str, grid: FieldGrid) -> Array:
    maps = [field_map(c.estimate, c.uncertainty.posterior, station, grid).sd_mm for c in (a, b)]
    return np.asarray(np.hypot(*maps))


def _probability(a: Calibration, b: Calibration, station: str) -> float | None:
    """See `StationComparison`."""
    keys, others = (c.uncertainty.posterior.keys_of(c.estimate, station) for c in (a, b))
    return (
        _chance(a, b, keys, difference(_only(b, station), _only(a, station), keys))
        if set(keys) == set(others)
        else None
    )


def _chance(a: Calibration, b: Calibration, keys: Sequence[Key], off: Array) -> float | None:
    """Of a chi-squared as large: the difference d under (A^-1 + B^-1)^-1 = A (A + B)^+ B, which needs no inverse of
    either information where a direction is unknown.
    """
    first, second = (c.uncertainty.posterior.information.marginal(keys) for c in (a, b))
    both = first.matrix @ (first + second).inverse @ second.matrix
    degrees = min(first.known_rank, second.known_rank)
    return upper_tail(float(off @ both @ off), degrees) if degrees > 0 else None


def _only(calibration: Calibration, station: str) -> Estimate:
    """One station and its camera."""
    old = calibration.estimate
    camera = old.stations[station].camera
    return Estimate({camera: old.cameras[camera]}, {station: old.stations[station]}, {}, old.structure)


# ---- over the image -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class CameraComparison:
    """The intrinsics of one camera in two calibrations, a and b, over its image.

    Attributes:
        camera: its name in a. phi_px: of a and of b.
        x_px (X,), y_px (Y,): a grid over the image.
        difference_px: (Y, X, 2) where b sees the direction that a sees at a pixel, less the pixel; NaN where either has
            no answer. angles_deg: (Y, X) between the directions that a and b see there.
        turn_deg: of b's directions to those of a, which was taken out; 0 where that was not asked for.
        probability: of intrinsics as far apart or farther, from their uncertainties alone; None where one of the two
            does not say how well they are known, or has other free ones.
    """

    camera: str
    phi_px: tuple[float, float]
    x_px: Array
    y_px: Array
    difference_px: Array
    angles_deg: Array
    turn_deg: float
    probability: float | None

    @property
    def errors_px(self) -> Array:
        """(Y, X) length of the difference; NaN where either has no answer."""
        return np.asarray(np.linalg.norm(self.difference_px, axis=2))

    @property
    def explained(self) -> bool | None:
        """Whether the uncertainties explain the difference; None where they are not known."""
        return None if self.probability is None else self.probability >= _DOUBTFUL


def compare_cameras(
    a: Calibration, b: Calibration, camera: str | None = None, *, without_turn: bool = False
) -> list[CameraComparison]:
    """Compare the intrinsics of two calibrations, camera by camera; neither needs a field.

    Args:
        camera: this one alone, by its name in both; else all that both have, or the only one of each.
        without_turn: take out the rotation that most directions agree on: another principal point looks much like a
            camera that is turned.

    Raises:
        InputError: no camera that both have, or not the one named; images of other sizes.
    """
    pairs = [(name, name) for name in a.cameras if name in b.cameras]
    if not pairs and len(a.cameras) == len(b.cameras) == 1:
        pairs = [(next(iter(a.cameras)), next(iter(b.cameras)))]
    pairs = [pair for pair in pairs if camera in (None, pair[0])]
    if not pairs:
        asked = "no camera" if camera is None else f"camera {camera!r}"
        raise InputError(f"{asked} is in both calibrations: {_listed([*a.cameras])}, and {_listed([*b.cameras])}")
    return [_camera_compared(a, b, *pair, without_turn) for pair in pairs]


def _camera_compared(a: Calibration, b: Calibration, name: str, other: str, without_turn: bool) -> CameraComparison:
    first, second = a.cameras[name], b.cameras[other]
    if first.image_size != second.image_size:
        sizes = " and ".join(f"{w} x {h} px" for w, h in (first.image_size, second.image_size))
        raise InputError(f"camera {name!r}: its images are of {sizes}: calibrations of one size can be compared")
    width, height = first.image_size
    x, y = (np.linspace(0.0, n - 1.0, max(2, round(_COLUMNS * n / width))) for n in (width, height))
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    seen, also = first.rays(pixels), second.rays(pixels)
    both = np.isfinite(seen[:, 0]) & np.isfinite(also[:, 0])
    turn = _common_turn(seen[both], also[both]) if without_turn else np.eye(3)
    turned = seen @ turn.T
    angles = 2.0 * np.arcsin(np.clip(0.5 * np.linalg.norm(turned - also, axis=1), 0.0, 1.0))
    grid = len(y), len(x)
    return CameraComparison(
        name,
        (first.phi, second.phi),
        x,
        y,
        (second.project(turned) - pixels).reshape(*grid, 2),
        np.degrees(angles).reshape(grid),
        float(np.degrees(np.linalg.norm(rotation_log(turn)))),
        _intrinsics_probability(a, b, name) if name == other else None,
    )


def _common_turn(seen: Array, also: Array) -> Array:
    """(3, 3) the rotation that most of the directions (N, 3) agree on: Cauchy's weights at the median, since lenses
    differ most in corners that nobody observed.
    """
    turn = np.eye(3)
    for _ in range(_ROUNDS):
        away = np.linalg.norm(seen @ turn.T - also, axis=1)
        weights = 1.0 / (1.0 + (away / max(median(away), 1e-15)) ** 2)
        turn = nearest_rotation((also * weights[:, None]).T @ seen)
    return turn


def _intrinsics_probability(a: Calibration, b: Calibration, camera: str) -> float | None:
    if a.posterior is None or b.posterior is None:
        return None
    keys, others = ([key for key in c.uncertainty.posterior.keys if key[:2] == ("camera", camera)] for c in (a, b))
    if set(keys) != set(others) or not keys:
        return None
    first, second = (Estimate({camera: c.cameras[camera]}, {}, {}, EXACT) for c in (a, b))
    return _chance(a, b, keys, difference(second, first, keys))
