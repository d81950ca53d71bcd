"""New boards and fields with fixed intrinsics, and comparison of intrinsics over the image."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import scenes
from photos.real_data import ov_plane
from scenery import board_scene, field_scene, overhead_pose
from test_cli import Say, refused, say

from ceres_cal.base.errors import DegenerateError, InputError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.moves.agreement import NOISIER
from ceres_cal.moves.comparisons import compare_cameras
from ceres_cal.moves.scores import score
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Options, Station
from ceres_cal.scene.camera import Camera, in_image
from ceres_cal.scene.lens import Brown
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, Scene, simulate

__all__ = ["say"]
_CAMERA = scenes.camera("brown")
_STATION = {"camera": Station("camera", Pose.identity())}
_BOARD = checkerboard(9, 6, 0.1)


def _boards(count: int, seed: int, sigma_px: float = 0.2) -> Observations:
    scene = board_scene(_BOARD, {"camera": _CAMERA}, _STATION, count, seed)
    return simulate(scene, Disturbance(points_sigma_px=sigma_px), seed=seed).observations


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(_boards(12, 1), Options(usual_camera=False, lens="brown"))


def test_new_boards_are_predicted_to_the_noise(calibration: Calibration) -> None:
    answers = score(calibration, _boards(12, 2))
    (answer,) = answers.values()
    assert answers.holds and "is good for these observations: it predicts them to 0.2" in answer.words
    assert answer.misfit.noise[0] == pytest.approx(1.0, abs=0.06)  # 1.00
    assert answer.name == "camera" and answer.misfit.points == 12 * 54
    assert len(answer.views) == 12 and answer.views[0].misfit.all_rms_px >= answer.views[-1].misfit.all_rms_px
    assert answer.solution is not None and answer.solution.estimate.cameras["camera"] == calibration.cameras["camera"]


def test_a_board_that_the_lens_cannot_show_is_named(calibration: Calibration) -> None:
    """The message asked for four points, although there were 54."""
    seen = _boards(2, 3)
    shuffled = np.random.default_rng(0).permutation(seen.points.pixels[:54])
    pixels = np.vstack([shuffled, seen.points.pixels[54:]])
    with pytest.raises(DegenerateError, match=r"board_01.*54 points.*no pose explains its points with this lens"):
        score(calibration, replace(seen, points=replace(seen.points, pixels=pixels)))


def test_one_camera_of_several_is_scored(calibration: Calibration) -> None:
    """The other cameras of a rig have no observations, and are ignored."""
    alone = score(calibration, _boards(3, 1))
    cameras = {**calibration.estimate.cameras, "other": next(iter(calibration.estimate.cameras.values()))}
    rig = replace(calibration, estimate=replace(calibration.estimate, cameras=cameras))
    together = score(rig, _boards(3, 1))
    assert list(together) == list(alone)
    assert [one.misfit.all_rms_px for one in together.values()] == [one.misfit.all_rms_px for one in alone.values()]


def test_plain_least_squares_is_that_of_opencv(calibration: Calibration) -> None:
    seen = _boards(1, 3)
    answer = score(calibration, seen, options=replace(calibration.options, loss="trivial", reject_sigma=1e9))
    places, camera = _BOARD.point_array, calibration.station().to_opencv()
    matrix, distortion = camera.matrix, camera.distortion
    _, turn, shift = cv2.solvePnP(places, seen.points.pixels, matrix, distortion)
    turn, shift = cv2.solvePnPRefineLM(places, seen.points.pixels, matrix, distortion, turn, shift)
    off = cv2.projectPoints(places, turn, shift, matrix, distortion)[0][:, 0] - seen.points.pixels
    assert answer["camera"].misfit.points_rms_px == pytest.approx(np.sqrt(np.mean(np.sum(off**2, axis=1))), rel=1e-6)


def test_other_intrinsics_are_told_by_their_score(calibration: Calibration) -> None:
    camera = calibration.cameras["camera"]
    wrong = replace(camera, principal_point=(camera.principal_point[0] + 40.0, camera.principal_point[1]))
    worse = replace(calibration, estimate=replace(calibration.estimate, cameras={"camera": wrong}), posterior=None)
    answer = score(worse, _boards(12, 2))["camera"]
    assert answer.misfit.noise[0] > 1.3 and not answer.holds  # 1.51


def test_the_poses_of_a_rig_are_tested_where_they_are_held() -> None:
    scene = scenes.two_cameras("brown")
    boards = replace(scene, views=tuple(plan for plan in scene.views if plan.target == "board"))
    noise = Disturbance(points_sigma_px=0.2, curves_sigma_px=0.2)
    known = calibrate(simulate(scene, noise, seed=1).observations, Options(usual_camera=False, lens="brown"))
    seen = simulate(boards, noise, seed=2).observations
    assert score(known, seen, hold_stations=True)["east"].misfit.noise[0] == pytest.approx(1.0, abs=0.12)
    east = known.estimate.stations["east"]
    bumped = replace(east, cam_from_world=Pose(rotation_exp([0.0, 0.004, 0.0]), np.zeros(3)) @ east.cam_from_world)
    moved = replace(known.estimate, stations={**known.estimate.stations, "east": bumped})
    other = replace(known, estimate=moved)
    assert score(other, seen)["east"].misfit.noise[0] == pytest.approx(1.0, abs=0.12)
    assert score(other, seen, hold_stations=True)["east"].misfit.noise[0] > 2.0  # 5


def test_a_field_is_scored_by_its_own_noise_and_place() -> None:
    """By the noise of boards a sound field was "not good"; of a camera that moved, "usable": its rows were outliers."""
    camera, pose = _CAMERA, overhead_pose(0.3, 0.2, 4.0, tilt_x_deg=8.0)
    stations = {"camera": Station("camera", pose)}
    field = field_scene(ssl_field("B"), {"camera": camera}, stations, spacing_m=0.3)
    boards = board_scene(_BOARD, {"camera": camera}, stations, 6, seed=1)

    def seen(of: Scene, sigma_px: float, seed: int) -> Observations:
        return simulate(of, Disturbance(points_sigma_px=sigma_px, curves_sigma_px=sigma_px), seed).observations

    known = calibrate(seen(field, 0.3, 1) + seen(boards, 0.15, 1), Options(lens="brown"))
    answer = score(known, seen(field, 0.3, 2))["camera"]
    assert answer.holds is not False and answer.misfit.noise[0] > NOISIER, answer.words  # 1.9
    moved = Pose.looking(pose.position + np.array([0.05, 0.0, 0.0]), pose.rotation)
    bumped = replace(known.estimate, stations={"camera": Station("camera", moved)})
    both = seen(field, 0.3, 3) + seen(boards, 0.15, 3)
    assert score(known, both, hold_stations=True)["camera"].holds
    answer = score(replace(known, estimate=bumped), both, hold_stations=True)["camera"]
    assert answer.holds is False and "were taken out" in answer.words, answer.words


def test_a_field_alone_leaves_nothing_to_pose_under_held_stations() -> None:
    seen = simulate(scenes.corners("brown"), seed=1).observations
    known = calibrate(seen, Options(usual_camera=False, lens="brown"))
    (answer,) = score(known, seen).values()
    assert answer.misfit.points_rms_px < 1e-6
    with pytest.raises(InputError, match="ceres-cal check"):
        score(known, seen, hold_stations=True)


def test_everything_held_calibrates(calibration: Calibration) -> None:
    camera = calibration.cameras["camera"]
    numbers = {"phi": camera.phi, "cx": camera.principal_point[0], "cy": camera.principal_point[1]}
    seen = _boards(6, 4)
    held = calibrate(seen, Options(usual_camera=False, lens="brown", fixed={**numbers, **camera.lens.coefficients}))
    assert held.fit.points_rms_px == pytest.approx(score(calibration, seen)["camera"].misfit.points_rms_px, rel=1e-4)
    assert held.uncertainty.posterior.keys == ()


# ---- over the image -------------------------------------------------------------------------------------------------


def test_equal_cameras_differ_nowhere(calibration: Calibration) -> None:
    (answer,) = compare_cameras(calibration, calibration).values()
    assert answer.image is not None and answer.holds and answer.probability == pytest.approx(1.0)
    same = answer.image
    assert np.nanmax(same.errors_px) < 1e-6 and np.nanmax(same.angles_deg) < 1e-6 and same.turn_deg == 0.0


def test_repetitions_are_explained(calibration: Calibration) -> None:
    others = [calibrate(_boards(12, seed), Options(usual_camera=False, lens="brown")) for seed in (5, 6, 7)]
    for other in others:
        (found,) = compare_cameras(calibration, other).values()
        assert found.holds and found.image is not None
        assert 0.0 < np.nanmedian(found.image.errors_px) < 4.0  # 2.0 at most


def test_a_turn_is_taken_out(calibration: Calibration) -> None:
    """Another principal point rotates all rays, but hardly changes the lens."""
    camera = calibration.cameras["camera"]
    shifted = replace(camera, principal_point=(camera.principal_point[0] + 6.0, camera.principal_point[1]))
    other = replace(calibration, estimate=replace(calibration.estimate, cameras={"camera": shifted}))
    (answer,) = compare_cameras(calibration, other).values()
    (without,) = compare_cameras(calibration, other, without_turn=True).values()
    assert answer.image is not None and without.image is not None
    plain, turned = answer.image, without.image
    middle = tuple(n // 2 for n in plain.errors_px.shape)
    assert plain.errors_px[middle] == pytest.approx(6.0, abs=0.1) and answer.holds is False
    assert turned.turn_deg == pytest.approx(np.degrees(6.0 / camera.phi), rel=0.1)
    assert turned.errors_px[middle] < 0.5  # 0.1


def test_cameras_that_cannot_be_compared(calibration: Calibration) -> None:
    with pytest.raises(InputError, match="camera 'other' is not in both"):
        compare_cameras(calibration, calibration, "other")
    small = replace(calibration.cameras["camera"], image_size=(640, 480))
    other = replace(calibration, estimate=replace(calibration.estimate, cameras={"camera": small}))
    with pytest.raises(InputError, match="1280 x 960 px and 640 x 480 px"):
        compare_cameras(calibration, other)


# ---- as typed -------------------------------------------------------------------------------------------------------


def test_score_and_compare_as_typed(say: Say, calibration: Calibration, tmp_path: Path) -> None:
    known, new = tmp_path / "known.json", tmp_path / "new.json"
    calibration.save(known)
    _boards(3, 8).save(new)
    said = say("score", known, new)
    assert said.code == 0 and said.out.startswith("score     camera is good for these observations: it predicts")
    data = json.loads(say("score", known, new, "--loss", "trivial", "--reject-sigma", "inf", "--json").out)
    assert data["cameras"][0]["points"] == 162 and len(data["views"]) == 3
    said = say("compare", known, known)
    assert said.code == 0 and "0.000 px on average" in said.out
    assert (
        json.loads(say("compare", known, known, "--without-turn", "--json").out)["cameras"]["camera"]["turn_deg"] < 1e-6
    )
    assert "maps of a field" in refused(say("compare", known, known, "--picture", tmp_path / "x.svg"))
    assert "ceres-cal score" in refused(say("refit", known, new, "--what", "pose-only"))


@pytest.mark.usefixtures("real_data")
@pytest.mark.thorough
def test_ov_plane() -> None:
    """Its own split: scipy has residuals of 0.482 px in training, and 0.475 px for the test views with free poses."""
    parts = [ov_plane(name) for name in ("train", "test")]
    known = calibrate(
        parts[0],
        Options(
            usual_camera=False,
            lens="kannala-brandt",
            free_aspect=True,
            loss="trivial",
            reject_sigma=1e9,
            as_built="as drawn",
        ),
    )
    assert known.fit.points_rms_px == pytest.approx(0.4815, abs=5e-4)
    (answer,) = score(known, parts[1]).values()
    assert answer.misfit.points_rms_px == pytest.approx(0.4746, abs=5e-4)


@pytest.mark.thorough
def test_few_clicks_are_noisier_by_chance() -> None:
    """The same camera with clicks twice as accurate: 11 of 60 pairs of about ten clicks said "is
    not good for these".
    """
    camera = Camera((1280, 960), 700.0, (640.0, 480.0), Brown((-0.2, 0.05, 0.0, 0.0, 0.0)))
    seen_by = camera.at(Pose.looking((0.3, -0.5, 4.5), rotation_exp((np.pi - 0.2, 0.02, 0.0))))
    field = ssl_field("B")
    shown = np.flatnonzero(in_image(seen_by.project(field.point_array), camera.image_size))

    def clicked(seed: int, count: int) -> Observations:
        rng = np.random.default_rng(seed)
        pixels, rows = np.full((len(field.points), 2), np.nan), rng.permutation(shown)[:count]
        pixels[rows] = seen_by.project(field.point_array[rows]) + rng.normal(0.0, 1.0, (count, 2))
        return Observations.from_points(pixels, field, camera.image_size)

    found = [score(calibrate(clicked(seed, 11)), clicked(seed + 100, 8))["camera"] for seed in range(3)]
    assert sum(max(one.misfit.noise[:1]) > NOISIER for one in found) >= 1
    assert all(one.holds is not False for one in found)
