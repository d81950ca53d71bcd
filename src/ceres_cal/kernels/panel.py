"""The panel: a chunk's weighted Jacobian rows with the residual as the last one, column by column an observation.

What `sight` does with it once it is filled: Newton's share of the loss, the products, the structure's share.
"""

from __future__ import annotations

from typing import Any

from ceres_cal.kernels.jit import jit
from ceres_cal.kernels.losses import bend

_FLAT, _MOSTLY_FLAT = 0.7, 0.5  # a bend; share of a chunk beyond which it says nothing of where the minimum lies


@jit
def add_products(n: int, count: int, panel: Any, products: Any) -> None:
    """products += P P^T over the panel's first n columns, lower triangle; three rows by three, to read each one less.

    Both have room for a multiple of three rows.
    """
    for k in range(0, count, 3):
        a, b, c = panel[k], panel[k + 1], panel[k + 2]
        for j in range(0, k + 1, 3):
            x, y, z = panel[j], panel[j + 1], panel[j + 2]
            s00, s01, s02, s10, s11, s12, s20, s21, s22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(n):
                s00 += a[i] * x[i]
                s01 += a[i] * y[i]
                s02 += a[i] * z[i]
                s10 += b[i] * x[i]
                s11 += b[i] * y[i]
                s12 += b[i] * z[i]
                s20 += c[i] * x[i]
                s21 += c[i] * y[i]
                s22 += c[i] * z[i]
            upper, middle, lower = products[k], products[k + 1], products[k + 2]
            upper[j] += s00
            upper[j + 1] += s01
            upper[j + 2] += s02
            middle[j] += s10
            middle[j + 1] += s11
            middle[j + 2] += s12
            lower[j] += s20
            lower[j + 1] += s21
            lower[j + 2] += s22


@jit
def bend_rows(n: int, components: int, loss: int, scale: float, squared: Any, last: int, panel: Any) -> None:
    """Take the second derivative of rho into the panel's rows: Newton's step on the loss, its gradient unchanged."""
    flat = 0
    for i in range(n):
        flat += bend(loss, scale, squared[i]) < _FLAT
    if flat > _MOSTLY_FLAT * n:
        return
    for i in range(n):
        left = bend(loss, scale, squared[i])
        if left == 1.0:
            continue
        length2 = 0.0
        for c in range(components):
            length2 += panel[last, c * n + i] * panel[last, c * n + i]
        for k in range(last):
            along = 0.0
            for c in range(components):
                along += panel[last, c * n + i] * panel[k, c * n + i]
            for c in range(components):
                panel[k, c * n + i] -= (1.0 - left) * along / length2 * panel[last, c * n + i]
        for c in range(components):
            panel[last, c * n + i] /= left


@jit
def add_structure(
    i: int, n: int, components: int, slots: Any, directions: Any, pose: Any, places: Any, panel: Any, columns: Any,
    normal: Any,
) -> None:  # fmt: skip
    """The share of the chunk's observation i in the rows of the structure numbers `slots` (-1: none) that move it.

    Moving the target along a direction moves the point by R times it in the camera frame: the pose's translation rows
    of the panel say what that does. Structure numbers stand between the free intrinsics and the pose.
    """
    base, translation = len(places) - 7, len(places) - 4
    for a in range(len(slots)):
        if slots[a] < 0:
            continue
        for c in range(components):
            columns[a, c] = 0.0
            for j in range(3):
                turned = 0.0
                for k in range(3):
                    turned += pose[j, k] * directions[a, k]
                columns[a, c] += panel[translation + j, c * n + i] * turned
        for k in range(len(places)):
            value = 0.0
            for c in range(components):
                value += columns[a, c] * panel[k, c * n + i]
            row, column = max(base + slots[a], places[k]), min(base + slots[a], places[k])
            normal[row, column] += value
        for b in range(a + 1):
            if slots[b] >= 0:
                value = 0.0
                for c in range(components):
                    value += columns[a, c] * columns[b, c]
                normal[base + max(slots[a], slots[b]), base + min(slots[a], slots[b])] += value
