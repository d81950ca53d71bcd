"""Cells of the image, and whether residuals of different sights agree in them: what a lens leaves behind.

What goes together within a sight alone, as a bent board or a blurred frame has it, is no lens, and does not count: only
products of different sights do.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.observations.sights import Sights
from ceres_cal.solve.robust import RobustSolution

AGREES = 3.0
"""From how many standard deviations on a lens leaves something: of one that leaves nothing one in a thousand does."""
_IN_A_CELL, _MOST_CELLS = 8, 8  # observations on average; cells along the image


def agreement(end: RobustSolution, sizes: Mapping[str, tuple[int, int]]) -> float:
    """By how many standard deviations sums of residuals over a cell have one sign in all sights; 0 of one sight.

    Args:
        end: of all rounds; what took part is asked. sizes: of the images of each camera, px.
    """
    sights, (of_points, of_curves) = end.problem.sights, end.problem.weighting.scales
    points = end.residuals.points[sights.point_rows] / (of_points * sights.sigma_px[:, None])
    curves = end.residuals.curves[sights.curve_rows] / (of_curves * sights.curve_sigma_px)
    owner = [np.repeat(np.arange(len(sights)), np.diff(one)) for one in (sights.point_bounds, sights.curve_bounds)]
    sight = np.concatenate([owner[0], owner[0], owner[1]])
    both, of = np.unique(cells_of(sights, sizes) * len(sights) + sight, return_inverse=True)
    sums, cell = np.bincount(of, np.concatenate([points[:, 0], points[:, 1], curves])), both // max(len(sights), 1)
    total, squares, fourth = (np.bincount(cell, sums**power) for power in (1, 2, 4))
    variance = 2.0 * float(np.sum(squares**2 - fourth))
    return float(np.sum(total**2 - squares)) / np.sqrt(variance) if variance > 0.0 else 0.0


def cells_of(sights: Sights, sizes: Mapping[str, tuple[int, int]]) -> Indices:
    """(2 N + M,) numbers, from 0 on, of the cells of all points' x, of their y and of all curve observations, which are
    apart as the curves are.
    """
    points = _cells(sights, sights.point_bounds, sights.pixels, sizes)
    curves = _cells(sights, sights.curve_bounds, sights.curve_pixels, sizes)
    apart = [points * 2, points * 2 + 1, -1 - (curves * len(sights.tracks) + sights.track_index)]
    return np.asarray(np.unique(np.concatenate(apart), return_inverse=True)[1])


def _cells(sights: Sights, bounds: Indices, pixels: Array, sizes: Mapping[str, tuple[int, int]]) -> Indices:
    """(N,) number of the cell of each observation of the sights, in its own camera's image."""
    names = sorted(sizes)
    owner = np.repeat([names.index(key.camera) for key in sights.keys], np.diff(bounds))
    count = (len(sights.point_rows) + len(sights.curve_rows)) / (_IN_A_CELL * len(names))
    side = min(_MOST_CELLS, max(2, int(np.sqrt(count))))
    x, y = np.clip((pixels / np.array([sizes[name] for name in names])[owner] * side).astype(int), 0, side - 1).T
    return np.asarray((owner * side + y) * side + x)
