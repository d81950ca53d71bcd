"""The Jacobian of every observation for itself, in px: what the sums of `sight` are made of, for reading residuals."""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.jit import jit
from ceres_cal.kernels.lenses import answer_limit, distort, intrinsics_rows, one_dimensional
from ceres_cal.kernels.losses import robust_loss
from ceres_cal.kernels.sight import CHUNK, feet, pose_rows, to_camera


@jit
def point_rows(
    lens: int, intrinsics: Any, powers: Any, unit: float, poses: Any, bounds: Any, points: Any, rows: Any
) -> bool:
    """d project(X) / d [intrinsics | 6 pose] into `rows` (N, 2, intrinsics + 6); False where one cannot be projected.

    Args:
        See `point_residuals`. The pose columns are left perturbations in the camera frame: (dw x R X) + dt.
    """
    size = len(intrinsics)
    jacobian, scratch = np.empty((size + 6, 2, CHUNK)), np.empty((21, CHUNK))
    local, rotated, rays, image, work = scratch[:3], scratch[3:6], scratch[6:9], scratch[9:16], scratch[16:21]
    dense = one_dimensional(lens, intrinsics, powers)
    limit = answer_limit(lens, dense)
    for v in range(len(poses)):
        for start in range(bounds[v], bounds[v + 1], CHUNK):
            n = min(CHUNK, bounds[v + 1] - start)
            for i in range(n):
                for j in range(3):
                    local[j, i] = points[start + i, j]
            to_camera(n, poses[v], local, rotated, rays)
            if not distort(lens, n, intrinsics, dense, unit, limit, rays, image, work):
                return False
            intrinsics_rows(lens, n, intrinsics, powers, unit, image, work, jacobian)
            pose_rows(n, size, intrinsics[1], rotated, image, jacobian)
            for i in range(n):
                for c in range(2):
                    for k in range(size + 6):
                        rows[start + i, c, k] = jacobian[k, c, i]
    return True


@jit
def curve_rows(
    lens: int, intrinsics: Any, powers: Any, unit: float, poses: Any, bounds: Any, tracks: Any, is_arc: Any,
    track: Any, pixels: Any, s: Any, rows: Any, normals: Any,
) -> bool:  # fmt: skip
    """The same of the signed distance to the curve, into `rows` (M, intrinsics + 6), by the envelope theorem.

    Args:
        See `curve_residuals`; s is moved to the foot. normals: (M, 2), filled with the image normal there: the foot
            lies at the pixel plus the signed distance along it.
    """
    size = len(intrinsics)
    jacobian, scratch = np.empty((size + 6, 2, CHUNK)), np.empty((32, CHUNK))
    local, rotated, rays, image, work, foot = (
        scratch[:3], scratch[3:6], scratch[6:9], scratch[9:16], scratch[16:21], scratch[21:],
    )  # fmt: skip
    dense = one_dimensional(lens, intrinsics, powers)
    limit = answer_limit(lens, dense)
    for v in range(len(poses)):
        for start in range(bounds[v], bounds[v + 1], CHUNK):
            n = min(CHUNK, bounds[v + 1] - start)
            if not feet(
                lens, n, start, intrinsics, dense, unit, limit, poses[v], tracks, is_arc, track, pixels, s,
                local, rotated, rays, image, work, foot,
            ):  # fmt: skip
                return False
            intrinsics_rows(lens, n, intrinsics, powers, unit, image, work, jacobian)
            pose_rows(n, size, intrinsics[1], rotated, image, jacobian)
            for i in range(n):
                length = np.sqrt(foot[7, i])
                nx, ny = -foot[1, i] / length, foot[0, i] / length
                normals[start + i, 0], normals[start + i, 1] = nx, ny
                for k in range(size + 6):
                    rows[start + i, k] = nx * jacobian[k, 0, i] + ny * jacobian[k, 1, i]
    return True


@jit
def loss_weights(loss: int, scale: float, squared: Any) -> Any:
    """rho' at each squared residual, (N,): the weight an observation has in the solve."""
    weights = np.empty(len(squared))
    for i in range(len(squared)):
        weights[i] = robust_loss(loss, scale, squared[i])[1]
    return weights
