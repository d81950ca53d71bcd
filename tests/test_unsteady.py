"""Principal points that move from view to view, and a rolling shutter: found, named, with honest uncertainty."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from accuracy.as_built import CAMERAS, Board, observed
from photos.held_out import left_px
from thorough import partly

from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.diagnostics import diagnose
from ceres_cal.effects.evidence import RepeatedAmounts
from ceres_cal.observations import Observations, gather_sights
from ceres_cal.problem import problem_of
from ceres_cal.problem.parameters import Options
from ceres_cal.robust.robust import solve_robustly
from ceres_cal.robust.unsteady import MOVES, ROLLING
from ceres_cal.scene.targets import checkerboard
from ceres_cal.start.initialise import initialise

VIEWS, MOVED_PX = 14, 12.0
FLAT = Board(views=VIEWS)


def shifted(seed: int, sigma_px: float) -> Observations:
    """Views of a flat board with random principal points: everything in a view is shifted."""
    _, observations = observed(FLAT, seed)
    points = observations.points
    moved = np.random.default_rng(seed).normal(0.0, sigma_px, (len(observations.views), 2))
    return replace(observations, points=replace(points, pixels=points.pixels + moved[points.view]))


def rolling(seed: int, sigma_px: float, board: Board = FLAT) -> Observations:
    """Views with a random motion each, while their rows are read out from the first to the last."""
    _, observations = observed(board, seed)
    points, (_, height) = observations.points, observations.cameras["camera"]
    moved = np.random.default_rng(100 + seed).normal(0.0, sigma_px, (len(observations.views), 2))[points.view]
    pixels = points.pixels + moved * (points.pixels[:, 1:] / height - 0.5)
    return replace(observations, points=replace(points, pixels=pixels))


def test_a_shutter_that_rolls_too_little_to_be_taken_off_is_in_what_is_stated() -> None:
    """Poses and aspect absorb nearly all of it; the aspect has an error by the mean of all views."""
    for seed in (1, 4, 5):
        calibration = calibrate(rolling(seed, 3.0))
        posterior = calibration.posterior
        assert posterior is not None and posterior.dependence is not None and posterior.by_model is not None
        assert ROLLING not in {one.kind for one in calibration.effects}
        assert 0.3 < posterior.dependence.read_out_px < 1.2  # 0.60, 0.64 and 0.56: boards fill a third of the pictures
        assert "rolling shutter" in " ".join(posterior.dependence.causes)
        phi = posterior.column("camera", "camera", "phi")
        assert (posterior.spread.sd / posterior.by_model.spread.sd)[phi] > 2.0  # 2.15 to 2.30; without it 1.68 to 1.72


def through_a_moving_pupil(seed: int, views: int) -> Observations:
    """An equidistant fisheye and near boards: its pupil moves ahead by 6 mm times the square of the angle."""
    rng, board, shown = np.random.default_rng(seed), checkerboard(9, 7, 0.05), dict[str, Any]()
    places = board.point_array - board.point_array.mean(axis=0)
    while len(shown) < views:
        angle, around, far_m = rng.uniform([0.0, -np.pi, 0.3], [1.35, np.pi, 1.2])
        ahead = np.array([np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)])
        facing = np.linalg.qr(np.column_stack([ahead, rng.normal(size=(3, 2))]))[0][:, [1, 2, 0]]
        facing[:, 2] = np.cross(facing[:, 0], facing[:, 1])
        points = places @ (facing @ cv2.Rodrigues(rng.normal(0.0, 0.35, 3))[0]).T + far_m * ahead
        beside = np.hypot(points[:, 0], points[:, 1])
        theta = np.arctan2(beside, points[:, 2])
        for _ in range(20):
            theta = np.arctan2(beside, points[:, 2] - 0.006 * theta**2)
        radius = 550.0 * theta * (1.0 + 0.02 * theta**2)
        pixels = np.array([1019.0, 1031.0]) + (radius / beside)[:, None] * points[:, :2]
        if np.max(theta) < 1.6 and np.all(np.abs(pixels - 1023.5) < 1023.0):
            shown[str(len(shown))] = pixels + rng.normal(0.0, 0.05, pixels.shape)
    return Observations.from_points(shown, board, (2048, 2048))


def phi_off(calibration: Calibration) -> float:
    """Error in standard deviations."""
    verdict = calibration.uncertainty.verdict("camera", "camera", "phi")
    return (verdict.value - CAMERAS["camera"].phi) / verdict.sd


@pytest.fixture(scope="module")
def moving() -> list[tuple[Observations, Calibration]]:
    return [(each, calibrate(each)) for each in (shifted(seed, MOVED_PX) for seed in range(4))]


def test_a_steady_camera_is_left_alone() -> None:
    for seed in range(4):
        calibration = calibrate(shifted(seed, 0.0))
        assert not {one.kind for one in calibration.effects} & {MOVES, ROLLING}  # none of 40


def test_principal_points_that_move_are_found_and_named(moving: list[tuple[Observations, Calibration]]) -> None:
    for _, calibration in moving:
        (found,) = [one for one in calibration.effects if one.kind == MOVES]
        assert found.subject == "camera"
        assert 0.5 < found.sigma / MOVED_PX < 1.6  # 0.78 to 1.01 measured; 11 of 12 scenes are found
        assert any("principal point moves" in warning for warning in calibration.warnings)
        assert not calibration.outliers


@pytest.mark.parametrize("seed", partly([1, 11], [11]))
def test_rays_that_do_not_meet_in_one_point_are_no_principal_point_that_moves(seed: int) -> None:
    """The lens's errors were attributed to it, or to a rolling shutter: other views were predicted
    to 0.31 and 0.92 px.
    """
    known, new = through_a_moving_pupil(seed, 10), through_a_moving_pupil(100 + seed, 12)
    assert not {one.kind for one in calibrate(known).effects} & {MOVES, ROLLING}
    lengths_px, kept = left_px(Options(), known, new)
    assert np.mean(kept) > 0.8
    assert np.sqrt(np.mean(lengths_px[kept] ** 2)) < 0.2  # 0.14 and 0.11 measured, of a noise of 0.07


def test_what_is_stated_holds_beside_them(moving: list[tuple[Observations, Calibration]]) -> None:
    off = np.array([phi_off(calibration) for _, calibration in moving])
    assert np.max(np.abs(off)) < 3.5  # 1.2 measured; of 12 scenes 2.0
    for observations, calibration in moving:
        assert calibration.fit.point_scale < 1.2  # of the noise alone: 0.99 measured
        assert len(observations.shown_views) == VIEWS


def test_a_saved_calibration_is_diagnosed_beside_them(
    moving: list[tuple[Observations, Calibration]], tmp_path: Path
) -> None:
    observations, calibration = moving[0]
    calibration.save(tmp_path / "camera.json")
    diagnosis = diagnose(Calibration.load(tmp_path / "camera.json"), observations)
    assert not [one for one in diagnosis.findings if one.is_model_error]
    (noise,) = diagnosis.noise
    assert noise.sigma_px == pytest.approx(0.3, rel=0.1)  # the simulation's: 0.292 measured


def test_what_is_taken_off_counts_from_the_first_round_on() -> None:
    """Otherwise the leverages gave a larger noise than the count, and each round asked for another one."""
    sights, options = gather_sights(shifted(0, 0.0)), Options(lens="radial")
    start = initialise(sights, options).estimate
    plain = problem_of(sights, options, start)
    alone, beside = (solve_robustly(one, start, is_near=True) for one in (plain, replace(plain, taken_up=200.0)))
    assert beside.rounds == alone.rounds
    spare = plain.equations - plain.unknowns(start)
    assert (alone.inliers.point_scale / beside.inliers.point_scale) ** 2 == pytest.approx(1.0 - 200.0 / spare, rel=0.02)


def test_a_rolling_shutter_is_found_and_named() -> None:
    for seed in (1, 4):
        calibration = calibrate(rolling(seed, 30.0))
        (found,) = [one for one in calibration.effects if one.kind == ROLLING]  # 7 of 8 scenes are, one as a lens's
        assert "rolling shutter" in found.sentence
        assert calibration.fit.point_scale < 1.2  # of the noise alone: 0.98 measured; 2.1 before it is taken off
        assert abs(phi_off(calibration)) < 3.5  # 2.0 measured; 2.7 and 3.8 before, of three times the error


@pytest.mark.thorough
def test_what_is_taken_off_says_nothing_of_the_board() -> None:
    """It depends on the board's estimate: a board as drawn was estimated as longer one way with probability 1."""
    bent = Board(views=VIEWS, points_m=2e-4, bow_m=1e-3, heights_m=3e-4)
    for seed in (10, 13):
        assert "stretch" not in {one.kind for one in calibrate(rolling(seed, 30.0, bent)).as_built}  # 5 of 16 before


