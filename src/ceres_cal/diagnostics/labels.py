"""Wrong labels: observations that lie where another feature of the same target is than the one they are named after.

Rejected observations are examined, and those beyond the ends of a curve that lies on one line with another curve: a
solve, which does not use the ends, fits them.

A false alarm is an outlier that lies there by chance. For one observation, the probability is the share of the image
that is as close to any other feature; for several of one frame and label that fit one feature, the binomial tail.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cache

import numpy as np

from ceres_cal import kernels
from ceres_cal.base import Array, Frozen, Indices, Mask, cached_property, distinct, log_binomial_tail, replace
from ceres_cal.calibration import Calibration
from ceres_cal.observations import Columns, Curves, Observations
from ceres_cal.problem import EXACT, Estimate, camera_optics
from ceres_cal.scene import Camera, Curve, Target, curve_points, nearest_to_rays, turned_on


class WrongLabel(Frozen):
    """Observations of one view and one label that fit another feature.

    Attributes:
        is_curve, view: the same for all of them. feature, instead: indices of the label and of the feature that fits,
            among the target's. rows: (K,) rows. distance_px: (K,) from the feature that fits.
        log_p: natural logarithm of the probability of so many by chance.
    """

    is_curve: bool
    view: int
    feature: int
    instead: int
    rows: Indices
    distance_px: Array
    log_p: float


def find_mislabelled(
    observations: Observations,
    estimate: Estimate,
    taking_part: tuple[Mask, Mask],
    scales: tuple[float, float],
    reject_sigma: float,
) -> tuple[list[WrongLabel], int]:
    """Return every group of observations that another feature explains within the noise, and how many were examined.

    Args:
        taking_part: (N,) of points and (M,) of curve observations. scales: noise scales of both.
    """
    most = 20_000  # rejected observations examined: of more, evenly spread ones
    mislabelled: list[WrongLabel] = []
    tried = 0

    @cache  # all frames of one station show a field from the same place
    def sight(target: str, station: str, placement: str | None) -> _Sight:
        return _Sight(observations.targets[target], estimate.camera_at(station, placement))

    both: tuple[Columns, ...] = (observations.points, observations.curves)
    for column, original, used, scale in zip(both, observations.copies.originals, taking_part, scales, strict=True):
        rejected = original & ~used
        doubtful = rejected | _may_lie_beyond(observations, column)
        rows = np.flatnonzero(doubtful)
        rows = rows[:: max(1, len(rows) // most)]
        for number in distinct(column.view[rows]):
            own, view = rows[column.view[rows] == number], observations.views[number]
            if view.placement is None or view.placement in estimate.placements:
                bound = reject_sigma * scale * column.sigma_px[own]
                seen = sight(view.target, view.station, view.placement)
                mislabelled += _of_view(seen, column, int(number), own, bound)
                tried += len(distinct(column.feature[own[rejected[own]]]))
    return mislabelled, tried


class _Sight(Frozen):
    """A target as a camera sees it from one pose."""

    target: Target
    camera: Camera

    @cached_property
    def length_px(self) -> float:
        """Length of all its curves within the image."""
        return sum(_visible_length_px(self.camera, curve) for curve in self.target.curves.values())

    def distances(self, column: Columns, rows: Indices) -> Array:
        """(N, F) px from observations to each point, or to each curve between its ends."""
        pixels = column.pixels[rows]
        if isinstance(column, Curves):
            return _curve_distances(self.target, self.camera, pixels)
        off = np.linalg.norm(pixels[:, None] - self.camera.project(self.target.point_array), axis=2)
        return np.where(np.isfinite(off), off, np.inf)

    def chance(self, is_curve: bool, distance_px: float) -> float:
        """Return the share of the image that lies within a distance of any feature."""
        width, height = self.camera.image_size
        if not is_curve:
            return min(1.0, len(self.target.points) * np.pi * distance_px**2 / (width * height))
        return min(1.0, 2.0 * distance_px * self.length_px / (width * height))


def _of_view(sight: _Sight, column: Columns, view: int, rows: Indices, bound: Array) -> list[WrongLabel]:
    """Return the groups of one view."""
    is_curve, named = isinstance(column, Curves), column.feature[rows]
    distance = sight.distances(column, rows)
    every = np.arange(len(rows))
    misses = distance[every, named] > bound
    distance[every, named] = np.inf
    nearest = np.argmin(distance, axis=1)
    away = distance[every, nearest]
    fits = misses & (away <= bound)
    groups = []
    for label, instead in distinct(np.column_stack([named, nearest])[fits], axis=0):
        tried = named == label
        chosen = fits & tried & (nearest == instead)
        under_it = np.count_nonzero((column.view == view) & (column.feature == label))
        if 2 * chosen.sum() <= under_it == (misses & tried).sum():
            continue  # the whole feature lies elsewhere, and only crosses the other: a circle of another radius
        near = sight.chance(is_curve, float(away[chosen].max()))
        log_p = float(log_binomial_tail(chosen.sum(), tried.sum(), near))
        groups.append(WrongLabel(is_curve, view, int(label), int(instead), rows[chosen], away[chosen], log_p))
    return groups


def _may_lie_beyond(observations: Observations, column: Columns) -> Mask:
    """(N,) which observations are of curves that lie on one line, or circle, with another curve of their target."""
    beyond = np.zeros(len(column), dtype=bool)
    if isinstance(column, Curves):
        of_view = np.array([list(observations.targets).index(view.target) for view in observations.views])
        for number, target in enumerate(observations.targets.values()):
            shared = _shares_its_line(target)
            if shared.any():
                own = of_view[column.view] == number
                beyond[own] = shared[column.feature[own]]
    return beyond


def _shares_its_line(target: Target) -> Mask:
    """(C,) which curves lie on one straight line, or one circle, with another."""
    same_line = 1e-6  # tolerance, m and rad, for two curves on one line or circle
    tracks, is_arc = target.tracks[0], target.is_arc
    c, a = tracks[:, 0], tracks[:, 1]
    along = a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-12)
    between = c[:, None] - c
    beside = np.linalg.norm(np.cross(along[:, None], between), axis=2)  # distance of the other's start from a line
    turned = np.linalg.norm(np.cross(along[:, None], along), axis=2)
    lines = (beside < same_line) & (turned < same_line) & ~is_arc[:, None] & ~is_arc
    size = np.linalg.norm(a, axis=1)
    arcs = (np.linalg.norm(between, axis=2) < same_line) & (np.abs(size[:, None] - size) < same_line)
    same = (lines | (arcs & is_arc[:, None] & is_arc)) & ~np.eye(len(c), dtype=bool)
    return np.asarray(same.any(axis=1))


def _visible_length_px(camera: Camera, curve: Curve) -> float:
    pieces = 199  # of a curve, to measure its length in the image
    pixels = camera.project(curve_points(curve, 0, pieces))
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
    found = inside & np.isfinite(distance)
    return np.where(found, np.abs(distance), np.inf).reshape(len(curves), -1).T


# ---- other names ----------------------------------------------------------------------------------------------------


def renamings(observations: Observations, calibration: Calibration) -> Iterator[WrongLabel]:
    """Yield features of the world whose observations in a view, its rows, all lie where another feature does: at least
    two observations of a curve, or two features that are exchanged.
    """
    least_rows = 2  # of a feature that is renamed: one observation lies on some curve by chance
    judged = calibration.inlier_masks(observations), calibration.fit.scales, calibration.options.reject_sigma
    found, _ = find_mislabelled(observations, calibration.estimate, *judged)
    whole = {(one.is_curve, one.view, one.feature): one for one in found if _is_whole(one, observations, calibration)}
    for one in whole.values():
        back = whole.get((one.is_curve, one.view, one.instead))
        exchanged = back is not None and back.instead == one.feature
        rows = _rows_of(one, observations)
        if not one.is_curve or len(rows) >= least_rows or exchanged:
            yield replace(one, rows=rows)


def renaming_words(one: WrongLabel, observations: Observations) -> str:
    """Return the sentence that a feature was observed where another one lies."""
    view = observations.views[one.view]
    target = observations.targets[view.target]
    kind, names = ("curve", target.curve_names) if one.is_curve else ("point", target.point_names)
    return f"frame {view.frame!r}: {kind} {names[one.feature]!r} is seen where {names[one.instead]!r} lies"


def _rows_of(one: WrongLabel, observations: Observations) -> Indices:
    column = observations.curves if one.is_curve else observations.points
    return np.flatnonzero((column.view == one.view) & (column.feature == one.feature))


def _is_whole(one: WrongLabel, observations: Observations, calibration: Calibration) -> bool:
    """Return whether all observations of the feature lie where the other does; where they cross, some fit both."""
    view, rows = observations.views[one.view], _rows_of(one, observations)
    if view.placement is not None or 2 * len(one.rows) <= len(rows):
        return False
    column: Columns = observations.curves if one.is_curve else observations.points
    scale = calibration.fit.curve_scale if one.is_curve else calibration.fit.point_scale
    sight = _Sight(observations.targets[view.target], calibration.estimate.camera_at(view.station))
    off = sight.distances(column, rows)[:, one.instead]
    return bool(np.all(off <= calibration.options.reject_sigma * scale * column.sigma_px[rows]))


def mended(observations: Observations, wrong: Iterable[WrongLabel]) -> Observations:
    """Return the observations with the right names."""
    points, curves = observations.points.feature.copy(), observations.curves.feature.copy()
    for one in wrong:
        (curves if one.is_curve else points)[one.rows] = one.instead
    return observations.with_features(points, curves)
