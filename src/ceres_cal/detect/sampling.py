"""By how much a sensor's pixels draw lines aside that are thinner than they are, which a picture tells by itself.

A line that lies on the middle of a row of pixels, or between two rows, is drawn there. Elsewhere a sharp lens and a
colour sensor, of whose pixels most colours are filled in, draw it up to 0.12 px towards one of them, by where it lies
in the pixel; and at 45 degrees by where it lies between the diagonals that see green. Red and blue are seen in every
other row only, so what weighs them unlike waves over two pixels. Along a line in such a direction that changes slowly,
so that many places err together; nearer and farther ones tell it all the same, since lines are straight or round and
what is drawn of them waves.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Indices32, distinct, median
from ceres_cal.detect.courses import Course

_REMAINS = 0.15  # of the error, what is left once it is taken off
_AROUND = 10  # places to either side, of which the mean tells where in its pixel a line lies
_ROUNDS, _FEWEST = 5, 20
_CURVATURE = np.array([1.0, -2.0, 1.0])
# Across level lines, upright ones, and those along either diagonal, which a sensor of colours draws alike.
_ACROSS = np.array([(0.0, 1.0), (1.0, 0.0), (0.5**0.5, 0.5**0.5), (0.5**0.5, -(0.5**0.5))])
# Directions, 1/px of the longest wave across them, and how many there are, each half as long as the one before.
_WAVES = (((0,), 0.5, 3), ((1,), 0.5, 3), ((2, 3), 0.5**0.5, 2))


def drawn_aside(course: Course, offset_px: Array, threes: Indices, half_width_px: int) -> tuple[Array, Array]:
    """(N,) px along the normals by which lines are drawn beside themselves, and its standard deviation (N,).

    That is as large as a line's middle needs whose places all err alike, since they are taken to err each by itself.

    Args:
        offset_px: (N,) where along the normals they were measured, NaN where they were not. threes: (M, 3) places that
            follow each other on a curve, all of them measured. half_width_px: of the windows, along the curve.
    """
    aside: Array = np.zeros(len(course))
    if len(threes) < _FEWEST:
        return aside, aside
    at_rest_px = 1e-5  # a hundredth of the least standard deviation of a place, and less
    # Standard deviation of the error's amplitude, beforehand: what is wide has edges that are drawn aside alike.
    prior_px = 0.1 / max(median(course.width_px), 1.0)
    bends = offset_px[threes] @ _CURVATURE
    for _ in range(_ROUNDS):  # where in the pixel a line lies is where it is drawn but for that
        turns = _turns(course, _smooth(course.curve, offset_px - aside), half_width_px)
        amplitude, sigma = _amplitudes(np.einsum("mtk,t->mk", turns.imag[threes], _CURVATURE), bends, prior_px)
        before, aside = aside, np.nan_to_num(turns.imag @ amplitude)
        if np.max(np.abs(aside - before)) < at_rest_px:
            break
    left = np.hypot(_REMAINS * amplitude, sigma)
    remains = left * np.nan_to_num(np.abs(turns) * np.sqrt(_alike(course, offset_px, turns)))
    return aside, np.linalg.norm(remains, axis=1)


def _alike(course: Course, offset_px: Array, turns: Array) -> Array:
    """(N, K) how many places of its curve err as a place does: few where the line wanders through the pixels."""
    measured, alike = np.isfinite(offset_px), np.ones(turns.shape)
    for number in distinct(course.curve):
        every = turns[measured & (course.curve == number)]
        squares = np.maximum(np.sum(np.abs(every) ** 2, axis=0), 1e-12)
        alike[course.curve == number] = np.maximum(np.abs(np.sum(every, axis=0)) ** 2 / squares, 1.0)
    return alike


def _smooth(curve: Indices32, offset_px: Array) -> Array:
    """(N,) the mean of the places around on the same curve: one place's own error would explain itself.

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
    """(K,) of what, times columns (M, K), explains the bends (M,) but for a few; and its standard deviation (K,)."""
    robust = 2.0  # of the usual residual: Cauchy's scale
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
    """(N, K) complex: how far round its pixel a line is, the mean over each window, along the normal: of each wave."""
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
