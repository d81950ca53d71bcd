"""Many placements that only one station sees each: their poses are eliminated from the problem (variable projection).

For given intrinsics each pose is brought to its own best value, and what is left of the normal equations, the Schur
complement A_cc - A_cp A_pp^-1 A_pc, speaks of what all sights share: the free intrinsics and the structure. Near the
best pose one evaluation per sight is enough: the complement takes the rest of the step, and its cost, along.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.arguments import CurveColumns, Loss, Optics, PointColumns, Sweep, Unknowns
from ceres_cal.kernels.block import rotation
from ceres_cal.kernels.jit import borrowing, jit
from ceres_cal.kernels.lenses import add_multiple, prepared
from ceres_cal.kernels.panel import order_of_rows
from ceres_cal.kernels.sight import normal_equations
from ceres_cal.kernels.workspace import working_space

_MOST_STEPS = 50
_NOTHING_LEFT = 1e-14  # squared standard deviations


@jit
def _move(pose: Any, step: Any, turned: Any, moved: Any) -> None:
    """moved = the pose after a left perturbation: R <- exp(dw) R, t <- t + dt."""
    rotation(step, turned)
    for j in range(3):
        for k in range(3):
            moved[j, k] = turned[j, 0] * pose[0, k] + turned[j, 1] * pose[1, k] + turned[j, 2] * pose[2, k]
        moved[j, 3] = pose[j, 3] + step[3 + j]


@jit
def _solve_pose(normal: Any, count: int, damping: float, lower: Any, gain: Any) -> None:
    """gain (6, count + 1) = A_pp^-1 [A_pc A_pe] by Cholesky; a direction that nothing fixes is left where it is.

    `normal` has its lower triangle filled, in the order [count intrinsics | 6 pose | residual]. `lower` is Cholesky's
    factor with its diagonal inverted: a product is cheaper than a quotient.
    """
    for k in range(6):
        for i in range(k, 6):
            total = normal[count + i, count + k] * (1.0 + damping if i == k else 1.0)
            for j in range(k):
                total -= lower[i, j] * lower[k, j]
            if i == k:
                held = not total > 1e-13 * normal[count + k, count + k]
                lower[k, k] = 0.0 if held else 1.0 / np.sqrt(total)
            else:
                lower[i, k] = total * lower[k, k]
    for k in range(6):
        own, known = gain[k, :count], normal[count + k, :count]
        for column in range(count):
            own[column] = known[column]
        gain[k, count] = normal[count + 6, count + k]
        for j in range(k):
            add_multiple(count + 1, -lower[k, j], gain[j], gain[k])
        _scaled(count + 1, lower[k, k], gain[k])
    for k in range(5, -1, -1):
        for j in range(k + 1, 6):
            add_multiple(count + 1, -lower[j, k], gain[j], gain[k])
        _scaled(count + 1, lower[k, k], gain[k])


@borrowing
def _scaled(n: int, factor: float, own: Any) -> None:
    """own *= factor."""
    for i in range(n):
        own[i] *= factor


@borrowing
def _add_complement(count: int, normal: Any, gain: Any, reduced: Any) -> None:
    """reduced += A_cc - A_cp A_pp^-1 A_pc, lower triangle, the residual's row last."""
    p = normal[count : count + 6]
    for i in range(count + 1):
        own, row = reduced[i], normal[count + 6 if i == count else i]
        a, b, c, d, e, f = gain[0, i], gain[1, i], gain[2, i], gain[3, i], gain[4, i], gain[5, i]
        for j in range(min(i + 1, count)):
            own[j] += row[j] - (a * p[0, j] + b * p[1, j] + c * p[2, j] + d * p[3, j] + e * p[4, j] + f * p[5, j])
    last = normal[count + 6]
    left = last[count + 6]
    for k in range(6):
        left -= gain[k, count] * last[count + k]
    reduced[count, count] += left


@jit
def eliminate_placements(
    first: int, last: int, optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss,
    newton: bool, tolerance: float, change: Any, sweep: Sweep,
) -> None:  # fmt: skip
    """The sights first to last at their best poses: their costs, and what they say of the free intrinsics.

    Args:
        newton: see `normal_equations`.
        tolerance: how much of a sight's cost a step of its pose may still promise when it is left to the complement.
        change: (free + structure,) by how much these have moved since the poses and gains of `sweep` were made.
        sweep: poses, moved (left alone where an observation cannot be projected), gains, renewed, costs, filled, and
            reduced, the complement, added up.
    """
    poses, gains, costs, reduced = sweep.poses, sweep.gains, sweep.costs, sweep.reduced
    count = len(unknowns.free) + unknowns.structure
    optics, order = prepared(optics, optics.intrinsics), order_of_rows(unknowns, len(optics.intrinsics))
    normal, trial = np.empty((count + 7, count + 7)), np.empty((count + 7, count + 7))
    space = working_space(optics, len(order.rows))
    lower, gain = np.empty((6, 6)), np.empty((6, count + 1))
    turned, step, pose, moved = np.empty((3, 3)), np.empty(6), np.empty((3, 4)), np.empty((3, 4))
    for v in range(first, last):
        for k in range(6):
            step[k] = 0.0
            for j in range(count):
                step[k] -= gains[v, k, j] * change[j]
        _move(poses[v], step, turned, moved)
        cost, promise, damping = np.inf, np.inf, 0.0
        for _ in range(_MOST_STEPS):
            moved_cost = normal_equations(v, optics, moved, points, curves, loss, newton, order, trial, space)
            if moved_cost <= cost:
                pose, moved, normal, trial, cost, damping = moved, pose, trial, normal, moved_cost, 0.1 * damping
            elif not np.isfinite(cost) or promise <= 1e-12 * cost:
                break  # nothing to be seen from where it starts; rounding
            else:
                damping = max(1e-3, 10.0 * damping)
            _solve_pose(normal, count, damping, lower, gain)
            promise = 0.0
            for k in range(6):
                step[k] = -gain[k, count]
                promise -= step[k] * normal[count + 6, count + k]
            if promise <= max(tolerance * cost, _NOTHING_LEFT):
                break
            _move(pose, step, turned, moved)
        if not np.isfinite(cost):
            costs[v] = np.inf
            continue
        if damping > 0.0:
            _solve_pose(normal, count, 0.0, lower, gain)
            promise = 0.0
            for k in range(6):
                promise += gain[k, count] * normal[count + 6, count + k]
            for k in range(6):
                step[k] = -gain[k, count] if promise <= 1e-2 * cost else 0.0
        _move(pose, step, turned, poses[v])
        gains[v] = gain[:, :count]
        _add_complement(count, normal, gain, reduced)
        costs[v] = cost - max(promise, 0.0)
