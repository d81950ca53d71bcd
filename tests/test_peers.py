"""The same optimum as independent solvers on the same corners: OpenCV, and pycolmap's own C++ cost functions; and the
script that compares all installed peers.

The corners are noisy, so that the optimum differs from the truth and residuals do not vanish: agreement means the same
model, the same cost and a converged solver. The versions of pyceres and pycolmap are pinned as a pair, which is tested
here.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pyceres
import pycolmap
import pycolmap.cost_functions
import pytest
from beside import page
from scenery import BoardRanges, board_scene

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose, rotation_exp, rotation_log
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import BoardDetections
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens
from ceres_cal.scene.targets import checkerboard
from ceres_cal.simulate import Disturbance, Station, simulate

BOARD = checkerboard(9, 6, 0.125)  # its corners are exact in single precision, which OpenCV needs
SIZE = (1280, 960)
LENSES: dict[str, tuple[float, Lens]] = {
    "brown": (825.0, Brown((-0.24, 0.082, 4e-4, -3e-4, -0.011))),
    "kannala-brandt": (480.0, KannalaBrandt((-0.05, 0.012, -0.008, 0.0015))),
}


@dataclass(frozen=True, eq=False)
class Answer:
    """Result of a solver: phi, aspect, cx, cy and coefficients; cam_from_board of every view; 2D rms."""

    intrinsics: Array
    poses: Sequence[Pose]
    rms_px: float


@cache
def corners(lens: str) -> Observations:
    """15 views of a board, 0.3 px of noise, pixels rounded to single precision."""
    phi, model = LENSES[lens]
    camera = Camera(SIZE, phi, (651.3, 468.9), model, 1.004)
    scene = board_scene(
        BOARD,
        {"camera": camera},
        {"camera": Station("camera", Pose.identity())},
        15,
        seed=1,
        held=BoardRanges((0.8, 2.0)),
    )
    found = simulate(scene, Disturbance(points_sigma_px=0.3), seed=1).observations
    return replace(found, points=replace(found.points, pixels=found.points.pixels.astype(np.float32)))


def per_view(observations: Observations, precision: Any) -> tuple[list[Any], list[Any]]:
    """Board points and pixels of each view in OpenCV's form."""
    rows = [np.flatnonzero(observations.points.view == number) for number in range(len(observations.views))]
    (board,) = observations.targets.values()
    places = [board.point_array[observations.points.feature[row]].astype(precision) for row in rows]
    return places, [observations.points.pixels[row].astype(precision) for row in rows]


@cache
def ours(lens: str, free_aspect: bool = True, fixed: tuple[str, ...] = ()) -> tuple[Calibration, Answer]:
    """Plain least squares: no robust loss, no rejection, the stated sigmas."""
    options = Options(
        usual_camera=False, lens=lens, free_aspect=free_aspect, fixed=dict.fromkeys(fixed, 0.0), loss="trivial",
        noise_scale="stated", reject_sigma=1e9,
    )  # fmt: skip
    calibration = calibrate(corners(lens), options)
    camera = calibration.cameras["camera"]
    station = calibration.station().cam_from_world
    poses = [station @ calibration.placements[str(view.placement)] for view in corners(lens).views]
    intrinsics = np.array([camera.phi, camera.aspect, *camera.principal_point, *camera.lens.values])
    return calibration, Answer(intrinsics, poses, calibration.fit.points_rms_px)


def assert_same(found: Answer, peer: Answer, fixed: int = 0) -> None:
    """Every parameter is equal to 1e-6, relative; the principal point relative to phi, rotations in rad."""
    free = len(found.intrinsics) - fixed
    size = np.abs(peer.intrinsics[:free])
    size[2:4] = peer.intrinsics[0]
    assert np.max(np.abs(found.intrinsics - peer.intrinsics)[:free] / size) < 1e-6
    for mine, theirs in zip(found.poses, peer.poses, strict=True):
        assert np.linalg.norm(rotation_log(mine.rotation @ theirs.rotation.T)) < 1e-6
        away = np.linalg.norm(mine.translation - theirs.translation)
        assert away < 1e-6 * np.linalg.norm(theirs.translation)
    assert found.rms_px == pytest.approx(peer.rms_px, rel=1e-9)
    assert peer.rms_px == pytest.approx(0.3 * np.sqrt(2.0), rel=0.1)  # noise, and nothing else


# ---- OpenCV ---------------------------------------------------------------------------------------------------------

PATIENCE = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 2000, 1e-15)


def from_opencv(rms: float, matrix: Any, distortion: Any, rotations: Any, translations: Any) -> Answer:
    poses = [Pose.exp(np.concatenate([r.ravel(), t.ravel()])) for r, t in zip(rotations, translations, strict=True)]
    fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    return Answer(np.array([fx, fy / fx, cx, cy, *distortion.ravel()]), poses, rms)


