"""ChArUco boards: checkerboards with markers in their bright squares, so that a part of one identifies its corners."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from msgspec import structs

from ceres_cal.base import InputError, checked, replace
from ceres_cal.scene.targets.grids import checkerboard, checkered
from ceres_cal.scene.targets.target import Grid, Shape, Target, TargetKind, from_arguments

if TYPE_CHECKING:
    import cv2


@checked
def charuco(
    columns: int, rows: int, square_m: float, marker_m: float, dictionary: str, *, legacy: bool = False
) -> Target:
    """Return the inner corners of a ChArUco board, named as a checkerboard's: one fewer than squares in each direction.

    Args:
        marker_m: side of a marker, best at most 0.8 of a square, because a corner needs some white towards the markers.
        dictionary: OpenCV's name of the markers' dictionary, such as "DICT_4X4_50".
        legacy: whether it was made with OpenCV before 4.6, which began boards of an even number of rows of squares with
            a bright one.

    Raises:
        InputError: see `checkerboard`; or markers that do not fit into the squares.
    """
    board = checkerboard(columns, rows, square_m)
    if not 0.0 < marker_m < square_m:
        raise InputError(f"charuco: marker_m must be between 0 and the square's {square_m} m, not {marker_m}")
    own = {"kind": "charuco", "marker_m": float(marker_m), "dictionary": dictionary, "legacy": bool(legacy)}
    spec = {**board.spec, **own}
    assert board.paper is not None and board.grid is not None
    paper = structs.replace(board.paper, shapes=partial(_shapes, board.grid, spec))
    return replace(board, spec=spec, paper=paper)


def _shapes(grid: Grid, spec: Mapping[str, Any]) -> Iterator[Shape]:
    """Yield the dark squares, the dark ground of each marker, and its light cells."""
    board = opencv_board(spec)
    dictionary = board.getDictionary()
    corners = np.array(board.getObjPoints())[:, :, :2] - grid.spacing_m  # from the first inner corner, clockwise
    beside = np.floor(corners[0, 0] / grid.spacing_m).sum()  # a marker lies in a bright square
    yield from checkered(grid, int(beside + 1) % 2)
    for low, high in corners[:, [0, 2]]:
        yield Shape((float(low[0]), float(low[1])), float(high[0] - low[0]))
    for number, (low, high) in zip(board.getIds(), corners[:, [0, 2]], strict=True):
        cells = dictionary.markerSize + 2  # with the dark border
        bits, cell_m = dictionary.generateImageMarker(int(number), cells), float(high[0] - low[0]) / cells
        for row, column in product(range(cells), range(cells)):
            if bits[row, column]:
                yield Shape((low[0] + column * cell_m, low[1] + row * cell_m), cell_m, is_dark=False)


def opencv_board(spec: Mapping[str, Any]) -> cv2.aruco.CharucoBoard:
    """Return the board for OpenCV; InputError for a dictionary that it does not have, or that has too few markers."""
    import cv2

    squares = (spec["columns"] + 1, spec["rows"] + 1)
    dictionary, needed = dictionary_of(spec["dictionary"]), squares[0] * squares[1] // 2
    if len(dictionary.bytesList) < needed:
        raise InputError(
            f"{spec['dictionary']} has {len(dictionary.bytesList)} markers, but a board of {squares[0]} x {squares[1]} "
            f"squares needs {needed}: name the dictionary that was printed"
        )
    board = cv2.aruco.CharucoBoard(squares, spec["square_m"], spec["marker_m"], dictionary)
    board.setLegacyPattern(spec["legacy"])
    return board


def dictionary_of(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of that name; raise InputError where there is none."""
    import cv2

    code = getattr(cv2.aruco, name, None)
    if not name.startswith("DICT_") or not isinstance(code, int):
        raise InputError(f"unknown marker dictionary {name!r}: name one of OpenCV's, such as DICT_4X4_50")
    return cv2.aruco.getPredefinedDictionary(code)


KIND = TargetKind(
    "charuco",
    "the inner corners of a ChArUco board, a checkerboard with markers",
    "columns and rows (inner corners), square_m, marker_m, dictionary (OpenCV's name), legacy (OpenCV before 4.6)",
    'points "c,r" as of a checkerboard',
    lambda: {"charuco": charuco(7, 5, 0.04, 0.03, "DICT_4X4_50")},
    from_arguments("charuco", charuco),
)
