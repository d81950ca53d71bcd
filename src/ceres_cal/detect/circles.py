"""Grids of circles in images: OpenCV finds them, and the middles that it measures are corrected to the centres.

The middle of a circle's picture is not the picture of its centre: perspective moves it towards the nearer side and the
distortion of a lens along the radius, by some hundredths of a pixel, or by some tenths where circles are large. A
smooth picture of the whole grid says by how much.
"""

from __future__ import annotations

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, Image8
from ceres_cal.detect.scatter import smooth_picture
from ceres_cal.scene.targets import Target

_ANGLES = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
_RIM = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


def measured_circles(image: Image8, board: Target) -> Array | str:
    """Return the centres (rows, columns, 2) px of dark or of bright circles, or the reason why there are none.

    Args:
        image: stretched from black to white, since OpenCV looks for spots at fixed levels of grey.
    """
    columns, rows, asymmetric = (board.spec[name] for name in ("columns", "rows", "asymmetric"))
    layout = cv2.CALIB_CB_ASYMMETRIC_GRID if asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    grid = _middles_seen(image, columns, rows, layout)
    if grid is None:
        return f"no grid of {columns} x {rows} circles found"
    if _is_mirrored(grid):
        if asymmetric:  # an asymmetric grid turned over is another grid
            return f"a grid of {columns} x {rows} circles, but seen mirrored"
        grid = grid[:, ::-1]
    return _centres(grid, board.point_array[:, :2], 0.5 * board.spec["diameter_m"])


def _middles_seen(image: Image8, columns: int, rows: int, layout: int) -> Array | None:
    """Return the middles (rows, columns, 2) px of the pictures of circles, None where OpenCV finds no grid of them."""
    spots = cv2.SimpleBlobDetector.Params()
    # OpenCV's own limit is a circle 80 px across. Larger spots than this hide the circles around their middle.
    spots.maxArea = image.size / (columns * rows)
    for spots.blobColor in (0, 255):
        detector = cv2.SimpleBlobDetector.create(spots)
        if len(detector.detect(image)) < columns * rows:  # the search would look for them anew for each layout
            continue
        # The second layout also finds tilted boards, and boards in clutter.
        for how in (layout, layout | cv2.CALIB_CB_CLUSTERING):
            shown, seen = cv2.findCirclesGrid(image, (columns, rows), flags=how, blobDetector=detector)
            if shown:
                return np.asarray(seen.reshape(rows, columns, 2), dtype=float)
    return None


def _is_mirrored(grid: Array) -> bool:
    along_row, along_column = np.diff(grid, axis=1).sum(axis=(0, 1)), np.diff(grid[::2], axis=0).sum(axis=(0, 1))
    return float(along_row[0] * along_column[1] - along_row[1] * along_column[0]) < 0.0


def _centres(grid: Array, places: Array, radius_m: float) -> Array:
    """Return the images of the circles' centres, given the middles of their pictures (rows, columns, 2) px."""
    middles = grid.reshape(-1, 2)
    fitted = smooth_picture(places, middles)
    if fitted is None:
        return grid
    picture = fitted[0]
    rims = picture((places[:, None] + radius_m * _RIM).reshape(-1, 2)).reshape(len(places), -1, 2)
    centres = picture(places)
    return np.asarray((middles - _middles(rims - centres[:, None])).reshape(grid.shape))


def _middles(outlines: Array) -> Array:
    """Return the centroids (N, 2) of polygons (N, corners, 2)."""
    x, y = np.moveaxis(outlines, -1, 0)
    after = np.roll(outlines, -1, axis=1)
    double = x * after[..., 1] - y * after[..., 0]
    return np.asarray(np.sum((outlines + after) * double[..., None], axis=1) / (3.0 * double.sum(axis=1)[:, None]))
