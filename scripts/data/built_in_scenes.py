"""Makes the scenes that are part of the package: python scripts/run.py built_in_scenes [FOLDER]"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

from scenery import BoardRanges, board_scene, field_scene, join, overhead_pose, rings_scene

from ceres_cal.base.files import UNITS, write_json
from ceres_cal.base.transforms import Pose, rotation_log
from ceres_cal.problem.parameters import Station
from ceres_cal.scene.camera import Camera, camera_to_json
from ceres_cal.scene.lens import KannalaBrandt, Radial
from ceres_cal.scene.targets import Target, checkerboard, custom, rings, ssl_field
from ceres_cal.simulate import Disturbance, Scene
from ceres_cal.simulate.files import SCENE_FORMAT, SCENE_VERSION

FOLDER = Path(__file__).resolve().parents[2] / "src/ceres_cal/simulate/scenes"
_WORKDAY = Disturbance(
    points_sigma_px=0.5,
    curves_sigma_px=0.3,
    outliers=0.04,
    outlier_spread_px=20.0,
    wrong_labels=0.01,
    hidden_stretches=6,
    hidden_length_m=0.7,
    hidden_points=0.1,
)
"""An ordinary day at the field: robots and people hide lines, and one observation in twenty is wrong."""

_PAPER_PHI = 736.0
"""The paper's a1, a2, a3 (section 2), with a phi that the paper does not give: that of a 4.2 mm lens on a third-inch
sensor of 780 x 580 pixels, 683 px at the centre, times a1."""


def _overhead_camera() -> Camera:
    """1280 x 960 with barrel distortion: in the image's corner the measured radius is 0.77 of the ideal one."""
    return Camera((1280, 960), 868.0, (646.5, 473.8), Radial((-5.2e-5, 6.1e-7), (2, 3)))


def _camera_2004() -> Camera:
    paper = (1.07761103142178, -0.00096240306505, 0.00000401304361)
    lens, phi = Radial.from_paper(*paper, phi=_PAPER_PHI)
    return Camera((780, 580), phi, (392.3, 287.6), lens)


def _station_2004() -> Station:
    return Station("overhead", overhead_pose(-1.25, -0.13, 2.5, tilt_x_deg=2.5, tilt_y_deg=-3.0, yaw_deg=89.0))


def _field_of_2004() -> Target:
    """A small field of 4.9 x 3.4 m (the paper does not give its size): outline, halfway line and circle."""
    whole = ssl_field("B", field_length_m=4.9, field_width_m=3.4, center_circle_radius_m=0.5)
    points = [
        *("TopLeftCorner", "TopRightCorner", "BottomLeftCorner", "BottomRightCorner"),
        *("TopHalfwayCrossing", "BottomHalfwayCrossing", "TopCircleCrossing", "BottomCircleCrossing"),
    ]
    curves = ["TopTouchLine", "BottomTouchLine", "LeftGoalLine", "RightGoalLine", "HalfwayLine", "CenterCircle"]
    return custom({name: whole.points[name] for name in points}, {name: whole.curves[name] for name in curves})


def _ssl_field() -> tuple[Scene, Disturbance]:
    cameras = {"overhead": _overhead_camera()}
    pose = overhead_pose(-2.27, -0.12, 4.02, tilt_x_deg=1.8, tilt_y_deg=-2.4, yaw_deg=90.6)
    stations = {"overhead": Station("overhead", pose)}
    field = field_scene(ssl_field("B"), cameras, stations, frames=8, spacing_m=0.15)
    boards = board_scene(checkerboard(9, 6, 0.1), cameras, stations, count=12, seed=1)
    how = {"robots": 8, "balls": 1, "shadows": 1, "wear": 0.03, "jpeg_quality": 90}
    return replace(join(field, boards), photography=how), _WORKDAY


def _rings_2004() -> tuple[Scene, Disturbance]:
    sheet = rings([i / 100 for i in range(1, 37)])
    cam_from_sheet = Pose.exp((0.012, -0.016, 0.3, 0.002, 0.0015, 0.4))
    scene = rings_scene(sheet, {"overhead": _camera_2004()}, {"overhead": _station_2004()}, cam_from_sheet)
    return replace(scene, photography={"jpeg_quality": 95}), Disturbance(curves_sigma_px=0.2)


def _field_2004() -> tuple[Scene, Disturbance]:
    cameras, stations = {"overhead": _camera_2004()}, {"overhead": _station_2004()}
    scene = field_scene(_field_of_2004(), cameras, stations, frames=1, spacing_m=0.03)
    how = {"robots": 5, "balls": 1, "shadows": 1, "wear": 0.03, "jpeg_quality": 95}
    return replace(scene, photography=how), Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)


