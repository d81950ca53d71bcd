"""Observations that were taken out but lie where another feature of the same target is: wrong labels.

The false alarm is an outlier that happens to lie there. Its probability: the share of the image that lies as near to
any other feature, for each observation; for several of one frame and label that fit one feature, the binomial tail.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.arrays import Array, Indices, Mask, distinct
from ceres_cal.base.cached import cached_property
from ceres_cal.base.tails import log_binomial_tail
from ceres_cal.observations import Columns, Curves, Observations
from ceres_cal.problem.noise import Inliers
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.residuals import camera_optics
from ceres_cal.problem.structure import EXACT
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import Curve, curve_points, nearest_to_rays, turned_on
from ceres_cal.scene.targets import Target

_PIECES = 199  # of a curve, to measure its length in the image
_MOST = 20_000  # rejected observations looked at: of more, evenly spread ones


@dataclass(frozen=True, eq=False)
class Mislabelled:
    """Rejected observations of one view under one label that fit another.

    Attributes:
        is_curve, view: of all of them. feature, instead: index of the label and of the feature that fits, among the
            target's. rows: (K,) rows. distance_px: (K,) from the feature that fits.
        tried: how many rejected ones of this view and label were looked at. log_p: of so many by chance.
    """

    is_curve: bool
    view: int
    feature: int
    instead: int
    rows: Indices
    distance_px: Array
    tried: int
    log_p: float


@dataclass(frozen=True, eq=False)
class Mislabelling:
    """All such groups, and how many groups were looked at."""

    mislabelled: tuple[Mislabelled, ...]
    tried: int


def find_mislabelled(
    observations: Observations, estimate: Estimate, inliers: Inliers, reject_sigma: float
) -> Mislabelling:
    """Every group of rejected observations that another feature explains within the noise."""
    mislabelled: list[Mislabelled] = []
    tried = 0

    @cache  # all frames of one station show a field from the same place
    def sight(target: str, station: str, placement: str | None) -> _Sight:
        return _Sight(observations.targets[target], estimate.camera_at(station, placement))

    points, curves = observations.copies.originals
    both: tuple[tuple[Columns, Mask, float], ...] = (
        (observations.points, points & ~inliers.points, inliers.point_scale),
        (observations.curves, curves & ~inliers.curves, inliers.curve_scale),
    )
    for column, rejected, scale in both:
        rows = np.flatnonzero(rejected)
        rows = rows[:: max(1, len(rows) // _MOST)]
        for number in distinct(column.view[rows]):
            own, view = rows[column.view[rows] == number], observations.views[number]
            tried += len(distinct(column.feature[own]))
            if view.placement is None or view.placement in estimate.placements:
                bound = reject_sigma * scale * column.sigma_px[own]
                seen = sight(view.target, view.station, view.placement)
                mislabelled += _of_view(seen, column, int(number), own, bound)
    return Mislabelling(tuple(mislabelled), tried)


@dataclass(frozen=True, eq=False)
class _Sight:
    """A target as a camera sees it from one pose."""

    target: Target
    camera: Camera

    @cached_property
    def length_px(self) -> float:
        """Length of all its curves within the image."""
        return sum(_visible_length_px(self.camera, curve) for curve in self.target.curves.values())

    def chance(self, is_curve: bool, distance_px: float) -> float:
        """The share of the image that lies within a distance of any feature."""
        width, height = self.camera.image_size
        if not is_curve:
            return min(1.0, len(self.target.points) * np.pi * distance_px**2 / (width * height))
        return min(1.0, 2.0 * distance_px * self.length_px / (width * height))


def _of_view(sight: _Sight, column: Columns, view: int, rows: Indices, bound: Array) -> list[Mislabelled]:
    """The groups of one view."""
    is_curve = isinstance(column, Curves)
    pixels, named = column.pixels[rows], column.feature[rows]
    if is_curve:
        distance = _curve_distances(sight.target, sight.camera, pixels)
    else:
        places = sight.camera.project(sight.target.point_array)
        distance = np.linalg.norm(pixels[:, None] - places[None], axis=2)
    distance = np.where(np.isfinite(distance), distance, np.inf)
    distance[np.arange(len(rows)), named] = np.inf
    nearest = np.argmin(distance, axis=1)
    away = distance[np.arange(len(rows)), nearest]
    fits = away <= bound
    groups = []
    for label, instead in distinct(np.column_stack([named, nearest])[fits], axis=0):
        tried = named == label
        chosen = fits & tried & (nearest == instead)
        near = sight.chance(is_curve, float(away[chosen].max()))
        log_p = float(log_binomial_tail(chosen.sum(), tried.sum(), near))
        groups.append(
            Mislabelled(
                is_curve, view, int(label), int(instead), rows[chosen], away[chosen], int(tried.sum()), log_p
            )
        )  # fmt: skip
    return groups


def _visible_length_px(camera: Camera, curve: Curve) -> float:
    pixels = camera.project(curve_points(curve, 0, _PIECES))
    inside = np.all((pixels >= 0.0) & (pixels <= np.array(camera.image_size)), axis=1)
    steps = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    return float(np.sum(steps[inside[1:] & inside[:-1]]))


def _curve_distances(target: Target, camera: Camera, pixels: Array) -> Array:
    """(N, C) distances to each curve's centre between its ends, px."""
    curves, tracks, is_arc = list(target.curves.values()), target.tracks[0], target.is_arc
    rays = np.nan_to_num(camera.rays(pixels) @ camera.cam_from_world.rotation)
    track = np.repeat(np.arange(len(curves), dtype=np.int32), len(pixels))
    nearest = nearest_to_rays(tracks[track], is_arc[track], camera.position, np.tile(rays, (len(curves), 1)))
    s = np.concatenate([turned_on(curves[k], nearest[track == k]) for k in range(len(curves))])
    low, high = np.array([curve.parameter_range for curve in curves])[track].T
    inside = (s >= low) & (s <= high)
    columns = kernels.CurveColumns(
        np.array([0, len(s)]), tracks, is_arc, track, np.tile(pixels, (len(curves), 1)), np.ones(len(s)), s,
        EXACT.track_slots,
    )  # fmt: skip
    pose = np.column_stack([camera.cam_from_world.rotation, camera.cam_from_world.translation])[None]
    distance = np.empty(len(s))
    kernels.curve_residuals(camera_optics(camera), pose, columns, distance)
    return np.where(inside, np.abs(distance), np.inf).reshape(len(curves), -1).T
