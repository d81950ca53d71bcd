"""Scenes with known truth: every lens with every mix of targets, each of which determines its camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scenery import BoardRanges, board_scene, field_scene, join, overhead_pose, rings_scene

from ceres_cal.base.transforms import Pose
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial, Spline
from ceres_cal.scene.lens.spline import COLUMNS, ROWS
from ceres_cal.scene.targets import Segment, Target, checkerboard, custom, rings, ssl_field
from ceres_cal.simulate import Scene, Station

# phi, lens, and the height (m) from which the image just contains a division B field.
_LENSES: dict[str, tuple[float, Lens, float]] = {
    "radial-2-3": (868.0, Radial((-5.2e-5, 6.1e-7), (2, 3)), 5.2),
    "radial-3": (840.0, Radial((6.0e-7,), (3,)), 5.2),
    "radial-3-5": (850.0, Radial((3.6e-7, 2.3e-13), (3, 5)), 5.2),
    "radial-2-3-4-5": (861.0, Radial((-4.1e-5, 3.7e-7, 1.2e-10, 1.3e-13), (2, 3, 4, 5)), 5.2),
    "brown": (825.0, Brown((-0.24, 0.082, 4e-4, -3e-4, -0.011)), 5.2),
    "kannala-brandt": (548.0, KannalaBrandt((-0.012, 0.004, -0.003, 0.0006)), 3.2),
}
LENSES = tuple(_LENSES)
_RATIONAL = (0.31, -0.05, 4e-4, -3e-4, 0.01, 0.58, 0.02, 0.004, 9e-4, -4e-4, -7e-4, 3e-4)
# rim, displacements along the radius from the axis outwards, and across it, px
_SPLINE = (
    620.0,
    *(-1.2, -4.0, -9.0, -15.0, -21.0, -26.0, -29.0, -30.0, -29.5, -28.0, -27.0),
    *(0.9, -1.3, 0.4, 0.7) * 6,
)
_SURFACE = (*_SPLINE[:26], 0.92, 0.69, *(0.7 * np.sin(0.37 * np.arange(2 * COLUMNS * ROWS))).tolist())
_MORE: dict[str, tuple[float, Lens, float]] = {
    "brown-all": (825.0, Brown(_RATIONAL, ("rational", "prism")), 5.2),
    "brown-rational": (825.0, Brown(_RATIONAL[:8], ("rational",)), 5.2),
    "kannala-brandt-tangential": (
        548.0,
        KannalaBrandt((-0.012, 0.004, -0.003, 0.0006, 8e-4, -5e-4), ("tangential",)),
        3.2,
    ),
    "spline": (825.0, Spline(_SPLINE, (2, 3, 4)), 5.2),
    "spline-surface": (825.0, Spline(_SURFACE, (2, 3), ("surface",)), 5.2),
}
EVERY_LENS = tuple(name for name in (*_LENSES, *_MORE) if name != "spline-surface")
"""With all optional terms of a lens, except a surface, most of whose nodes are not observed."""

RADIAL = Options(lens="radial", usual_camera=False)
"""The paper's lens without further priors, for tests that do not depend on the lens."""

_SPACING_M = 0.2
_LINES = tuple(name for name in ssl_field("B").curve_names if name != "CenterCircle")
_BOARD = checkerboard(9, 6, 0.1)


def camera(lens: str) -> Camera:
    """1280 x 960 px with its principal point off the centre."""
    phi, model, _ = (_LENSES | _MORE)[lens]
    return Camera((1280, 960), phi, (651.3, 468.9), model)


def _height_m(lens: str) -> float:
    return _LENSES[lens][2]


def _leaning(lens: str) -> tuple[dict[str, Camera], dict[str, Station]]:
    """One station above the field, tilted by 18 degrees."""
    pose = overhead_pose(-0.5, -1.2, _height_m(lens), tilt_x_deg=-14.0, tilt_y_deg=-11.5, yaw_deg=4.0)
    return {"overhead": camera(lens)}, {"overhead": Station("overhead", pose)}


def _upright(lens: str) -> tuple[dict[str, Camera], dict[str, Station]]:
    """One station above the field, tilted by 1 degree: the field alone does not determine phi."""
    pose = overhead_pose(0.1, 0.2, _height_m(lens), tilt_x_deg=0.8, tilt_y_deg=-0.6, yaw_deg=-2.0)
    return {"overhead": camera(lens)}, {"overhead": Station("overhead", pose)}


def side_by_side(left: Camera) -> tuple[dict[str, Camera], dict[str, Station]]:
    """Two cameras with nearly the same phi, each above its half of the field."""
    stations = {
        "left": Station("left", overhead_pose(-2.3, 0.05, 4.4, 4.0, 2.0, 90.0)),
        "right": Station("right", overhead_pose(2.35, -0.08, 4.5, 5.0, -2.5, -90.8)),
    }
    return {"left": left, "right": replace(left, phi=873.4)}, stations


def corners(lens: str) -> Scene:
    """The points of the field alone."""
    return field_scene(ssl_field("B"), *_leaning(lens), curves=())


