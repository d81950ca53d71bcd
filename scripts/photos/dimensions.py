"""Fields with unknown dimensions, from observations and photographs: python scripts/run.py dimensions [--help]

Printed are the coverage of the 95 % intervals and the errors of the dimensions. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from rendering.photograph import photograph
from rendering.photography import Photography, taken_as
from runner import Row, mean_and_error, over, root_and_error, script
from scenery import field_scene, overhead_pose

from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.photographs import Auto, Facing, FieldOptions, detect_field
from ceres_cal.observations import Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, simulate

CAMERA = Camera((1280, 960), 600.0, (651.3, 468.9), Radial((-5.2e-5, 6.1e-7)))
KNOWN = {
    "the circle": ("field_length_m", "field_width_m"),
    "the length": ("field_width_m", "penalty_area_depth_m", "penalty_area_width_m", "center_circle_radius_m"),
}
FIELD = ssl_field("B")


def odd_field(names: tuple[str, ...], rng: np.random.Generator, most: float) -> dict[str, float]:
    """Random dimensions that differ by up to the share `most` from the field's."""
    return {name: FIELD.dimensions[name] * float(rng.uniform(1.0 - most, 1.0 + most)) for name in names}


def scene_of(true: Mapping[str, float], rng: np.random.Generator) -> Scene:
    """A whole field of these dimensions below one camera, tilted by up to 12 degrees."""
    x, y, tilt_x, tilt_y = rng.uniform((-0.5, -0.3, -12.0, -12.0), (0.5, 0.3, 12.0, 12.0))
    pose = overhead_pose(x, y, 5.0, tilt_x, tilt_y, rng.uniform(-10.0, 10.0))
    return field_scene(ssl_field("B", **true), {"a": CAMERA}, {"s": Station("a", pose)}, spacing_m=0.15)


def simulated(seed: int, names: tuple[str, ...], folder: Path) -> tuple[dict[str, float], Calibration]:
    """The truth, and the calibration of observations for which the field is given as division B's."""
    rng = np.random.default_rng([11, seed])
    true = odd_field(names, rng, 0.15)
    seen = simulate(scene_of(true, rng), Disturbance(0.2, 0.2), seed).observations
    seen = replace(seen, targets={"field": FIELD})
    return true, calibrate(seen, Options(lens="radial", dimensions=tuple(f"field/{name}" for name in names)))


def photographed(seed: int, names: tuple[str, ...], folder: Path) -> tuple[dict[str, float], Calibration]:
    """The same with a rendered photograph in which the field is found without an initial camera."""
    rng = np.random.default_rng([12, seed])
    true = odd_field(names, rng, 0.08)
    scene = taken_as(scene_of(true, rng), Photography(robots=4, unevenness=0.15, carpet_texture=0.05))
    path = folder / f"{seed}.png"
    cv2.imwrite(str(path), photograph(scene, "s", "0001", seed=seed).image)
    open_ = tuple(Prior("target", "field", name, (FIELD.dimensions[name],), (np.inf,)) for name in names)
    facing = Auto((Facing("LeftGoalLine", "left"),))
    found = detect_field([path], FIELD, facing, None, FieldOptions("a", "s", lengths=open_))
    return true, calibrate(found.observations, Options())


_Solve = Callable[[int, tuple[str, ...], Path], tuple[dict[str, float], Calibration]]


def _solved(
    solve: _Solve, names: tuple[str, ...], folder: Path, seed: int
) -> tuple[dict[str, float], Calibration] | str:
    """The truth and the calibration, or the message of a refusal."""
    try:
        return solve(seed, names, folder)
    except CalibrationError as error:
        return str(error)


def rows(case: str, solve: _Solve, names: tuple[str, ...], runs: int) -> Iterator[Row]:
    """Coverage and errors of all dimensions together."""
    inside, errors, squares, failed = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for seed, came in enumerate(over(partial(_solved, solve, names, Path(folder)), range(runs))):
            if isinstance(came, str):
                failed.append(f"{seed}: {came}")
                continue
            true, calibration = came
            found = [one for one in calibration.uncertainty.verdicts if one.key.kind == "dimension"]
            right = [true[one.key.quantity] for one in found]
            off = np.array([one.value - value for one, value in zip(found, right, strict=True)])
            inside.append(np.mean([one.low <= value <= one.high for one, value in zip(found, right, strict=True)]))
            errors += (1e3 * np.abs(off)).tolist()
            squares.append(np.mean((off / [one.sd for one in found]) ** 2))
    yield Row(case, "fields without a calibration", len(failed), most=0.0, note="; ".join(failed))
    if inside:
        yield Row(case, "dimensions in their 95 % intervals", *mean_and_error(inside), 0.9, 0.98)
        yield Row(case, "error over sd, rms", *root_and_error(squares), 0.8, 1.25)
        yield Row(case, "median error, mm", float(np.median(errors)), note=f"largest {np.max(errors):.2f} mm")


_cases = {
    f"{what}, {known} known": partial(rows, f"{what}, {known} known", solve, names)
    for known, names in KNOWN.items()
    for what, solve in (("observations", simulated), ("photographs", photographed))
}
main = script(_cases, __doc__, (10, "fields"))
