"""Grids of circles in images: OpenCV finds them, and its ellipse middles are corrected to the circles' centres.

The middle of an ellipse is not the image of its circle's centre: perspective moves it towards the nearer side, by some
hundredths of a pixel, or by some tenths where circles are large and tilted. The homography of the whole grid says by
how much.
"""

from __future__ import annotations

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, Image8
from ceres_cal.scene.targets import Target


def measured_circles(image: Image8, board: Target) -> Array | str:
    """Return the centres (rows, columns, 2) px, or the reason why there are none."""
    columns, rows, asymmetric = (board.spec[name] for name in ("columns", "rows", "asymmetric"))
    layout = cv2.CALIB_CB_ASYMMETRIC_GRID if asymmetric else cv2.CALIB_CB_SYMMETRIC_GRID
    # The second way also finds tilted boards, and boards in clutter.
    for how in (layout, layout | cv2.CALIB_CB_CLUSTERING):
        shown, seen = cv2.findCirclesGrid(image, (columns, rows), flags=how)
        if shown:
            grid = np.asarray(seen.reshape(rows, columns, 2), dtype=float)
            if _is_mirrored(grid):
                if asymmetric:  # an asymmetric grid turned over is another grid
                    return f"a grid of {columns} x {rows} circles, but seen mirrored"
                grid = grid[:, ::-1]
            return _centres(grid, board.point_array[:, :2], 0.5 * board.spec["diameter_m"])
    return f"no grid of {columns} x {rows} circles found"


def _is_mirrored(grid: Array) -> bool:
    along_row, along_column = np.diff(grid, axis=1).sum(axis=(0, 1)), np.diff(grid[::2], axis=0).sum(axis=(0, 1))
    return float(along_row[0] * along_column[1] - along_row[1] * along_column[0]) < 0.0


def _centres(grid: Array, places: Array, radius_m: float) -> Array:
    """Return the images of the circles' centres, given the middles of their ellipses (rows, columns, 2) px."""
    middles = grid.reshape(-1, 2)
    homography, _ = cv2.findHomography(places, middles)
    if homography is None:
        return grid
    inverse = np.linalg.inv(homography)
    shifts = []
    for x, y in places:
        circle = np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [-x, -y, x * x + y * y - radius_m**2]])
        conic = inverse.T @ circle @ inverse
        centre = homography @ (x, y, 1.0)
        shifts.append(np.linalg.solve(conic[:2, :2], -conic[:2, 2]) - centre[:2] / centre[2])
    return np.asarray((middles - np.array(shifts)).reshape(grid.shape))
