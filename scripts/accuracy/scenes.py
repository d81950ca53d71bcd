"""The scenes of `accuracy.py`: problems with their priors, those measured with ssl-vision, and misplaced paint."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from math import hypot

import msgspec
import numpy as np
from scenery import BoardRanges, board_scene, field_scene, join, overhead_pose

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, Lens, Radial
from ceres_cal.scene.targets import Arc, Curve, Segment, checkerboard, custom, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Simulation, Station, simulate

FIELD = ssl_field("B")
CLEAN_NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)
GROSS_NOISE = replace(CLEAN_NOISE, outliers=0.2)
SSL_NOISE = Disturbance(points_sigma_px=0.5, curves_sigma_px=0.3)
PAINT_SIGMA_M = 0.008
RADIAL = Radial((-5.2e-5, 6.1e-7))
_SPACING_M = 0.15


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene, the options of its calibration, and priors whose values are the true ones."""

    scene: Scene
    options: Options
    priors: tuple[Prior, ...] = ()


def _camera() -> Camera:
    return Camera((1280, 960), 868.0, (646.5, 473.8), RADIAL)


def taped(scene: Scene, station: str, sigma_m: float) -> Prior:
    """A prior for the height of a station with this sigma."""
    height_m = float(scene.camera_at(station).position[2])
    return Prior("station", station, "height_m", (height_m,), (sigma_m,))


# ---- against the Cramer-Rao bound -----------------------------------------------------------------------------------


def boards(phi: float, lens: Lens, count: int = 20) -> Problem:
    """A board at some places in front of one camera."""
    cameras = {"camera": Camera((1280, 960), phi, (646.5, 473.8), lens)}
    stations = {"camera": Station("camera", Pose.identity())}
    scene = board_scene(checkerboard(9, 6, 0.05), cameras, stations, count=count, seed=3, held=BoardRanges((0.5, 1.5)))
    return Problem(scene, Options(usual_camera=False, lens=lens.kind))


def over_the_field() -> Problem:
    """One camera above a division B field, with its points, lines and circle; the height is known to 10 mm."""
    pose = overhead_pose(-0.3, 0.2, 5.2, tilt_x_deg=1.8, tilt_y_deg=-2.4, yaw_deg=1.6)
    scene = field_scene(FIELD, {"overhead": _camera()}, {"overhead": Station("overhead", pose)}, spacing_m=_SPACING_M)
    return Problem(scene, Options(usual_camera=False, lens="radial"), (taped(scene, "overhead", 0.010),))


def two_cameras() -> Problem:
    """Two cameras above one field that both see its middle, and six boards that both see at the same time."""
    right = Camera((1280, 960), 873.4, (631.2, 486.0), Radial((-6.1e-5, 6.3e-7)))
    cameras = {"left": _camera(), "right": right}
    stations = {
        "left": Station("left", overhead_pose(-2.3, 0.05, 4.4, tilt_x_deg=4.0, tilt_y_deg=2.0, yaw_deg=90.0)),
        "right": Station("right", overhead_pose(2.35, -0.08, 4.5, tilt_x_deg=5.0, tilt_y_deg=-2.5, yaw_deg=-90.8)),
    }
    field = field_scene(FIELD, cameras, stations, spacing_m=_SPACING_M)
    board = checkerboard(9, 6, 0.1)
    both = board_scene(board, cameras, stations, count=6, seed=2, held=BoardRanges((3.0, 5.0), (20.0, 50.0)))
    return Problem(join(field, both), Options(usual_camera=False, lens="radial"))


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "boards, radial": partial(boards, 868.0, RADIAL),
    "boards, brown": partial(boards, 825.0, Brown((-0.24, 0.082, 4e-4, -3e-4, -0.011))),
    "field": over_the_field,
    "two cameras": two_cameras,
}


# ---- problems with phi and height correlated ------------------------------------------------------------------------


def tilted(tilt_deg: float, height_sigma_m: float | None = None, boards: int = 0, spacing_m: float = 0.4) -> Problem:
    """A whole field's lines, sparsely observed by a tilted camera, with a stated height or boards if wanted."""
    cameras = {"overhead": replace(_camera(), phi=560.0)}
    pose = overhead_pose(-0.3, 0.2, 4.0, tilt_x_deg=0.6 * tilt_deg, tilt_y_deg=-0.8 * tilt_deg, yaw_deg=1.6)
    stations = {"overhead": Station("overhead", pose)}
    scene = field_scene(FIELD, cameras, stations, points=(), spacing_m=spacing_m)
    if boards:
        shown = board_scene(checkerboard(9, 6, 0.1), cameras, stations, boards, seed=5, held=BoardRanges((1.0, 2.0)))
        scene = join(scene, shown)
    priors = () if height_sigma_m is None else (taped(scene, "overhead", height_sigma_m),)
    return Problem(scene, Options(usual_camera=False, lens="radial"), priors)


