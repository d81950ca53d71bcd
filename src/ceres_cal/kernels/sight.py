"""All observations of one sight: residuals in measured pixels, robust weights, normal equations (design, 5 and 6).

The observations are walked in chunks laid out number by number, so that the compiler can use SIMD registers. The pose
columns are left perturbations in the camera frame, (dw x R X) + dt.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.arguments import BUILT, CurveColumns, Loss, Optics, PointColumns
from ceres_cal.kernels.jit import borrowing, jit
from ceres_cal.kernels.lenses import distort, intrinsics_rows, prepared
from ceres_cal.kernels.losses import robust_loss
from ceres_cal.kernels.panel import Order, add_products, add_structure, bend_rows, product_of, shows
from ceres_cal.kernels.workspace import CHUNK, Workspace, working_space

_FOOT_STEPS = 30
_FOOT_TOLERANCE_PX = 1e-9


@borrowing
def to_camera(n: int, pose: Any, space: Workspace) -> None:
    """R X and R X + t of the local points; pose is (3, 4), [R t]."""
    points, rotated, rays = space.local, space.rotated, space.rays
    for j in range(3):
        for i in range(n):
            rotated[j, i] = pose[j, 0] * points[0, i] + pose[j, 1] * points[1, i] + pose[j, 2] * points[2, i]
            rays[j, i] = rotated[j, i] + pose[j, 3]


@borrowing
def shown_points(n: int, start: int, optics: Optics, pose: Any, points: PointColumns, space: Workspace) -> bool:
    """The image of a chunk of points; False where any of them cannot be projected."""
    places, local = points.places, space.local
    for i in range(n):
        for j in range(3):
            local[j, i] = places[start + i, j]
    to_camera(n, pose, space)
    return distort(n, optics, space.rays, space.image, space.work)


@borrowing
def jacobian_rows(n: int, optics: Optics, space: Workspace, alone: bool) -> None:
    """Derivatives of the chunk's pixels with respect to the intrinsics (but not where the pose alone is free), and to a
    left perturbation of the pose: rotation, then translation.
    """
    if not alone:
        intrinsics_rows(n, optics, space.image, space.work, space.jacobian)
    first, aspect = len(optics.intrinsics), optics.intrinsics[1]
    rotated, image, jacobian = space.rotated, space.image, space.jacobian
    for c in range(2):
        scale = 1.0 if c == 0 else aspect
        for i in range(n):
            dx = scale * (image[2, i] if c == 0 else image[3, i] + image[7, i])
            dy = scale * (image[3, i] if c == 0 else image[4, i])
            dz = scale * image[5 + c, i]
            x, y, z = rotated[0, i], rotated[1, i], rotated[2, i]
            jacobian[first, c, i] = dz * y - dy * z
            jacobian[first + 1, c, i] = dx * z - dz * x
            jacobian[first + 2, c, i] = dy * x - dx * y
            jacobian[first + 3, c, i], jacobian[first + 4, c, i], jacobian[first + 5, c, i] = dx, dy, dz


@borrowing
def _on_curves(n: int, start: int, curves: CurveColumns, space: Workspace) -> None:
    """C(s) and dC/ds: c + s a on a segment, c + a cos s + b sin s on an arc."""
    tracks, is_arc, track, s, points, tangents = (
        curves.tracks, curves.is_arc, curves.track, curves.feet, space.local, space.tangents,
    )  # fmt: skip
    for i in range(n):
        k, value = track[start + i], s[start + i]
        f, g, df, dg = value, 0.0, 1.0, 0.0
        if is_arc[k]:
            f, g = np.cos(value), np.sin(value)
            df, dg = -g, f
        for j in range(3):
            points[j, i] = tracks[k, 0, j] + f * tracks[k, 1, j] + g * tracks[k, 2, j]
            tangents[j, i] = df * tracks[k, 1, j] + dg * tracks[k, 2, j]


@borrowing
def move_to_feet(n: int, start: int, optics: Optics, pose: Any, curves: CurveColumns, space: Workspace) -> bool:
    """Move s to the feet of the perpendiculars: tau . (project(C(s)) - p) = 0 (design, section 5).

    Gauss-Newton steps whose slope is corrected by the secant, so that the curve's own bend is seen without second
    derivatives. False where any curve cannot be projected.
    """
    aspect, cx, cy = optics.intrinsics[1], optics.intrinsics[2], optics.intrinsics[3]
    pixels, s, image, tangents, foot = curves.pixels, curves.feet, space.image, space.tangents, space.foot
    for step in range(_FOOT_STEPS):
        _on_curves(n, start, curves, space)
        to_camera(n, pose, space)
        if not distort(n, optics, space.rays, image, space.work):
            return False
        worst = 0.0
        for i in range(n):
            tx, ty, tz = tangents[0, i], tangents[1, i], tangents[2, i]
            x = pose[0, 0] * tx + pose[0, 1] * ty + pose[0, 2] * tz
            y = pose[1, 0] * tx + pose[1, 1] * ty + pose[1, 2] * tz
            z = pose[2, 0] * tx + pose[2, 1] * ty + pose[2, 2] * tz
            tau_x = image[2, i] * x + image[3, i] * y + image[5, i] * z
            tau_y = aspect * ((image[3, i] + image[7, i]) * x + image[4, i] * y + image[6, i] * z)
            dx = cx + image[0, i] - pixels[start + i, 0]
            dy = cy + aspect * image[1, i] - pixels[start + i, 1]
            along, length2 = tau_x * dx + tau_y * dy, tau_x * tau_x + tau_y * tau_y
            slope = length2
            if step > 0 and s[start + i] != foot[5, i]:
                secant = (along - foot[6, i]) / (s[start + i] - foot[5, i])
                slope = max(0.25 * length2, min(secant, 4.0 * length2))
            foot[0, i], foot[1, i], foot[2, i], foot[3, i] = tau_x, tau_y, dx, dy
            foot[5, i], foot[6, i], foot[7, i] = s[start + i], along, length2
            foot[4, i] = max(-0.5, min(-along / slope, 0.5))
            worst = max(worst, abs(foot[4, i]) * np.sqrt(length2))
        if worst < _FOOT_TOLERANCE_PX:
            break
        for i in range(n):
            s[start + i] += foot[4, i]
    return True


# ---- one sight ------------------------------------------------------------------------------------------------------


@borrowing
def _rows_shown(n: int, optics: Optics, order: Order, space: Workspace) -> int:
    """The chunk's Jacobian, and which of its rows take part; the answer is which of these is the residual's, the last.
    What the chunk shows nothing of, most of a lens that has its numbers place by place, is left out.
    """
    rows, places = space.rows, space.places
    jacobian_rows(n, optics, space, order.free == 0)
    count = 0
    for k in range(len(order.rows)):
        if k >= order.free or shows(n, space.jacobian[order.rows[k]]):
            rows[count], places[count] = order.rows[k], order.places[k]
            count += 1
    return count - 1


@borrowing
def _add_points(
    sight: int, optics: Optics, pose: Any, points: PointColumns, loss: Loss, newton: bool, order: Order,
    normal: Any, space: Workspace,
) -> float:  # fmt: skip
    """Sum of rho over the point observations, NaN where one cannot be projected; their share of `normal`."""
    intrinsics, pixels, weights = optics.intrinsics, points.pixels, points.weights
    image, jacobian, panel, rows = space.image, space.jacobian, space.panel, space.rows
    cost = 0.0
    for start in range(points.bounds[sight], points.bounds[sight + 1], CHUNK):
        n = min(CHUNK, points.bounds[sight + 1] - start)
        if not shown_points(n, start, optics, pose, points, space):
            return np.nan
        last = _rows_shown(n, optics, order, space)
        error_x, error_y, factor, squared = panel[last, :n], panel[last, n : 2 * n], space.local[0], space.local[1]
        for i in range(n):
            w = weights[start + i]
            dx = w * (intrinsics[2] + image[0, i] - pixels[start + i, 0])
            dy = w * (intrinsics[3] + intrinsics[1] * image[1, i] - pixels[start + i, 1])
            squared[i] = dx * dx + dy * dy
            rho, slope = robust_loss(loss, squared[i])
            cost += rho
            root = np.sqrt(slope)
            error_x[i], error_y[i] = root * dx, root * dy
            factor[i] = root * w
        for k in range(last):
            own = jacobian[rows[k]]
            product_of(n, factor, own[0], panel[k])
            product_of(n, factor, own[1], panel[k, n:])
        if newton:
            bend_rows(n, 2, loss, squared, last, panel)
        add_products(2 * n, last + 1, space, normal)
        if len(points.slots) > 0:
            directions = space.directions
            directions[:] = 0.0
            directions[0, 0], directions[1, 1] = 1.0, 1.0
            for i in range(n):
                for k in range(BUILT - 2):
                    directions[2 + k, 2] = points.bends[start + i, k]
                slots = points.slots[start + i]
                add_structure(i, n, 2, slots, pose, order.free, last, space, normal)
    return cost


@borrowing
def curve_directions(i: int, k: int, curves: CurveColumns, tangents: Any, directions: Any) -> None:
    """Where the foot on track k goes: to the left of a segment; with the centre and outwards on an arc."""
    if curves.is_arc[k]:
        directions[0, 0], directions[0, 1] = 1.0, 0.0
        # The tangent's right side is outside; turned by a quarter it is the radius' own direction.
        length = np.sqrt(tangents[0, i] * tangents[0, i] + tangents[1, i] * tangents[1, i])
        directions[2, 0], directions[2, 1], directions[2, 2] = tangents[1, i] / length, -tangents[0, i] / length, 0.0
    else:
        x, y = curves.tracks[k, 1, 0], curves.tracks[k, 1, 1]
        length = np.sqrt(x * x + y * y) + 1e-300
        directions[0, 0], directions[0, 1] = -y / length, x / length


@borrowing
def _add_curves(
    sight: int, optics: Optics, pose: Any, curves: CurveColumns, loss: Loss, newton: bool, order: Order,
    normal: Any, space: Workspace,
) -> float:  # fmt: skip
    """The same for the curve observations: one residual each, the distance along the image normal at the foot.

    By the envelope theorem its derivative is that of the projected foot with s held, along the normal.
    """
    rows, weights, track = space.rows, curves.weights, curves.track
    local, foot, jacobian, panel = space.local, space.foot, space.jacobian, space.panel
    cost = 0.0
    for start in range(curves.bounds[sight], curves.bounds[sight + 1], CHUNK):
        n = min(CHUNK, curves.bounds[sight + 1] - start)
        if not move_to_feet(n, start, optics, pose, curves, space):
            return np.nan
        last = _rows_shown(n, optics, order, space)
        for i in range(n):
            length = np.sqrt(foot[7, i])
            nx, ny = -foot[1, i] / length, foot[0, i] / length
            e = weights[start + i] * (nx * foot[2, i] + ny * foot[3, i])
            local[2, i] = e * e
            rho, slope = robust_loss(loss, e * e)
            cost += rho
            root = np.sqrt(slope)
            panel[last, i] = root * e
            local[0, i], local[1, i] = root * weights[start + i] * nx, root * weights[start + i] * ny
        for k in range(last):
            own, x = jacobian[rows[k]], panel[k]
            for i in range(n):
                x[i] = local[0, i] * own[0, i] + local[1, i] * own[1, i]
        if newton:
            bend_rows(n, 1, loss, local[2], last, panel)
        add_products(n, last + 1, space, normal)
        if len(curves.slots) > 0:
            directions = space.directions
            directions[:] = 0.0
            directions[0, 0], directions[1, 1], directions[2, 2] = 1.0, 1.0, 1.0
            for i in range(n):
                k = track[start + i]
                curve_directions(i, k, curves, space.tangents, directions)
                add_structure(i, n, 1, curves.slots[k], pose, order.free, last, space, normal)
    return cost


@borrowing
def normal_equations(
    sight: int, optics: Optics, pose: Any, points: PointColumns, curves: CurveColumns, loss: Loss, newton: bool,
    order: Order, normal: Any, space: Workspace,
) -> float:  # fmt: skip
    """Sum of rho over one sight, NaN where an observation cannot be projected; A added up in `normal`'s lower triangle.

    Args:
        sight: its number in the columns. optics: prepared. pose: (3, 4) [R t] of cam_from_frame.
        newton: whether A takes rho'' along, for a step, or rho' alone, as the weight that each observation has.
        order: see `order_of_rows`; structure numbers come after the intrinsics, before the pose.
    """
    normal[:] = 0.0
    cost = 0.0
    if points.bounds[sight + 1] > points.bounds[sight]:
        cost += _add_points(sight, optics, pose, points, loss, newton, order, normal, space)
    if curves.bounds[sight + 1] > curves.bounds[sight]:
        cost += _add_curves(sight, optics, pose, curves, loss, newton, order, normal, space)
    return cost


@jit
def point_residuals(
    first: int, last: int, optics: Optics, poses: Any, points: PointColumns, rows: Any, residuals: Any
) -> None:
    """project(X) - p in px of the sights first to last at poses (S, 3, 4), to `rows` of `residuals`; NaN where there is
    none.
    """
    optics = prepared(optics, optics.intrinsics)
    space = working_space(optics, 0)
    for v in range(first, last):
        for start in range(points.bounds[v], points.bounds[v + 1], CHUNK):
            n = min(CHUNK, points.bounds[v + 1] - start)
            if not _chunk_residuals(n, start, optics, poses[v], points, space, rows, residuals):
                for k in range(start, start + n):
                    if not _chunk_residuals(1, k, optics, poses[v], points, space, rows, residuals):
                        residuals[rows[k]] = np.nan


@jit
def _chunk_residuals(
    n: int, start: int, optics: Optics, pose: Any, points: PointColumns, space: Workspace, rows: Any, residuals: Any
) -> bool:
    """The same for some points of one sight; False where any of them cannot be projected."""
    if not shown_points(n, start, optics, pose, points, space):
        return False
    intrinsics, image, pixels = optics.intrinsics, space.image, points.pixels
    for i in range(n):
        row = rows[start + i]
        residuals[row, 0] = intrinsics[2] + image[0, i] - pixels[start + i, 0]
        residuals[row, 1] = intrinsics[3] + intrinsics[1] * image[1, i] - pixels[start + i, 1]
    return True


@jit
def curve_residuals(optics: Optics, poses: Any, curves: CurveColumns, residuals: Any) -> None:
    """Signed distance from each pixel to its curve in px, (M,), and s moved to the foot; NaN where there is none."""
    optics = prepared(optics, optics.intrinsics)
    space = working_space(optics, 0)
    for v in range(len(poses)):
        for start in range(curves.bounds[v], curves.bounds[v + 1], CHUNK):
            n = min(CHUNK, curves.bounds[v + 1] - start)
            if not _chunk_distances(n, start, optics, poses[v], curves, space, residuals):
                for k in range(start, start + n):
                    if not _chunk_distances(1, k, optics, poses[v], curves, space, residuals):
                        residuals[k] = np.nan


@jit
def _chunk_distances(
    n: int, start: int, optics: Optics, pose: Any, curves: CurveColumns, space: Workspace, residuals: Any
) -> bool:
    """The same for some curve observations of one sight; False where any of them has no foot."""
    if not move_to_feet(n, start, optics, pose, curves, space):
        return False
    foot = space.foot
    for i in range(n):
        distance = foot[0, i] * foot[3, i] - foot[1, i] * foot[2, i]
        residuals[start + i] = distance / np.sqrt(foot[7, i])
    return True