@pytest.mark.parametrize("free_aspect", [True, False])
def test_opencv_brown(free_aspect: bool) -> None:
    flags = 0 if free_aspect else cv2.CALIB_FIX_ASPECT_RATIO
    places, pixels = per_view(corners("brown"), np.float32)
    peer = from_opencv(
        *cv2.calibrateCamera(places, pixels, SIZE, np.eye(3), np.zeros(5), flags=flags, criteria=PATIENCE)
    )
    assert_same(ours("brown", free_aspect)[1], peer)  # 6e-7 (of k3) measured, 2e-9 of all but the coefficients


def test_opencv_fisheye() -> None:
    """Started with errors of 1 %: without an initial estimate it ends with an rms of 377 px."""
    _, found = ours("kannala-brandt")
    phi, aspect, cx, cy, *coefficients = found.intrinsics * 1.01
    start = np.array([[phi, 0.0, cx], [0.0, phi * aspect, cy], [0.0, 0.0, 1.0]])
    places, pixels = ([each[None] for each in column] for column in per_view(corners("kannala-brandt"), np.float64))
    flags = cv2.CALIB_FIX_SKEW + cv2.CALIB_RECOMPUTE_EXTRINSIC + cv2.CALIB_USE_INTRINSIC_GUESS
    peer = cv2.fisheye.calibrate(places, pixels, SIZE, start, np.array(coefficients), flags=flags, criteria=PATIENCE)
    assert_same(found, from_opencv(*peer))  # 4e-9 measured


# ---- pycolmap's cost functions in a pyceres problem -----------------------------------------------------------------

HALF = 0.5  # in COLMAP the centre of the top-left pixel is (0.5, 0.5)


def solve_with_colmap(
    model: pycolmap.CameraModelId, observations: Observations, start: Array, poses: Sequence[Pose], held: list[int]
) -> tuple[Array, list[Pose], float]:
    """Least squares over COLMAP's parameters and one pose per view.

    A pose is a quaternion and a translation in one block, for which pyceres has no manifold. Therefore each round
    rotates the board's points by the present rotation and solves for a small one (x, y, z, 1) with w fixed. Where x, y,
    z end at 0, the rotation is stationary.
    """
    parameters, poses = start.copy(), list(poses)
    options, summary = pyceres.SolverOptions(), pyceres.SolverSummary()
    options.function_tolerance, options.gradient_tolerance, options.parameter_tolerance = 1e-18, 1e-20, 1e-14
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    options.logging_type = pyceres.LoggingType.SILENT
    turn = np.ones(1)
    for _ in range(6):
        problem = pyceres.Problem()
        blocks = [np.array([0.0, 0.0, 0.0, 1.0, *pose.translation]) for pose in poses]
        for block, pose, places, pixels in zip(blocks, poses, *per_view(observations, np.float64), strict=True):
            for place, pixel in zip(places @ pose.rotation.T, pixels + HALF, strict=True):
                cost = pycolmap.cost_functions.ReprojErrorCost(model, pixel, place)
                problem.add_residual_block(cost, None, [block, parameters])
            problem.set_manifold(block, pyceres.SubsetManifold(7, [3]))
        if held:
            problem.set_manifold(parameters, pyceres.SubsetManifold(len(parameters), held))
        pyceres.solve(options, problem, summary)
        turn = np.array([np.linalg.norm(block[:3]) for block in blocks])
        poses = [
            Pose(rotation_exp(2.0 * np.arctan(size) * block[:3] / max(size, 1e-300)) @ pose.rotation, block[4:])
            for block, pose, size in zip(blocks, poses, turn, strict=True)
        ]
        if np.max(turn) < 1e-9:
            break
    assert np.max(turn) < 1e-9
    return parameters, poses, float(np.sqrt(2.0 * summary.final_cost / len(observations.points)))


MODELS = {
    "OPENCV": ("brown", ("k3",), 1, 0),  # fx fy cx cy k1 k2 p1 p2
    "FULL_OPENCV": ("brown", (), 0, 3),  # ... k3 k4 k5 k6, of which the last three stay 0
    "OPENCV_FISHEYE": ("kannala-brandt", (), 0, 0),
}


@pytest.mark.parametrize("name", MODELS)
def test_pycolmap_cost_functions(name: str) -> None:
    lens, fixed, without, more = MODELS[name]
    _, found = ours(lens, True, fixed)
    phi, aspect, cx, cy, *coefficients = found.intrinsics
    coefficients = [*coefficients[: len(coefficients) - without], *[0.0] * more]
    start = np.array([phi, phi * aspect, cx + HALF, cy + HALF, *coefficients])
    held = list(range(len(start) - more, len(start)))
    rng = np.random.default_rng(0)
    start *= 1.0 + 1e-3 * rng.standard_normal(len(start))
    starts = [Pose.exp(rng.normal(0.0, 1e-3, 6)) @ pose for pose in found.poses]
    model = getattr(pycolmap.CameraModelId, name)
    parameters, poses, rms_px = solve_with_colmap(model, corners(lens), start, starts, held)
    fx, fy, cx, cy, *coefficients = parameters
    peer = np.array([fx, fy / fx, cx - HALF, cy - HALF, *coefficients[: len(coefficients) - more], *[0.0] * without])
    assert_same(found, Answer(peer, poses, rms_px), fixed=without)  # 6e-7 (of k3), 2e-9 measured


