"""The compressed block of one sight, as Ceres asks for it (design, section 6).

A = sum w [J e]^T [J e] over [free intrinsics | structure | 6 pose | e] is factored as A = U^T U; the rows of U are the
Jacobian that Ceres sees, their last column its residual. Station and placement follow by the chain rule on U.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.arguments import ROUNDING, Blocks, CurveColumns, Loss, Optics, PointColumns, Unknowns
from ceres_cal.kernels.jit import jit
from ceres_cal.kernels.lenses import prepared
from ceres_cal.kernels.panel import order_of_rows
from ceres_cal.kernels.sight import normal_equations
from ceres_cal.kernels.workspace import working_space

# Numbers from which on rounding in what the observations leave open adds up, and the share of the diagonal that is
# added against it: that changes no slope.
_MANY, _LIFT = 64, 1e-12


@jit
def cholesky(normal: Any, upper: Any) -> None:
    """U with U^T U = A from A's lower triangle; where A is singular the row of U is zero."""
    size = len(normal)
    whole = 1.0 + (_LIFT if size > _MANY else 0.0)
    upper[:] = 0.0
    for k in range(size):
        pivot = whole * normal[k, k]
        for j in range(k):
            pivot -= upper[j, k] * upper[j, k]
        if not pivot > 1e-15 * normal[k, k]:
            continue
        root = np.sqrt(pivot)
        upper[k, k] = root
        for i in range(k + 1, size):
            total = normal[i, k]
            for j in range(k):
                total -= upper[j, k] * upper[j, i]
            upper[k, i] = total / root


@jit
def substitute(upper: Any, x: Any) -> None:
    """x <- (U^T U)^-1 x by forward and back substitution, in place; U of full rank."""
    for k in range(len(x)):
        for j in range(k):
            x[k] -= upper[j, k] * x[j]
        x[k] /= upper[k, k]
    for k in range(len(x) - 1, -1, -1):
        for j in range(k + 1, len(x)):
            x[k] -= upper[k, j] * x[j]
        x[k] /= upper[k, k]


@jit
def _sine_series(w: Any) -> tuple[float, float, float, float]:
    """Squared angle of a rotation vector, and sin a / a, (1 - cos a) / a^2, (a - sin a) / a^3, also where a is tiny."""
    angle2 = w[0] * w[0] + w[1] * w[1] + w[2] * w[2]
    angle = np.sqrt(angle2)
    if angle < 1e-4:
        return angle2, 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0, 1.0 / 6.0 - angle2 / 120.0
    half = np.sin(0.5 * angle) / angle
    return angle2, np.sin(angle) / angle, 2.0 * half * half, (angle - np.sin(angle)) / (angle * angle2)


@jit
def _turn(w: Any, diagonal: float, outer: float, cross: float, out: Any) -> None:
    """diagonal 1 + outer w w^T + cross [w]x, into the left (3, 3) of `out`."""
    for j in range(3):
        for k in range(3):
            out[j, k] = outer * w[j] * w[k]
        out[j, j] += diagonal
    x, y, z = cross * w[0], cross * w[1], cross * w[2]
    out[0, 1] -= z
    out[1, 0] += z
    out[0, 2] += y
    out[2, 0] -= y
    out[1, 2] -= x
    out[2, 1] += x


@jit
def rotation(w: Any, out: Any) -> None:
    """Rodrigues' formula, into the left (3, 3) of `out`."""
    angle2, sine, versine, _ = _sine_series(w)
    _turn(w, 1.0 - versine * angle2, versine, sine, out)


@jit
def _left_jacobian(w: Any, out: Any) -> None:
    """J with exp(w + dw) = exp(J dw) exp(w), (3, 3)."""
    angle2, _, versine, rest = _sine_series(w)
    _turn(w, 1.0 - rest * angle2, rest, versine, out)


