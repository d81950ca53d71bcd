"""A surface over the picture: cubic B-splines on a grid, which follow what no other term of a lens does, as smooth as
the data require (`effects/smoothness.py`).

Polynomials that are long enough for that bend where nothing was observed. Here each place is displaced by the sixteen
nodes around it, and beyond the observations by a smooth continuation (thin plates; Wahba, Spline Models for
Observational Data, SIAM 1990).
"""

from __future__ import annotations

from functools import cache, lru_cache

import numpy as np

from ceres_cal.base.arrays import Array, median

_SPLINES = np.array([[1.0, -3.0, 3.0, -1.0], [4.0, 0.0, -6.0, 3.0], [1.0, 3.0, 3.0, -3.0], [0.0, 0.0, 0.0, 1.0]]) / 6.0
# Powers of the place by which other terms of the lens and the camera displace are excluded from the surface: it has a
# thousandth of its size in them.
_DEGREE, _WITHOUT = 3, 1e-3


@cache
def _products(count: int) -> tuple[tuple[Array, ...], Array]:
    """Along one axis from -1 to 1, return integrals (count, count) of products of the B-splines, of their slopes and of
    their second derivatives; and (degree + 1, count) mean products with Legendre polynomials of root mean square 1.
    """
    cells = 0.5 * (count - 3)
    t, weight = np.polynomial.legendre.leggauss(5)
    t, weight = 0.5 + 0.5 * t, 0.5 * weight / cells
    powers = np.vander(t, 4, increasing=True)
    orders = [powers, np.column_stack([0.0 * t, t**0, 2.0 * t, 3.0 * t * t]) * cells]
    orders.append(np.column_stack([0.0 * t, 0.0 * t, 2.0 * t**0, 6.0 * t]) * cells**2)
    grams = [np.zeros((count, count)) for _ in orders]
    moments = np.zeros((_DEGREE + 1, count))
    sizes = np.sqrt(2.0 * np.arange(_DEGREE + 1) + 1.0)[:, None]
    for first in range(count - 3):
        nodes = slice(first, first + 4)
        for gram, order in zip(grams, orders, strict=True):
            values = order @ _SPLINES.T
            gram[nodes, nodes] += (values.T * weight) @ values
        legendre = sizes * np.polynomial.legendre.legvander((first + t) / cells - 1.0, _DEGREE).T
        moments[:, nodes] += 0.5 * (legendre * weight) @ (powers @ _SPLINES.T)
    return tuple(grams), moments


@lru_cache(maxsize=8)
def roughness(wide: float, high: float, columns: int, rows: int) -> Array:
    """(K, K) over nodes by column, row and axis: bending of the x and of the y displacements over a picture with these
    half sides, scaled such that the variances of its inverse have a median of 1.
    """
    (across, slope_x, bend_x), moments_x = _products(columns)
    (down, slope_y, bend_y), moments_y = _products(rows)
    bending = np.kron(bend_x, down) / wide**4 + np.kron(across, bend_y) / high**4
    bending += 2.0 * np.kron(slope_x, slope_y) / (wide * high) ** 2
    low = [np.kron(moments_x[i], moments_y[j]) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    without = np.transpose(low) @ np.array(low)
    free = np.linalg.inv(bending + 1.0 / _WITHOUT**2 * np.trace(bending) * without)
    own = median(np.diag(free)) * bending + without / _WITHOUT**2
    return np.asarray(np.kron(own, np.eye(2)))
