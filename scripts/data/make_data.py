"""Makes the sample data sets again: python scripts/run.py make_data [FOLDER]

Observations and truths are the same bytes every time; photographs are, as far as OpenCV's drawing and compression
allow.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rendering.album import Album, take_album
from scenery import overhead_pose

from ceres_cal.base.files import write_bytes, write_json
from ceres_cal.problem.parameters import Station
from ceres_cal.simulate import Disturbance, Scene, Simulation, built_in_scene, simulate, truth_to_json, write_simulation

DATA = Path(__file__).resolve().parents[2] / "data"
SEED = 1
DECIMALS = 4  # of pixels: finer than the noise, and the same on every machine
PHOTOGRAPHED = (*(f"{i:04d}" for i in range(1, 4)), *(f"board_{i:02d}" for i in range(1, 9)))
BUMPED = overhead_pose(-2.255, -0.128, 4.012, tilt_x_deg=1.1, tilt_y_deg=-3.1, yaw_deg=91.0)
"""Pose of the camera after somebody knocked it: it has moved by 19 mm and 1.1 degrees."""


def rounded(simulation: Simulation) -> Simulation:
    """The simulation with its observed pixels rounded."""
    observations = simulation.observations
    points = replace(observations.points, pixels=np.round(observations.points.pixels, DECIMALS))
    curves = replace(observations.curves, pixels=np.round(observations.curves.pixels, DECIMALS))
    return replace(simulation, observations=replace(observations, points=points, curves=curves))


def frames_only(scene: Scene, frames: tuple[str, ...]) -> Scene:
    """The scene with only these frames."""
    kept = (replace(v, frames=tuple(frame for frame in v.frames if frame in frames)) for v in scene.views)
    return replace(scene, views=tuple(view for view in kept if view.frames))


def album_of(scene: Scene) -> Album:
    """Photographs of a scene."""
    return take_album(simulate(scene, seed=SEED), "jpg")


def write_images(images: Mapping[str, bytes], folder: Path) -> None:
    for name, content in images.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_bytes(folder / name, content)


def make_ssl_field(folder: Path) -> None:
    scene, disturbance = built_in_scene("ssl-field")
    album = album_of(frames_only(scene, PHOTOGRAPHED))
    write_images(album.images, folder)
    write_simulation(rounded(simulate(scene, disturbance, SEED)), folder, {"photographs": album.truth})


def make_ssl_field_moved(folder: Path) -> None:
    """One frame of the same camera after it was knocked."""
    scene, disturbance = built_in_scene("ssl-field")
    moved = replace(frames_only(scene, ("0001",)), stations={"overhead": Station("overhead", BUMPED)})
    moved = replace(moved, placements={}, targets={"field": moved.targets["field"]})
    # Another seed gives other robots and other noise than before.
    album = take_album(simulate(moved, Disturbance(), SEED + 1), "jpg")
    write_images(album.images, folder)
    write_simulation(rounded(simulate(moved, disturbance, SEED + 1)), folder, {"photographs": album.truth})


def make_field_2004(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    simulations: dict[str, Simulation] = {}
    shots: dict[str, Any] = {}
    for name, scene_name in (("rings.json", "rings-2004"), ("field.json", "field-2004")):
        scene, disturbance = built_in_scene(scene_name)
        simulations[name] = rounded(simulate(scene, disturbance, SEED))
        simulations[name].observations.save(folder / name)
        album = album_of(scene)
        write_images(album.images, folder)
        shots |= album.truth
    write_json(folder / "truth.json", truth_to_json(simulations) | {"photographs": shots})


def main(arguments: Sequence[str]) -> int:
    root = Path(arguments[0]) if arguments else DATA
    make_ssl_field(root / "ssl_field")
    make_ssl_field_moved(root / "ssl_field_moved")
    make_field_2004(root / "field_2004")
    for path in sorted(path for path in root.rglob("*") if path.suffix in (".json", ".jpg")):
        print(f"{path.relative_to(root)}: {path.stat().st_size / 1000:.1f} kB")
    return 0
