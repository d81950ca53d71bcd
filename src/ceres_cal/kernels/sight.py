"""All observations of one sight: residuals in measured pixels, robust weights, normal equations (design, 5 and 6).

The observations are walked in chunks laid out number by number, so that the compiler can use SIMD registers. The pose
columns are left perturbations in the camera frame, (dw x R X) + dt. `lenses` names the working arrays.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.jit import jit
from ceres_cal.kernels.lenses import answer_limit, distort, intrinsics_rows, one_dimensional
from ceres_cal.kernels.losses import robust_loss
from ceres_cal.kernels.panel import add_products, add_structure, bend_rows

CHUNK = 112  # a board of a hundred corners at once, all of it in the first cache
_POSE_ALONE = 7  # rows: nothing of the camera is free
_FOOT_STEPS = 30
_FOOT_TOLERANCE_PX = 1e-9


@jit
def to_camera(n: int, pose: Any, points: Any, rotated: Any, rays: Any) -> None:
    """rotated = R X and rays = R X + t of points (3, n); pose is (3, 4), [R t]."""
    for j in range(3):
        for i in range(n):
            rotated[j, i] = pose[j, 0] * points[0, i] + pose[j, 1] * points[1, i] + pose[j, 2] * points[2, i]
            rays[j, i] = rotated[j, i] + pose[j, 3]


@jit
def pose_rows(n: int, first: int, aspect: float, rotated: Any, image: Any, jacobian: Any) -> None:
    """Derivatives of the pixel with respect to a left perturbation of the pose: rotation, then translation."""
    for c in range(2):
        scale = 1.0 if c == 0 else aspect
        for i in range(n):
            dx = scale * (image[2, i] if c == 0 else image[3, i])
            dy = scale * (image[3, i] if c == 0 else image[4, i])
            dz = scale * image[5 + c, i]
            x, y, z = rotated[0, i], rotated[1, i], rotated[2, i]
            jacobian[first, c, i] = dz * y - dy * z
            jacobian[first + 1, c, i] = dx * z - dz * x
            jacobian[first + 2, c, i] = dy * x - dx * y
            jacobian[first + 3, c, i], jacobian[first + 4, c, i], jacobian[first + 5, c, i] = dx, dy, dz


@jit
def _on_curves(n: int, start: int, tracks: Any, is_arc: Any, track: Any, s: Any, points: Any, tangents: Any) -> None:
    """C(s) and dC/ds, (3, n) each: c + s a on a segment, c + a cos s + b sin s on an arc."""
    for i in range(n):
        k, value = track[start + i], s[start + i]
        f, g, df, dg = value, 0.0, 1.0, 0.0
        if is_arc[k]:
            f, g = np.cos(value), np.sin(value)
            df, dg = -g, f
        for j in range(3):
            points[j, i] = tracks[k, 0, j] + f * tracks[k, 1, j] + g * tracks[k, 2, j]
            tangents[j, i] = df * tracks[k, 1, j] + dg * tracks[k, 2, j]


@jit
def feet(
    lens: int, n: int, start: int, intrinsics: Any, dense: Any, unit: float, limit: float, pose: Any,
    tracks: Any, is_arc: Any, track: Any, pixels: Any, s: Any,
    points: Any, rotated: Any, rays: Any, image: Any, work: Any, foot: Any,
) -> bool:  # fmt: skip
    """Move s to the feet of the perpendiculars: tau . (project(C(s)) - p) = 0 (design, section 5).

    Gauss-Newton steps whose slope is corrected by the secant, so that the curve's own bend is seen without second
    derivatives. Leaves in `foot` (8, n): tau in px (0, 1), residual vector (2, 3), its dot product with tau (4), the
    previous s and dot product (5, 6), |tau|^2 (7).
    """
    aspect, cx, cy = intrinsics[1], intrinsics[2], intrinsics[3]
    for step in range(_FOOT_STEPS):
        _on_curves(n, start, tracks, is_arc, track, s, points, foot[8:])
        to_camera(n, pose, points, rotated, rays)
        if not distort(lens, n, intrinsics, dense, unit, limit, rays, image, work):
            return False
        worst = 0.0
        for i in range(n):
            tx, ty, tz = foot[8, i], foot[9, i], foot[10, i]
            x = pose[0, 0] * tx + pose[0, 1] * ty + pose[0, 2] * tz
            y = pose[1, 0] * tx + pose[1, 1] * ty + pose[1, 2] * tz
            z = pose[2, 0] * tx + pose[2, 1] * ty + pose[2, 2] * tz
            tau_x = image[2, i] * x + image[3, i] * y + image[5, i] * z
            tau_y = aspect * (image[3, i] * x + image[4, i] * y + image[6, i] * z)
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


@jit
def _add_points(
    lens: int, intrinsics: Any, powers: Any, dense: Any, unit: float, limit: float, pose: Any, points: Any, pixels: Any,
    weights: Any, slots: Any, bends: Any, loss: int, scale: float, newton: bool, rows: Any, places: Any,
    normal: Any, products: Any, jacobian: Any, panel: Any, scratch: Any,
) -> float:  # fmt: skip
    """Sum of rho over the point observations, NaN where one cannot be projected; their share of `normal`."""
    last = len(rows) - 1
    local, rotated, rays, image, work = scratch[:3], scratch[3:6], scratch[6:9], scratch[9:16], scratch[16:21]
    cost = 0.0
    for start in range(0, len(points), CHUNK):
        n = min(CHUNK, len(points) - start)
        for i in range(n):
            for j in range(3):
                local[j, i] = points[start + i, j]
        to_camera(n, pose, local, rotated, rays)
        if not distort(lens, n, intrinsics, dense, unit, limit, rays, image, work):
            return np.nan
        error_x, error_y, factor, squared = panel[last, :n], panel[last, n : 2 * n], local[0], local[1]
        for i in range(n):
            w = weights[start + i]
            dx = w * (intrinsics[2] + image[0, i] - pixels[start + i, 0])
            dy = w * (intrinsics[3] + intrinsics[1] * image[1, i] - pixels[start + i, 1])
            squared[i] = dx * dx + dy * dy
            rho, slope = robust_loss(loss, scale, squared[i])
            cost += rho
            root = np.sqrt(slope)
            error_x[i], error_y[i] = root * dx, root * dy
            factor[i] = root * w
        if len(rows) > _POSE_ALONE:
            intrinsics_rows(lens, n, intrinsics, powers, unit, image, work, jacobian)
        pose_rows(n, len(intrinsics), intrinsics[1], rotated, image, jacobian)
        for k in range(last):
            own, x, y = jacobian[rows[k]], panel[k, :n], panel[k, n : 2 * n]  # whole rows: SIMD needs plain indices
            for i in range(n):
                x[i], y[i] = factor[i] * own[0, i], factor[i] * own[1, i]
        if newton:
            bend_rows(n, 2, loss, scale, squared, last, panel)
        add_products(2 * n, len(rows), panel, products)
        if len(slots) > 0:
            directions, columns = np.eye(4, 3), np.empty((4, 2))
            for i in range(n):
                directions[2, 2], directions[3, 2] = bends[start + i, 0], bends[start + i, 1]
                add_structure(i, n, 2, slots[start + i], directions, pose, places, panel, columns, normal)
    return cost


@jit
def _curve_directions(i: int, k: int, tracks: Any, is_arc: Any, foot: Any, directions: Any) -> None:
    """Where the foot on track k goes: to the left of a segment; with the centre and outwards on an arc."""
    if is_arc[k]:
        directions[0, 0], directions[0, 1] = 1.0, 0.0
        # The tangent's right side is outside; turned by a quarter it is the radius' own direction.
        length = np.sqrt(foot[8, i] * foot[8, i] + foot[9, i] * foot[9, i])
        directions[2, 0], directions[2, 1], directions[2, 2] = foot[9, i] / length, -foot[8, i] / length, 0.0
    else:
        x, y = tracks[k, 1, 0], tracks[k, 1, 1]
        length = np.sqrt(x * x + y * y) + 1e-300
        directions[0, 0], directions[0, 1] = -y / length, x / length


@jit
def _add_curves(
    lens: int, intrinsics: Any, powers: Any, dense: Any, unit: float, limit: float, pose: Any, tracks: Any,
    is_arc: Any, track: Any, pixels: Any, weights: Any, s: Any, track_slots: Any, loss: int, scale: float, newton: bool,
    rows: Any, places: Any, normal: Any, products: Any, jacobian: Any, panel: Any, scratch: Any,
) -> float:  # fmt: skip
    """The same for the curve observations: one residual each, the distance along the image normal at the foot.

    By the envelope theorem its derivative is that of the projected foot with s held, along the normal.
    """
    last = len(rows) - 1
    local, rotated, rays, image, work, foot = (
        scratch[:3], scratch[3:6], scratch[6:9], scratch[9:16], scratch[16:21], scratch[21:],
    )  # fmt: skip
    cost = 0.0
    for start in range(0, len(pixels), CHUNK):
        n = min(CHUNK, len(pixels) - start)
        if not feet(
            lens, n, start, intrinsics, dense, unit, limit, pose, tracks, is_arc, track, pixels, s,
            local, rotated, rays, image, work, foot,
        ):  # fmt: skip
            return np.nan
        for i in range(n):
            length = np.sqrt(foot[7, i])
            nx, ny = -foot[1, i] / length, foot[0, i] / length
            e = weights[start + i] * (nx * foot[2, i] + ny * foot[3, i])
            local[2, i] = e * e
            rho, slope = robust_loss(loss, scale, e * e)
            cost += rho
            root = np.sqrt(slope)
            panel[last, i] = root * e
            local[0, i], local[1, i] = root * weights[start + i] * nx, root * weights[start + i] * ny
        if len(rows) > _POSE_ALONE:
            intrinsics_rows(lens, n, intrinsics, powers, unit, image, work, jacobian)
        pose_rows(n, len(intrinsics), intrinsics[1], rotated, image, jacobian)
        for k in range(last):
            own, x = jacobian[rows[k]], panel[k]
            for i in range(n):
                x[i] = local[0, i] * own[0, i] + local[1, i] * own[1, i]
        if newton:
            bend_rows(n, 1, loss, scale, local[2], last, panel)
        add_products(n, len(rows), panel, products)
        if len(track_slots) > 0:
            directions, columns = np.eye(3, 3), np.empty((3, 2))
            for i in range(n):
                _curve_directions(i, track[start + i], tracks, is_arc, foot, directions)
                add_structure(i, n, 1, track_slots[track[start + i]], directions, pose, places, panel, columns, normal)
    return cost


@jit
def layout_of_rows(free: Any, intrinsics: int, structure: int) -> tuple[Any, Any]:
    """(rows, places) as `normal_equations` takes them: A is [free intrinsics | structure | 6 pose | residual]."""
    count = len(free)
    rows, places = np.empty(count + 7, np.int64), np.empty(count + 7, np.int64)
    rows[:count] = free
    rows[count:] = np.arange(intrinsics, intrinsics + 7)
    places[:count] = np.arange(count)
    places[count:] = np.arange(count + structure, count + structure + 7)
    return rows, places


@jit
def working_space(intrinsics: int, rows: int) -> tuple[Any, Any, Any, Any]:
    """Where `normal_equations` works: the chunk's Jacobian, its weighted rows, their products, and what leads there."""
    return (
        np.empty((intrinsics + 6, 2, CHUNK)),
        np.zeros((rows + 3, 2 * CHUNK)),
        np.empty((rows + 3, rows + 3)),
        np.empty((32, CHUNK)),
    )