@jit
def _chain(station: Any, placement: Any, pose: Any, to_station: Any, to_placement: Any) -> None:
    """pose = station @ placement, and the left perturbation of pose that a change of either vector makes, (6, 6) each.

    With R = R_s R_p and t = R_s t_p + t_s: dw = dw_s + R_s dw_p, dt = dw_s x (R_s t_p) + dt_s + R_s dt_p.
    """
    first, second = np.empty((3, 3)), np.empty((3, 3))
    left = np.empty((3, 3))
    rotation(station, first)
    rotation(placement, second)
    for j in range(3):
        for k in range(3):
            pose[j, k] = first[j, 0] * second[0, k] + first[j, 1] * second[1, k] + first[j, 2] * second[2, k]
        pose[j, 3] = first[j, 0] * placement[3] + first[j, 1] * placement[4] + first[j, 2] * placement[5]
    turned = (pose[0, 3], pose[1, 3], pose[2, 3])
    to_station[:] = 0.0
    to_placement[:] = 0.0
    _left_jacobian(station, left)
    for k in range(3):
        to_station[0, k], to_station[1, k], to_station[2, k] = left[0, k], left[1, k], left[2, k]
        to_station[3, k] = left[1, k] * turned[2] - left[2, k] * turned[1]
        to_station[4, k] = left[2, k] * turned[0] - left[0, k] * turned[2]
        to_station[5, k] = left[0, k] * turned[1] - left[1, k] * turned[0]
        to_station[3 + k, 3 + k] = 1.0
        pose[k, 3] += station[3 + k]
    _left_jacobian(placement, left)
    for j in range(3):
        for k in range(3):
            to_placement[j, k] = first[j, 0] * left[0, k] + first[j, 1] * left[1, k] + first[j, 2] * left[2, k]
            to_placement[3 + j, 3 + k] = first[j, k]


@jit
def _copy_plain(upper: Any, first: int, count: int, jacobian: Any) -> None:
    """Columns of U as the row-major Jacobian of one block; nothing where the block is held."""
    if len(jacobian) == 0:
        return
    jacobian[:] = 0.0
    for row in range(len(upper) - 1):
        for k in range(count):
            jacobian[count * row + k] = upper[row, first + k]


@jit
def _copy_chained(upper: Any, first: int, chain: Any, jacobian: Any) -> None:
    """U's pose columns times the chain rule, as the row-major Jacobian of one 6-vector block."""
    if len(jacobian) == 0:
        return
    jacobian[:] = 0.0
    for row in range(len(upper) - 1):
        for k in range(6):
            for j in range(6):
                jacobian[6 * row + k] += upper[row, first + j] * chain[j, k]


@jit
def evaluate_block(
    optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss, at: Blocks,
    residuals: Any, jacobians: Blocks,
) -> bool:  # fmt: skip
    """What Ceres asks of the block of one sight (design, section 6); False where an observation cannot be projected.

    Args:
        optics: `at.camera` replaces the free entries of its intrinsics. points, curves: of this sight alone.
        at: the free intrinsics, and the 6-vectors of cam_from_world and world_from_target; its structure is already in
            the columns.
        residuals: (free + structure + 7,): the rows of U, then what is missing from the robust cost.
        jacobians: row-major, as many rows x the block's size.
    """
    count, structure = len(unknowns.free), unknowns.structure
    shared = count + structure
    intrinsics = optics.intrinsics.copy()
    for k in range(count):
        intrinsics[unknowns.free[k]] = at.camera[k]
    pose, to_station, to_placement = np.empty((3, 4)), np.empty((6, 6)), np.empty((6, 6))
    _chain(at.station, at.placement, pose, to_station, to_placement)
    optics, order = prepared(optics, intrinsics), order_of_rows(unknowns, len(intrinsics))
    normal, upper = np.empty((shared + 7, shared + 7)), np.empty((shared + 7, shared + 7))
    space = working_space(optics, len(order.rows))
    last = shared + 6
    for newton in (True, False):
        cost = normal_equations(0, optics, pose, points, curves, loss, newton, order, normal, space)
        if not np.isfinite(cost):
            return False
        cholesky(normal, upper)
        missing = cost
        for row in range(last):
            residuals[row] = upper[row, last]
            missing -= upper[row, last] * upper[row, last]
        if missing > -ROUNDING * cost:  # else Newton's step promises more than there is
            break
    residuals[last] = np.sqrt(max(missing, 0.0))
    _copy_plain(upper, 0, count, jacobians.camera)
    _copy_plain(upper, count, structure, jacobians.structure)
    _copy_chained(upper, shared, to_station, jacobians.station)
    _copy_chained(upper, shared, to_placement, jacobians.placement)
    return True