# ---- mirrored poses -------------------------------------------------------------------------------------------------


def small_boards(count: int, seed: int) -> Scene:
    """Boards so small and distant that perspective hardly distinguishes their two mirrored poses."""
    cameras = {"camera": Camera((1280, 960), 600.0, (645.0, 470.0), Brown((-0.28, 0.07, 0.0, 0.0, 0.0)))}
    stations = {"camera": Station("camera", Pose.identity())}
    board = checkerboard(6, 5, 0.06)
    return board_scene(board, cameras, stations, count, seed, held=BoardRanges((0.7, 2.5), (15.0, 40.0)))


# ---- scenes of ssl-vision -------------------------------------------------------------------------------------------

_HALF_DIAGONAL_2004_PX = 0.5 * hypot(780, 580)
_PAPER_LIKE = Radial((-0.9e-3, 4.0e-6), (2, 3))
"""The paper's polynomial with a1 = 1, in the pixels of a 780 x 580 image: 450 px -> 632 px."""
_SSL_VISION = Radial((2.0e-6,), (3,))
"""ssl-vision's own model with the same strength: 450 px -> 632 px."""

SSL_VISION_MM: Mapping[str, tuple[tuple[float, float], tuple[float, float]]] = {
    "half, paper's lens": ((2.5, 8.2), (3.0, 8.4)),
    "whole, paper's lens": ((2.6, 8.0), (2.5, 9.8)),
    "half, its own lens": ((0.82, 2.1), (1.9, 3.8)),
    "whole, its own lens": ((0.56, 1.5), (0.58, 1.7)),
}
"""Errors of ssl-vision's own calibrator, which was measured elsewhere: mean and worst field error at z = 0 and at
z = 150 mm, medians over 20 seeds. It was given the correct line of each point, and the height."""


def ssl_problem(half: bool, lens: Radial) -> Problem:
    """A camera at 4 m, tilted by 3 degrees, sees four corners and line points every 150 mm; the height is known to 5
    mm.

    It sees half of the field in 780 x 580 px, where the barrel distortion cuts off a part, or the whole field in 1280 x
    960 px with the lens scaled to this size.
    """
    size = (780, 580) if half else (1280, 960)
    grown = 0.5 * hypot(*size) / _HALF_DIAGONAL_2004_PX
    scaled = tuple(a / grown ** (power - 1) for a, power in zip(lens.values, lens.powers, strict=True))
    camera = Camera(
        size, 540.0 if half else 500.0, (0.5 * (size[0] - 1), 0.5 * (size[1] - 1)), Radial(scaled, lens.powers)
    )
    pose = overhead_pose(
        -2.05 if half else 0.0, 0.0, 4.0, tilt_x_deg=-3.0 if half else 3.0, yaw_deg=90.0 if half else 0.0
    )
    right = ("TopHalfwayCrossing", "BottomHalfwayCrossing") if half else ("TopRightCorner", "BottomRightCorner")
    scene = field_scene(
        FIELD,
        {"overhead": camera},
        {"overhead": Station("overhead", pose)},
        points=("TopLeftCorner", "BottomLeftCorner", *right),
        spacing_m=_SPACING_M,
    )
    return Problem(scene, Options(usual_camera=False, powers=lens.powers), (taped(scene, "overhead", 0.005),))


SSL_PROBLEMS: dict[str, Callable[[], Problem]] = {
    "half, paper's lens": partial(ssl_problem, True, _PAPER_LIKE),
    "whole, paper's lens": partial(ssl_problem, False, _PAPER_LIKE),
    "half, its own lens": partial(ssl_problem, True, _SSL_VISION),
    "whole, its own lens": partial(ssl_problem, False, _SSL_VISION),
}


def field_places(half: bool = False) -> Array:
    """A grid of places (N, 2) m every 250 mm on the field or its left half."""
    x, y = np.meshgrid(np.linspace(-4.5, 0.0 if half else 4.5, 19 if half else 37), np.linspace(-3.0, 3.0, 25))
    return np.column_stack([x.ravel(), y.ravel()])


