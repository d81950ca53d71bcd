"""What the observations and an estimate disagree about, in measured pixels, one by one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.arrays import Array
from ceres_cal.base.threads import parts_of, run_parts
from ceres_cal.model.parameters import Estimate, intrinsics_vector, unit_px
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, nearest_places
from ceres_cal.scene.camera import Camera

_POINT_NS = 10.0


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals in the order of the observations, px; NaN where the estimate cannot show an observation at all.

    Attributes:
        points: (N, 2), projected minus observed. curves: (M,), signed distance from the observed pixel to the curve.
        feet: (M,) the foot of that distance, as the parameter of the curve's track.
    """

    points: Array
    curves: Array
    feet: Array

    @cached_property
    def lengths(self) -> tuple[Array, Array]:
        """Lengths of the residuals of points (N,) and of curves (M,), px."""
        x, y = self.points.T
        return np.sqrt(x * x + y * y), np.abs(self.curves)


def lens_arguments(camera: Camera) -> tuple[int, Array, Array, float]:
    """(code, intrinsics, powers, unit) as the kernels take a camera's optics."""
    return (
        kernels.LENS_CODES[camera.lens.kind],
        intrinsics_vector(camera),
        np.asarray(camera.lens.radius_powers, dtype=np.int64),
        unit_px(camera),
    )


def residuals(observations: Observations, sights: Sights, estimate: Estimate, feet: Array | None = None) -> Residuals:
    """Residuals of every observation in the sights; NaN for rows in none of them.

    Args:
        feet: (M,) where on its track the search for each curve observation's foot starts, such as those of earlier
            residuals; without them it starts where the ray passes nearest.
    """
    points = np.full((len(observations.points), 2), np.nan)
    curves, ends = np.full(len(observations.curves), np.nan), np.full(len(observations.curves), np.nan)
    poses = estimate.pose_stack(sights.keys)
    for name in sights.cameras:
        numbers = sights.numbers(camera=name)
        own = sights.take(numbers)
        optics = lens_arguments(estimate.cameras[name])
        _point_residuals(optics, poses[numbers], own, estimate.structure.points(own), points)
        if len(own.curve_rows):
            distances = np.empty(len(own.curve_rows))
            starts = starting_feet(own, estimate, feet)
            kernels.curve_residuals(
                *optics, poses[numbers], own.curve_bounds, estimate.structure.tracks(own), own.is_arc, own.track,
                own.curve_pixels, starts, distances,
            )  # fmt: skip
            curves[own.curve_rows], ends[own.curve_rows] = distances, starts
    return Residuals(points, curves, ends)


def _point_residuals(
    optics: tuple[int, Array, Array, float], poses: Array, sights: Sights, points: Array, found: Array
) -> None:
    def part(first: int, last: int) -> None:
        bounds = sights.point_bounds[first : last + 1]
        kernels.point_residuals(*optics, poses[first:last], bounds, points, sights.pixels, sights.point_rows, found)

    run_parts(part, parts_of(len(sights), len(points), _POINT_NS))


def starting_feet(sights: Sights, estimate: Estimate, feet: Array | None) -> Array:
    """(M of the sights,) a copy of the feet of their rows, or where the rays pass nearest."""
    if not len(sights.curve_rows):
        return np.empty(0)
    if feet is not None:
        known = feet[sights.curve_rows]
        if np.all(np.isfinite(known)):
            return known
    seen = [sights[int(number)] for number in np.flatnonzero(np.diff(sights.curve_bounds))]
    nearest = [nearest_places(s, estimate.camera_at(s.key.station, s.key.placement)) for s in seen]
    return np.concatenate(nearest)