def _two_cameras() -> tuple[Scene, Disturbance]:
    left = _overhead_camera()
    right = Camera((1280, 960), 873.4, (631.2, 486.0), Radial((-6.1e-5, 6.3e-7), (2, 3)))
    cameras = {"left": left, "right": right}
    stations = {
        "left": Station("left", overhead_pose(-2.3, 0.05, 4.4, tilt_x_deg=4.0, tilt_y_deg=2.0, yaw_deg=90.0)),
        "right": Station("right", overhead_pose(2.35, -0.08, 4.5, tilt_x_deg=5.0, tilt_y_deg=-2.5, yaw_deg=-90.8)),
    }
    field = field_scene(ssl_field("B"), cameras, stations, frames=4, spacing_m=0.15)
    shared = board_scene(
        checkerboard(9, 6, 0.1), cameras, stations, count=8, seed=2, held=BoardRanges((3.0, 5.0), (20.0, 50.0))
    )
    return join(field, shared), _WORKDAY


def _moved_camera() -> tuple[Scene, Disturbance]:
    stations = {
        "before": Station("overhead", overhead_pose(-2.27, -0.12, 4.02, tilt_x_deg=1.8, tilt_y_deg=-2.4, yaw_deg=90.6)),
        "after": Station("overhead", overhead_pose(-2.0, 0.06, 4.0, tilt_x_deg=-3.1, tilt_y_deg=1.2, yaw_deg=88.9)),
        "leaning": Station("overhead", overhead_pose(-2.3, -1.9, 3.9, tilt_y_deg=-25.0, yaw_deg=90.0)),
    }
    scene = field_scene(ssl_field("B"), {"overhead": _overhead_camera()}, stations, frames=4, spacing_m=0.15)
    return scene, _WORKDAY


def _photographs() -> tuple[Scene, Disturbance]:
    pose = overhead_pose(-2.27, -0.12, 4.02, tilt_x_deg=6.0, tilt_y_deg=-5.0, yaw_deg=90.6)
    stations = {"overhead": Station("overhead", pose)}
    scene = field_scene(ssl_field("B"), {"overhead": _overhead_camera()}, stations, frames=4)
    how = {"robots": 8, "balls": 1, "shadows": 1, "wear": 0.05, "jpeg_quality": 95}
    return replace(scene, photography=how), Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)


def _boards() -> tuple[Scene, Disturbance]:
    cameras = {"camera": _overhead_camera()}
    stations = {"camera": Station("camera", Pose.identity())}
    scene = board_scene(checkerboard(9, 6, 0.05), cameras, stations, count=20, seed=3, held=BoardRanges((0.5, 1.5)))
    return scene, Disturbance(points_sigma_px=0.2)


def _fisheye() -> tuple[Scene, Disturbance]:
    camera = Camera((1280, 960), 548.0, (637.1, 482.4), KannalaBrandt((-0.012, 0.004, -0.003, 0.0006)))
    stations = {"fisheye": Station("fisheye", overhead_pose(0.2, -0.3, 2.8, tilt_x_deg=14.0, tilt_y_deg=9.0))}
    return field_scene(ssl_field("B"), {"fisheye": camera}, stations, frames=4), _WORKDAY


SCENES: dict[str, Callable[[], tuple[Scene, Disturbance]]] = {
    "ssl-field": _ssl_field,
    "rings-2004": _rings_2004,
    "field-2004": _field_2004,
    "two-cameras": _two_cameras,
    "moved-camera": _moved_camera,
    "photographs": _photographs,
    "boards": _boards,
    "fisheye": _fisheye,
}


def scene_to_json(scene: Scene, disturbance: Disturbance | None = None) -> dict[str, Any]:
    """A scene and its disturbance in the format of a file; poses are exact up to rounding, everything else exactly."""
    return {
        "format": SCENE_FORMAT,
        "version": SCENE_VERSION,
        "units": UNITS,
        "targets": {name: dict(target.spec) for name, target in scene.targets.items()},
        "cameras": {name: camera_to_json(camera) for name, camera in scene.cameras.items()},
        "stations": {
            name: {
                "camera": station.camera,
                "position_m": station.cam_from_world.position.tolist(),
                "rotation_vector": rotation_log(station.cam_from_world.rotation).tolist(),
            }
            for name, station in scene.stations.items()
        },
        "placements": {
            name: {"translation_m": pose.translation.tolist(), "rotation_vector": rotation_log(pose.rotation).tolist()}
            for name, pose in scene.placements.items()
        },
        "views": [
            {one.name: value for one in fields(plan) if (value := getattr(plan, one.name)) != one.default}
            for plan in scene.views
        ],
        "disturbance": asdict(disturbance or Disturbance()),
        **({"photography": dict(scene.photography)} if scene.photography else {}),
    }


def content(name: str) -> dict[str, Any]:
    """Content of a scene's file, with rounded positions, and without default values of the disturbance."""
    data = scene_to_json(*SCENES[name]())
    for one in data["stations"].values():
        one["position_m"] = [round(number, 12) + 0.0 for number in one["position_m"]]
    usual = vars(Disturbance())
    data["disturbance"] = {key: value for key, value in data["disturbance"].items() if value != usual[key]}
    return data


def main(given: Sequence[str]) -> int:
    for name in SCENES:
        write_json(Path(*given or (FOLDER,)) / f"{name}.json", content(name))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
