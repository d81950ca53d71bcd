"""Displacement of lines thinner than a sensor's pixels, which is estimated from the picture itself.

A line on the middle of a row of pixels, or midway between two rows, is imaged in its place. Elsewhere a sharp lens and
a colour sensor, which interpolates most colours, displace it by up to 0.12 px towards one of them, depending on its
position within the pixel; at 45 degrees it depends on the position between the diagonals that see green. Red and blue
are seen in every other row only, so unequal weights of both add a wave over two pixels. Along a line in such a
direction the displacement changes slowly, so that many places err together. It can be determined from more distant
places nevertheless, since lines are straight or round and the displacement is periodic.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Indices32, distinct, median
from ceres_cal.detect.courses import Course

_REMAINS = 0.15  # share of the displacement that remains after the correction
_AROUND = 10  # places to either side, whose mean gives the position of a line within its pixel
_ROUNDS, _FEWEST = 5, 20
_CURVATURE = np.array([1.0, -2.0, 1.0])
# Normals of horizontal lines, of vertical ones, and of those along either diagonal, which a colour sensor displaces
# alike.
_ACROSS = np.array([(0.0, 1.0), (1.0, 0.0), (0.5**0.5, 0.5**0.5), (0.5**0.5, -(0.5**0.5))])
# Directions (rows of _ACROSS), frequency (1/px) of the longest wave across them, and number of waves, each half as long
# as the one before.
_WAVES = (((0,), 0.5, 3), ((1,), 0.5, 3), ((2, 3), 0.5**0.5, 2))


def drawn_aside(course: Course, offset_px: Array, threes: Indices, half_width_px: int) -> tuple[Array, Array]:
    """Estimate (N,) px along the normals by which lines are displaced, and its standard deviation (N,).

    The standard deviation is enlarged, so that the middle of a line whose places all have the same error gets the right
    one although places are treated as independent.

    Args:
        offset_px: (N,) where along the normals the lines were measured, NaN where they were not.
        threes: (M, 3) places that follow each other on a curve, all of them measured.
        half_width_px: half width of the windows, along the curve.
    """
    aside: Array = np.zeros(len(course))
    if len(threes) < _FEWEST:
        return aside, aside
    at_rest_px = 1e-5  # tolerance of convergence: a hundredth of the least standard deviation of a place, and less
    # Prior standard deviation of the displacement's amplitude, smaller for wide lines: their edges are displaced alike.
    prior_px = 0.1 / max(median(course.width_px), 1.0)
    bends = offset_px[threes] @ _CURVATURE
    # The position of a line within its pixel is its measured place without the displacement.
    for _ in range(_ROUNDS):
        turns = _turns(course, _smooth(course.curve, offset_px - aside), half_width_px)
        amplitude, sigma = _amplitudes(np.einsum("mtk,t->mk", turns.imag[threes], _CURVATURE), bends, prior_px)
        before, aside = aside, np.nan_to_num(turns.imag @ amplitude)
        if np.max(np.abs(aside - before)) < at_rest_px:
            break
    left = np.hypot(_REMAINS * amplitude, sigma)
    remains = left * np.nan_to_num(np.abs(turns) * np.sqrt(_alike(course, offset_px, turns)))
    return aside, np.linalg.norm(remains, axis=1)


def _alike(course: Course, offset_px: Array, turns: Array) -> Array:
    """(N, K) number of places on the same curve that share a place's error: few where the line crosses many pixels."""
    measured, alike = np.isfinite(offset_px), np.ones(turns.shape)
    for number in distinct(course.curve):
        every = turns[measured & (course.curve == number)]
        squares = np.maximum(np.sum(np.abs(every) ** 2, axis=0), 1e-12)
        alike[course.curve == number] = np.maximum(np.abs(np.sum(every, axis=0)) ** 2 / squares, 1.0)
    return alike


def _smooth(curve: Indices32, offset_px: Array) -> Array:
    """(N,) the mean offset of the neighbouring places on the same curve: a single place's own error would explain
    itself.

    Args:
        curve: (N,) ascending.
    """
    sums = np.cumsum([np.nan_to_num(offset_px), np.isfinite(offset_px)], axis=1)
    sums, rows = np.pad(sums, ((0, 0), (1, 0))), np.arange(len(curve))
    first = np.maximum(rows - _AROUND, np.searchsorted(curve, curve))
    after = np.minimum(rows + _AROUND + 1, np.searchsorted(curve, curve, "right"))
    total, count = sums[:, after] - sums[:, first]
    return np.asarray(total / np.maximum(count, 1.0))


def _amplitudes(columns: Array, bends: Array, prior_px: float) -> tuple[Array, Array]:
    """(K,) robust least-squares amplitudes of the columns (M, K) that explain the bends (M,), and their sigmas (K,)."""
    robust = 2.0  # scale of Cauchy's loss, in units of the usual residual
    least_px = 1e-4
    amplitude: Array = np.zeros(columns.shape[1])
    for _ in range(_ROUNDS):
        left = bends - columns @ amplitude
        usual = max(median(np.abs(left)) / 0.6745, least_px)
        weighted = columns / (1.0 + (left / (robust * usual)) ** 2)[:, None]
        normal = weighted.T @ columns + (usual / prior_px) ** 2 * np.eye(len(amplitude))
        amplitude = np.asarray(np.linalg.solve(normal, weighted.T @ bends), dtype=float)
    return np.asarray(amplitude), usual * np.sqrt(np.diag(np.linalg.inv(normal)))


def _turns(course: Course, offset_px: Array, half_width_px: int) -> Array:
    """(N, K) complex phase factors of each wave at a line's position within its pixel: mean over each window, along the
    normal.
    """
    places, normals = course.pixels + offset_px[:, None] * course.normals, course.normals
    nearest = np.argmax(np.abs(normals @ _ACROSS.T), axis=1)
    level = np.abs(normals[:, 1]) >= np.abs(normals[:, 0])
    along, across = np.where(level, places.T, places.T[::-1])
    n_along, n_across = np.where(level, normals.T, normals.T[::-1])
    u = np.round(along)[:, None] + np.arange(-half_width_px, half_width_px + 1)
    du = u - along[:, None]
    bent = 0.5 * course.curvature[:, None] * (du / n_across[:, None]) ** 2
    v = across[:, None] + (bent - du * n_along[:, None]) / n_across[:, None]
    x, y = np.where(level[:, None], (u, v), (v, u))
    wave = _ACROSS[nearest]
    crossed, share = wave[:, :1] * x + wave[:, 1:] * y, np.sum(wave * normals, axis=1)
    turns = np.zeros((len(course), sum(count for *_, count in _WAVES)), dtype=complex)
    number = 0
    for own, cycles, count in _WAVES:
        rows = np.isin(nearest, own)
        turn = np.exp(2j * np.pi * cycles * crossed[rows])
        for _ in range(count):
            turns[rows, number] = share[rows] * np.mean(turn, axis=1)
            turn, number = turn * turn, number + 1
    return turns