@jit
def normal_equations(
    lens: int, intrinsics: Any, powers: Any, dense: Any, limit: float, unit: float, pose: Any, points: Any,
    pixels: Any, weights: Any, slots: Any, bends: Any, tracks: Any, is_arc: Any, track: Any, curve_pixels: Any,
    curve_weights: Any, s: Any, track_slots: Any, loss: int, scale: float, newton: bool, rows: Any, places: Any,
    normal: Any, space: Any,
) -> float:  # fmt: skip
    """Sum of rho over one sight, NaN where an observation cannot be projected; A added up in `normal`'s lower triangle.

    Args:
        lens: a LENS_CODES value; intrinsics: phi, aspect, cx, cy, scaled coefficients; powers: those of the
            one-dimensional map of the lens, dense: that map, limit: its `answer_limit`; unit: half the image diagonal,
            px; pose: (3, 4) [R t] of cam_from_frame.
        points (N, 3) m, pixels (N, 2), weights (N,) = 1 / (noise scale * sigma).
        tracks (T, 3, 3), is_arc (T,), track (M,) index into tracks, curve_pixels (M, 2), curve_weights (M,),
            s (M,): place on the track, read as a start and left at the foot.
        slots (N, 4) with bends (N, 2), and track_slots (T, 3): the structure numbers that move each point and track,
            -1 for none; empty without structure (see `structure.Structure`).
        loss, scale: a LOSS_CODES value and its scale in standard deviations. newton: whether A takes rho'' along, for
            a step, or rho' alone, as the weight that each observation has.
        rows: which numbers take part: indices into [intrinsics | 6 pose | residual], the last one the residual's.
        places: their rows in A; structure numbers come after the intrinsics, before the pose.
        space: from `working_space`, used again and again.
    """
    jacobian, panel, products, scratch = space
    products[:] = 0.0
    normal[:] = 0.0
    cost = 0.0
    if len(points) > 0:
        cost += _add_points(
            lens, intrinsics, powers, dense, unit, limit, pose, points, pixels, weights, slots, bends, loss, scale,
            newton, rows, places, normal, products, jacobian, panel, scratch,
        )  # fmt: skip
    if len(curve_pixels) > 0:
        cost += _add_curves(
            lens, intrinsics, powers, dense, unit, limit, pose, tracks, is_arc, track, curve_pixels, curve_weights, s,
            track_slots, loss, scale, newton, rows, places, normal, products, jacobian, panel, scratch,
        )  # fmt: skip
    for k in range(len(rows)):
        for j in range(k + 1):
            normal[places[k], places[j]] += products[k, j]
    return cost


