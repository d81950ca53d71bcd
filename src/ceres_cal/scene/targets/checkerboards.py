"""Checkerboards: their inner corners, and how they are printed."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import product

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.typed import checked
from ceres_cal.scene.targets.target import (
    Footprints,
    Grid,
    Paper,
    Square,
    Target,
    TargetKind,
    from_arguments,
    require_size,
    share_inside,
)


@checked
def checkerboard(columns: int, rows: int, square_m: float) -> Target:
    """The inner corners of a checkerboard: feature "c,r" lies at (c, r, 0) squares, c < columns, r < rows.

    Raises:
        InputError: fewer than 2 corners a side, more than MOST_FEATURES, or a square that is no positive number.
    """
    if columns < 2 or rows < 2:
        raise InputError(f"checkerboard: columns and rows count inner corners, at least 2, not {columns} and {rows}")
    require_size(columns * rows, "checkerboard")
    if not (np.isfinite(square_m) and square_m > 0.0):
        raise InputError(f"checkerboard: square_m must be a positive number of metres, not {square_m}")
    grid = Grid(int(columns), int(rows), float(square_m), checkered=True)
    spec = {"kind": "checkerboard", "columns": grid.columns, "rows": grid.rows, "square_m": grid.spacing_m}
    points = {f"{c},{r}": (c * square_m, r * square_m, 0.0) for r in range(rows) for c in range(columns)}
    paper = Paper(
        (-2.0 * grid.spacing_m, -2.0 * grid.spacing_m),
        ((grid.columns + 1) * grid.spacing_m, (grid.rows + 1) * grid.spacing_m),
        partial(_dark_squares, grid),
        partial(_squares, grid),
    )
    return Target(spec, points, {}, movable=True, bows=True, grid=grid, paper=paper)


def _dark_squares(grid: Grid, footprints: Footprints) -> Array:
    """The square between "0,0" and "1,1" is dark, and so is, beyond the outer corners, one more square each way."""
    sign, within = np.full(len(footprints.plane), 1.0), np.full(len(footprints.plane), 1.0)
    for axis, count in enumerate((grid.columns, grid.rows)):
        place = footprints.plane[:, axis] / grid.spacing_m
        step = np.hypot(footprints.along_x[:, axis], footprints.along_y[:, axis]) / grid.spacing_m
        line = np.round(place)
        wave = 2.0 * share_inside(place - line, step) - 1.0
        sign *= np.where(line % 2 == 0, wave, -wave)
        within *= share_inside(place + 1.0, step) * share_inside(count - place, step)
    return np.asarray(within * (0.5 + 0.5 * sign))


def _squares(grid: Grid) -> Iterator[Square]:
    """The dark ones of `_dark_squares`."""
    for row, column in product(range(-1, grid.rows), range(-1, grid.columns)):
        if (row + column) % 2 == 0:
            yield Square((column * grid.spacing_m, row * grid.spacing_m), grid.spacing_m)


KIND = TargetKind(
    "checkerboard",
    "the inner corners of a checkerboard",
    "columns and rows (inner corners), square_m",
    'points "c,r" at (c, r, 0) squares, c from 0 to columns - 1, r from 0 to rows - 1',
    lambda: {"checkerboard": checkerboard(9, 6, 0.025)},
    from_arguments("checkerboard", checkerboard),
)
