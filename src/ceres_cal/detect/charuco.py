"""ChArUco boards: checkerboards with markers in their bright squares, by which a part of one tells its corners."""

from __future__ import annotations

import cv2

from ceres_cal.base.errors import InputError
from ceres_cal.base.frozen import Frozen
from ceres_cal.detect.markers import dictionary_of


class CharucoSpec(Frozen, eq=True):
    """The markers of a ChArUco board; its squares are those of the checkerboard target.

    Attributes:
        dictionary: OpenCV's name of the marker dictionary, such as "DICT_4X4_50".
        marker_m: side of a marker. Best at most 0.8 of a square: a corner needs some white towards the markers.
        legacy_pattern: made with OpenCV before 4.6, which began boards of an even number of rows otherwise.
    """

    dictionary: str
    marker_m: float
    legacy_pattern: bool = False


def charuco_detector(charuco: CharucoSpec, columns: int, rows: int, square_m: float) -> cv2.aruco.CharucoDetector:
    """What finds the corners of a checkerboard with markers; InputError where these do not fit it."""
    dictionary = dictionary_of(charuco.dictionary)
    if not 0.0 < charuco.marker_m < square_m:
        raise InputError(f"marker_m must be between 0 and the square's {square_m} m, not {charuco.marker_m}")
    needed = (columns + 1) * (rows + 1) // 2
    if len(dictionary.bytesList) < needed:
        raise InputError(
            f"{charuco.dictionary} has {len(dictionary.bytesList)} markers, but a board of {columns + 1} x {rows + 1} "
            f"squares needs {needed}: name the dictionary that was printed"
        )
    board = cv2.aruco.CharucoBoard((columns + 1, rows + 1), square_m, charuco.marker_m, dictionary)
    board.setLegacyPattern(charuco.legacy_pattern)
    return cv2.aruco.CharucoDetector(board)
