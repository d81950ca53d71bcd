"""The Jacobian of every observation for itself, in px: what the sums of `sight` are made of, for reading residuals."""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.arguments import BUILT, CurveColumns, Loss, Optics, PointColumns
from ceres_cal.kernels.jit import borrowing, jit
from ceres_cal.kernels.lenses import prepared
from ceres_cal.kernels.losses import robust_loss
from ceres_cal.kernels.sight import curve_directions, jacobian_rows, move_to_feet, shown_points
from ceres_cal.kernels.workspace import CHUNK, working_space


@jit
def point_rows(optics: Optics, poses: Any, points: PointColumns, rows: Any) -> None:
    """d project(X) / d [intrinsics | 6 pose | x, y, the warp's numbers] into `rows` (N, 2, intrinsics + 6 + BUILT); NaN
    where a sight has points that cannot be projected.

    Args:
        See `point_residuals`. The pose columns are left perturbations in the camera frame: (dw x R X) + dt.
    """
    optics = prepared(optics, optics.intrinsics)
    space = working_space(optics, 0)
    jacobian, directions = space.jacobian, np.eye(BUILT, 3)
    for v in range(len(poses)):
        for start in range(points.bounds[v], points.bounds[v + 1], CHUNK):
            n = min(CHUNK, points.bounds[v + 1] - start)
            if not shown_points(n, start, optics, poses[v], points, space):
                rows[start : start + n] = np.nan
                continue
            jacobian_rows(n, optics, space, False)
            for i in range(n):
                for k in range(BUILT - 2):
                    directions[2 + k, 2] = points.bends[start + i, k]
                for c in range(2):
                    row = rows[start + i, c]
                    for k in range(len(jacobian)):
                        row[k] = jacobian[k, c, i]
                    _add_built(poses[v], directions, row)


@jit
def curve_rows(optics: Optics, poses: Any, curves: CurveColumns, rows: Any, normals: Any) -> bool:
    """The same of the signed distance to the curve, into `rows` (M, intrinsics + 6 + BUILT), by the envelope theorem;
    the last columns are of a segment's offset to the left, or of an arc's x, y and radius, and 0.

    Args:
        See `curve_residuals`; s is moved to the foot. normals: (M, 2), filled with the image normal there: the foot
            lies at the pixel plus the signed distance along it.
    """
    optics = prepared(optics, optics.intrinsics)
    space = working_space(optics, 0)
    jacobian, foot, directions = space.jacobian, space.foot, space.directions
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
                row = rows[start + i]
                for k in range(len(jacobian)):
                    row[k] = nx * jacobian[k, 0, i] + ny * jacobian[k, 1, i]
                track = curves.track[start + i]
                directions[:] = 0.0
                directions[1, 1] = 1.0 if curves.is_arc[track] else 0.0
                curve_directions(i, track, curves, space.tangents, directions)
                _add_built(poses[v], directions, row)
    return True


@borrowing
def _add_built(pose: Any, directions: Any, row: Any) -> None:
    """A row's last BUILT columns, the target moved along each direction; those before are the pose's translation."""
    first = len(row) - BUILT
    for a in range(BUILT):
        row[first + a] = 0.0
        for j in range(3):
            for k in range(3):
                row[first + a] += row[first - 3 + j] * pose[j, k] * directions[a, k]


@jit
def loss_weights(loss: Loss, squared: Any, weights: Any) -> None:
    """rho' at each squared residual, to `weights` (N,): what an observation has in the solve."""
    for i in range(len(squared)):
        weights[i] = robust_loss(loss, squared[i])[1]
