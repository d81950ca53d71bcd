"""Grids of dark circles, as OpenCV has them: in columns and rows, or every other row half a step aside."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.typed import checked
from ceres_cal.scene.targets.target import (
    Disc,
    Footprints,
    Grid,
    Paper,
    Target,
    TargetKind,
    from_arguments,
    require_size,
    share_inside,
)


@checked
def circle_grid(columns: int, rows: int, spacing_m: float, diameter_m: float, *, asymmetric: bool = False) -> Target:
    """The centres of a grid of circles, features "c,r", c < columns, r < rows.

    Centre "c,r" lies at (c, r, 0) spacings; of an asymmetric grid at (2 c + r mod 2, r, 0), as OpenCV counts them: the
    spacing is half the distance between circles of one row.

    Raises:
        InputError: fewer than 2 circles a side, more than MOST_FEATURES, a spacing that is no positive number, or
            circles that meet.
    """
    if columns < 2 or rows < 2:
        raise InputError(f"circle-grid: columns and rows count circles, at least 2, not {columns} and {rows}")
    require_size(columns * rows, "circle-grid")
    if not (np.isfinite(spacing_m) and spacing_m > 0.0):
        raise InputError(f"circle-grid: spacing_m must be a positive number of metres, not {spacing_m}")
    apart_m = float(spacing_m) * (np.sqrt(2.0) if asymmetric else 1.0)
    if not 0.0 < diameter_m < apart_m:
        raise InputError(f"circle-grid: diameter_m must be above 0 and below the {apart_m:.4g} m between circles")
    size = Grid(int(columns), int(rows), float(spacing_m))
    spec = {
        "kind": "circle-grid",
        "columns": size.columns,
        "rows": size.rows,
        "spacing_m": size.spacing_m,
        "diameter_m": float(diameter_m),
        "asymmetric": bool(asymmetric),
    }
    step = 2 if asymmetric else 1
    places = {
        f"{c},{r}": ((step * c + (r % 2 if asymmetric else 0)) * spacing_m, r * spacing_m, 0.0)
        for r in range(rows)
        for c in range(columns)
    }
    flat, border = np.array(list(places.values()))[:, :2], apart_m
    paper = Paper(
        (-border, -border),
        (float(flat[:, 0].max() + border), float(flat[:, 1].max() + border)),
        partial(_dark_circles, size, 0.5 * float(diameter_m), asymmetric),
        partial(_discs, places, 0.5 * float(diameter_m)),
    )
    return Target(spec, places, {}, movable=True, bows=True, grid=None if asymmetric else size, paper=paper)


def _dark_circles(grid: Grid, radius_m: float, asymmetric: bool, footprints: Footprints) -> Array:
    """Of the two rows around a place the nearer circle decides: circles do not meet."""
    step, x, y = (2.0 if asymmetric else 1.0), *(footprints.plane.T / grid.spacing_m)
    offs = []
    for below in (0.0, 1.0):
        row = np.clip(np.floor(y) + below, 0, grid.rows - 1)
        aside = row % 2 if asymmetric else 0.0
        column = np.clip(np.round((x - aside) / step), 0, grid.columns - 1)
        offs.append(np.column_stack([x - step * column - aside, y - row]) * grid.spacing_m)
    away = np.array([np.hypot(off[:, 0], off[:, 1]) for off in offs])
    off, nearest = np.where((away[0] <= away[1])[:, None], *offs), away.min(axis=0)
    direction = off / np.maximum(nearest, 1e-12)[:, None]
    return share_inside(radius_m - nearest, footprints.step_m(direction))


def _discs(places: Mapping[str, tuple[float, float, float]], radius_m: float) -> Iterator[Disc]:
    for x, y, _ in places.values():
        yield Disc((x, y), radius_m)


KIND = TargetKind(
    "circle-grid",
    "the centres of a grid of circles",
    "columns and rows (circles), spacing_m, diameter_m, asymmetric (every other row half a step aside, OpenCV's)",
    'points "c,r" at (c, r, 0) spacings, or (2 c + r mod 2, r, 0) of an asymmetric grid',
    lambda: {"circle-grid": circle_grid(4, 11, 0.02, 0.016, asymmetric=True)},
    from_arguments("circle-grid", circle_grid),
)
