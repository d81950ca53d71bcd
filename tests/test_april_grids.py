"""Kalibr's AprilGrid in rendered pictures, against OpenCV's own corners."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from test_boards import photograph, rms, write
from test_cli import Say, refused, say

from ceres_cal.base.arrays import Array, Image8
from ceres_cal.base.errors import InputError
from ceres_cal.detect.boards import detect_boards
from ceres_cal.scene.targets import april_grid, target_from_spec

__all__ = ["say"]
GRID = april_grid(4, 3, 0.08, 0.25)
_TAG, _GAP, _MARGIN = 160, 40, 60  # px of the drawing


def drawing(border_bits: int) -> Image8:
    """Tags from the bottom left, row by row, and small dark squares at their corners."""
    width, height = (2 * _MARGIN + n * _TAG + (n - 1) * _GAP for n in (4, 3))
    sheet = np.full((height, width), 255, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number in range(12):
        column, row = number % 4, 2 - number // 4
        x, y = (_MARGIN + n * (_TAG + _GAP) for n in (column, row))
        sheet[y : y + _TAG, x : x + _TAG] = cv2.aruco.generateImageMarker(dictionary, number, _TAG, None, border_bits)
        for left, top in ((x - _GAP, y - _GAP), (x + _TAG, y - _GAP), (x - _GAP, y + _TAG), (x + _TAG, y + _TAG)):
            sheet[top : top + _GAP, left : left + _GAP] = 0
    return sheet


def picture(border_bits: int, scale: float = 1.0) -> tuple[Image8, Array]:
    """The drawing in perspective, and its corners (48, 2) px; smaller in the same picture at another scale."""
    sheet = drawing(border_bits)
    height, width = sheet.shape
    corners = _MARGIN + GRID.point_array[:, :2] / 0.08 * _TAG - 0.5
    to_picture = cv2.getPerspectiveTransform(
        np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32),
        scale * np.array([[110, 80], [1180, 150], [1090, 860], [190, 780]], np.float32),
    )
    finer = np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]])  # 4 x 4 places in each pixel
    fine = cv2.warpPerspective(sheet, finer @ to_picture, (4 * 1280, 4 * 960), borderValue=255)
    image = photograph(np.asarray(cv2.resize(fine, (1280, 960), interpolation=cv2.INTER_AREA), float) / 255.0)
    return image, cv2.perspectiveTransform(corners[None], to_picture)[0]


@pytest.mark.parametrize("border_bits", [2, 1])
def test_corners_of_tags(border_bits: int, tmp_path: Path) -> None:
    image, truth = picture(border_bits)
    points = detect_boards([write(tmp_path / "a.png", image)], GRID).observations.points
    assert len(points) == 48
    error = points.pixels - truth[points.feature]
    assert rms(error) < 0.01  # 0.0035
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, _, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    peer = np.concatenate([one.reshape(4, 2) for one in corners])
    off = peer - truth[np.argmin(np.linalg.norm(peer[:, None] - truth, axis=2), axis=1)]
    assert rms(error) < 0.3 * rms(off)  # of 0.027


def test_outermost_corners_are_as_accurate_as_others(tmp_path: Path) -> None:
    """Discs around them were as large as a tag and reached beyond the small squares: they were off by 0.1 to 0.2 px."""
    image, truth = picture(2, 0.5)
    points = detect_boards([write(tmp_path / "a.png", image)], GRID).observations.points
    off = np.linalg.norm(points.pixels - truth[points.feature], axis=1)
    assert len(points) == 48 and np.max(off) < 0.05  # 0.02


def test_another_gap_is_named(tmp_path: Path) -> None:
    """Such a board was taken for one that was not built as drawn, and the calibration was called good."""
    path = write(tmp_path / "a.png", picture(2)[0])
    why = r"tags 0\.3 of their side apart do not fit on the board, which shows a gap of 0\.2(49|5\d): correct the gap"
    with pytest.raises(InputError, match=why):
        detect_boards([path], april_grid(4, 3, 0.08, 0.3))


def test_a_part_is_enough(tmp_path: Path) -> None:
    image, truth = picture(2)
    image[:, 700:] = 128
    points = detect_boards([write(tmp_path / "a.png", image)], GRID).observations.points
    assert 12 <= len(points) < 48 and rms(points.pixels - truth[points.feature]) < 0.05


def test_nothing_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no board of 4 x 3 tags in any of 1 images; .*: 0 of 12 tags found"):
        detect_boards([write(tmp_path / "a.png", np.full((480, 640), 128, np.uint8))], GRID)


def test_the_target() -> None:
    assert target_from_spec(dict(GRID.spec), "here") == GRID
    assert GRID.points["2,1"] == pytest.approx((0.1, 0.08, 0.0))
    with pytest.raises(InputError, match="positive"):
        april_grid(6, 6, 0.08, 0.0)


def test_as_typed(say: Say, tmp_path: Path) -> None:
    path = write(tmp_path / "a.png", picture(2)[0])
    detect = ("detect", "board", path, "--columns", 4, "--rows", 3, "--april-grid", 0.08, "-o", tmp_path / "o.json")
    assert "48 corners in all" in say(*detect, "--gap", 0.25, "--quiet").out
    assert "--gap" in refused(say(*detect))