def lines(lens: str) -> Scene:
    """The straight lines of the field alone."""
    return field_scene(ssl_field("B"), *_leaning(lens), points=(), curves=_LINES, spacing_m=_SPACING_M)


def lines_and_arcs(lens: str) -> Scene:
    """The lines and the centre circle; their left edges instead of the middle of the paint."""
    scene = field_scene(ssl_field("B"), *_leaning(lens), points=(), spacing_m=_SPACING_M)
    return replace(scene, views=tuple(replace(plan, side="left") for plan in scene.views))


def boards(lens: str) -> Scene:
    """Checkerboards at several tilts in front of one static camera; nothing shows the world."""
    stations = {"camera": Station("camera", Pose.identity())}
    return board_scene(_BOARD, {"camera": camera(lens)}, stations, count=8, seed=11)


def rings_and_field(lens: str) -> Scene:
    """A nearly frontal sheet of rings that fills the image, then the field."""
    cameras, stations = _leaning(lens)
    sheet = rings([0.04 * i for i in range(1, 16)])
    cam_from_sheet = Pose.exp((0.03, -0.05, 0.2, 0.004, -0.003, 0.5))
    paper = rings_scene(sheet, cameras, stations, cam_from_sheet, spacing_m=0.05)
    return join(paper, field_scene(ssl_field("B"), cameras, stations, spacing_m=_SPACING_M))


def _court() -> Target:
    """A court of 8 x 5 m with six poles of 1 m."""
    places = {
        "a": (-3.5, -2.0),
        "b": (0.2, -2.2),
        "c": (3.4, -1.8),
        "d": (-3.3, 1.9),
        "e": (-0.1, 2.1),
        "f": (3.5, 2.0),
    }
    points = {f"pole_{name}_top": (x, y, 1.0) for name, (x, y) in places.items()}
    points |= {f"pole_{name}_foot": (x, y, 0.0) for name, (x, y) in places.items()}
    ends = {
        "south": (-4.0, -2.5, 4.0, -2.5),
        "north": (-4.0, 2.5, 4.0, 2.5),
        "west": (-4.0, -2.5, -4.0, 2.5),
        "east": (4.0, -2.5, 4.0, 2.5),
        "across": (-4.0, -2.5, 4.0, 2.5),
    }
    return custom(
        points, {name: Segment((x1, y1, 0.0), (x2, y2, 0.0), 0.05) for name, (x1, y1, x2, y2) in ends.items()}
    )


def poles(lens: str) -> Scene:
    """A custom target with points at two heights, and segments."""
    return field_scene(_court(), *_leaning(lens), spacing_m=_SPACING_M, name="court")


def two_cameras(lens: str) -> Scene:
    """Two cameras above one field, and boards that both see at the same time."""
    west = camera(lens)
    east = replace(west, phi=west.phi * 1.013, principal_point=(633.2, 487.5))
    height = _height_m(lens)
    stations = {
        "west": Station("west", overhead_pose(-2.4, -0.4, height, tilt_x_deg=14.0, tilt_y_deg=7.0, yaw_deg=88.0)),
        "east": Station("east", overhead_pose(2.3, 0.3, height - 0.2, tilt_x_deg=15.0, tilt_y_deg=-6.0, yaw_deg=-91.0)),
    }
    cameras = {"west": west, "east": east}
    field = field_scene(ssl_field("B"), cameras, stations, spacing_m=_SPACING_M)
    distance_m = (0.5 * height, 0.9 * height)
    return join(field, board_scene(_BOARD, cameras, stations, count=4, seed=12, held=BoardRanges(distance_m)))


def several_stations(lens: str) -> Scene:
    """One camera at three stations above one field."""
    height = _height_m(lens)
    stations = {
        "first": Station("overhead", overhead_pose(0.3, -0.1, height, tilt_x_deg=1.0, tilt_y_deg=2.0)),
        "second": Station("overhead", overhead_pose(-1.6, 0.4, height - 0.3, tilt_y_deg=-16.0, yaw_deg=20.0)),
        "third": Station("overhead", overhead_pose(0.4, 1.7, height, tilt_x_deg=19.0, yaw_deg=-8.0)),
    }
    return field_scene(ssl_field("B"), {"overhead": camera(lens)}, stations, spacing_m=_SPACING_M)


def field_and_boards(lens: str) -> Scene:
    """The field from straight above, and boards that determine phi."""
    cameras, stations = _upright(lens)
    field = field_scene(ssl_field("B"), cameras, stations, frames=2, spacing_m=_SPACING_M)
    return join(field, board_scene(_BOARD, cameras, stations, count=6, seed=13))


MIXES: dict[str, Callable[[str], Scene]] = {
    "corners": corners,
    "lines": lines,
    "lines-arcs": lines_and_arcs,
    "boards": boards,
    "rings-field": rings_and_field,
    "poles": poles,
    "two-cameras": two_cameras,
    "several-stations": several_stations,
    "field-boards": field_and_boards,
}

SCENES: dict[str, Callable[[], Scene]] = {
    f"{lens}/{mix}": partial(make, lens) for lens in LENSES for mix, make in MIXES.items()
}
"""Every lens with every mix, by name "<lens>/<mix>"."""
