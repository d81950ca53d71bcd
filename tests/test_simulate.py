"""Simulation: every row is where the camera model projects it, and its truth is correct."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from data.built_in_scenes import content, scene_to_json
from hypothesis import given
from hypothesis import strategies as st
from scenery import BoardRanges, board_placements, board_scene, field_scene, join, overhead_pose
from scenes import SCENES

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import Pose
from ceres_cal.observations import Observations
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Arc, Curve, Segment, checkerboard, custom, rings, ssl_field
from ceres_cal.simulate import (
    CLEAN,
    OUTLIER,
    WRONG_LABEL,
    Disturbance,
    Scene,
    Simulation,
    Station,
    ViewPlan,
    built_in_scene,
    load_scene,
    scene_from_json,
    scene_names,
    simulate,
    truth_to_json,
    write_simulation,
)
from data import make_data

ROOT = Path(__file__).resolve().parents[1]
CAMERA = Camera((1280, 960), 868.0, (646.5, 473.8), Radial((-5.2e-5, 6.1e-7)))
WORKDAY = Disturbance(0.5, 0.3, outliers=0.1, outlier_spread_px=30.0, wrong_labels=0.05)

each_scene = pytest.mark.parametrize("name", SCENES)
each_built_in = pytest.mark.parametrize("name", scene_names())


def over_field(frames: int = 1, **options: Any) -> Scene:
    """CAMERA above half of a division B field."""
    stations = {"overhead": Station("overhead", overhead_pose(-2.2, 0.1, 4.0, 2.0, 3.0, 90.0))}
    return field_scene(ssl_field("B"), {"overhead": CAMERA}, stations, frames, **options)


def camera_before_target(scene: Scene, observations: Observations, view: int) -> Camera:
    """The camera of a view with cam_from_target as its pose."""
    entry = observations.views[view]
    placement = Pose.identity() if entry.placement is None else scene.placements[entry.placement]
    station = scene.stations[entry.station]
    return scene.cameras[station.camera].at(station.cam_from_world @ placement)


def distance_to_curve(curve: Curve, side: int, xy: Array) -> Array:
    """Distance (N,) m of places in the plane from the painted line of a curve, by elementary geometry."""
    if isinstance(curve, Arc):
        radius = curve.radius_m - 0.5 * side * curve.width_m
        return np.asarray(np.abs(np.hypot(*(xy - curve.centre[:2]).T) - radius))
    start, end = np.array(curve.start[:2]), np.array(curve.end[:2])
    along = (end - start) / curve.length_m
    left = np.array([-along[1], along[0]])
    s = (xy - start) @ along
    beyond = np.maximum(0.0, np.maximum(-s, s - curve.length_m))
    return np.asarray(np.hypot((xy - start) @ left - 0.5 * side * curve.width_m, beyond))


# ---- without disturbance --------------------------------------------------------------------------------------------


@each_scene
def test_points_are_where_the_camera_sees_them(name: str) -> None:
    scene = SCENES[name]()
    simulation = simulate(scene)
    points = simulation.observations.points
    for view, entry in enumerate(simulation.observations.views):
        rows = points.view == view
        there = scene.targets[entry.target].point_array[points.feature[rows]]
        seen = camera_before_target(scene, simulation.observations, view).project(there)
        np.testing.assert_allclose(points.pixels[rows], seen, rtol=0, atol=1e-9)  # 1e-12 measured
    assert np.array_equal(simulation.points.pixels, points.pixels)
    assert np.all(points.sigma_px == 1.0)


@each_scene
def test_curve_rows_lie_on_their_curves(name: str) -> None:
    scene = SCENES[name]()
    observations = simulate(scene).observations
    curves = observations.curves
    for view, entry in enumerate(observations.views):
        camera, target = camera_before_target(scene, observations, view), scene.targets[entry.target]
        for feature in np.unique(curves.feature[curves.view == view]):
            rows = (curves.view == view) & (curves.feature == feature)
            (side,) = np.unique(curves.side[rows])
            curve = target.curves[target.curve_names[feature]]
            away = distance_to_curve(curve, int(side), camera.locate(curves.pixels[rows]))
            assert np.max(away) < 1e-9  # 1e-13 m measured


@each_scene
def test_shared_scenes_are_whole(name: str) -> None:
    """A requirement of other tests: every station and placement is observed, no lens folds, no view is empty."""
    scene = SCENES[name]()
    observations = simulate(scene).observations
    assert set(observations.stations) == set(scene.stations)
    assert set(observations.placements) == set(scene.placements)
    assert not any(camera.folds for camera in scene.cameras.values())
    assert len(observations.views) == sum(len(plan.frames) for plan in scene.views)
    assert len(observations.points) + len(observations.curves) >= 20


def test_spacing_is_that_of_the_plan() -> None:
    scene = over_field(points=(), curves=("HalfwayLine",), spacing_m=0.25)
    simulation = simulate(scene)
    y = scene.camera_at("overhead").locate(simulation.observations.curves.pixels)[:, 1]
    np.testing.assert_allclose(y, np.arange(-3.0 + 0.125, 3.0, 0.25), atol=1e-9)


def test_only_what_was_asked_for_is_observed() -> None:
    scene = over_field(points=("TopLeftCorner", "LeftPenaltyMark"), curves=("CenterCircle", "LeftGoalLine"))
    observations = simulate(scene).observations
    names = {observations.feature_name("point", row) for row in range(len(observations.points))}
    assert names == {"TopLeftCorner", "LeftPenaltyMark"}
    names = {observations.feature_name("curve", row) for row in range(len(observations.curves))}
    assert names == {"CenterCircle", "LeftGoalLine"}


# ---- what is not seen -----------------------------------------------------------------------------------------------


@given(
    st.floats(-5, 5), st.floats(-4, 4), st.floats(0.5, 6), st.floats(-80, 80), st.floats(-80, 80), st.floats(-180, 180)
)
def test_nothing_is_seen_outside_the_image(
    x: float, y: float, height: float, tilt_x: float, tilt_y: float, yaw: float
) -> None:
    stations = {"any": Station("any", overhead_pose(x, y, height, tilt_x, tilt_y, yaw))}
    scene = field_scene(ssl_field("B"), {"any": CAMERA}, stations, 3, spacing_m=0.4)
    try:
        simulation = simulate(scene, replace(WORKDAY, outlier_spread_px=300.0), seed=5)
    except InputError:  # nothing is in view
        return
    for column in (
        simulation.observations.points,
        simulation.observations.curves,
        simulation.points,
        simulation.curves,
    ):
        assert np.all((column.pixels >= -0.5) & (column.pixels <= (1279.5, 959.5)))


def test_nothing_is_seen_behind_the_camera() -> None:
    around = custom({str(i): (4.0 * math.cos(0.1 * i), 4.0 * math.sin(0.1 * i), 1.0) for i in range(63)})
    stations = {"any": Station("any", overhead_pose(0.0, 0.0, 1.0, tilt_x_deg=-90.0))}  # looks along +y
    scene = field_scene(around, {"any": CAMERA}, stations, name="around")
    features = simulate(scene).observations.points.feature
    assert len(features) > 5
    assert np.all(around.point_array[features, 1] > 0.0)


def test_nothing_is_seen_past_the_monotone_radius() -> None:
    camera = replace(CAMERA, lens=Radial((-1.2e-6,), (3,)))
    assert camera.folds
    stations = {"any": Station("any", overhead_pose(height_m=1.5))}
    simulation = simulate(field_scene(ssl_field("B"), {"any": camera}, stations, spacing_m=0.002))
    radius = np.linalg.norm(camera.offsets(simulation.curves.pixels), axis=1)
    limit = camera.lens.monotone_radius(camera.phi)
    assert 0.95 * limit < radius.max() <= limit


def test_views_without_observation_are_left_out() -> None:
    looking_away = Station("overhead", overhead_pose(20.0, 0.0, 2.0))
    scene = over_field(frames=2)
    scene = replace(scene, stations={**scene.stations, "away": looking_away})
    away = replace(scene.views[0], frames=("0003",), station="away")
    observations = simulate(replace(scene, views=(away, *scene.views))).observations
    assert [view.frame for view in observations.views] == ["0001", "0002"]
    assert set(observations.curves.view) == {0, 1}


def test_hidden_stretches_are_stretches() -> None:
    line = custom(curves={"line": Segment((-2.0, 0.0, 0.0), (2.0, 0.0, 0.0)), "far": Segment((-2, 1, 0), (2, 1, 0))})
    scene = field_scene(line, {"any": CAMERA}, {"any": Station("any", overhead_pose())}, 50, spacing_m=0.05)
    simulation = simulate(scene, Disturbance(hidden_stretches=2, hidden_length_m=0.5), seed=3)
    camera, curves = scene.camera_at("any"), simulation.observations.curves
    hidden_counts = []
    for view in range(50):
        gaps, hidden = 0, 0
        for feature in (0, 1):
            x = camera.locate(curves.pixels[(curves.view == view) & (curves.feature == feature)])[:, 0]
            seen = np.isin(np.arange(80), np.rint((x + 1.975) / 0.05))
            gaps += int(np.sum(np.diff(np.concatenate([[1], seen, [1]])) == -1))
            hidden += int(np.sum(~seen))
        assert 1 <= gaps <= 2
        assert hidden <= 22  # 0.5 m at 0.05 m are 10 or 11 places, twice
        hidden_counts.append(hidden)
    assert max(hidden_counts) >= 20
    assert len(np.unique(curves.pixels[:, 0].round(6))) == 160  # each place is seen in some frame


def test_hidden_points() -> None:
    scene = board_scene(checkerboard(9, 6, 0.1), {"c": CAMERA}, {"c": Station("c", Pose.identity())}, 40, seed=1)
    simulation = simulate(scene, Disturbance(hidden_points=0.25), seed=1)
    share = 1.0 - len(simulation.observations.points) / (40 * 54)
    assert abs(share - 0.25) < 0.04  # 4 sd of 2160 draws
    with pytest.raises(InputError, match="camera 'c' has no observation"):
        simulate(scene, Disturbance(hidden_points=1.0))


# ---- noise, outliers, wrong labels ----------------------------------------------------------------------------------


def test_same_seed_same_rows() -> None:
    scene = over_field(4)
    busy = replace(WORKDAY, hidden_stretches=4, hidden_points=0.2)
    first, again, other = simulate(scene, busy, 7), simulate(scene, busy, 7), simulate(scene, busy, 8)
    assert first.observations.digest == again.observations.digest
    assert first.observations.digest != other.observations.digest
    for a, b in ((first.points, again.points), (first.curves, again.curves)):
        assert np.array_equal(a.flag, b.flag)
        assert np.array_equal(a.pixels, b.pixels)


def test_frames_differ() -> None:
    curves = simulate(over_field(2), WORKDAY, 1).observations.curves
    assert len(np.unique(curves.pixels, axis=0)) == len(curves)


def large_simulation() -> Simulation:
    return simulate(over_field(400, spacing_m=0.2), WORKDAY, seed=2)


def test_noise_is_as_stated() -> None:
    simulation = large_simulation()
    observations = simulation.observations
    for column, truth, sigma in (
        (observations.points, simulation.points, 0.5),
        (observations.curves, simulation.curves, 0.3),
    ):
        assert np.all(column.sigma_px == sigma)
        moved = column.pixels - truth.pixels
        undisturbed = moved[truth.flag != OUTLIER]
        assert abs(np.std(undisturbed) / sigma - 1.0) < 0.03  # 4 sd of 9000 numbers: 0.03
        assert np.all(np.abs(np.mean(undisturbed, axis=0)) < 0.06 * sigma)
        assert abs(np.std(moved[truth.flag == OUTLIER]) / 30.0 - 1.0) < 0.15
        for flag, share in ((OUTLIER, 0.1), (WRONG_LABEL, 0.05)):
            count = len(truth.flag)
            # 4 sd of the draw, and the outliers that left the image (measured: 0.6 % of all)
            assert abs(np.mean(truth.flag == flag) - share) < 4.0 * np.sqrt(share / count) + 0.01
            assert np.array_equal(truth.rows(flag), np.flatnonzero(truth.flag == flag))


def test_labels_are_wrong_where_flagged_and_only_there() -> None:
    simulation = large_simulation()
    observations = simulation.observations
    for column, truth in ((observations.points, simulation.points), (observations.curves, simulation.curves)):
        assert np.array_equal(column.feature != truth.feature, truth.flag == WRONG_LABEL)
        assert set(np.unique(truth.flag)) == {CLEAN, OUTLIER, WRONG_LABEL}
    wrong = simulation.points.rows(WRONG_LABEL)
    assert len(np.unique(observations.points.feature[wrong])) == 25  # any other name, seen or not


def test_wrong_label_of_a_curve_is_its_neighbours() -> None:
    sheet = rings([0.1, 0.2, 0.3, 0.4])
    scene = field_scene(sheet, {"any": CAMERA}, {"any": Station("any", overhead_pose(height_m=1.0))}, 20, name="sheet")
    simulation = simulate(scene, Disturbance(wrong_labels=0.5), seed=1)
    wrong = simulation.curves.rows(WRONG_LABEL)
    named, true = simulation.observations.curves.feature[wrong], simulation.curves.feature[wrong]
    assert len(wrong) > 300
    assert np.all(np.abs(named - true) == 1)


def test_wrong_label_next_to_an_open_arc() -> None:
    """The nearest place of a quarter circle is one of its ends, not a place on the rest of its circle."""
    target = custom(
        curves={
            "line": Segment((-1.0, -0.9, 0.0), (-0.8, -0.9, 0.0)),
            "quarter": Arc((0.0, 0.0, 0.0), 1.2, 0.0, 0.5 * np.pi),
            "other": Segment((-1.0, 0.1, 0.0), (-0.8, 0.1, 0.0)),
        }
    )
    scene = field_scene(target, {"any": CAMERA}, {"any": Station("any", overhead_pose())}, 50, curves=("line",))
    simulation = simulate(scene, Disturbance(wrong_labels=1.0))
    named = {simulation.observations.feature_name("curve", row) for row in range(len(simulation.observations.curves))}
    assert named == {"other"}


def test_a_lone_curve_has_no_wrong_name() -> None:
    target = custom({"p": (0.0, 0.0, 0.0)}, {"line": Segment((-1.0, 0.0, 0.0), (1.0, 0.0, 0.0))})
    scene = field_scene(target, {"any": CAMERA}, {"any": Station("any", overhead_pose())}, 5)
    simulation = simulate(scene, Disturbance(wrong_labels=1.0))
    assert not np.any(simulation.points.flag)
    assert not np.any(simulation.curves.flag)


def test_many_frames_of_a_static_camera_are_fast() -> None:
    scene = over_field(5000, spacing_m=0.15)
    start = time.perf_counter()
    simulation = simulate(scene, replace(WORKDAY, hidden_stretches=5))
    assert len(simulation.observations.curves) > 900_000
    assert time.perf_counter() - start < 5.0  # 0.25 s measured


# ---- composing scenes -----------------------------------------------------------------------------------------------


def test_overhead_pose_looks_down() -> None:
    pose = overhead_pose(1.0, -2.0, 4.0)
    np.testing.assert_allclose(pose.position, [1.0, -2.0, 4.0], atol=1e-15)
    np.testing.assert_allclose(pose.transform([1.5, -1.5, 0.0]), [0.5, -0.5, 4.0], atol=1e-15)
    turned = overhead_pose(yaw_deg=90.0)
    np.testing.assert_allclose(turned.transform([0.0, 1.0, 0.0]), [1.0, 0.0, 4.0], atol=1e-15)
    leaning = overhead_pose(tilt_x_deg=3.0, tilt_y_deg=-4.0, yaw_deg=31.0)
    assert np.rad2deg(np.arccos(-leaning.rotation[2, 2])) == pytest.approx(5.0, abs=1e-9)
    looks_down_the_image, looks_left = overhead_pose(tilt_x_deg=10.0), overhead_pose(tilt_y_deg=10.0)
    assert looks_down_the_image.rotation[2, 1] < -0.1 and looks_left.rotation[2, 0] < -0.1


def test_boards_are_seen_whole_by_every_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    board = checkerboard(9, 6, 0.1)
    posed = [CAMERA.at(overhead_pose(-0.5, 0, 4.0)), CAMERA.at(overhead_pose(0.5, 0.2, 4.0, yaw_deg=170.0))]
    placements = board_placements(board, posed, 6, seed=4, held=BoardRanges((2.5, 3.5), (20.0, 40.0)))
    for placement in placements:
        for camera in posed:
            pixels = camera.project(placement.transform(board.point_array))
            assert np.all((pixels >= 0.0) & (pixels <= (1279.0, 959.0)))
        middle = posed[0].cam_from_world.transform(placement.transform(board.point_array.mean(axis=0)))
        distance = np.linalg.norm(middle)
        assert 2.5 <= distance <= 3.5
        normal = posed[0].cam_from_world.rotation @ placement.rotation[:, 2]
        assert 20.0 <= np.rad2deg(np.arccos(normal @ middle / distance)) <= 40.0
    again = board_placements(board, posed, 6, seed=4, held=BoardRanges((2.5, 3.5), (20.0, 40.0)))
    assert placements == again
    monkeypatch.setattr("scenery._TRIES", 200)
    with pytest.raises(InputError, match="no 1 places found"):
        board_placements(board, posed, 1, seed=4, held=BoardRanges((0.2, 0.3)))


def test_frames_are_numbered_for_each_camera() -> None:
    pose = overhead_pose()
    stations = {"a": Station("one", pose), "b": Station("one", pose), "c": Station("two", pose)}
    scene = field_scene(ssl_field("B"), {"one": CAMERA, "two": CAMERA}, stations, 2)
    assert [plan.frames for plan in scene.views] == [("0001", "0002"), ("0003", "0004"), ("0001", "0002")]


def test_join_refuses_one_name_for_two_things() -> None:
    scene = over_field()
    assert join(scene, scene).cameras == scene.cameras
    with pytest.raises(InputError, match="cameras: 'overhead' means different things"):
        join(scene, replace(scene, cameras={"overhead": replace(CAMERA, phi=900.0)}))


# ---- files ----------------------------------------------------------------------------------------------------------


@each_built_in
def test_scene_file_round_trip(name: str, tmp_path: Path) -> None:
    scene, disturbance = built_in_scene(name)
    path = tmp_path / "scene.json"
    path.write_bytes(msgspec.json.encode(scene_to_json(scene, disturbance)))
    loaded, loaded_disturbance = load_scene(path)
    assert loaded_disturbance == disturbance
    assert (loaded.targets, loaded.cameras, loaded.views) == (scene.targets, scene.cameras, scene.views)
    for station, there in scene.stations.items():
        np.testing.assert_allclose(
            loaded.stations[station].cam_from_world.log(), there.cam_from_world.log(), atol=1e-13
        )
    first, second = simulate(scene, disturbance, 1).observations, simulate(loaded, loaded_disturbance, 1).observations
    np.testing.assert_allclose(first.points.pixels, second.points.pixels, rtol=0, atol=1e-9)
    np.testing.assert_allclose(first.curves.pixels, second.curves.pixels, rtol=0, atol=1e-9)


def small_scene() -> dict[str, Any]:
    """A minimal scene file."""
    return {
        "format": "ceres-cal/scene",
        "version": 1,
        "targets": {"field": {"kind": "ssl-field", "division": "B"}},
        "cameras": {
            "c": {
                "image_size": [1280, 960],
                "phi": 868.0,
                "principal_point": [640.0, 480.0],
                "lens": {"kind": "radial", "powers": [3], "coefficients": {"a3": 6e-7}},
            }
        },
        "stations": {"s": {"camera": "c", "position_m": [-2.2, 0.0, 4.0], "euler_rad": [np.pi, 0.0, 0.1]}},
        "placements": {"p": {"translation_m": [0.0, 0.0, 0.5], "rotation_vector": [0.1, 0.0, 0.0]}},
        "views": [{"frames": ["1", "2"], "station": "s", "target": "field"}],
    }


def test_scene_file_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "scene.json"
    path.write_bytes(msgspec.json.encode(small_scene()))
    scene, disturbance = load_scene(path)
    assert disturbance == Disturbance()
    assert scene.views == (ViewPlan(("1", "2"), "s", "field"),)
    camera = scene.camera_at("s")
    np.testing.assert_allclose(camera.position, [-2.2, 0.0, 4.0], atol=1e-12)
    # Straight down: the paper's alpha = pi.
    np.testing.assert_allclose(camera.project([[-2.2, 0.0, 0.0]]), [[640.0, 480.0]], atol=1e-9)


def change(*path: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    def apply(data: dict[str, Any]) -> None:
        place: Any = data
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = to

    return apply


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        (change("format", to="ceres-cal/observations"), "it holds observations, where a scene must be given"),
        (change("version", to=2), "version 2 is not known"),
        (change("extra", to=1), "extra"),
        (change("targets", "field", to={"kind": "pitch"}), "target 'field': unknown kind 'pitch'"),
        (change("cameras", "c", "phi", to=-1.0), "camera 'c': intrinsics must be finite"),
        (change("cameras", "c", "phi", to="long"), "camera 'c': Expected a number"),
        (
            change("cameras", "c", "lens", "coefficients", to={"k1": 0.1}),
            "camera 'c': lens 'radial' has no coefficient",
        ),
        (change("cameras", "c", "lens", "kind", to="glass"), "camera 'c': there is no lens 'glass'"),
        (change("stations", "s", "camera", to="d"), "station 's' names camera 'd', which is not there: there are 'c'"),
        (change("stations", "s", "rotation_vector", to=[0, 0, 0]), "station 's': give its rotation as one of"),
        (change("stations", "s", "position_m", to=[0, 0]), "station 's': "),
        (change("stations", "s", "position_m", to=[0, 0, "up"]), "station 's': "),
        (change("placements", "p", "rotation_vector", to=None), "placement 'p': give its rotation as one of"),
        (change("placements", "p", "translation_m", to=[0, 0, 1e400]), "scene.json: "),
        (change("views", to=[]), "no views"),
        (change("views", 0, "frames", to=[]), "view 0: give at least one frame"),
        (change("views", 0, "frames", to=["1", "1"]), "view 0: give at least one frame, each name once"),
        (change("views", 0, "station", to="t"), "view 0 names station 't'"),
        (change("views", 0, "target", to="t"), "view 0 names target 't'"),
        (change("views", 0, "placement", to="q"), "view 0 names placement 'q'"),
        (change("views", 0, "points", to=["Corner"]), "view 0: target 'field' has no point 'Corner'"),
        (change("views", 0, "curves", to=["HalfwayLine"] * 2), "view 0: a curve is named twice"),
        (change("views", 0, "spacing_m", to=0), "view 0: spacing_m must be a positive"),
        (change("views", 0, "side", to="top"), "view 0: side 'top' is unknown"),
        (change("views", 0, "sharpness", to=1), "view 0: 'sharpness' is unknown: there are frames"),
        (change("disturbance", to={"noise": 1}), "disturbance: 'noise' is unknown"),
        (change("disturbance", to={"outliers": 1.5}), "disturbance: outliers is a share"),
        (change("disturbance", to={"outliers": 0.6, "wrong_labels": 0.6}), "at most 1 in all"),
        (change("disturbance", to={"points_sigma_px": -0.5}), "disturbance: points_sigma_px must be"),
        (change("disturbance", to={"hidden_stretches": 0.5}), "disturbance: Expected a whole number"),
    ],
)
def test_bad_scenes_get_one_line(broken: Callable[[dict[str, Any]], None], said: str, tmp_path: Path) -> None:
    data = small_scene()
    broken(data)
    path = tmp_path / "scene.json"
    # JSON has no infinity: write a number that overflows to it.
    path.write_bytes(msgspec.json.encode(data).replace(b"null]", b"1e400]"))
    with pytest.raises(InputError) as caught:
        load_scene(path)
    text = str(caught.value)
    assert text.startswith(str(path)) and said in text and "\n" not in text


@each_built_in
def test_built_in_scenes_are_as_they_were_made(name: str) -> None:
    made, disturbance = scene_from_json(content(name), name)
    kept, same = built_in_scene(name)
    assert disturbance == same and made.views == kept.views and made.photography == kept.photography
    assert made.targets == kept.targets and made.cameras == kept.cameras
    first, second = simulate(made, disturbance, 0).observations, simulate(kept, disturbance, 0).observations
    assert first.points.pixels == pytest.approx(second.points.pixels, abs=1e-9)
    assert first.curves.pixels == pytest.approx(second.curves.pixels, abs=1e-9)


def test_unknown_built_in_scene() -> None:
    with pytest.raises(InputError, match="there is no scene 'moon': choose one of ssl-field"):
        built_in_scene("moon")


def test_written_simulation_comes_back(tmp_path: Path) -> None:
    scene, disturbance = built_in_scene("two-cameras")
    simulation = simulate(scene, disturbance, seed=9)
    folder = tmp_path / "new" / "folder"
    write_simulation(simulation, folder)
    observations = Observations.load(folder / "observations.json")
    assert observations.digest == simulation.observations.digest
    truth = msgspec.json.decode((folder / "truth.json").read_bytes())
    assert truth == msgspec.json.decode(msgspec.json.encode(truth_to_json({"observations.json": simulation})))
    rows = truth["files"]["observations.json"]
    assert rows["seed"] == 9
    for kind, column, found in (
        ("points", observations.points, simulation.points),
        ("curves", observations.curves, simulation.curves),
    ):
        assert rows[kind]["count"] == len(column)
        assert rows[kind]["outlier_count"] == len(rows[kind]["outlier_rows"]) > 0
        assert rows[kind]["wrong_label_count"] == len(rows[kind]["wrong_label_rows"]) > 0
        assert rows[kind]["outlier_rows"] == np.flatnonzero(found.flag == OUTLIER).tolist()
        assert rows[kind]["wrong_label_rows"] == np.flatnonzero(column.feature != found.feature).tolist()
    west = truth["stations"]["left"]
    assert west["camera"] == "left"
    np.testing.assert_allclose(west["position_m"], scene.stations["left"].cam_from_world.position, atol=1e-10)
    np.testing.assert_allclose(west["rotation"], scene.stations["left"].cam_from_world.rotation, atol=1e-10)
    assert truth["cameras"]["right"]["lens"] == {
        "kind": "radial",
        "powers": [2, 3],
        "coefficients": {"a2": -6.1e-5, "a3": 6.3e-7},
    }
    assert set(truth["placements"]) == set(observations.placements)


def test_folder_that_cannot_be_made(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file/folder: cannot be made"):
        write_simulation(simulate(over_field()), tmp_path / "file" / "folder")


# ---- the sample data ------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_sample_data_come_from_the_script(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All observations and truths; seven of the fourteen photographs are rendered again."""
    monkeypatch.setattr(make_data, "PHOTOGRAPHED", make_data.PHOTOGRAPHED[:4])
    assert make_data.main([str(tmp_path)]) == 0
    names = {path.relative_to(ROOT / "data") for path in (ROOT / "data").glob("*/*.json")}
    assert names == {path.relative_to(tmp_path) for path in tmp_path.glob("*/*.json")} and len(names) == 7
    for name in names:
        shipped, made = (msgspec.json.decode((root / name).read_bytes()) for root in (ROOT / "data", tmp_path))
        if name.name == "truth.json":
            taken = made.pop("photographs")
            assert taken == {one: shot for one, shot in shipped.pop("photographs").items() if one in taken}
        assert made == shipped, name
    assert sum((ROOT / "data" / name).stat().st_size for name in names) < 400_000
    every = [path for path in (ROOT / "data").rglob("*.jpg") if path.parts[-2] != "opencv_left"]  # taken by a camera
    images = sorted(path.relative_to(tmp_path) for path in tmp_path.rglob("*.jpg"))
    assert (len(every), len(images), len(capsys.readouterr().out.splitlines())) == (14, 7, 14)
    assert max(path.stat().st_size for path in every) < 300_000
    for path in images:
        ours, theirs = (cv2.imread(str(root / path), cv2.IMREAD_GRAYSCALE) for root in (ROOT / "data", tmp_path))
        assert ours is not None and theirs is not None
        assert np.mean(cv2.absdiff(ours, theirs)) < 0.5, path  # 0; another OpenCV may draw and compress differently


