"""The closed-form initial estimate: near the truth for every mix of points and lines, and honest about phi."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scenery import board_scene, field_scene, join, overhead_pose
from scenes import RADIAL, SCENES
from thorough import partly

from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.transforms import Pose, rotation_log
from ceres_cal.observations import Observations, Prior
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, ViewPlan, simulate
from ceres_cal.start.initialise import Start, initialise

NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)
CAMERA = Camera((1280, 960), 868.0, (651.3, 468.9), Radial((-5.2e-5, 6.1e-7)))


def start_of(observations: Observations, options: Options | None = None) -> Start:
    return initialise(gather_sights(observations), options or RADIAL)


def options_for(scene: Scene, **more: Any) -> Options:
    lens = next(iter(scene.cameras.values())).lens
    return Options(lens=lens.kind, powers=getattr(lens, "powers", (2, 3)), **more)


def angle_deg(a: Pose, b: Pose) -> float:
    return float(np.degrees(np.linalg.norm(rotation_log(a.rotation @ b.rotation.T))))


def alone(pose: Pose, **more: Any) -> Scene:
    """CAMERA above a division B field at one station, "up"."""
    return field_scene(ssl_field("B"), {"camera": CAMERA}, {"up": Station("camera", pose)}, **more)


# ---- nearness -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "disturbance", [pytest.param(Disturbance(), marks=pytest.mark.thorough), NOISE], ids=["exact", "noisy"]
)
@pytest.mark.parametrize("name", partly(SCENES, [*SCENES][1::2]))  # the others each time: their calibration
def test_starts_are_near_the_truth(name: str, disturbance: Disturbance) -> None:
    """Near enough for the solve, and the initial camera shows all observations.

    Largest measured errors: 7 % of phi, 2 degrees, 0.3 m at 3 to 5 m, and a median residual of 3.9 px (rings, which are
    taken for frontal).
    """
    scene = SCENES[name]()
    observations = simulate(scene, disturbance).observations
    start = start_of(observations, options_for(scene))
    assert set(start.phi_from.values()) == {"views"}
    for camera, truth in scene.cameras.items():
        assert start.estimate.cameras[camera].phi == pytest.approx(truth.phi, rel=0.1)
        assert not start.estimate.cameras[camera].folds
    for station, place in scene.stations.items():
        found = start.estimate.stations[station]
        assert found.camera == place.camera
        assert angle_deg(found.cam_from_world, place.cam_from_world) < 5.0
        assert np.linalg.norm(found.cam_from_world.position - place.cam_from_world.position) < 0.4
    for placement, pose in scene.placements.items():
        if placement != "rings":
            assert angle_deg(start.estimate.placements[placement], pose) < 10.0  # 5 degrees measured
    found_residuals = residuals(gather_sights(observations, predicted=True), start.estimate)
    lengths = np.concatenate([np.linalg.norm(found_residuals.points, axis=1), np.abs(found_residuals.curves)])
    assert np.all(np.isfinite(lengths))
    assert np.median(lengths) < 6.0


def test_a_thousand_rows_of_one_line_start_as_well_as_ten() -> None:
    """Very many observations are thinned out evenly for the initial estimate."""
    pose = overhead_pose(-0.5, -1.2, 5.2, tilt_x_deg=-14.0, tilt_y_deg=-11.5, yaw_deg=4.0)
    for spacing_m in (0.3, 0.003):
        scene = alone(pose, points=(), spacing_m=spacing_m)
        start = start_of(simulate(scene, NOISE).observations)
        assert start.estimate.cameras["camera"].phi == pytest.approx(868.0, rel=0.05)


def test_points_off_the_plane_are_left_to_the_solve() -> None:
    """Tops of poles 1 m above the court: the plane with the most observations determines the pose."""
    scene = SCENES["radial-2-3/poles"]()
    plan = scene.views[0]
    tops = replace(scene, views=(replace(plan, points=tuple(n for n in scene.targets["court"].points if "top" in n)),))
    start = start_of(simulate(tops).observations)
    assert (
        angle_deg(start.estimate.stations["overhead"].cam_from_world, scene.stations["overhead"].cam_from_world) < 5.0
    )


# ---- phi ------------------------------------------------------------------------------------------------------------

FRONTAL = overhead_pose(0.1, -0.2, 5.0)


def test_phi_of_a_frontal_view_is_a_guess() -> None:
    start = start_of(simulate(alone(FRONTAL), NOISE).observations)
    assert start.phi_from == {"camera": "guess"}
    found = start.estimate.camera_at("up")
    assert 0.5 < found.phi / CAMERA.phi < 2.0
    # A frontal view determines phi / height.
    assert found.phi / found.position[2] == pytest.approx(CAMERA.phi / 5.0, rel=0.05)


@pytest.mark.parametrize("phi_error", [0.9, 1.0, 1.15])
def test_a_prior_on_phi_is_taken(phi_error: float) -> None:
    prior = Prior("camera", "camera", "phi", (phi_error * 868.0,), (10.0,))
    start = start_of(simulate(alone(FRONTAL), NOISE).observations, Options(lens="radial", priors=(prior,)))
    assert start.phi_from == {"camera": "prior"}
    assert start.estimate.cameras["camera"].phi == pytest.approx(phi_error * 868.0, rel=0.03)


@pytest.mark.parametrize("quantity", ["height_m", "position_m"])
@pytest.mark.parametrize("height_m", [4.5, 5.0])
def test_a_prior_on_the_height_tells_phi(quantity: str, height_m: float) -> None:
    value = (height_m,) if quantity == "height_m" else (0.1, -0.2, height_m)
    prior = Prior("station", "up", quantity, value, (0.01,) * len(value))
    start = start_of(replace(simulate(alone(FRONTAL), NOISE).observations, priors=(prior,)))
    assert start.phi_from == {"camera": "prior"}
    assert start.estimate.stations["up"].cam_from_world.position[2] == pytest.approx(height_m, rel=0.02)
    assert start.estimate.cameras["camera"].phi == pytest.approx(868.0 * height_m / 5.0, rel=0.05)


def test_a_fixed_phi_is_kept() -> None:
    start = start_of(
        simulate(alone(FRONTAL), NOISE).observations, Options(lens="radial", fixed={"phi": 900.0, "a2": -5e-5})
    )
    assert start.phi_from == {"camera": "fixed"}
    assert start.estimate.cameras["camera"].phi == 900.0
    assert start.estimate.cameras["camera"].lens.coefficients["a2"] == -5e-5


def test_phi_is_guessed_for_the_camera_that_needs_it_only() -> None:
    tilted = overhead_pose(-0.5, -1.2, 5.2, tilt_x_deg=-14.0, tilt_y_deg=-11.5)
    stations = {"up": Station("upright", FRONTAL), "aside": Station("leaning", tilted)}
    scene = field_scene(ssl_field("B"), {"upright": CAMERA, "leaning": CAMERA}, stations)
    assert start_of(simulate(scene, NOISE).observations).phi_from == {"upright": "guess", "leaning": "views"}


@pytest.mark.parametrize(
    "quantity, value, expected",
    [
        ("principal_point", (700.0, 420.0), (700.0, 420.0)),
        ("cx", (700.0,), (700.0, 479.5)),
        ("cy", (420.0,), (639.5, 420.0)),
        ("cx", (8000.0,), (640.0, 480.0)),  # nothing fits with the stated value
    ],
)
def test_the_principal_point_starts_at_its_prior(
    quantity: str, value: tuple[float, ...], expected: tuple[float, float]
) -> None:
    prior = Prior("camera", "camera", quantity, value, (1.0,) * len(value))
    observations = simulate(alone(overhead_pose(0.0, 0.0, 5.0, 10.0, 8.0)), NOISE).observations
    assert (
        start_of(observations, Options(lens="radial", priors=(prior,))).estimate.cameras["camera"].principal_point
        == expected
    )
    fixed = Options(lens="radial", priors=(prior,), fixed={"cx": 655.0, "cy": 465.0})
    assert start_of(observations, fixed).estimate.cameras["camera"].principal_point == (655.0, 465.0)


@pytest.mark.parametrize(
    "centre, starts", [(CAMERA.principal_point, (639.5, 479.5)), ((330.0, 700.0), (0.28 * 1280, 0.72 * 960))]
)
def test_a_part_of_a_sensor_starts_in_its_quarter(centre: tuple[float, float], starts: tuple[float, float]) -> None:
    scene = alone(overhead_pose(0.0, 0.0, 5.0, 3.0, 2.0))
    scene = replace(scene, cameras={"camera": replace(CAMERA, principal_point=centre)})
    start = start_of(simulate(scene, NOISE).observations)
    assert start.estimate.cameras["camera"].principal_point == pytest.approx(starts)
    assert start.estimate.camera_at("up").phi == pytest.approx(CAMERA.phi, rel=0.5)


# ---- wrong labels ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_wrong_labels_on_a_board_do_not_pose_it(share: float) -> None:
    """One board of eight has many corners with other names: consensus finds its pose."""
    scene = SCENES["radial-2-3/boards"]()
    observations = simulate(scene, NOISE).observations
    rng = np.random.default_rng(1)
    points = observations.points
    rows = rng.choice(np.flatnonzero(points.view == 2), round(54 * share), replace=False)
    feature = points.feature.copy()
    feature[rows] = np.roll(feature[rows], 1)
    start = start_of(replace(observations, points=replace(points, feature=feature)))
    assert start.estimate.cameras["camera"].phi == pytest.approx(868.0, rel=0.1)
    for placement, pose in scene.placements.items():
        assert angle_deg(start.estimate.placements[placement], pose) < 5.0  # 1.5 degrees measured


def test_a_mislabelled_line_of_eleven_does_not_pose_the_field() -> None:
    """All observations of one penalty stretch, 5 % of all, have the name of the halfway line."""
    scene = SCENES["radial-2-3/lines"]()
    observations = simulate(scene, NOISE).observations
    names = ssl_field("B").curve_names
    feature = observations.curves.feature.copy()
    wrong = feature == names.index("LeftPenaltyStretch")
    assert 0.02 < np.mean(wrong) < 0.2
    feature[wrong] = names.index("HalfwayLine")
    start = start_of(replace(observations, curves=replace(observations.curves, feature=feature)))
    truth = scene.stations["overhead"].cam_from_world
    assert angle_deg(start.estimate.stations["overhead"].cam_from_world, truth) < 3.0  # 0.4 degrees measured


# ---- chains of poses ------------------------------------------------------------------------------------------------


def chain() -> Scene:
    """Only the first station sees the field; each of the others sees a board together with a neighbour."""
    board = checkerboard(9, 6, 0.1)
    stations = {
        "a": Station("a", overhead_pose(-1.5, 0.0, 4.0, 8.0, -12.0)),
        "b": Station("b", overhead_pose(0.0, 0.0, 4.0, -9.0, 10.0)),
        "c": Station("c", overhead_pose(1.5, 0.0, 4.0, 7.0, 12.0)),
    }
    cameras = dict.fromkeys("abc", CAMERA)
    views = [ViewPlan(("1",), "a", "field", spacing_m=0.2)]
    placements = {}
    for number, (x, tilt) in enumerate([(-0.9, 0.3), (-0.7, -0.4), (0.7, 0.35), (0.9, -0.3)]):
        name = f"board_{number}"
        placements[name] = Pose.exp((tilt, 0.4 * tilt, 0.5 * number, x, -0.3, 1.0 + 0.1 * number))
        views += [ViewPlan((name,), station, "board", name) for station in ("ab" if x < 0.0 else "bc")]
    return Scene({"field": ssl_field("B"), "board": board}, cameras, stations, placements, tuple(views))


def test_poses_are_chained_through_what_is_seen_by_two() -> None:
    scene = chain()
    start = start_of(simulate(scene, NOISE).observations)
    for station, place in scene.stations.items():
        found = start.estimate.stations[station].cam_from_world
        assert angle_deg(found, place.cam_from_world) < 6.0  # 3 degrees measured
        assert np.linalg.norm(found.position - place.cam_from_world.position) < 0.5  # 0.22 m measured


def test_boards_alone_are_placed_before_their_camera() -> None:
    """Nothing shows the world, so the first station's camera frame is the world."""
    scene = SCENES["brown/boards"]()
    tilted = replace(scene, stations={"camera": Station("camera", overhead_pose(1.0, 2.0, 3.0, 10.0))})
    moved = {name: tilted.stations["camera"].cam_from_world.inverse @ pose for name, pose in scene.placements.items()}
    start = start_of(simulate(replace(tilted, placements=moved)).observations, Options(lens="brown"))
    assert start.estimate.stations["camera"].cam_from_world == Pose.identity()
    for name, pose in scene.placements.items():
        assert angle_deg(start.estimate.placements[name], pose) < 10.0


