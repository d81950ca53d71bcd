"""What the observations and an estimate disagree about, in measured pixels, one by one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.cached import cached_property
from ceres_cal.base.threads import parts_of, run_parts
from ceres_cal.observations.files import Content
from ceres_cal.observations.sights import Sights, nearest_feet
from ceres_cal.problem.parameters import Estimate, intrinsics_vector, unit_px
from ceres_cal.problem.structure import Structure
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import LENSES

# Share of observations that may be anywhere in the image: as many as are wrong in the simulated days of
# scripts/accuracy/moves.py. Nothing changes from half to double.
_STRAY = 0.05


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
        points = np.abs(np.ascontiguousarray(self.points).view(complex)[:, 0])  # in one pass
        return points, np.abs(self.curves)

    def of_rows(self, points: Indices, curves: Indices) -> Residuals:
        """Those of some of the observations, as if there were no others."""
        return Residuals(self.points[points], self.curves[curves], self.feet[curves])

    def in_sigmas(self, sights: Sights, scales: tuple[float, float]) -> tuple[Array, Array]:
        """(N,) of the sights' points and (M,) of their curve observations: lengths of the residuals at these noise
        scales, in standard deviations.
        """
        points = np.linalg.norm(self.points[sights.point_rows], axis=1) / (scales[0] * sights.sigma_px)
        return points, np.abs(self.curves[sights.curve_rows]) / (scales[1] * sights.curve_sigma_px)

    def misfit(self, sights: Sights, camera: Camera, scales: tuple[float, float]) -> float:
        """Negative log likelihood of a camera's sights at these noise scales, each observation a stray with a small
        probability; in nats.
        """
        width, height = camera.image_size
        points, curves = self.in_sigmas(sights, scales)
        p, c = sights.sigma_px * scales[0], sights.curve_sigma_px * scales[1]
        total = 0.0
        for lengths, inside, stray in (
            (points, 1.0 / (2.0 * np.pi * p**2), 1.0 / (width * height)),
            (curves, 1.0 / (np.sqrt(2.0 * np.pi) * c), 1.0 / np.hypot(width, height)),
        ):
            likely = (1.0 - _STRAY) * inside * np.exp(-0.5 * np.minimum(np.nan_to_num(lengths, nan=1e3), 1e3) ** 2)
            total -= float(np.sum(np.log(likely + _STRAY * stray)))
        return total


def camera_optics(camera: Camera) -> kernels.Optics:
    """A camera's optics as the kernels take them."""
    lens = camera.lens
    kind = lens.kind if LENSES.get(lens.kind) is type(lens) else ""  # another's formulas may be others
    return kernels.Optics(lens, kind, lens.form, intrinsics_vector(camera), unit_px(camera))


def point_columns(sights: Sights, structure: Structure, noise_scale: float | None = None) -> kernels.PointColumns:
    """The point observations of some sights as the kernels take them; without a noise scale they have no weights."""
    moved = sights.point_index if len(structure.values) else sights.point_index[:0]
    return kernels.PointColumns(
        sights.point_bounds,
        structure.points(sights),
        sights.pixels,
        _weights(sights.sigma_px, noise_scale),
        structure.point_slots[moved],
        structure.bends[moved],
    )


def curve_columns(
    sights: Sights, structure: Structure, feet: Array, noise_scale: float | None = None
) -> kernels.CurveColumns:
    """The curve observations of some sights as the kernels take them, which move the feet (M of the sights,)."""
    return kernels.CurveColumns(
        sights.curve_bounds,
        structure.tracks(sights),
        sights.is_arc,
        sights.track_index,
        sights.curve_pixels,
        _weights(sights.curve_sigma_px, noise_scale),
        feet,
        structure.track_slots,
    )


def _weights(sigma_px: Array, noise_scale: float | None) -> Array:
    if noise_scale is None:
        return kernels.NOTHING
    weights = noise_scale * sigma_px
    return np.reciprocal(weights, out=weights)


def residuals(observations: Content, sights: Sights, estimate: Estimate, feet: Array | None = None) -> Residuals:
    """Residuals of every observation in the sights; NaN for rows in none of them.

    Args:
        feet: (M,) where on its track the search for each curve observation's foot starts, such as those of earlier
            residuals; without them it starts where the ray passes nearest.
    """
    return _residuals(len(observations.points), len(observations.curves), sights, estimate, feet)


def residuals_alone(sights: Sights, estimate: Estimate, feet: Array | None = None) -> Residuals:
    """Residuals of the sights' own observations, in their order, as if there were no others."""
    n, m = len(sights.point_rows), len(sights.curve_rows)
    own = replace(sights, point_rows=np.arange(n), curve_rows=np.arange(m))
    return _residuals(n, m, own, estimate, None if feet is None else feet[sights.curve_rows])


def _residuals(n: int, m: int, sights: Sights, estimate: Estimate, feet: Array | None) -> Residuals:
    points, curves, ends = np.full((n, 2), np.nan), np.full(m, np.nan), np.full(m, np.nan)
    poses = estimate.pose_stack(sights.keys)
    for name in sights.cameras:
        numbers = sights.numbers(camera=name)
        own = sights.take(numbers)
        optics = camera_optics(estimate.cameras[name])
        _point_residuals(optics, poses[numbers], own, estimate.structure, points)
        if len(own.curve_rows):
            distances = np.empty(len(own.curve_rows))
            columns = curve_columns(own, estimate.structure, starting_feet(own, estimate, feet))
            kernels.curve_residuals(optics, poses[numbers], columns, distances)
            curves[own.curve_rows], ends[own.curve_rows] = distances, columns.feet
    return Residuals(points, curves, ends)


def _point_residuals(
    optics: kernels.Optics, poses: Array, sights: Sights, structure: Structure, offsets: Array
) -> None:
    point_ns = 10.0
    columns = point_columns(sights, structure)

    def part(first: int, last: int) -> None:
        kernels.point_residuals(first, last, optics, poses, columns, sights.point_rows, offsets)

    run_parts(part, parts_of(len(sights), len(sights.points), point_ns))


def starting_feet(sights: Sights, estimate: Estimate, feet: Array | None) -> Array:
    """(M of the sights,) a copy of the feet of their rows, or where the rays pass nearest."""
    if not len(sights.curve_rows):
        return np.empty(0)
    if feet is not None:
        known = feet[sights.curve_rows]
        if np.all(np.isfinite(known)):
            return known
    seen = [sights[int(number)] for number in np.flatnonzero(np.diff(sights.curve_bounds))]
    nearest = [nearest_feet(s, estimate.camera_at(s.key.station, s.key.placement)) for s in seen]
    return np.concatenate(nearest)