@jit
def point_residuals(
    lens: int, intrinsics: Any, powers: Any, unit: float, poses: Any, bounds: Any, points: Any, pixels: Any,
    rows: Any, residuals: Any,
) -> None:  # fmt: skip
    """project(X) - p in px of the sights at poses (S, 3, 4), to `rows` of `residuals`; NaN where there is none."""
    scratch = np.empty((21, CHUNK))
    dense = one_dimensional(lens, intrinsics, powers)
    limit = answer_limit(lens, dense)
    for v in range(len(poses)):
        for start in range(bounds[v], bounds[v + 1], CHUNK):
            stop = min(start + CHUNK, bounds[v + 1])
            if not _chunk_residuals(
                start, stop, lens, intrinsics, dense, unit, limit, poses[v], points, pixels, scratch, rows, residuals
            ):
                for k in range(start, stop):
                    if not _chunk_residuals(
                        k, k + 1, lens, intrinsics, dense, unit, limit, poses[v], points, pixels, scratch, rows,
                        residuals,
                    ):  # fmt: skip
                        residuals[rows[k]] = np.nan


@jit
def _chunk_residuals(
    start: int, stop: int, lens: int, intrinsics: Any, dense: Any, unit: float, limit: float, pose: Any, points: Any,
    pixels: Any, scratch: Any, rows: Any, residuals: Any,
) -> bool:  # fmt: skip
    """The same for some points of one sight; False where any of them cannot be projected."""
    n, image = stop - start, scratch[9:16]
    for i in range(n):
        for j in range(3):
            scratch[j, i] = points[start + i, j]
    to_camera(n, pose, scratch[:3], scratch[3:6], scratch[6:9])
    if not distort(lens, n, intrinsics, dense, unit, limit, scratch[6:9], image, scratch[16:]):
        return False
    for i in range(n):
        row = rows[start + i]
        residuals[row, 0] = intrinsics[2] + image[0, i] - pixels[start + i, 0]
        residuals[row, 1] = intrinsics[3] + intrinsics[1] * image[1, i] - pixels[start + i, 1]
    return True


