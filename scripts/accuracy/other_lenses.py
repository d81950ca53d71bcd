"""Lenses given by formulas, which the package need not have: python scripts/run.py other_lenses [--help]

Each lens is a formula of this script. 6, 12 or 25 views of a board, tilted by up to 40 degrees, fill its picture with
0.2 px of noise, and are calibrated with default options, so that the lens is chosen. Printed is the error of rays over
the part of the image that the views fill, divided by the stated standard deviation (root mean square, after the
best-fitting rotation). It is 1 where the statement is honest; a lens model that is too simple would give a larger
value. Exits with 1 when a figure is missed by more than two standard errors.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from halves import pairs, seen_grid, stated_squares, turn_basis
from runner import Row, root_and_error, script

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import NO_CURVES, Observations, Points, View
from ceres_cal.scene.targets import Target, checkerboard

Project = Callable[[Array], Array]
"""Directions (N, 3) -> pixels (N, 2)."""

_SIZE, _CENTRE = (1280, 960), np.array([651.3, 468.9])
_VIEWS, _NOISE_PX, _LEAST_CORNERS, _MARGIN_PX = (6, 12, 25), 0.2, 20, 3.0
_LEAST, _MOST = 0.6, 1.6
_BOARD = checkerboard(9, 6, 0.1)


# ---- the lenses -----------------------------------------------------------------------------------------------------


def _angles(directions: Array) -> Array:
    return np.asarray(np.arctan2(np.linalg.norm(directions[:, :2], axis=1), directions[:, 2]))


def _by_angle(radius_px: Callable[[Array], Array], directions: Array) -> Array:
    across = np.linalg.norm(directions[:, :2], axis=1)
    unit = directions[:, :2] / np.where(across > 0.0, across, 1.0)[:, None]
    return np.asarray(_CENTRE + radius_px(_angles(directions))[:, None] * unit)


def _pinhole(phi: float, bent: Callable[[Array], Array], directions: Array) -> Array:
    return np.asarray(_CENTRE + phi * bent(directions[:, :2] / directions[:, 2:]))


def _brown(k: tuple[float, float, float], p: tuple[float, float], at: Array) -> Array:
    square, (x, y) = np.sum(at**2, axis=1), at.T
    radial = at * (1.0 + k[0] * square + k[1] * square**2 + k[2] * square**3)[:, None]
    aside = [2.0 * p[0] * x * y + p[1] * (square + 2.0 * x**2), p[0] * (square + 2.0 * y**2) + 2.0 * p[1] * x * y]
    return np.asarray(radial + np.column_stack(aside))


def _rational(at: Array) -> Array:
    square = np.sum(at**2, axis=1)[:, None]
    return np.asarray(at * (1.0 + 0.2 * square - 0.05 * square**2) / (1.0 + 0.55 * square + 0.02 * square**2))


def _tilted_sensor(at: Array) -> Array:
    """A sensor that is tilted about its principal point by 1.1 and 0.7 degrees; its rows and columns stay
    perpendicular. These are OpenCV's tauX and tauY.
    """
    turn = rotation_exp(np.array([0.02, 0.012, 0.0]))
    seen = np.column_stack([_brown((-0.2, 0.05, 0.0), (0.0, 0.0), at), np.ones(len(at))]) @ turn
    return np.asarray(turn[2, 2] * seen[:, :2] / seen[:, 2:] - turn[2, :2])


def _division(angle: Array) -> Array:
    return np.asarray(1600.0 * np.tan(angle) / (1.0 + np.sqrt(1.0 + np.tan(angle) ** 2)))


def _wavy(angle: Array) -> Array:
    return np.asarray(850.0 * np.tan(angle) * (1.0 - 0.125 * np.tan(angle) ** 2) + 1.2 * np.sin(9.0 * angle))


LENSES: Mapping[str, tuple[Project, float]] = {
    "no distortion": (partial(_pinhole, 900.0, partial(_brown, (0.0, 0.0, 0.0), (0.0, 0.0))), 35.0),
    "brown k1 k2": (partial(_pinhole, 850.0, partial(_brown, (-0.24, 0.08, 0.0), (0.0, 0.0))), 38.0),
    "hardly decentred": (partial(_pinhole, 850.0, partial(_brown, (-0.24, 0.08, 0.0), (8e-4, -6e-4))), 38.0),
    "decentred": (partial(_pinhole, 850.0, partial(_brown, (-0.24, 0.08, 0.0), (4e-3, -3e-3))), 38.0),
    "brown k1 k2 k3": (partial(_pinhole, 700.0, partial(_brown, (-0.33, 0.15, -0.035), (0.0, 0.0))), 42.0),
    "rational": (partial(_pinhole, 800.0, _rational), 45.0),
    "tilted sensor": (partial(_pinhole, 850.0, _tilted_sensor), 38.0),
    "equidistant": (partial(_by_angle, lambda angle: 560.0 * angle), 70.0),
    "equisolid": (partial(_by_angle, lambda angle: 1120.0 * np.sin(0.5 * angle)), 75.0),
    "stereographic": (partial(_by_angle, lambda angle: 1120.0 * np.tan(0.5 * angle)), 60.0),
    "division": (partial(_by_angle, _division), 48.0),
    "wavy": (partial(_by_angle, _wavy), 36.0),
}
"""Name -> projection, and the largest angle from the axis, deg, in the picture."""


# ---- scenes ---------------------------------------------------------------------------------------------------------


def observed(lens: Project, reach_deg: float, views: int, seed: int) -> Observations:
    """The corners of a board in so many views through a lens."""
    rng = np.random.default_rng(seed)
    pixels, features = zip(*(_view(lens, np.deg2rad(reach_deg), rng) for _ in range(views)), strict=True)
    return board_views(_BOARD, _SIZE, pixels, features)


def board_views(
    board: Target, size: tuple[int, int], pixels: Sequence[Array], features: Sequence[Array]
) -> Observations:
    """Observations of a board by one camera: the pixels of each view, and the corners that they show."""
    numbers = np.repeat(np.arange(len(pixels), dtype=np.int32), [len(each) for each in features])
    names = tuple(View(f"{n:02d}", "camera", "camera", "board", f"{n:02d}") for n in range(len(pixels)))
    points = Points(numbers, np.concatenate(features), np.concatenate(pixels), np.ones(len(numbers)))
    return Observations({"board": board}, {"camera": size}, names, points, NO_CURVES)


def _view(lens: Project, reach: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Pixels and numbers of the visible corners of a random view that shows enough of them."""
    while True:
        axis = rng.standard_normal(3)
        turn = rotation_exp(axis / np.linalg.norm(axis) * np.deg2rad(rng.uniform(5.0, 40.0)))
        angle, around = reach * np.sqrt(rng.uniform(0.0, 0.7)), rng.uniform(0.0, 2.0 * np.pi)
        towards = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
        places = (_BOARD.point_array - _BOARD.point_array.mean(axis=0)) @ turn.T + rng.uniform(0.7, 1.6) * towards
        shown = np.flatnonzero((places[:, 2] > 0.05) & (_angles(places) < 1.02 * reach))
        pixels = lens(places[shown])
        inside = np.all((pixels > _MARGIN_PX) & (pixels < np.array(_SIZE) - _MARGIN_PX), axis=1)
        if np.count_nonzero(inside) >= _LEAST_CORNERS:
            noise = _NOISE_PX * rng.standard_normal((np.count_nonzero(inside), 2))
            return pixels[inside] + noise, shown[inside].astype(np.int32)


