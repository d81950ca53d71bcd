"""Kalibr's AprilGrids in images: OpenCV finds the tags, and their corners are measured as saddles.

A small dark square touches each corner of a tag, so the picture there looks like a chessboard's corner.
"""

from __future__ import annotations

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, Image, Image8, Mask, medians_known
from ceres_cal.detect.partly import NO_PLACE
from ceres_cal.detect.saddles import REACH, measure_saddles
from ceres_cal.scene.targets import Target

_CORNERS = ((0, 0), (0, 1), (1, 1), (1, 0))  # row and column within a tag, in OpenCV's order
# Relative difference between gaps that no printer makes. Gaps are measured to 0.003, under a fisheye lens to 0.02; a
# smaller limit refuses those, and with a larger one another board passes for one that was not built as drawn.
_OTHER_GAP = 0.05


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
    grid, gap = min(grids, key=lambda one: _misfit(one, places)), board.spec["gap"]
    # OpenCV sees corners some pixels inside the tags. They are measured twice, since discs depend on where corners are.
    # Without a tag across the gap, only the stated gap says where the small square at a corner ends.
    rough = measure_saddles(image, grid).grid
    corners = measure_saddles(image, rough, np.where(_is_beside_tag(rough), REACH, REACH * min(gap, 1.0))).grid
    shown = _gap_shown(corners)
    if abs(shown - gap) > _OTHER_GAP * gap:
        return f"tags {gap:g} of their side apart {NO_PLACE}, which shows a gap of {shown:.3f}: correct the gap"
    return corners


def _is_beside_tag(grid: Array) -> Mask:
    """(2 rows, 2 columns) whether the next corner across a gap was seen, along the row or along the column."""
    seen = np.pad(~np.isnan(grid[..., 0]), 1)
    rows, columns = seen.shape
    along_row = seen.reshape(rows, -1, 2)[:, :, ::-1].reshape(rows, columns)
    along_column = seen.reshape(-1, 2, columns)[:, ::-1].reshape(rows, columns)
    return np.asarray((along_row | along_column)[1:-1, 1:-1])


def _gap_shown(grid: Array) -> float:
    """Return the gap between tags divided by their side, NaN if no two neighbours are seen: the median over pairs of
    neighbours, whose four corners in a row have the same cross-ratio in any perspective.
    """
    gaps = []
    for line in (grid, grid.swapaxes(0, 1)):
        places = line[:-2:2], line[1:-2:2], line[2::2], line[3::2]
        sides, apart = (
            np.linalg.norm(places[b] - places[a], axis=-1) * np.linalg.norm(places[d] - places[c], axis=-1)
            for a, b, c, d in ((0, 1, 2, 3), (0, 2, 1, 3))
        )
        gaps.append(np.sqrt(apart / sides).ravel() - 1.0)
    return float(medians_known(np.concatenate(gaps)))


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
