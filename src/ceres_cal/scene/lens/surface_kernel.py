"""A surface of cubic B-splines on a grid, for the solve: see `surface`. Plain numbers and loops, which the kernels
compile.

Among the intrinsics, from the place `at` on: half the grid's width and height, in the lens's units, then the
coefficients of the x and the y displacement of each node, column after column.
"""

from __future__ import annotations

from typing import Any

COLUMNS, ROWS = 16, 12  # of nodes
HEAD = 2


def _side(given: float) -> float:
    """1 where it is not set yet, and all displacements are 0."""
    return given if given > 0.0 else 1.0


def _cell(place: float, count: int) -> tuple[int, float, float]:
    """Of a place from -1 to 1: the first of the four nodes, how far into the cell, and cells to a unit (0 beyond)."""
    cells = 0.5 * (count - 3)
    inside = min(max(place, -1.0), 1.0)
    first = min(int((inside + 1.0) * cells), count - 4)
    return first, (inside + 1.0) * cells - first, cells if inside == place else 0.0


def _weight(k: int, t: float) -> float:
    """Of the k-th of the four nodes."""
    if k == 0:
        return (1.0 - t) * (1.0 - t) * (1.0 - t) / 6.0
    if k == 1:
        return (3.0 * t - 6.0) * t * t / 6.0 + 2.0 / 3.0
    if k == 2:
        return ((3.0 - 3.0 * t) * t + 3.0) * t / 6.0 + 1.0 / 6.0
    return t * t * t / 6.0


def _weight_slope(k: int, t: float) -> float:
    if k == 0:
        return -0.5 * (1.0 - t) * (1.0 - t)
    if k == 1:
        return (1.5 * t - 2.0) * t
    if k == 2:
        return (1.0 - 1.5 * t) * t + 0.5
    return 0.5 * t * t


def add_surface(n: int, intrinsics: Any, at: int, work: Any, image: Any) -> None:
    """The displacement at the places in the work's rows 0 and 1, to the image's rows 0 and 1; its derivatives by the
    complex place and its conjugate to rows 2, 3 and 4, 7.
    """
    wide, high = _side(intrinsics[at]), _side(intrinsics[at + 1])
    for i in range(n):
        column, s, per_x = _cell(work[0, i] / wide, COLUMNS)
        row, t, per_y = _cell(work[1, i] / high, ROWS)
        x, y, xx, xy, yx, yy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(4):
            along, along_slope = _weight(j, s), _weight_slope(j, s) * per_x / wide
            for k in range(4):
                node = at + HEAD + 2 * ((column + j) * ROWS + row + k)
                a, b = intrinsics[node], intrinsics[node + 1]
                down = _weight(k, t)
                weight, slope_x = along * down, along_slope * down
                slope_y = along * _weight_slope(k, t) * per_y / high
                x += weight * a
                y += weight * b
                xx += slope_x * a
                xy += slope_y * a
                yx += slope_x * b
                yy += slope_y * b
        image[0, i] += x
        image[1, i] += y
        image[2, i] += 0.5 * (xx + yy)
        image[3, i] += 0.5 * (yx - xy)
        image[4, i] += 0.5 * (xx - yy)
        image[7, i] += 0.5 * (yx + xy)


def differentiate_surface(n: int, intrinsics: Any, unit: float, at: int, work: Any, jacobian: Any) -> None:
    """Derivatives of the pixel by the numbers of the surface."""
    wide, high, aspect = _side(intrinsics[at]), _side(intrinsics[at + 1]), intrinsics[1]
    for k in range(at, at + HEAD + 2 * COLUMNS * ROWS):
        for i in range(n):
            jacobian[k, 0, i] = 0.0
            jacobian[k, 1, i] = 0.0
    for i in range(n):
        column, s, per_x = _cell(work[0, i] / wide, COLUMNS)
        row, t, per_y = _cell(work[1, i] / high, ROWS)
        for j in range(4):
            along, along_slope = _weight(j, s), _weight_slope(j, s) * per_x
            for k in range(4):
                node = at + HEAD + 2 * ((column + j) * ROWS + row + k)
                weight = unit * along * _weight(k, t)
                jacobian[node, 0, i] = weight
                jacobian[node + 1, 1, i] = aspect * weight
                stretch = -unit * along_slope * _weight(k, t) * work[0, i] / (wide * wide)
                jacobian[at, 0, i] += stretch * intrinsics[node]
                jacobian[at, 1, i] += aspect * stretch * intrinsics[node + 1]
                stretch = -unit * along * _weight_slope(k, t) * per_y * work[1, i] / (high * high)
                jacobian[at + 1, 0, i] += stretch * intrinsics[node]
                jacobian[at + 1, 1, i] += aspect * stretch * intrinsics[node + 1]