def off_over_stated(calibration: Calibration, lens: Project, observations: Observations) -> float:
    """Mean square of the errors of rays over the image, each divided by its stated standard deviation."""
    camera = calibration.estimate.cameras["camera"].at(Pose.identity())
    pixels = seen_grid(observations)
    rays = camera.rays(pixels)
    pixels, rays = pixels[np.isfinite(rays[:, 0])], rays[np.isfinite(rays[:, 0])]
    turned = turn_basis(camera, rays)
    off = (lens(rays) - pixels).ravel()
    off -= turned @ (turned.T @ off)
    return float(np.mean(pairs(off**2) / pairs(stated_squares(calibration, camera, rays, turned))))


def rows(name: str, runs: int) -> Iterator[Row]:
    """The figure of one lens, over all numbers of views."""
    lens, reach_deg = LENSES[name]
    squares, chosen, refused = [], Counter[str](), 0
    for seed in range(runs):
        observations = observed(lens, reach_deg, _VIEWS[seed % len(_VIEWS)], seed)
        try:
            calibration = calibrate(observations)
        except CalibrationError:
            refused += 1
            continue
        squares.append(off_over_stated(calibration, lens, observations))
        chosen[calibration.lens_choice.chosen if calibration.lens_choice else ""] += 1
    note = ", ".join(f"{label} {count}" for label, count in chosen.most_common(3))
    note += f"; {refused} refused" if refused else ""
    yield Row(name, f"error over stated, rms of {len(squares)}", *root_and_error(squares), _LEAST, _MOST, note)


main = script({name: partial(rows, name) for name in LENSES}, __doc__, (12, "scenes of each lens"))