def test_too_few_equations_beside_the_views_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small boards leave none if each view has its own numbers: findings about the board keep their probability."""
    asked = RepeatedAmounts.sizes

    def sizes(repeated: RepeatedAmounts, numbers: Any, priors: Any, stated: Any = ()) -> Any:
        return {} if stated else asked(repeated, numbers, priors)

    monkeypatch.setattr(RepeatedAmounts, "sizes", sizes)
    calibration = calibrate(rolling(1, 30.0, Board(views=VIEWS, points_m=2e-4, bow_m=1e-3)))
    assert {one.kind for one in calibration.effects} & {MOVES, ROLLING}
    assert {one.kind for one in calibration.as_built} >= {"points", "warp"}


@pytest.mark.thorough
def test_pictures_of_two_cameras_are_no_stabilised_one(real_data: Path) -> None:
    """A real stereo pair in one folder, 13 pictures each: a read-out time seems to explain most of the residuals."""
    pictures = sorted((real_data / "opencv_left_right").glob("*.jpg"))
    both = detect_boards(pictures, checkerboard(9, 6, 0.025)).observations
    calibration = calibrate(both)
    assert not calibration.effects
    first = diagnose(calibration, both).findings[0]
    assert (first.kind, first.frame) == ("lens changed", "left14")
