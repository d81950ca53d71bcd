"""Files of scenes and true values: users write scenes; the truth is saved beside the simulated observations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import Array, InputError, body_of, convert, make_folder, naming, read_json, write_json
from ceres_cal.base.files import UNITS
from ceres_cal.base.transforms import Pose, euler_from_rotation, rotation_exp, rotation_from_euler
from ceres_cal.problem.parameters import Station
from ceres_cal.scene import Camera, CameraFile, Vector, camera_to_json, targets_from_specs
from ceres_cal.simulate.scene import Disturbance, Scene, ViewPlan
from ceres_cal.simulate.simulation import OUTLIER, WRONG_LABEL, Simulation, Truth

SCENE_FORMAT, SCENE_VERSION = "ceres-cal/scene", 1
TRUTH_FORMAT, TRUTH_VERSION = "ceres-cal/truth", 1

Settings = TypeVar("Settings", Disturbance, ViewPlan)


class _RotationFile(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    euler_rad: Vector | None = None
    rotation_vector: Vector | None = None


class _SceneStation(_RotationFile, forbid_unknown_fields=True, kw_only=True):
    camera: str
    position_m: Vector


class _PlacementFile(_RotationFile, forbid_unknown_fields=True, kw_only=True):
    translation_m: Vector


class _SceneFile(msgspec.Struct, forbid_unknown_fields=True):
    targets: dict[str, Any]
    cameras: dict[str, Any]
    stations: dict[str, Any]
    views: list[dict[str, Any]]
    placements: dict[str, Any] = {}
    disturbance: dict[str, Any] = {}
    photography: dict[str, Any] = {}
    units: str = UNITS


# ---- reading a scene ------------------------------------------------------------------------------------------------


def load_scene(path: str | Path) -> tuple[Scene, Disturbance]:
    """Load a scene file and the disturbance in it.

    Raises:
        InputError: one line that names the file and the place in it.
    """
    return scene_from_json(read_json(path, SCENE_FORMAT, SCENE_VERSION), str(path))


def scene_from_json(data: Mapping[str, Any], where: str) -> tuple[Scene, Disturbance]:
    """Return the scene and the disturbance that a file describes.

    A station has its camera's `position_m`, a placement the `translation_m` of world_from_target. Both have one of
    `euler_rad` (the paper's angles) and `rotation_vector`, of cam_from_world and world_from_target. A view without
    `points` or `curves` observes all that its target has.

    Args:
        data: the file as plain data.
        where: name of the file in messages.

    Raises:
        InputError: one line that names `where` and the place in it.
    """
    file = convert(body_of(data, where, SCENE_FORMAT, SCENE_VERSION), _SceneFile, where)
    with naming(where):
        scene = Scene(
            targets_from_specs(file.targets),
            {name: _camera(entry, f"camera {name!r}") for name, entry in file.cameras.items()},
            {name: _station(entry, f"station {name!r}") for name, entry in file.stations.items()},
            {name: _placement(entry, f"placement {name!r}") for name, entry in file.placements.items()},
            tuple(_named(ViewPlan, entry, f"view {number}") for number, entry in enumerate(file.views)),
            file.photography,
        )
        return scene, _named(Disturbance, file.disturbance, "disturbance")


def _camera(entry: Any, here: str) -> Camera:
    file = convert(entry, CameraFile, here)
    with naming(here):
        return file.camera()


def _rotation(file: _RotationFile, here: str) -> Array:
    if file.euler_rad is not None and file.rotation_vector is None:
        return rotation_from_euler(*file.euler_rad)
    if file.rotation_vector is not None and file.euler_rad is None:
        return rotation_exp(file.rotation_vector)
    raise InputError(f"{here}: give its rotation as one of euler_rad and rotation_vector")


def _station(entry: Any, here: str) -> Station:
    file = convert(entry, _SceneStation, here)
    return Station(file.camera, Pose.looking(file.position_m, _rotation(file, here)))


def _placement(entry: Any, here: str) -> Pose:
    file = convert(entry, _PlacementFile, here)
    return Pose(_rotation(file, here), np.array(file.translation_m))


def _named(kind: type[Settings], entry: dict[str, Any], here: str) -> Settings:
    known = [field.name for field in fields(kind)]
    for name in entry:
        if name not in known:
            raise InputError(f"{here}: {name!r} is unknown: there are {', '.join(known)}")
    return convert(entry, kind, here)


# ---- writing --------------------------------------------------------------------------------------------------------


def truth_to_json(simulations: Mapping[str, Simulation]) -> dict[str, Any]:
    """Return the true values behind simulated observations: intrinsics, stations, placements, and each file's disturbed
    rows.

    Poses are given to 1e-10 m and rad, intrinsics with every digit.

    Args:
        simulations: name of the file of observations -> its simulation. Their scenes must agree on shared names.
    """
    scenes = [simulation.scene for simulation in simulations.values()]
    return {
        "format": TRUTH_FORMAT,
        "version": TRUTH_VERSION,
        "units": UNITS,
        "cameras": {name: camera_to_json(camera) for scene in scenes for name, camera in scene.cameras.items()},
        "stations": {name: _station_truth(station) for scene in scenes for name, station in scene.stations.items()},
        "placements": {name: _placement_truth(pose) for scene in scenes for name, pose in scene.placements.items()},
        "files": {name: _file_truth(simulation) for name, simulation in simulations.items()},
    }


def _placement_truth(pose: Pose) -> dict[str, Any]:
    return {"translation_m": _tidy(pose.translation), "rotation": _tidy(pose.rotation)}


def _file_truth(simulation: Simulation) -> dict[str, Any]:
    rows = {name: _rows_truth(getattr(simulation, name)) for name in ("points", "curves")}
    return {"seed": simulation.seed, "disturbance": asdict(simulation.disturbance), **rows}


def _station_truth(station: Station) -> dict[str, Any]:
    pose = station.cam_from_world
    return {
        "camera": station.camera,
        "position_m": _tidy(pose.position),
        "rotation": _tidy(pose.rotation),
        "euler_rad": _tidy(euler_from_rotation(pose.rotation)),
    }


def _tidy(numbers: ArrayLike) -> Any:
    """Round metres or radians to 1e-10, far below what can be measured, so that all machines give the same digits."""
    return (np.round(np.asarray(numbers, dtype=float), 10) + 0.0).tolist()  # + 0.0 turns -0.0 into 0.0


def _rows_truth(truth: Truth) -> dict[str, Any]:
    outliers, wrong = truth.rows(OUTLIER).tolist(), truth.rows(WRONG_LABEL).tolist()
    return {
        "count": len(truth.flag),
        "outlier_count": len(outliers),
        "wrong_label_count": len(wrong),
        "outlier_rows": outliers,
        "wrong_label_rows": wrong,
    }


def write_simulation(simulation: Simulation, folder: str | Path, more_truth: Mapping[str, Any] | None = None) -> None:
    """Write `observations.json` and `truth.json` into a folder, which is created if it does not exist.

    Args:
        more_truth: further entries of the truth.

    Raises:
        InputError: it cannot be written.
    """
    folder = make_folder(folder)
    simulation.observations.save(folder / "observations.json")
    write_json(folder / "truth.json", truth_to_json({"observations.json": simulation}) | dict(more_truth or {}))
