"""The normal equations of many sights where they stand: what each one says, nothing moved."""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.jit import jit
from ceres_cal.kernels.lenses import answer_limit, one_dimensional
from ceres_cal.kernels.sight import layout_of_rows, normal_equations, working_space


@jit
def sight_normals(
    first: int, last: int, lens: int, intrinsics: Any, free: Any, powers: Any, unit: float,
    bounds: Any, pixels: Any, weights: Any, slots: Any, bends: Any,
    is_arc: Any, curve_bounds: Any, track: Any, curve_pixels: Any, curve_weights: Any, s: Any, track_slots: Any,
    loss: int, scale: float, newton: bool, points: Any, tracks: Any, structure: int, poses: Any, units: Any,
    normals: Any,
) -> bool:  # fmt: skip
    """False where an observation cannot be projected; else J^T W J of the sights first to last, each by itself.

    Args:
        normals: (last - first, n, n) with n = free + structure + 6: free intrinsics, structure, left perturbation of
            the pose, each multiplied with its one of `units` (n,). Everything else as in
            `elimination.eliminate_placements`.
    """
    size = len(free) + structure + 6
    rows, places = layout_of_rows(free, len(intrinsics), structure)
    dense = one_dimensional(lens, intrinsics, powers)
    limit = answer_limit(lens, dense)
    normal, space = np.empty((size + 1, size + 1)), working_space(len(intrinsics), len(rows))
    for v in range(first, last):
        p, c = slice(bounds[v], bounds[v + 1]), slice(curve_bounds[v], curve_bounds[v + 1])
        moving = p if len(slots) > 0 else slice(0, 0)
        cost = normal_equations(
            lens, intrinsics, powers, dense, limit, unit, poses[v], points[p], pixels[p], weights[p], slots[moving],
            bends[moving], tracks, is_arc, track[c], curve_pixels[c], curve_weights[c], s[c], track_slots, loss, scale,
            newton, rows, places, normal, space,
        )  # fmt: skip
        if not np.isfinite(cost):
            return False
        for i in range(size):
            for j in range(i + 1):
                normals[v - first, i, j] = units[i] * units[j] * normal[i, j]
                normals[v - first, j, i] = normals[v - first, i, j]
    return True
