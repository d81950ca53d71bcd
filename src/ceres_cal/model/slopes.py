"""How what a camera shows moves with its numbers: exactly, by the loops of the solve."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.arrays import Array
from ceres_cal.model.parameters import intrinsics_scales
from ceres_cal.model.residuals import camera_optics
from ceres_cal.scene.camera import Camera


class PixelSlopes(NamedTuple):
    """Derivatives of the pixels that show N places; NaN where one is not shown.

    Attributes:
        intrinsics: (N, 2, C) by all intrinsics, in the units of the files. turns: (N, 2, 3) px per rad, about the
            camera's axes. places: (N, 2, 3) px per m.
    """

    intrinsics: Array
    turns: Array
    places: Array


def pixel_slopes(camera: Camera, places: Array) -> PixelSlopes:
    """Of a camera at its pose, of places (N, 3) m; NaN among these are shown nowhere."""
    optics, scales = camera_optics(camera), intrinsics_scales(camera)
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    count, size = len(known), len(scales)
    points = kernels.PointColumns(
        np.arange(count + 1),  # a sight each: one that is not shown keeps no other one's from being known
        np.ascontiguousarray(places[known]),
        np.zeros((count, 2)),
        kernels.NOTHING,
        np.empty((0, kernels.BUILT), dtype=np.int32),
        np.zeros((count, kernels.BUILT - 2)),
    )
    rows = np.full((len(places), 2, size + 6 + kernels.BUILT), np.nan)
    shown = rows[known]
    kernels.point_rows(optics, np.repeat(camera.cam_from_world.matrix[None], count, axis=0), points, shown)
    rows[known] = shown
    intrinsics, turns, shifts, _ = np.split(rows, [size, size + 3, size + 6], axis=2)
    pose = camera.cam_from_world  # whose translation turns along about the camera
    return PixelSlopes(intrinsics * scales, turns + np.cross(pose.translation, shifts), shifts @ pose.rotation)