@pytest.mark.parametrize("name", MODELS)
def test_pycolmap_projects_as_we_do(name: str) -> None:
    """One of its cost functions evaluated directly."""
    lens, _, without, more = MODELS[name]
    camera = Camera(SIZE, LENSES[lens][0], (651.3, 468.9), LENSES[lens][1], 1.004)
    values = list(camera.lens.values)
    if without:
        values[-1] = 0.0
        camera = replace(camera, lens=camera.lens.with_values(values))
    parameters = [camera.phi, camera.phi * 1.004, 651.3 + HALF, 468.9 + HALF]
    parameters += [*values[: len(values) - without], *[0.0] * more]
    point = np.array([0.7, -0.4, 1.5])
    cost = pycolmap.cost_functions.ReprojErrorCost(
        getattr(pycolmap.CameraModelId, name), np.array([200.5, 300.5]), point
    )
    residual, _ = cost.evaluate(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), np.array(parameters))
    assert np.max(np.abs(residual.ravel() - (camera.project(point[None])[0] - (200.0, 300.0)))) < 1e-10


# ---- real boards ----------------------------------------------------------------------------------------------------


def test_sony_boards(sony_boards: BoardDetections) -> None:
    """OpenCV with these corners, k1 and k2 only: 0.138 px and 702.59; with its own 0.162 px,
    700.93; published: 701.0.
    """
    assert len(sony_boards.observations.views) == 13
    fixed = {"p1": 0.0, "p2": 0.0, "k3": 0.0}
    options = Options(usual_camera=False, lens="brown", free_aspect=True, fixed=fixed, as_built="as drawn")
    everything = replace(options, loss="trivial", noise_scale="stated", reject_sigma=1e9)
    plain = calibrate(sony_boards.observations, everything)
    assert plain.fit.points == 13 * 24 and plain.fit.points_rms_px <= 0.139  # 0.1384 measured
    assert abs(plain.station().phi - 702.6) <= 0.5  # 702.58 measured


@pytest.mark.thorough
def test_gopro_boards(gopro_boards: BoardDetections) -> None:
    """OpenCV with three radial coefficients and its own corners: 0.5235 px and 560.07; some are 2 px and more off."""
    observations = gopro_boards.observations
    assert len(observations.views) >= 35
    fixed = {"p1": 0.0, "p2": 0.0}  # as OpenCV, which takes boards as drawn
    options = Options(usual_camera=False, lens="brown", free_aspect=True, fixed=fixed, as_built="as drawn")
    calibration = calibrate(observations, options)
    assert calibration.fit.points_rms_px <= 0.53  # 0.444 measured, without 7 corners
    assert len(calibration.rejected) < 0.01 * len(observations.points)
    everything = replace(options, loss="trivial", noise_scale="stated", reject_sigma=1e9)
    plain = calibrate(observations, everything)
    assert plain.fit.points == len(observations.points)
    assert plain.fit.points_rms_px == pytest.approx(0.5208, abs=1e-3)  # 0.52076 measured
    assert plain.station().phi == pytest.approx(560.09, abs=0.02)  # 560.0906 measured


# ---- side by side ---------------------------------------------------------------------------------------------------

ROOT = Path(__file__).parents[1]


@pytest.mark.thorough
def test_quick_form_side_by_side(tmp_path: Path) -> None:
    """With this Python's OpenCV, the set of data/opencv_left, and two inputs."""
    path = tmp_path / "peers.json"
    command = [sys.executable, str(ROOT / "scripts" / "peers.py"), "--quick", "--splits", "1", "--jobs", "1"]
    asked = [*command, "--peers", "opencv", "--json", str(path)]
    printed = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    found = json.loads(path.read_text(encoding="utf-8"))
    assert found["environment"]["missing"] == {} and "held-out rms, px" in printed
    left_px = {row["peer"]: row["rms_px"] for row in found["prediction"] if row["setting"] in ("default", "OPENCV")}
    assert left_px["opencv"] == pytest.approx(0.169, abs=0.01)  # 0.168 measured of the corners that count
    assert left_px["ours"] < 0.75 * left_px["opencv"]  # 0.62: the board is not as drawn
    (apart,) = (row["numbers"] for row in found["truth"] if row["peer"] == "opencv")
    assert apart > 1.3  # 2 measured: OpenCV has no number for the board's errors
    said = {(row["fault"], row["peer"]): row for row in found["lies"]}
    assert not any(said["sound", peer]["wrong"] for peer in ("ours", "opencv"))
    assert said["repeated picture", "ours"]["notices"] == "named"
    assert said["repeated picture", "opencv"]["notices"] == "no"


def test_page_is_made_of_the_stored_run() -> None:
    stored = json.loads((ROOT / "docs" / "peers.json").read_text(encoding="utf-8"))
    assert (ROOT / "docs" / "peers.md").read_text(encoding="utf-8") == page.made(stored)
    assert len(stored["environment"]["versions"]) > 5  # five peers and ceres-cal
    assert len({row["set"] for row in stored["prediction"] if "rms_px" in row}) >= 6
    assert len({row["fault"] for row in stored["lies"]}) == 11  # ten, and the correct one
