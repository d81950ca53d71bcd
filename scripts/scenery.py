"""The usual scenes, composed of a few parts: fields, boards and rings in front of any number of stations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.problem.parameters import Station
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target
from ceres_cal.simulate import Scene, ViewPlan, board_pose, well_inside

_TRIES = 5_000


def overhead_pose(
    x_m: float = 0.0,
    y_m: float = 0.0,
    height_m: float = 4.0,
    tilt_x_deg: float = 0.0,
    tilt_y_deg: float = 0.0,
    yaw_deg: float = 0.0,
) -> Pose:
    """cam_from_world of a camera that looks down at the floor.

    Without yaw and tilt the image's x has the direction of the field's x, and the image's y is opposite to the field's
    y. Yaw rotates the camera counter-clockwise as seen from above. Tilt is one rotation about (tilt_x, tilt_y) in the
    image, with the angle hypot(tilt_x, tilt_y): a positive tilt_x looks towards the lower part of the image, a positive
    tilt_y towards its left.
    """
    yaw = np.deg2rad(yaw_deg)
    down = np.diag([1.0, -1.0, -1.0]) @ rotation_exp([0.0, 0.0, -yaw])
    tilt = rotation_exp(np.deg2rad([tilt_x_deg, tilt_y_deg, 0.0]))
    return Pose.looking((x_m, y_m, height_m), tilt @ down)


@dataclass(frozen=True)
class BoardRanges:
    """Ranges for a board in front of the first camera: the distance of its centre, and the angle between its normal and
    the line of sight to the centre.
    """

    distance_m: tuple[float, float] = (1.0, 2.5)
    tilt_deg: tuple[float, float] = (15.0, 45.0)


def board_placements(
    board: Target, cameras: Sequence[Camera], count: int, seed: int, held: BoardRanges = BoardRanges()
) -> list[Pose]:
    """world_from_target of a board at random places where every one of the posed cameras sees all of its points.

    Raises:
        InputError: no such place is found.
    """
    rng = np.random.default_rng(seed)
    placements: list[Pose] = []
    for _ in range(_TRIES):
        if len(placements) == count:
            return placements
        cam_from_board = _random_board_pose(board, cameras[0], held, rng)
        placement = cameras[0].cam_from_world.inverse @ cam_from_board
        if all(np.all(well_inside(camera, placement.transform(board.point_array))) for camera in cameras):
            placements.append(placement)
    raise InputError(
        f"no {count} places found where {len(cameras)} camera(s) see a whole {board.kind}: "
        "take a smaller board, a larger distance or less tilt"
    )


def _random_board_pose(board: Target, camera: Camera, held: BoardRanges, rng: np.random.Generator) -> Pose:
    """cam_from_board with the board's centre at a random pixel."""
    pixel = rng.uniform((0.0, 0.0), camera.image_size)
    direction, spin = rng.uniform(0.0, 2.0 * np.pi, size=2)
    tilt = np.deg2rad(rng.uniform(*held.tilt_deg))
    line_of_sight = camera.rays(pixel[None])[0]
    return board_pose(board, line_of_sight, rng.uniform(*held.distance_m), (tilt, direction, spin))


def field_scene(
    field: Target,
    cameras: Mapping[str, Camera],
    stations: Mapping[str, Station],
    frames: int = 1,
    *,
    points: tuple[str, ...] | None = None,
    curves: tuple[str, ...] | None = None,
    spacing_m: float = 0.1,
    name: str = "field",
) -> Scene:
    """A target fixed in the world, seen in `frames` frames from every station.

    Frames are numbered for each camera from "0001" on. Cameras that see the field at the same time share the names; a
    camera with several stations takes one frame after the other.
    """
    taken: Counter[str] = Counter()
    views = []
    for station_name, station in stations.items():
        first = taken[station.camera] + 1
        taken[station.camera] += frames
        names = tuple(f"{number:04d}" for number in range(first, first + frames))
        views.append(ViewPlan(names, station_name, name, None, points, curves, spacing_m))
    return Scene({name: field}, cameras, stations, {}, tuple(views))


def board_scene(
    board: Target,
    cameras: Mapping[str, Camera],
    stations: Mapping[str, Station],
    count: int,
    seed: int,
    held: BoardRanges = BoardRanges(),
) -> Scene:
    """A board held at `count` places; each is seen whole from every station at once (see `board_placements`)."""
    posed = [cameras[station.camera].at(station.cam_from_world) for station in stations.values()]
    poses = board_placements(board, posed, count, seed, held)
    placements = {f"board_{number:02d}": pose for number, pose in enumerate(poses, start=1)}
    views = tuple(ViewPlan((frame,), station, "board", frame) for frame in placements for station in stations)
    return Scene({"board": board}, cameras, stations, placements, views)


def rings_scene(
    sheet: Target,
    cameras: Mapping[str, Camera],
    stations: Mapping[str, Station],
    cam_from_sheet: Pose,
    *,
    spacing_m: float = 0.02,
    name: str = "rings",
) -> Scene:
    """A sheet of concentric rings in front of the first station: the paper's figure 2. The view has no points."""
    station_name, station = next(iter(stations.items()))
    placement = station.cam_from_world.inverse @ cam_from_sheet
    view = ViewPlan((name,), station_name, name, name, points=(), spacing_m=spacing_m)
    return Scene({name: sheet}, cameras, stations, {name: placement}, (view,))


def join(*scenes: Scene) -> Scene:
    """Several scenes as one: all views in order, with the first photography that is defined.

    Raises:
        InputError: a name means different things in two scenes.
    """

    def together(what: str) -> dict[str, Any]:
        merged: dict[str, Any] = {}
        for scene in scenes:
            for name, value in getattr(scene, what).items():
                if merged.setdefault(name, value) != value:
                    raise InputError(f"{what}: {name!r} means different things in two scenes: give one another name")
        return merged

    return Scene(
        together("targets"),
        together("cameras"),
        together("stations"),
        together("placements"),
        tuple(plan for scene in scenes for plan in scene.views),
        next((scene.photography for scene in scenes if scene.photography), {}),
    )
