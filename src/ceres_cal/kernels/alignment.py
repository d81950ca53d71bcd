"""Radial alignment of many sights of points: what each tells by itself, and what all say of the profile together."""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.block import cholesky, substitute
from ceres_cal.kernels.jit import jit
from ceres_cal.kernels.planes import least_direction, median, normalise


@jit
def normalised_planes(bounds: Any, plane: Any, x: Any, lifts: Any) -> None:
    """x (2, N): each sight's plane points (N, 2) with their centroid at 0 and unit spread; see `normalise`."""
    for g in range(len(bounds) - 1):
        rows = slice(bounds[g], bounds[g + 1])
        normalise(plane[rows], x[:, rows], lifts[g])


@jit
def _aligned(x: Any, p: Any, weights: Any, normal: Any, upper: Any, h: Any) -> None:
    """h (6): h1 and h2 of p_x (h2 . X) - p_y (h1 . X) = 0, scaled so that |(h1 . X, h2 . X)| is |p| on average."""
    row = np.empty(6)
    normal[:] = 0.0
    for i in range(len(p)):
        a, b = p[i, 0], p[i, 1]
        row[0], row[1], row[2] = -b * x[0, i], -b * x[1, i], -b
        row[3], row[4], row[5] = a * x[0, i], a * x[1, i], a
        for k in range(6):
            for j in range(k + 1):
                normal[k, j] += weights[i] * row[k] * row[j]
    for k in range(6):
        h[k] = 1.0 + 0.1 * k
    least_direction(normal, upper, h)
    agree, size = 0.0, 0.0
    for i in range(len(p)):
        u = h[0] * x[0, i] + h[1] * x[1, i] + h[2]
        v = h[3] * x[0, i] + h[4] * x[1, i] + h[5]
        agree += weights[i] * (u * p[i, 0] + v * p[i, 1])
        size += weights[i] * (p[i, 0] * p[i, 0] + p[i, 1] * p[i, 1])
    h *= size / (agree if abs(agree) > 1e-12 else 1e-12)


@jit
def _depths(x: Any, p: Any, weights: Any, h: Any, share: Any, reduced: Any) -> None:
    """Of r (h3 . X) - q sum c_k r^2k = q: share (3, terms + 1) is how h3 follows (c, 1); the rest is added up."""
    size = 3 + len(reduced)
    products, upper, row = np.zeros((size, size)), np.empty((3, 3)), np.empty(size)
    for i in range(len(p)):
        r = np.sqrt(p[i, 0] * p[i, 0] + p[i, 1] * p[i, 1])
        u = h[0] * x[0, i] + h[1] * x[1, i] + h[2]
        v = h[3] * x[0, i] + h[4] * x[1, i] + h[5]
        q = (u * p[i, 0] + v * p[i, 1]) / max(r, 1e-9)
        row[0], row[1], row[2], row[size - 1] = r * x[0, i], r * x[1, i], r, q
        power = -q
        for k in range(3, size - 1):
            power *= r * r
            row[k] = power
        for k in range(size):
            for j in range(k + 1):
                products[k, j] += weights[i] * row[k] * row[j]
    trace = products[0, 0] + products[1, 1] + products[2, 2]
    for k in range(3):
        products[k, k] += 1e-12 * trace
    cholesky(products[:3, :3], upper)
    for column in range(len(reduced)):
        for k in range(3):
            share[k, column] = products[3 + column, k]
        substitute(upper, share[:, column])
    for k in range(len(reduced)):
        for j in range(len(reduced)):
            value = products[3 + max(k, j), 3 + min(k, j)]
            for i in range(3):
                value -= products[3 + k, i] * share[i, j]
            reduced[k, j] += value


@jit
def align_sights(bounds: Any, x: Any, p: Any, weights: Any, h12: Any, shares: Any, reduced: Any) -> None:
    """h1 and h2 (S, 6) of every sight, and the equations of the profile that are left, `reduced`, added up.

    Args:
        bounds: (S + 1,) where each sight begins. x: (2, N) plane points, p: (N, 2) offsets, of unit size each.
        shares: (S, 3, terms + 1), filled: h3 is (shares @ (-c, 1)). reduced: (terms + 1,) squared, q's row last.
    """
    normal, upper = np.empty((6, 6)), np.empty((6, 6))
    for g in range(len(bounds) - 1):
        rows = slice(bounds[g], bounds[g + 1])
        _aligned(x[:, rows], p[rows], weights[rows], normal, upper, h12[g])
        _depths(x[:, rows], p[rows], weights[rows], h12[g], shares[g], reduced)


@jit
def alignment_errors(bounds: Any, x: Any, p: Any, h12: Any, h3: Any, profile: Any, errors: Any) -> None:
    """Distance (N,) of each point from where its sight's h12 (S, 6) and h3 (S, 3) send it under the profile c_k."""
    for g in range(len(bounds) - 1):
        h, d = h12[g], h3[g]
        for i in range(bounds[g], bounds[g + 1]):
            r = np.sqrt(p[i, 0] * p[i, 0] + p[i, 1] * p[i, 1])
            u = h[0] * x[0, i] + h[1] * x[1, i] + h[2]
            v = h[3] * x[0, i] + h[4] * x[1, i] + h[5]
            depth = d[0] * x[0, i] + d[1] * x[1, i] + d[2]
            w = 0.0
            for k in range(len(profile) - 1, -1, -1):
                w = (w + profile[k]) * r * r
            q = (u * p[i, 0] + v * p[i, 1]) / max(r, 1e-9)
            across = (p[i, 0] * v - p[i, 1] * u) / max(np.sqrt(u * u + v * v), 1e-9) * r
            along = r - q * (1.0 + w) / (depth if abs(depth) > 1e-9 else 1e-9)
            errors[i] = np.sqrt(across * across + along * along)


@jit
def usual_by_radius(errors: Any, radius: Any, usual: Any) -> None:
    """The median error at each point's distance from the centre, to `usual` (N,): profiles fit worst where lenses bend
    most.
    """
    rings = min(max(len(errors) // 200, 1), 16)  # few points in a ring, and its outliers would be the usual there
    farthest = 0.0
    for r in radius:
        farthest = max(farthest, r)
    ring, inside = np.empty(len(errors), np.int64), np.empty(len(errors))
    for i in range(len(errors)):
        ring[i] = min(int(radius[i] * rings / (farthest + 1e-300)), rings - 1)
    for number in range(rings):
        count = 0
        for i in range(len(errors)):
            if ring[i] == number:
                inside[count] = errors[i]
                count += 1
        middle = max(median(inside[:count]), 1e-12) if count > 0 else 0.0
        for i in range(len(errors)):
            if ring[i] == number:
                usual[i] = middle
