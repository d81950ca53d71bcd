"""ChArUco boards: printed as OpenCV draws them, and distinguished from chessboards by their file."""

import cv2
import numpy as np
import pytest

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.scene.targets import Target, charuco, checkerboard, target_from_spec
from ceres_cal.scene.targets.charuco_boards import opencv_board

_CELL = 8  # px of a marker's cell; markers of 6 cells in squares of 8


def printed(board: Target) -> Array:
    """The sheet inside the outermost squares, with so many pixels for each cell."""
    assert board.paper is not None and board.grid is not None
    side, sheet = (
        board.grid.spacing_m,
        np.full((8 * _CELL * (board.grid.rows + 1), 8 * _CELL * (board.grid.columns + 1)), 255.0),
    )
    for shape in board.paper.shapes():
        x, y = np.rint((np.array(shape.place_m) / side + 1.0) * 8 * _CELL).astype(int)
        size = round(shape.size_m / side * 8 * _CELL)
        sheet[y : y + size, x : x + size] = 0.0 if shape.is_dark else 255.0
    return sheet


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("columns, rows", [(7, 5), (6, 4), (4, 6)])
def test_the_sheet_is_opencvs_board(columns: int, rows: int, *, legacy: bool) -> None:
    board = charuco(columns, rows, 0.04, 0.03, "DICT_4X4_50", legacy=legacy)
    drawn = opencv_board(board.spec).generateImage((8 * _CELL * (columns + 1), 8 * _CELL * (rows + 1)))
    assert np.array_equal(printed(board), drawn)
    framed = cv2.copyMakeBorder(drawn, 40, 40, 40, 40, cv2.BORDER_CONSTANT, value=255)
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(opencv_board(board.spec)).detectBoard(framed)
    assert len(numbers) == columns * rows
    seen = (np.asarray(corners, dtype=float).reshape(-1, 2) - 39.5) / (8 * _CELL) - 1.0
    truth = board.point_array[np.asarray(numbers).ravel(), :2] / 0.04
    assert np.allclose(seen, truth, atol=0.02)  # 0.003


def test_it_comes_back_from_its_description() -> None:
    board = charuco(7, 5, 0.04, 0.03, "DICT_5X5_100")
    assert target_from_spec(board.spec, "board") == board != checkerboard(7, 5, 0.04)
    without = {name: value for name, value in board.spec.items() if name != "legacy"}
    assert target_from_spec(without, "board") == board


def test_markers_do_not_fill_their_squares() -> None:
    with pytest.raises(InputError, match=r"charuco: marker_m must be between 0 and the square's 0\.04 m, not 0\.04"):
        charuco(7, 5, 0.04, 0.04, "DICT_4X4_50")