def test_the_truth_of_the_photographs_is_beside_them() -> None:
    for folder in (ROOT / "data").iterdir():
        if folder.is_dir() and folder.name != "opencv_left":  # which was taken by a camera
            truth = msgspec.json.decode((folder / "truth.json").read_bytes())["photographs"]
            assert sorted(truth) == sorted(str(path.relative_to(folder)) for path in folder.rglob("*.jpg"))


def test_ssl_field_is_what_it_says() -> None:
    path = ROOT / "data" / "ssl_field"
    observations = Observations.load(path / "observations.json")
    views = observations.views
    assert [view.target for view in views] == ["field"] * 8 + ["board"] * 12
    on_field = observations.curves.view
    assert np.all(np.bincount(on_field, minlength=8)[:8] >= 150)
    assert np.all(np.bincount(observations.points.view, minlength=20) >= 10)
    names = {observations.feature_name("curve", row) for row in range(len(observations.curves))}
    assert {"CenterCircle", "HalfwayLine", "LeftGoalLine", "TopTouchLine", "BottomTouchLine"} <= names
    truth = msgspec.json.decode((path / "truth.json").read_bytes())
    rotation = np.array(truth["stations"]["overhead"]["rotation"])
    assert np.rad2deg(np.arccos(-rotation[2, 2])) == pytest.approx(3.0, abs=1e-6)
    rows = truth["files"]["observations.json"]
    wrong = sum(rows[kind]["outlier_count"] + rows[kind]["wrong_label_count"] for kind in ("points", "curves"))
    assert 0.04 < wrong / (len(observations.points) + len(observations.curves)) < 0.06


def test_field_2004_is_the_papers_camera() -> None:
    scene, _ = built_in_scene("rings-2004")
    camera = scene.camera_at("overhead")
    lens = camera.lens
    assert isinstance(lens, Radial)
    a1 = 1.07761103142178
    np.testing.assert_allclose(lens.paper_coefficients(a1), (a1, -0.00096240306505, 0.00000401304361), rtol=1e-14)
    assert a1 * lens.ideal_radius(450.0) == pytest.approx(655.7, abs=0.05)  # the paper's section 2
    rings_seen = Observations.load(ROOT / "data" / "field_2004" / "rings.json")
    radius = np.linalg.norm(camera.offsets(rings_seen.curves.pixels), axis=1)
    assert 445.0 < radius.max() < 460.0 and radius.min() < 25.0
    field = Observations.load(ROOT / "data" / "field_2004" / "field.json")
    assert {"TopLeftCorner", "BottomLeftCorner", "TopHalfwayCrossing", "BottomHalfwayCrossing"} <= {
        field.feature_name("point", row) for row in range(len(field.points))
    }
    assert camera.position[2] == pytest.approx(2.5) and not camera.folds
