"""The two poses of a plane."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scenery import BoardRanges, board_scene, field_scene, overhead_pose
from thorough import partly

from ceres_cal.base.transforms import Pose, rotation_log
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.parameters import Estimate, Options, make_layout
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.robust.other_minima import mirrored, without_mirrored_poses
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, simulate

OPTIONS = Options(lens="brown")


def small_boards(seed: int, count: int = 60) -> tuple[Scene, Observations]:
    """Boards so small and distant that perspective hardly distinguishes their two poses."""
    camera = Camera((1280, 960), 600.0, (645.0, 470.0), Brown((-0.28, 0.07, 0.0, 0.0, 0.0)))
    stations = {"camera": Station("camera", Pose.identity())}
    scene = board_scene(
        checkerboard(6, 5, 0.06), {"camera": camera}, stations, count, seed, held=BoardRanges((0.7, 2.5), (15, 40))
    )
    return scene, simulate(scene, Disturbance(0.3, 0.3), seed).observations


def turned_deg(a: Pose, b: Pose) -> float:
    return float(np.degrees(np.linalg.norm(rotation_log(a.rotation.T @ b.rotation))))


def flipped(estimate: Estimate, observations: Observations) -> Estimate:
    sights = gather_sights(observations)
    poses = mirrored(sights, estimate.pose_stack(sights.keys))
    placements = {str(k.placement): Pose(p[:, :3], p[:, 3]) for k, p in zip(sights.keys, poses, strict=True)}
    return replace(estimate, placements=placements)


def test_mirrored_twice_is_the_same_pose() -> None:
    _, observations = small_boards(1)
    estimate = calibrate(observations, OPTIONS).estimate
    twice = flipped(flipped(estimate, observations), observations)
    for name, pose in estimate.placements.items():
        assert twice.placements[name].rotation == pytest.approx(pose.rotation, abs=1e-12)
        assert twice.placements[name].translation == pytest.approx(pose.translation, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_mirrored_poses_are_mended(seed: int) -> None:
    _, observations = small_boards(seed)
    estimate = calibrate(observations, OPTIONS).estimate
    wrong = flipped(estimate, observations)
    assert max(turned_deg(wrong.placements[n], p) for n, p in estimate.placements.items()) > 25.0
    sights, weighting = gather_sights(observations), Weighting(0.3, 0.3, "trivial")
    problem = Problem(sights, make_layout(observations, OPTIONS), weighting=weighting, options=OPTIONS)
    mended, count, undecided = without_mirrored_poses(problem, wrong, frozenset(sights.keys))
    assert count > 40  # 44 to 50 of 60: perspective determines the others, which are not tried
    changed = [name for name, pose in mended.placements.items() if pose != wrong.placements[name]]
    assert len(changed) == count
    for name in changed:
        assert turned_deg(mended.placements[name], estimate.placements[name]) < 0.5  # 0.01
    again, none, _ = without_mirrored_poses(problem, mended, undecided)
    assert none == 0 and again.placements.keys() == estimate.placements.keys()


@pytest.mark.parametrize("seed", partly(range(3), [0]))
def test_no_view_ends_mirrored_from_a_cold_start(seed: int) -> None:
    scene, observations = small_boards(seed, count=100)
    calibration = calibrate(observations, OPTIONS)
    for name, pose in calibration.placements.items():
        assert turned_deg(pose, scene.placements[name]) < 8.0  # 4; a mirrored pose is 30 to 80 off


@pytest.mark.parametrize("how", ["as it is", "mirrored", "axes exchanged"])
def test_boards_seen_from_behind_are_named(how: str) -> None:
    """A mirrored picture fits as well; only the visible side of a printed board reveals it."""
    scene = board_scene(
        checkerboard(9, 6, 0.03),
        {"camera": Camera((1280, 960), 900.0, (645.0, 470.0), Brown((-0.2, 0.05, 0.0, 0.0, 0.0)))},
        {"camera": Station("camera", Pose.identity())},
        8,
        1,
    )
    observed = simulate(scene, Disturbance(0.2, 0.2), 1).observations
    pixels, size = observed.points.pixels, (1280, 960)
    if how == "mirrored":
        pixels = pixels * (-1.0, 1.0) + (1279.0, 0.0)
    elif how == "axes exchanged":
        pixels, size = pixels[:, ::-1].copy(), (960, 1280)
    given = replace(observed, points=replace(observed.points, pixels=pixels), cameras={"camera": size})
    named = [words for words in calibrate(given).warnings if "checkerboards from behind" in words]
    assert len(named) == (how != "as it is")


def test_boards_whose_rows_are_counted_upwards_are_right_beside_a_floor() -> None:
    """Cameras that see a floor from above have no mirrored pictures, whatever the order of a board's rows."""
    camera = Camera((1280, 960), 700.0, (645.0, 470.0), Brown((-0.2, 0.05, 0.0, 0.0, 0.0)))
    stations = {"camera": Station("camera", overhead_pose(0.2, 0.1, 5.0, 8.0, 3.0, yaw_deg=20.0))}
    field = simulate(field_scene(ssl_field("B"), {"camera": camera}, stations), Disturbance(0.3, 0.3), 1).observations
    scene = board_scene(checkerboard(9, 6, 0.1), {"camera": camera}, stations, 8, 1)
    boards = simulate(scene, Disturbance(0.2, 0.2), 1).observations
    row, column = np.divmod(boards.points.feature, 9)
    upwards = replace(boards, points=replace(boards.points, feature=(9 * (5 - row) + column).astype(np.int32)))
    for given, count in ((upwards, 1), (upwards + field, 0)):
        named = [words for words in calibrate(given).warnings if "checkerboards from behind" in words]
        assert len(named) == count


def test_views_from_the_other_side_of_a_board_are_named() -> None:
    """If one view lists its columns from the last to the first, its pose is mirrored, but its
    residuals are not larger.
    """
    board = checkerboard(7, 5, 0.0254)
    matrix, distortion = np.array([[810.0, 0.0, 362.0], [0.0, 807.0, 214.0], [0.0, 0.0, 1.0]]), np.zeros(5)
    rng, shown = np.random.default_rng(0), dict[str, np.ndarray]()
    for frame in "abcdefg":
        turn = rng.uniform(-0.5, 0.5, 3)
        shift = np.array([0.0, 0.0, 0.6]) - cv2.Rodrigues(turn)[0] @ board.point_array.mean(axis=0)
        pixels = cv2.projectPoints(board.point_array, turn, shift, matrix, distortion)[0][:, 0]
        shown[frame] = pixels + rng.normal(0.0, 0.1, pixels.shape)
    for wrong in ("", "c", "bd"):
        given = dict(shown)
        for frame in wrong:
            given[frame] = given[frame].reshape(5, 7, 2)[:, ::-1].reshape(-1, 2)
        for target, moves in ((board, None), (board.point_array, True)):
            said = calibrate(Observations.from_points(given, target, (640, 480), moves=moves)).warnings
            named = [words for words in said if "from its other side" in words]
            assert len(named) == bool(wrong)
            assert all(repr(frame) in words for words in named for frame in wrong)
