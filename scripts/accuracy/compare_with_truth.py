"""Prints a calibration beside its scene's truth: python scripts/run.py compare_with_truth CALIBRATION TRUTH

Exits with 1 when a station's map has a mean error above 5 mm on the floor or at robot height.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError, InputError
from ceres_cal.base.files import read_json
from ceres_cal.base.transforms import Pose, euler_from_rotation
from ceres_cal.base.words import HEIGHTS_M
from ceres_cal.calibration import Calibration
from ceres_cal.observations import Observations
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import curve_points
from ceres_cal.scene.lens import make_lens
from ceres_cal.scene.targets import Target
from ceres_cal.simulate.files import TRUTH_FORMAT, TRUTH_VERSION

STEP_M = 0.1
MOST_MM = 5.0


def true_cameras(truth: Mapping[str, Any]) -> dict[str, Camera]:
    """The cameras, without a pose."""
    cameras = {}
    for name, entry in truth["cameras"].items():
        lens = make_lens(entry["lens"]["kind"], entry["lens"].get("powers", (2, 3)), entry["lens"]["coefficients"])
        cameras[name] = Camera(entry["image_size"], entry["phi"], entry["principal_point"], lens, entry["aspect"])
    return cameras


def intrinsics(camera: Camera) -> dict[str, float]:
    cx, cy = camera.principal_point
    return {"phi px": camera.phi, "cx px": cx, "cy px": cy, "aspect": camera.aspect, **camera.lens.coefficients}


def pose(camera: Camera) -> dict[str, float]:
    """Position and Euler angles in mm and degrees."""
    angles = np.degrees(euler_from_rotation(camera.cam_from_world.rotation))
    names = ("x mm", "y mm", "z mm", "alpha deg", "beta deg", "gamma deg")
    return dict(zip(names, [*(1000.0 * camera.position).tolist(), *angles.tolist()], strict=True))


def print_table(title: str, truth: Mapping[str, float], estimate: Mapping[str, float]) -> None:
    """Truth beside estimate, for the numbers that both have, since the lenses may differ."""
    print(f"{title:22}{'truth':>16}{'estimate':>16}{'difference':>13}")
    for name in (name for name in truth if name in estimate):
        difference = estimate[name] - truth[name]
        if name.endswith("deg"):
            difference = (difference + 180.0) % 360.0 - 180.0
        print(f"  {name:20}{truth[name]:16.8g}{estimate[name]:16.8g}{difference:13.3g}")


def outline(target: Target) -> Array:
    """x and y (N, 2) m of the target's points and of places along its curves."""
    curves = target.curves.values()
    along = [curve_points(curve, 0, 24) for curve in curves]
    return np.vstack([target.point_array, *along])[:, :2]


def fields(truth_path: Path, file_names: Sequence[str]) -> dict[str, Array]:
    """Lowest and highest x and y (2, 2) m of the targets without a placement that each station sees."""
    corners: dict[str, list[Array]] = {}
    for file_name in file_names:
        observations = Observations.load(truth_path.parent / file_name)
        for view in observations.views:
            if view.placement is None:
                corners.setdefault(view.station, []).append(outline(observations.targets[view.target]))
    return {
        name: np.array([np.vstack(parts).min(axis=0), np.vstack(parts).max(axis=0)]) for name, parts in corners.items()
    }


def map_errors_mm(truth: Camera, estimate: Camera, field: Array, height_m: float) -> Array:
    """Errors (N,) with which the estimate locates a grid of places in the part of the field that the image shows."""
    x, y = (np.arange(low, high + 0.5 * STEP_M, STEP_M) for low, high in field.T)
    places = np.stack([*(axis.ravel() for axis in np.meshgrid(x, y)), np.full(len(x) * len(y), height_m)], axis=1)
    pixels = truth.project(places)
    shown = np.all((pixels >= -0.5) & (pixels <= np.array(truth.image_size) - 0.5), axis=1)
    located = estimate.locate(pixels[shown], height_m)
    errors_mm = 1000.0 * np.linalg.norm(located - places[shown, :2], axis=1)
    return np.where(np.isnan(errors_mm), np.inf, errors_mm)


def compare(calibration_path: Path, truth_path: Path) -> int:
    """Print the tables; 1 when a map has a mean error above MOST_MM, else 0."""
    calibration = Calibration.load(calibration_path)
    truth = read_json(truth_path, TRUTH_FORMAT, TRUTH_VERSION)
    cameras, seen = true_cameras(truth), fields(truth_path, list(truth["files"]))
    for kind, names in (("cameras", calibration.cameras), ("stations", calibration.stations)):
        if strangers := names.keys() - truth[kind].keys():
            raise InputError(f"{truth_path}: {min(strangers)!r} is not in its {kind}: is this another scene's truth?")
    for name, camera in calibration.cameras.items():
        print_table(f"camera {name}", intrinsics(cameras[name]), intrinsics(camera))
    means = [0.0]
    for name, estimate in calibration.stations.items():
        if estimate.cam_from_world == Pose.identity():
            print(f"station {name}: it is the origin of the world, since boards alone do not determine where it stands")
            continue
        entry = truth["stations"][name]
        true = cameras[entry["camera"]].at(Pose.looking(entry["position_m"], entry["rotation"]))
        print_table(f"station {name}", pose(true), pose(estimate))
        for height_m in HEIGHTS_M if name in seen else ():
            errors = map_errors_mm(true, estimate, seen[name], height_m)
            means.append(float(np.mean(errors)))
            print(
                f"  map at z = {height_m:.2f} m: mean error {means[-1]:.2f} mm, largest {np.max(errors):.2f} mm, "
                f"over {len(errors)} places of the field that the image shows"
            )
    return 1 if max(means) > MOST_MM else 0


def main(arguments: Sequence[str]) -> int:
    if len(arguments) != 2:
        print("usage: run.py compare_with_truth CALIBRATION TRUTH", file=sys.stderr)
        return 2
    try:
        return compare(Path(arguments[0]), Path(arguments[1]))
    except CalibrationError as error:
        print(f"compare_with_truth.py: {error}", file=sys.stderr)
        return error.exit_code