@jit
def curve_residuals(
    lens: int, intrinsics: Any, powers: Any, unit: float, poses: Any, bounds: Any, tracks: Any, is_arc: Any,
    track: Any, pixels: Any, s: Any, residuals: Any,
) -> None:  # fmt: skip
    """Signed distance from each pixel to its curve in px, (M,), and s moved to the foot; NaN where there is none."""
    scratch = np.empty((32, CHUNK))
    dense = one_dimensional(lens, intrinsics, powers)
    limit = answer_limit(lens, dense)
    for v in range(len(poses)):
        for start in range(bounds[v], bounds[v + 1], CHUNK):
            stop = min(start + CHUNK, bounds[v + 1])
            if not _chunk_distances(
                start, stop, lens, intrinsics, dense, unit, limit, poses[v], tracks, is_arc, track, pixels, s, scratch,
                residuals,
            ):  # fmt: skip
                for k in range(start, stop):
                    if not _chunk_distances(
                        k, k + 1, lens, intrinsics, dense, unit, limit, poses[v], tracks, is_arc, track, pixels, s,
                        scratch, residuals,
                    ):  # fmt: skip
                        residuals[k] = np.nan


@jit
def _chunk_distances(
    start: int, stop: int, lens: int, intrinsics: Any, dense: Any, unit: float, limit: float, pose: Any, tracks: Any,
    is_arc: Any, track: Any, pixels: Any, s: Any, scratch: Any, residuals: Any,
) -> bool:  # fmt: skip
    """The same for some curve observations of one sight; False where any of them has no foot."""
    foot = scratch[21:]
    if not feet(
        lens, stop - start, start, intrinsics, dense, unit, limit, pose, tracks, is_arc, track, pixels, s,
        scratch[:3], scratch[3:6], scratch[6:9], scratch[9:16], scratch[16:21], foot,
    ):  # fmt: skip
        return False
    for i in range(stop - start):
        distance = foot[0, i] * foot[3, i] - foot[1, i] * foot[2, i]
        residuals[start + i] = distance / np.sqrt(foot[7, i])
    return True
