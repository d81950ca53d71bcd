"""The Jacobian of every observation for itself, in px: what the sums of `sight` are made of, for reading residuals."""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.arguments import CurveColumns, Loss, Optics, PointColumns
from ceres_cal.kernels.jit import jit
from ceres_cal.kernels.lenses import prepared
from ceres_cal.kernels.losses import robust_loss
from ceres_cal.kernels.sight import CHUNK, jacobian_rows, move_to_feet, shown_points, working_space


@jit
def point_rows(optics: Optics, poses: Any, points: PointColumns, rows: Any) -> bool:
    """d project(X) / d [intrinsics | 6 pose] into `rows` (N, 2, intrinsics + 6); False where one cannot be projected.

    Args:
        See `point_residuals`. The pose columns are left perturbations in the camera frame: (dw x R X) + dt.
    """
    optics = prepared(optics, optics.intrinsics)
    space = working_space(optics, 0)
    jacobian = space.jacobian
    for v in range(len(poses)):
        for start in range(points.bounds[v], points.bounds[v + 1], CHUNK):
            n = min(CHUNK, points.bounds[v + 1] - start)
            if not shown_points(n, start, optics, poses[v], points, space):
                return False
            jacobian_rows(n, optics, space, False)
            for i in range(n):
                for c in range(2):
                    for k in range(len(jacobian)):
                        rows[start + i, c, k] = jacobian[k, c, i]
    return True


@jit
def curve_rows(optics: Optics, poses: Any, curves: CurveColumns, rows: Any, normals: Any) -> bool:
    """The same of the signed distance to the curve, into `rows` (M, intrinsics + 6), by the envelope theorem.

    Args:
        See `curve_residuals`; s is moved to the foot. normals: (M, 2), filled with the image normal there: the foot
            lies at the pixel plus the signed distance along it.
    """
    optics = prepared(optics, optics.intrinsics)
    space = working_space(optics, 0)
    jacobian, foot = space.jacobian, space.foot
    for v in range(len(poses)):
        for start in range(curves.bounds[v], curves.bounds[v + 1], CHUNK):
            n = min(CHUNK, curves.bounds[v + 1] - start)
            if not move_to_feet(n, start, optics, poses[v], curves, space):
                return False
            jacobian_rows(n, optics, space, False)
            for i in range(n):
                length = np.sqrt(foot[7, i])
                nx, ny = -foot[1, i] / length, foot[0, i] / length
                normals[start + i, 0], normals[start + i, 1] = nx, ny
                for k in range(len(jacobian)):
                    rows[start + i, k] = nx * jacobian[k, 0, i] + ny * jacobian[k, 1, i]
    return True


@jit
def loss_weights(loss: Loss, squared: Any) -> Any:
    """rho' at each squared residual, (N,): the weight an observation has in the solve."""
    weights = np.empty(len(squared))
    for i in range(len(squared)):
        weights[i] = robust_loss(loss, squared[i])[1]
    return weights
