"""Where the observations of a sight are worked on, a chunk at a time, laid out number by number for SIMD registers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from ceres_cal.kernels.arguments import BUILT, Optics
from ceres_cal.kernels.jit import jit

CHUNK = 112  # a board of a hundred corners at once, all of it in the first cache


class Workspace(NamedTuple):
    """Where a chunk is worked on, used again and again; each has one column per observation of the chunk.

    Attributes:
        jacobian: (intrinsics + 6, 2, n) rows phi, aspect, cx, cy, coefficients, skew, pose; x and y
            components.
        panel: (rows + 3, 2 n) the weighted rows, see `panel`. products: (rows + 3,) squared, of those rows.
        rows, places: (rows,) which ones these are, and where they stand in the normal equations, see `panel.Order`.
        local, rotated, rays: (3, n) the point X in its frame, R X, and R X + t.
        image (8, n): the offset (ox, oy) from the principal point on square pixels, its derivatives xx, xy, yy with
            respect to the ray's x and y, and xz, yz with respect to its z; yx - xy.
        work: what the lens keeps for the derivatives with respect to its own numbers.
        tangents: (3, n) dC/ds. foot (8, n): tau in px (0, 1), residual vector (2, 3), step (4), the previous s and dot
            product of residual and tau (5, 6), |tau|^2 (7).
        directions, columns: (BUILT, 3), (BUILT, 2) of one observation and its structure numbers, see `add_structure`.
    """

    jacobian: Any
    panel: Any
    products: Any
    rows: Any
    places: Any
    local: Any
    rotated: Any
    rays: Any
    image: Any
    work: Any
    tangents: Any
    foot: Any
    directions: Any
    columns: Any


@jit
def working_space(optics: Optics, rows: int) -> Workspace:
    """For so many rows of normal equations."""
    scratch = np.empty((28 + optics.work_rows, CHUNK))
    return Workspace(
        np.empty((len(optics.intrinsics) + 6, 2, CHUNK)),
        np.zeros((rows + 3, 2 * CHUNK)),
        np.empty((rows + 3, rows + 3)),
        np.empty(rows, np.int64),
        np.empty(rows, np.int64),
        scratch[:3],
        scratch[3:6],
        scratch[6:9],
        scratch[9:17],
        scratch[28:],
        scratch[17:20],
        scratch[20:28],
        np.empty((BUILT, 3)),
        np.empty((BUILT, 2)),
    )
