"""What the observations and an estimate disagree about, in measured pixels, one by one."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from ceres_cal import kernels
from ceres_cal.camera import Camera
from ceres_cal.observations import Observations
from ceres_cal.parameters import Estimate, intrinsics_vector, unit_px
from ceres_cal.sights import Sight, nearest_places
from ceres_cal.transforms import Array


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals in the order of the observations, px; NaN where the estimate cannot show an observation at all.

    Attributes:
        points: (N, 2), projected minus observed. curves: (M,), signed distance from the observed pixel to the curve.
    """

    points: Array
    curves: Array


def lens_arguments(camera: Camera) -> tuple[int, Array, Array, float]:
    """(code, intrinsics, powers, unit) as the kernels take a camera's optics."""
    return (
        kernels.LENS_CODES[camera.lens.kind],
        intrinsics_vector(camera),
        np.asarray(camera.lens.radius_powers, dtype=np.int64),
        unit_px(camera),
    )


def pose_matrix(camera: Camera) -> Array:
    """[R t], (3, 4)."""
    pose = camera.cam_from_world
    return np.column_stack([pose.rotation, pose.translation])


def residuals(observations: Observations, sights: Iterable[Sight], estimate: Estimate) -> Residuals:
    """Residuals of every observation in the sights; NaN for rows in none of them."""
    points = np.full((len(observations.points), 2), np.nan)
    curves = np.full(len(observations.curves), np.nan)
    for sight in sights:
        camera = estimate.camera_at(sight.station, sight.placement)
        optics, pose = lens_arguments(camera), pose_matrix(camera)
        if len(sight.point_rows):
            found = np.empty((len(sight.point_rows), 2))
            kernels.point_residuals(*optics, pose, sight.points, sight.pixels, found)
            points[sight.point_rows] = found
        if len(sight.curve_rows):
            distances = np.empty(len(sight.curve_rows))
            places = nearest_places(sight, camera)
            kernels.curve_residuals(
                *optics, pose, sight.tracks, sight.is_arc, sight.track, sight.curve_pixels, places, distances
            )
            curves[sight.curve_rows] = distances
    return Residuals(points, curves)
