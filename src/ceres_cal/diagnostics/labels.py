"""Observations that were taken out but lie where another feature of the same target is: wrong labels.

The false alarm is an outlier that happens to lie there. Its probability: the share of the image that lies as near to
any other feature, for each observation; for several of one frame and label that fit one feature, the binomial tail.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.tails import log_binomial_tail
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.residuals import lens_arguments
from ceres_cal.observations import Curves, Observations, Points
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import SIDES, Target, along_track, nearest_on_track

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


def find_mislabelled(
    observations: Observations, estimate: Estimate, rejected_points: Indices, rejected_curves: Indices,
    scales: tuple[float, float], reject_sigma: float,
) -> tuple[list[Mislabelled], int]:  # fmt: skip
    """Every group of rejected observations that another feature explains within the noise, and how many groups were
    looked at.

    Args:
        rejected_points, rejected_curves: their rows. scales: noise scales of points and of curves.
    """
    found: list[Mislabelled] = []
    groups = 0

    @cache  # all frames of one station show a field from the same place
    def sight(target: str, station: str, placement: str | None) -> _Sight:
        return _Sight(observations.targets[target], estimate.camera_at(station, placement))

    for is_curve, rows in ((False, rejected_points), (True, rejected_curves)):
        column = observations.curves if is_curve else observations.points
        rows = rows[:: max(1, len(rows) // _MOST)]
        for view in np.unique(column.view[rows]):
            own = rows[column.view[rows] == view]
            groups += len(np.unique(column.feature[own]))
            one = observations.views[view]
            if one.placement is None or one.placement in estimate.placements:
                bound = reject_sigma * scales[is_curve] * column.sigma_px[own]
                found += _of_view(sight(one.target, one.station, one.placement), column, int(view), own, bound)
    return found, groups


@dataclass(frozen=True, eq=False)
class _Sight:
    """A target as a camera sees it from one pose."""

    target: Target
    camera: Camera

    @cached_property
    def length_px(self) -> float:
        """Length of all its curves within the image."""
        tracks = zip(self.target.curves.values(), self.target.tracks[0], self.target.is_arc, strict=True)
        return sum(_visible_length_px(self.camera, curve.parameter_range, track, arc) for curve, track, arc in tracks)

    def chance(self, is_curve: bool, distance_px: float) -> float:
        """The share of the image that lies within a distance of any feature."""
        width, height = self.camera.image_size
        if not is_curve:
            return min(1.0, len(self.target.points) * np.pi * distance_px**2 / (width * height))
        return min(1.0, 2.0 * distance_px * self.length_px / (width * height))


def _of_view(sight: _Sight, column: Points | Curves, view: int, rows: Indices, bound: Array) -> list[Mislabelled]:
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
    found = []
    for label, instead in np.unique(np.column_stack([named, nearest])[fits], axis=0):
        tried = named == label
        chosen = fits & tried & (nearest == instead)
        near = sight.chance(is_curve, float(away[chosen].max()))
        log_p = float(log_binomial_tail(chosen.sum(), tried.sum(), near))
        found.append(
            Mislabelled(
                is_curve, view, int(label), int(instead), rows[chosen], away[chosen], int(tried.sum()), log_p
            )
        )  # fmt: skip
    return found


def _visible_length_px(camera: Camera, parameter_range: tuple[float, float], track: Array, arc: bool) -> float:
    pixels = camera.project(along_track(track, arc, np.linspace(*parameter_range, 200)))
    inside = np.all((pixels >= 0.0) & (pixels <= np.array(camera.image_size)), axis=1)
    steps = np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    return float(np.sum(steps[inside[1:] & inside[:-1]]))


def _curve_distances(target: Target, camera: Camera, pixels: Array) -> Array:
    """(N, C) distances to each curve's centre between its ends, px."""
    located = camera.rays(pixels) @ camera.cam_from_world.rotation
    answer = np.full((len(pixels), len(target.curves)), np.inf)
    for number in range(len(target.curves)):
        track, arc = target.tracks[SIDES["centre"], number], bool(target.is_arc[number])
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (track[0, 2] - camera.position[2]) / located[:, 2]
            places = np.nan_to_num(camera.position + reach[:, None] * located)
        s = nearest_on_track(np.tile(track, (len(pixels), 1, 1)), np.full(len(pixels), arc), places)
        low, high = list(target.curves.values())[number].parameter_range
        s = low + np.mod(s - low, 2.0 * np.pi) if arc else s
        inside = (s >= low) & (s <= high)
        distance = _signed_distances(camera, track, arc, pixels, s)
        answer[inside, number] = np.abs(distance)[inside]
    return answer


def _signed_distances(camera: Camera, track: Array, arc: bool, pixels: Array, s: Array) -> Array:
    pose = np.column_stack([camera.cam_from_world.rotation, camera.cam_from_world.translation])[None]
    distance, feet = np.empty(len(pixels)), s.copy()
    kernels.curve_residuals(
        *lens_arguments(camera), pose, np.array([0, len(pixels)]), track[None], np.array([arc]),
        np.zeros(len(pixels), np.int32), np.ascontiguousarray(pixels), feet, distance,
    )  # fmt: skip
    return distance