def test_a_view_that_tells_nothing_is_named() -> None:
    """Two corners of one board of eight, and three of another one: the first one is named with its frame."""
    scene = SCENES["radial-2-3/boards"]()
    few = tuple(
        replace(plan, points=("0,0", "8,5")) if number == 4 else plan for number, plan in enumerate(scene.views)
    )
    with pytest.raises(
        DegenerateError, match=r"^frame 'board_05' \(station 'camera', placement 'board_05'\): 2 points"
    ):
        start_of(simulate(replace(scene, views=few)).observations)


def test_a_board_that_a_second_camera_sees_whole_needs_no_more_from_the_first() -> None:
    """Two corners do not determine a board's pose, but another station has determined it already."""
    scene = chain()
    views = tuple(
        replace(plan, points=("0,0", "8,5")) if plan.station == "a" and plan.placement == "board_0" else plan
        for plan in scene.views
    )
    start = start_of(simulate(replace(scene, views=views), NOISE).observations)
    assert angle_deg(start.estimate.placements["board_0"], scene.placements["board_0"]) < 10.0


def test_boards_and_field_of_one_camera_agree() -> None:
    stations = {"up": Station("camera", FRONTAL)}
    boards = board_scene(checkerboard(9, 6, 0.1), {"camera": CAMERA}, stations, 6, seed=13)
    start = start_of(simulate(join(alone(FRONTAL), boards), NOISE).observations)
    assert start.phi_from == {"camera": "views"}  # the boards are tilted
    assert start.estimate.stations["up"].cam_from_world.position[2] == pytest.approx(5.0, rel=0.06)