# ---- the field as built ---------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PaintedField:
    """Observations of a field whose paint is misplaced, with the names of the field as drawn.

    Attributes:
        offsets_m: offsets of each line and of the numbers of the circle, named as in tolerances.
    """

    scene: Scene
    observations: Observations
    offsets_m: Mapping[str, float]


def _paint(seed: int) -> tuple[dict[str, Curve], dict[str, float]]:
    """The curves of the field with random offsets of PAINT_SIGMA_M, and these offsets."""
    rng = np.random.default_rng(seed)
    curves: dict[str, Curve] = {}
    offsets: dict[str, float] = {}
    for name, curve in FIELD.curves.items():
        if isinstance(curve, Arc):
            x, y, radius = PAINT_SIGMA_M * rng.standard_normal(3)
            offsets |= {f"{name}.x": x, f"{name}.y": y, f"{name}.radius": radius}
            middle = (curve.centre[0] + x, curve.centre[1] + y, 0.0)
            curves[name] = msgspec.structs.replace(curve, centre=middle, radius_m=curve.radius_m + radius)
        else:
            offsets[name] = PAINT_SIGMA_M * rng.standard_normal()
            along = np.subtract(curve.end, curve.start)
            left = offsets[name] * np.array([-along[1], along[0], 0.0]) / np.linalg.norm(along)
            start, end = curve.start + left, curve.end + left
            curves[name] = Segment(tuple(start.tolist()), tuple(end.tolist()), curve.width_m)
    return curves, offsets


def _observed(scene: Scene, offsets_m: Mapping[str, float], seed: int, priors: tuple[Prior, ...] = ()) -> PaintedField:
    assert scene.targets["field"].curve_names == FIELD.curve_names  # features keep their numbers
    seen = simulate(scene, CLEAN_NOISE, seed).observations
    return PaintedField(scene, replace(seen, targets={**seen.targets, "field": FIELD}, priors=priors), offsets_m)


def painted_by_six_stations(seed: int) -> PaintedField:
    """One camera at six stations above a misplaced field, four frames each, and ten boards at the first station."""
    places = [
        (-2.2, -1.2, 4.6, 12.0, 6.0, 10.0),
        (2.1, -1.0, 5.0, 14.0, -8.0, 95.0),
        (2.3, 1.3, 4.8, -10.0, -12.0, 170.0),
        (-2.0, 1.1, 5.3, -15.0, 9.0, -80.0),
        (0.2, -1.6, 5.4, 18.0, 2.0, 40.0),
        (-0.3, 1.5, 5.1, -16.0, 5.0, -130.0),
    ]
    stations = {f"place {i}": Station("a", overhead_pose(*place)) for i, place in enumerate(places, start=1)}
    curves, offsets_m = _paint(seed)
    field = field_scene(custom({}, curves), {"a": _camera()}, stations, frames=4, points=(), spacing_m=_SPACING_M)
    before = {"place 1": stations["place 1"]}
    boards = board_scene(checkerboard(9, 6, 0.1), {"a": _camera()}, before, count=10, seed=seed)
    return _observed(join(field, boards), offsets_m, seed)


def painted_by_two_cameras(seed: int, heights_known: bool) -> PaintedField:
    """Two static cameras, each above its half of a misplaced field; nothing but the field is seen.

    Known heights are known to 5 mm; otherwise phi and height are correlated.
    """
    stations = {
        "left": Station("left", overhead_pose(-2.2, 0.0, 4.0, 2.0, 1.0, 0.0)),
        "right": Station("right", overhead_pose(2.2, 0.1, 4.1, -1.0, 2.0, 1.0)),
    }
    cameras = {"left": _camera(), "right": replace(_camera(), phi=850.0)}
    curves, offsets_m = _paint(seed)
    scene = field_scene(custom({}, curves), cameras, stations, points=(), spacing_m=0.1)
    priors = tuple(taped(scene, name, 0.005) for name in stations) if heights_known else ()
    return _observed(scene, offsets_m, seed, priors)


def without_noise(simulation: Simulation) -> Observations:
    """The simulated observations at their true pixels."""
    found = simulation.observations
    points = replace(found.points, pixels=simulation.points.pixels)
    return replace(found, points=points, curves=replace(found.curves, pixels=simulation.curves.pixels))
