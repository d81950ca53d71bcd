"""Markers of known place in rendered pictures, against OpenCV's own corners."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from test_boards import ideal_picture, photograph, rms, write
from test_cli import Say, refused, say

from ceres_cal.base.arrays import Array, Image8
from ceres_cal.base.errors import InputError, NothingShownError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown
from ceres_cal.scene.targets import Marker, markers, target_from_spec

__all__ = ["say"]
_PLACES = [(-0.8, -0.6), (0.1, -0.7), (0.9, -0.5), (-0.9, 0.1), (0.0, 0.0), (0.8, 0.3), (-0.7, 0.7), (0.2, 0.7)]
FLOOR = {7 + n: Marker(place, 0.24, 47.0 * n) for n, place in enumerate(_PLACES)}
NAME, DICTIONARY = "DICT_APRILTAG_36h11", cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
TARGET = markers(NAME, FLOOR)
_POSE = Pose(rotation_exp(np.array([np.pi - 0.3, 0.1, 0.05])), np.array([0.05, -0.1, 1.9]))
CAMERA = Camera((800, 600), 450.0, (404.0, 292.0), Brown((-0.25, 0.06, 0.0, 0.0, 0.0))).at(_POSE)
_CELLS = DICTIONARY.markerSize + 2


def paint(places: Array) -> Array:
    """Brightness of the floor (N, 2) m: grey, and each marker with one cell of white around it."""
    light = np.full(len(places), 0.6)
    for number, marker in FLOOR.items():
        bits = cv2.aruco.generateImageMarker(DICTIONARY, number, _CELLS) / 255.0
        bits = np.pad(bits, 1, constant_values=1.0)
        turn = np.radians(marker.turn_deg)
        near = np.flatnonzero(np.abs(places - marker.at_m[:2]).max(axis=1) < marker.side_m)
        away = (places[near] - marker.at_m[:2]) @ np.array(
            [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
        )
        column, row = np.floor(away.T * _CELLS / marker.side_m * [[1.0], [-1.0]] + 0.5 * len(bits)).astype(int)
        on = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < len(bits))
        light[near[on]] = bits[row[on], column[on]]
    return light


@pytest.fixture(scope="module")
def picture() -> Image8:
    return photograph(ideal_picture(CAMERA, 1.0, paint))


def test_corners(picture: Image8, tmp_path: Path) -> None:
    points = detect_boards([write(tmp_path / "a.png", picture)], TARGET).observations.points
    truth = CAMERA.project(TARGET.point_array)
    assert len(points) == 4 * len(FLOOR)
    error = rms(points.pixels - truth[points.feature])
    assert error < 0.03  # 0.018
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    corners, numbers, _ = cv2.aruco.ArucoDetector(DICTIONARY, parameters).detectMarkers(picture)
    theirs = [np.reshape(c, (4, 2)) - truth[4 * (n - 7) :][:4] for c, n in zip(corners, np.ravel(numbers), strict=True)]
    assert error < 0.2 * rms(np.concatenate(theirs))  # of 0.19


def test_a_camera_over_the_floor(picture: Image8, tmp_path: Path) -> None:
    """One picture of a tilted camera gives the calibration, and the floor is not treated as a movable board."""
    observations = detect_boards([write(tmp_path / "a.png", picture)], TARGET).observations
    assert observations.views[0].placement is None
    camera = calibrate(observations, Options(lens="brown", coefficients=("k1", "k2"))).estimate.camera_at("camera")
    pixels = CAMERA.project(TARGET.point_array)
    off_mm = 1e3 * (camera.locate(pixels) - CAMERA.locate(pixels))
    assert np.max(np.abs(off_mm)) < 0.3  # 0.1


def test_boards_of_markers_are_moved(picture: Image8, tmp_path: Path) -> None:
    board = markers(NAME, FLOOR, movable=True)
    paths = [write(tmp_path / name, picture) for name in ("a.png", "b.png")]
    assert detect_boards(paths, board).observations.placements == ("a", "b")


def test_what_is_not_there_once_is_not_seen(picture: Image8, tmp_path: Path) -> None:
    twice = picture.copy()
    x, y = np.round(CAMERA.project([[0.8, 0.3, 0.0]])[0]).astype(int)
    twice[10:110, 10:110] = twice[y - 50 : y + 50, x - 50 : x + 50]
    points = detect_boards([write(tmp_path / "a.png", twice)], TARGET).observations.points
    assert {TARGET.point_names[n].split(".")[0] for n in points.feature} == {"7", "8", "9", "10", "11", "13", "14"}
    one = markers(NAME, {12: FLOOR[12]})
    with pytest.raises(NothingShownError, match=r"no marker of 1 in any of 1 images; .*seen more than once: 12"):
        detect_boards([tmp_path / "a.png"], one)
    small = cv2.resize(picture, None, fx=0.3, fy=0.3, interpolation=cv2.INTER_AREA).astype(np.uint8)
    with pytest.raises(NothingShownError, match="too small or too blurred"):
        detect_boards([write(tmp_path / "b.png", small)], TARGET)


@pytest.mark.parametrize(
    ("name", "number", "words"),
    [("DICT_4X4_50", 50, "has markers 0 to 49, and no 50"), ("DICT_NONE", 1, "unknown marker dictionary 'DICT_NONE'")],
)
def test_other_dictionaries(name: str, number: int, words: str, picture: Image8, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        detect_boards([write(tmp_path / "a.png", picture)], markers(name, {number: Marker((0.0, 0.0), 0.1)}))


def test_the_target() -> None:
    assert target_from_spec(dict(TARGET.spec), "here") == TARGET
    turned = markers(NAME, {3: Marker((1.0, 2.0, 0.5), 0.2, 90.0)})
    assert turned.points["3.top_right"] == pytest.approx((0.9, 2.1, 0.5))
    with pytest.raises(InputError, match="marker '7': it needs a number from 0 on"):  # it was a TypeError
        markers("DICT_4X4_50", {"7": Marker((0.0, 0.0), 0.1)})  # type: ignore[dict-item]
    with pytest.raises(InputError, match="marker 3: it needs"):
        markers(NAME, {3: Marker((1.0, 2.0), -0.2)})
    with pytest.raises(InputError, match="by its number, not 'x'"):
        target_from_spec({**TARGET.spec, "markers": {"x": {"at_m": [0, 0], "side_m": 0.1}}}, "here")


def test_as_typed(say: Say, picture: Image8, tmp_path: Path) -> None:
    (tmp_path / "markers.json").write_text(json.dumps(dict(TARGET.spec)))
    image, output = write(tmp_path / "a.png", picture), tmp_path / "o.json"
    detect = ("detect", "board", image, "--target", tmp_path / "markers.json", "-o", output, "--quiet")
    assert "32 corners in all" in say(*detect).out
    assert "leave out --columns" in refused(say(*detect, "--columns", 4))
    assert "--target" in refused(say("detect", "board", image, "-o", output))
