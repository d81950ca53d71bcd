"""Homographies of very many sights of points at once, each reweighted against its own wrong labels."""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.block import cholesky, substitute
from ceres_cal.kernels.jit import jit

_PATIENCE = 8  # rounds of reweighting where some points do not fit
# Medians: no clean residual is that long, nine standard deviations. Nothing changes at half of it.
_WRONG = 8.0


@jit
def median(values: Any) -> float:
    """Of numbers; NumPy's own, as numba has it, needs more of numba than its runtime. By Hoare's selection."""
    kept, half = values.copy(), len(values) // 2
    low, high = 0, len(kept) - 1
    while low < high:
        pivot, i, j = kept[half], low, high
        while i <= j:
            while kept[i] < pivot:
                i += 1
            while pivot < kept[j]:
                j -= 1
            if i <= j:
                kept[i], kept[j] = kept[j], kept[i]
                i += 1
                j -= 1
        if j < half:
            low = i
        if half < i:
            high = j
    below = kept[half]
    if len(kept) % 2 == 0:
        below = kept[0]
        for i in range(1, half):
            below = max(below, kept[i])
    return 0.5 * (below + kept[half])


@jit
def normalise(plane: Any, x: Any, lift: Any) -> None:
    """x (2, n): the points with their centroid at 0 and unit spread; `lift` (3): centroid and 1 / spread."""
    n = len(plane)
    lift[0], lift[1] = np.sum(plane[:, 0]) / n, np.sum(plane[:, 1]) / n
    spread = 0.0
    for i in range(n):
        x[0, i], x[1, i] = plane[i, 0] - lift[0], plane[i, 1] - lift[1]
        spread += x[0, i] * x[0, i] + x[1, i] * x[1, i]
    lift[2] = 1.0 / (np.sqrt(spread / n) + 1e-12)
    for i in range(n):
        x[0, i] *= lift[2]
        x[1, i] *= lift[2]


@jit
def _lift(offsets: Any, profile: Any, unit: float, q: Any) -> None:
    for i in range(len(q)):
        q[i, 0], q[i, 1] = offsets[i, 0] / unit, offsets[i, 1] / unit
        squared, w = q[i, 0] * q[i, 0] + q[i, 1] * q[i, 1], 0.0
        for k in range(len(profile) - 1, -1, -1):
            w = (w + profile[k]) * squared
        q[i, 2] = 1.0 + w


@jit
def _moments(x: Any, q: Any, weights: Any, columns: Any, normal: Any) -> None:
    """normal (9, 9), lower triangle: of q_w (h1 . X) - q_x (h3 . X) = 0 and q_w (h2 . X) - q_y (h3 . X) = 0."""
    n = len(q)
    ww, wa, wb, ab, xx, xy, yy = columns
    for i in range(n):
        w, a, b, c = weights[i], q[i, 0], q[i, 1], q[i, 2]
        ww[i], wa[i], wb[i], ab[i] = w * c * c, -w * c * a, -w * c * b, w * (a * a + b * b)
        xx[i], xy[i], yy[i] = x[0, i] * x[0, i], x[0, i] * x[1, i], x[1, i] * x[1, i]
    normal[:] = 0.0
    for row, column, factor in ((0, 0, ww), (3, 3, ww), (6, 0, wa), (6, 3, wb), (6, 6, ab)):
        s, sx, sy, sxx, sxy, syy = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            s += factor[i]
            sx += factor[i] * x[0, i]
            sy += factor[i] * x[1, i]
            sxx += factor[i] * xx[i]
            sxy += factor[i] * xy[i]
            syy += factor[i] * yy[i]
        block = normal[row : row + 3, column : column + 3]
        block[0, 0], block[1, 1], block[2, 2] = sxx, syy, s
        block[1, 0] = block[0, 1] = sxy
        block[2, 0] = block[0, 2] = sx
        block[2, 1] = block[1, 2] = sy


@jit
def least_direction(normal: Any, upper: Any, h: Any) -> None:
    """The unit vector that `normal` shrinks most, by inverse iteration from h."""
    size = len(h)
    trace = 0.0
    for i in range(size):
        trace += normal[i, i]
    for i in range(size):
        normal[i, i] += 1e-13 * trace
    cholesky(normal, upper)
    for _ in range(4):
        substitute(upper, h)
        h /= np.sqrt(np.sum(h * h))


@jit
def _errors(x: Any, q: Any, h: Any, errors: Any, weights: Any) -> None:
    """Distance of each measured point from where h sends it, in q's unit, and 1 / depth^2 as weights."""
    agree = 0.0
    for i in range(len(q)):
        u = h[0] * x[0, i] + h[1] * x[1, i] + h[2]
        v = h[3] * x[0, i] + h[4] * x[1, i] + h[5]
        depth = h[6] * x[0, i] + h[7] * x[1, i] + h[8]
        agree += 1.0 if u * q[i, 0] + v * q[i, 1] + depth * q[i, 2] > 0.0 else -1.0
        depth = depth if abs(depth) > 1e-9 else 1e-9
        errors[i] = np.sqrt((u * q[i, 2] / depth - q[i, 0]) ** 2 + (v * q[i, 2] / depth - q[i, 1]) ** 2)
        weights[i] = 1.0 / (depth * depth)
    if agree < 0.0:
        h *= -1.0


@jit
def plane_homographies(
    bounds: Any, plane: Any, offsets: Any, profile: Any, unit: float, homographies: Any, errors: Any
) -> None:
    """H (S, 3, 3) of each sight with q ~ H (x, y, 1), sign by most of its points, and each point's error (N,).

    Args:
        bounds: (S + 1,) where each sight begins. plane: (N, 2) m. offsets: (N, 2) px. unit: px.
        profile: c_k of w = 1 + sum c_k r^2k, which makes q = (p, w); p and r are offsets and their lengths over `unit`.
    """
    most = 0
    for g in range(len(bounds) - 1):
        most = max(most, bounds[g + 1] - bounds[g])
    x, weights, columns, lifted = np.empty((2, most)), np.empty(most), np.empty((7, most)), np.empty((most, 3))
    normal, upper, h, lift = np.empty((9, 9)), np.empty((9, 9)), np.empty(9), np.empty(3)
    for g in range(len(bounds) - 1):
        rows = slice(bounds[g], bounds[g + 1])
        n = bounds[g + 1] - bounds[g]
        q, e = lifted[:n], errors[rows]
        _lift(offsets[rows], profile, unit, q)
        normalise(plane[rows], x, lift)
        weights[:n] = 1.0
        for i in range(9):
            h[i] = 1.0 + 0.1 * i  # anything: what the moments shrink more vanishes within a few iterations
        usual = 0.0
        for _ in range(_PATIENCE):
            _moments(x, q, weights, columns, normal)
            least_direction(normal, upper, h)
            _errors(x, q, h, e, weights)
            usual = median(e)
            worst = 0.0
            for i in range(n):
                worst = max(worst, e[i])
            if worst <= _WRONG * usual:
                break
            for i in range(n):
                weights[i] /= 1.0 + (e[i] / (1.5 * usual + 1e-12)) ** 2
        for j in range(3):
            a, b = h[3 * j] * lift[2], h[3 * j + 1] * lift[2]
            homographies[g, j, 0], homographies[g, j, 1] = a, b
            homographies[g, j, 2] = h[3 * j + 2] - a * lift[0] - b * lift[1]
