"""The panel: a chunk's weighted Jacobian rows with the residual as the last one, column by column an observation.

Which numbers the rows are, and what `sight` does with it once it is filled: Newton's share of the loss, the products,
the structure's share.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ceres_cal.kernels.arguments import Loss, Unknowns
from ceres_cal.kernels.jit import borrowing, jit
from ceres_cal.kernels.losses import bend
from ceres_cal.kernels.workspace import Workspace

_FLAT, _MOSTLY_FLAT = 0.7, 0.5  # a bend; share of a chunk beyond which it says nothing of where the minimum lies


class Order(NamedTuple):
    """Which numbers take part: A is [free intrinsics | structure | 6 pose | residual].

    Attributes:
        rows: indices into [intrinsics | 6 pose | residual], the last one the residual's. places: their rows in A.
        free: how many intrinsics there are, and where the structure begins.
    """

    rows: Any
    places: Any
    free: int


@jit
def order_of_rows(unknowns: Unknowns, intrinsics: int) -> Order:
    """The order of some unknowns of so many intrinsics."""
    count = len(unknowns.free)
    rows, places = np.empty(count + 7, np.int64), np.empty(count + 7, np.int64)
    rows[:count] = unknowns.free
    rows[count:] = np.arange(intrinsics, intrinsics + 7)
    places[:count] = np.arange(count)
    places[count:] = np.arange(count + unknowns.structure, count + unknowns.structure + 7)
    return Order(rows, places, count)


@borrowing
def shows(n: int, row: Any) -> bool:
    """Whether a number's derivatives (2, n) are anywhere other than 0."""
    for c in range(2):
        for i in range(n):
            if row[c, i] != 0.0:
                return True
    return False


@borrowing
def product_of(n: int, x: Any, y: Any, product: Any) -> None:
    """x times y, number by number: whole rows, for SIMD needs plain indices."""
    for i in range(n):
        product[i] = x[i] * y[i]


@borrowing
def add_products(n: int, count: int, space: Workspace, normal: Any) -> None:
    """normal += P P^T over the panel's first n columns, lower triangle."""
    panel, products, places = space.panel, space.products, space.places
    _multiply(n, count, panel, products)
    for k in range(count):
        for j in range(k + 1):
            normal[places[k], places[j]] += products[k, j]


@borrowing
def _multiply(n: int, count: int, panel: Any, products: Any) -> None:
    """products = P P^T, lower triangle; four rows by three, to read each one less. (Of more sums at once than the
    processor has registers for each takes longer.)

    Both have room for three rows more.
    """
    for k in range(0, count, 4):
        for j in range(0, min(k + 4, count), 3):
            s00, s01, s02, s10, s11, s12 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            s20, s21, s22, s30, s31, s32 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            for i in range(n):
                a, b, c, d = panel[k, i], panel[k + 1, i], panel[k + 2, i], panel[k + 3, i]
                x, y, z = panel[j, i], panel[j + 1, i], panel[j + 2, i]
                s00 += a * x
                s01 += a * y
                s02 += a * z
                s10 += b * x
                s11 += b * y
                s12 += b * z
                s20 += c * x
                s21 += c * y
                s22 += c * z
                s30 += d * x
                s31 += d * y
                s32 += d * z
            products[k, j], products[k, j + 1], products[k, j + 2] = s00, s01, s02
            products[k + 1, j], products[k + 1, j + 1], products[k + 1, j + 2] = s10, s11, s12
            products[k + 2, j], products[k + 2, j + 1], products[k + 2, j + 2] = s20, s21, s22
            products[k + 3, j], products[k + 3, j + 1], products[k + 3, j + 2] = s30, s31, s32


@borrowing
def bend_rows(n: int, components: int, loss: Loss, squared: Any, last: int, panel: Any) -> None:
    """Take the second derivative of rho into the panel's rows: Newton's step on the loss, its gradient unchanged."""
    flat = 0
    for i in range(n):
        flat += bend(loss, squared[i]) < _FLAT
    if flat > _MOSTLY_FLAT * n:
        return
    for i in range(n):
        left = bend(loss, squared[i])
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


@borrowing
def add_structure(
    i: int, n: int, components: int, slots: Any, pose: Any, base: int, last: int, space: Workspace, normal: Any
) -> None:
    """The share of the chunk's observation i in the rows of the structure numbers `slots` (-1: none) that move it.

    Moving the target along one of the workspace's directions, a slot each, moves the point by R times it in the camera
    frame: the pose's translation rows of the panel say what that does.

    Args:
        base: where the structure numbers begin, between the free intrinsics and the pose. last: the residual's row.
    """
    panel, directions, columns, places = space.panel, space.directions, space.columns, space.places
    translation = last - 3
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
        for k in range(last + 1):
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
