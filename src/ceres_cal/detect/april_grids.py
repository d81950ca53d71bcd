"""Kalibr's AprilGrids in images: OpenCV finds the tags, and their corners are measured as saddles.

A small dark square touches each corner of a tag, so the picture there looks like a chessboard's corner.
"""

from __future__ import annotations

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, Image, Image8
from ceres_cal.detect.saddles import measure_saddles
from ceres_cal.scene.targets import Target

_CORNERS = ((0, 0), (0, 1), (1, 1), (1, 0))  # row and column within a tag, in OpenCV's order


def measured_april_grid(image: Image, levels: Image8, board: Target) -> Array | str:
    """Return the corners (2 rows, 2 columns, 2) px, NaN where one was not seen, or the reason why there are none."""
    border_bits = (2, 1)  # width of the dark border around a tag's code, in cells: Kalibr's own, and other makers'
    columns, rows = board.spec["columns"], board.spec["rows"]
    found = max((_tags(levels, bits, columns * rows) for bits in border_bits), key=len)
    if len(found) < 2:
        return f"{len(found)} of {columns * rows} tags found"
    places = board.point_array[:, :2].reshape(2 * rows, 2 * columns, 2)
    # Libraries differ in which corner of a tag is the first. The right choice is the one that fits the board's
    # geometry.
    grids = [_grid(found, columns, rows, first) for first in range(4)]
    grid = min(grids, key=lambda one: _misfit(one, places))
    return measure_saddles(image, grid).grid


def _tags(image: Image8, border_bits: int, count: int) -> dict[int, Array]:
    """Return the corners (4, 2) px of each tag, by the tag's number."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.markerBorderBits = border_bits
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, parameters).detectMarkers(image)
    if numbers is None:
        return {}
    pairs = zip(map(int, numbers.ravel()), corners, strict=True)
    return {number: np.asarray(seen, dtype=float).reshape(4, 2) for number, seen in pairs if number < count}


def _grid(found: dict[int, Array], columns: int, rows: int, first: int) -> Array:
    """Arrange the corners as a grid from the top left; `first` is the index of a tag's top left corner in OpenCV's
    order.
    """
    grid = np.full((2 * rows, 2 * columns, 2), np.nan)
    for number, seen in found.items():
        column, row = number % columns, rows - 1 - number // columns
        for (down, right), pixel in zip(_CORNERS, np.roll(seen, -first, axis=0), strict=True):
            grid[2 * row + down, 2 * column + right] = pixel
    return grid


def _misfit(grid: Array, places: Array) -> float:
    seen = ~np.isnan(grid[..., 0])
    homography, _ = cv2.findHomography(places[seen], grid[seen])
    if homography is None:
        return float("inf")
    off = cv2.perspectiveTransform(places[seen][None], homography)[0] - grid[seen]
    return float(np.sum(off**2))
