"""Coverage of a printed target: the dark share of each small square of a picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, dots
from ceres_cal.scene.targets import Grid, Target


@dataclass(frozen=True, eq=False)
class Footprints:
    """Small squares of a picture on the target's plane z = const.

    Attributes:
        plane: (M, 2) their centres, m. along_x, along_y: (M, 2) steps on the plane, m, for one square to the right and
            down.
    """

    plane: Array
    along_x: Array
    along_y: Array

    def step_m(self, direction: Array) -> Array:
        """(M,) change along a direction (M, 2) over one square, m."""
        across = dots(self.along_x, direction), dots(self.along_y, direction)
        return np.asarray(np.maximum(np.hypot(*across), 1e-12))


def share_inside(distance: Array, step: Array) -> Array:
    """The share of a square on the positive side of a straight border, from the distance of its centre."""
    return np.clip(distance / step + 0.5, 0.0, 1.0)


def dark_share(target: Target, footprints: Footprints) -> Array:
    """(M,) dark share of squares on a checkerboard, a grid of circles or a sheet of rings."""
    spec = target.spec
    if target.kind == "rings":
        return _dark_rings(np.array(spec["radii_m"]), footprints)
    if target.kind == "circle-grid":
        size = Grid(spec["columns"], spec["rows"], spec["spacing_m"])
        return _dark_circles(size, 0.5 * spec["diameter_m"], spec["asymmetric"], footprints)
    assert target.kind == "checkerboard" and target.grid is not None
    return _dark_squares(target.grid, footprints)


def _dark_squares(grid: Grid, footprints: Footprints) -> Array:
    """The square between "0,0" and "1,1" is dark; there is one more row of squares outside the outer corners."""
    sign, within = np.full(len(footprints.plane), 1.0), np.full(len(footprints.plane), 1.0)
    for axis, count in enumerate((grid.columns, grid.rows)):
        place = footprints.plane[:, axis] / grid.spacing_m
        step = np.hypot(footprints.along_x[:, axis], footprints.along_y[:, axis]) / grid.spacing_m
        line = np.round(place)
        wave = 2.0 * share_inside(place - line, step) - 1.0
        sign *= np.where(line % 2 == 0, wave, -wave)
        within *= share_inside(place + 1.0, step) * share_inside(count - place, step)
    return np.asarray(within * (0.5 + 0.5 * sign))


def _dark_circles(grid: Grid, radius_m: float, asymmetric: bool, footprints: Footprints) -> Array:
    """The nearest circle of the two rows around a place decides, since circles do not touch."""
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


def _dark_rings(radii: Array, footprints: Footprints) -> Array:
    """The disc inside the first ring is dark, and so is every other ring."""
    away = np.maximum(np.hypot(footprints.plane[:, 0], footprints.plane[:, 1]), 1e-12)
    step = footprints.step_m(footprints.plane / away[:, None])
    inner = np.searchsorted(0.5 * (radii[1:] + radii[:-1]), away)  # the nearest edge
    outside = share_inside(away - radii[inner], step)
    return np.where(inner % 2 == 0, 1.0 - outside, outside)
