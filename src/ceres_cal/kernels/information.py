"""The normal equations of many sights where they stand: what each one says, nothing moved."""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.arguments import CurveColumns, Loss, Optics, PointColumns, Unknowns
from ceres_cal.kernels.jit import jit
from ceres_cal.kernels.lenses import prepared
from ceres_cal.kernels.panel import order_of_rows
from ceres_cal.kernels.sight import normal_equations
from ceres_cal.kernels.workspace import working_space


@jit
def sight_normals(
    first: int, last: int, optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss,
    poses: Any, units: Any, normals: Any,
) -> bool:  # fmt: skip
    """False where an observation cannot be projected; else J^T W J of the sights first to last, each by itself.

    Args:
        poses: (S, 3, 4) [R t] of cam_from_frame.
        normals: (last - first, n, n) with n = free + structure + 7: free intrinsics, structure, left perturbation of
            the pose and residual, each multiplied with its one of `units` (n,); an observation has its robust weight
            rho'.
    """
    size = len(units)
    optics, order = prepared(optics, optics.intrinsics), order_of_rows(unknowns, len(optics.intrinsics))
    normal, space = np.empty((size, size)), working_space(optics, len(order.rows))
    for v in range(first, last):
        cost = normal_equations(v, optics, poses[v], points, curves, loss, False, order, normal, space)
        if not np.isfinite(cost):
            return False
        for i in range(size):
            for j in range(i + 1):
                normals[v - first, i, j] = units[i] * units[j] * normal[i, j]
                normals[v - first, j, i] = normals[v - first, i, j]
    return True
