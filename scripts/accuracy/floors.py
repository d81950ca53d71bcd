"""Floors that differ from their drawing, in a single picture: python scripts/run.py floors [--help]

One camera above a division B field, tilted by 8 and 20 degrees, calibrated with the default options. The floor is flat,
or bowed by 5 mm, or the field's sides are 5 mm out of square. Printed is the error of places at the floor and at 150 mm
over the stated standard deviation; 1 where the statement is honest. A single picture does not determine such a floor,
so the prior `FLOOR_OFF` decides: 0.4 to 1.1 is required for a flat floor, at most 2.5 for the others, which are two of
its sigmas off.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from runner import Row, over, root_and_error, script

from accuracy.league import SetUp, scene_of
from ceres_cal.base.arrays import Array
from ceres_cal.base.words import HEIGHTS_M
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import AUTO
from ceres_cal.scene.camera import Camera
from ceres_cal.simulate import Disturbance, simulate

_NOISE_PX, _OFF_M, _HALF_M = 0.06, 0.005, 4.5
_TILTS_DEG = (8.0, 20.0)
_MARGIN_PX = 20.0
_PLACES = np.array([[x, y] for x in np.linspace(-2.5, 2.5, 11) for y in np.linspace(-2.0, 2.0, 9)])
_Moved = Callable[[Array, Array], Array]
"""Places (N, 3) of a flat floor, and three random numbers -> the places of the other floor."""


def _flat(places: Array, _: Array) -> Array:
    return places


def _bowed(places: Array, amounts: Array) -> Array:
    x, y = places[:, :2].T / _HALF_M
    up = np.column_stack([x * x, y * y, x * y]) @ (amounts / np.linalg.norm(amounts))
    return np.asarray(places + _OFF_M * up[:, None] * (0.0, 0.0, 1.0))


def _sheared(places: Array, amounts: Array) -> Array:
    x, y = places[:, :2].T / _HALF_M
    return np.asarray(places + 0.5 * np.sign(amounts[0]) * _OFF_M * np.column_stack([y, x, 0.0 * x]))


FLOORS: Mapping[str, tuple[_Moved, float, float]] = {
    "flat": (_flat, 0.4, 1.1),
    "bowed": (_bowed, 0.4, 2.5),
    "out of square": (_sheared, 0.4, 2.5),
}


def _seen(observations: Observations, camera: Camera, moved: _Moved, amounts: Array) -> Observations:
    """The observations with the flat floor replaced by another one."""

    def of(pixels: Array) -> Array:
        places = np.column_stack([camera.locate(pixels, 0.0), np.zeros(len(pixels))])
        return np.asarray(pixels + camera.project(moved(places, amounts)) - camera.project(places))

    points, curves = observations.points, observations.curves
    return replace(
        observations,
        points=replace(points, pixels=of(points.pixels)),
        curves=replace(curves, pixels=of(curves.pixels)),
    )


def _squares(floor: str, tilt_deg: float, seed: int) -> tuple[float, ...]:
    """Mean squares of errors over stated standard deviations, at each of HEIGHTS_M."""
    rng = np.random.default_rng([seed, int(tilt_deg)])
    scene = scene_of(SetUp(1, tilt_deg, AUTO, False, False), rng)
    (name,) = scene.stations
    camera = scene.camera_at(name)
    observations = simulate(scene, Disturbance(_NOISE_PX, _NOISE_PX), seed).observations
    observations = _seen(observations, camera, FLOORS[floor][0], rng.standard_normal(3))
    calibration = calibrate(observations)
    found = []
    for height_m in HEIGHTS_M:
        pixels = camera.project(np.column_stack([_PLACES, np.full(len(_PLACES), height_m)]))
        inside = np.all((pixels > _MARGIN_PX) & (pixels < np.array(camera.image_size) - _MARGIN_PX), axis=1)
        known = calibration.uncertainty.located(pixels[inside], height_m, name)
        off = np.linalg.norm(known.located - camera.locate(pixels[inside], height_m), axis=1)
        found.append(float(np.mean((off / known.sd_m) ** 2)))
    return tuple(found)


def rows(floor: str, runs: int) -> Iterator[Row]:
    """Error over stated, at each height."""
    pairs = [(tilt, seed) for tilt in _TILTS_DEG for seed in range(runs)]
    tilts, seeds = zip(*pairs, strict=True)
    squares = np.array(list(over(partial(_squares, floor), tilts, seeds)))
    _, least, most = FLOORS[floor]
    for number, height_m in enumerate(HEIGHTS_M):
        value, error = root_and_error(squares[:, number])
        yield Row(floor, f"error over stated at {1e3 * height_m:.0f} mm", value, error, least, most)


main = script({floor: partial(rows, floor) for floor in FLOORS}, __doc__, (8, "scenes of each floor and tilt"))
