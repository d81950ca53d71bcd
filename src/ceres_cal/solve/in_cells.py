"""Cells of the image, and whether residuals of different sights agree in them: what a lens leaves behind.

What goes together within a sight alone, as a bent board or a blurred frame has it, is no lens, and does not count: only
products of different sights do.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.effects.evidence import agreement as agreement_of
from ceres_cal.observations.sights import Sights
from ceres_cal.solve.robust import RobustSolution

AGREES = 3.0
"""From how many standard deviations on a lens leaves something: of one that leaves nothing one in a thousand does."""
# Observations on average; cells along the image: some show what is long, many what a surface's nodes do not follow.
_IN_A_CELL, _MOST_CELLS, _FINE_CELLS = 8, 8, 24
_RINGS = 24  # from the middle to the farthest observation
_MOST_EQUATIONS = 50_000  # of more, those of some sights
_MOST_GROUPS = 200  # of sights: products within one do not count, a half of a percent


def agreement(end: RobustSolution, sizes: Mapping[str, tuple[int, int]]) -> float:
    """By how many standard deviations sums of residuals over a cell have one sign in all sights; 0 of one sight.

    Args:
        end: of all rounds; what took part is asked. sizes: of the images of each camera, px.
    """
    sights = _some(end)
    points, curves = _in_sigmas(end, sights)
    of_points, of_curves = _sight_of(sights.point_bounds), _sight_of(sights.curve_bounds)
    sight = np.concatenate([of_points, of_points, of_curves])
    left = np.concatenate([points[:, 0], points[:, 1], curves])
    return max(_agreement(cells_of(sights, sizes, most), sight, left) for most in (_MOST_CELLS, _FINE_CELLS))


def agreement_in_rings(end: RobustSolution) -> float:
    """The same of sums over rings about the principal point, of what points lie farther out; of cameras the most."""
    agree, some = 0.0, _some(end)
    for name, camera in end.solution.estimate.cameras.items():
        sights = some.of_camera(name)
        offsets = camera.offsets(sights.pixels)
        radius = np.maximum(np.hypot(offsets[:, 0], offsets[:, 1]), 1e-12)
        ring = (_RINGS / np.max(radius, initial=1e-12) * radius).astype(int)
        outward = np.einsum("ij,ij->i", offsets, _in_sigmas(end, sights)[0]) / radius
        agree = max(agree, _agreement(ring, _sight_of(sights.point_bounds), outward))
    return agree


def _some(end: RobustSolution) -> Sights:
    sights = end.problem.sights
    every = -(-sights.equations // _MOST_EQUATIONS)
    return sights if every <= 1 else sights[::every]


def _sight_of(bounds: Indices) -> Indices:
    """Of each observation its sight's number; of very many sights, that of some beside each other."""
    sights = len(bounds) - 1
    return np.repeat(np.arange(sights) * min(sights, _MOST_GROUPS) // max(sights, 1), np.diff(bounds))


def _in_sigmas(end: RobustSolution, sights: Sights) -> tuple[Array, Array]:
    """(N, 2), (M,) residuals of points and curve observations, in standard deviations."""
    of_points, of_curves = end.problem.weighting.scales
    points = end.residuals.points[sights.point_rows] / (of_points * sights.sigma_px[:, None])
    return points, end.residuals.curves[sights.curve_rows] / (of_curves * sights.curve_sigma_px)


def _agreement(place: Indices, sight: Indices, left: Array) -> float:
    """By how many standard deviations the sums of residuals (N,) by place (N,) agree between sights (N,)."""
    count = int(np.max(sight, initial=0)) + 1
    size = count * (int(np.max(place, initial=0)) + 1)
    sums = np.bincount(place * count + sight, left, size).reshape(-1, count)
    return agreement_of(np.asarray(sums.T, dtype=float))


def cells_of(sights: Sights, sizes: Mapping[str, tuple[int, int]], most: int = _MOST_CELLS) -> Indices:
    """(2 N + M,) numbers of the cells of all points' x, of their y and of all curve observations, each curve apart;
    no more than so many along the image.
    """
    names = sorted(sizes)
    count = (len(sights.point_rows) + len(sights.curve_rows)) / (_IN_A_CELL * len(names))
    side = min(most, max(2, int(np.sqrt(count))))
    owners = np.array([names.index(key.camera) for key in sights.keys])
    per_px = side / np.array([sizes[name] for name in names], dtype=float)

    def cells(bounds: Indices, pixels: Array) -> Indices:
        owner = np.repeat(owners, np.diff(bounds))
        x, y = (np.clip((pixels[:, k] * per_px[owner, k]).astype(int), 0, side - 1) for k in (0, 1))
        return np.asarray((owner * side + y) * side + x)

    points, curves = cells(sights.point_bounds, sights.pixels), cells(sights.curve_bounds, sights.curve_pixels)
    first = 2 * side * side * len(names)
    return np.concatenate([points * 2, points * 2 + 1, first + curves * len(sights.tracks) + sights.track_index])
