"""The seam between two cameras: by how much they may, and do, disagree about what both of them see."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.model.parameters import Estimate
from ceres_cal.observations import Columns, Observations
from ceres_cal.scene.curves import along_track, nearest_on_track
from ceres_cal.scene.targets import Target
from ceres_cal.uncertainty.maps import FieldMap, field_map, locate_slopes, radius_95, shown_pixels, station_keys
from ceres_cal.uncertainty.posterior import Posterior

_BIN_M = 0.5  # along a curve; observations of one stretch are taken together
_FEWEST = 2  # observations of a stretch by each of the two stations
_PIXEL = 0.5  # for the slope of a map by differences


def seam_map(
    estimate: Estimate, posterior: Posterior, first: str, second: str, height_m: float, x_m: Array, y_m: Array
) -> FieldMap:
    """Predicted disagreement of two stations about places that both see, over a grid; `station` names both.

    What they have in common (one field, one camera, shared boards) is taken into account, but for cameras whose phi is
    followed along its profile: those count as independent.

    Raises:
        InputError: see `maps.station_keys`.
    """
    name = f"{first} - {second}"
    if {estimate.stations[s].camera for s in (first, second) if s in estimate.stations} & set(posterior.profiles):
        maps = [field_map(estimate, posterior, s, height_m, x_m, y_m) for s in (first, second)]
        sd, radius = (np.hypot(getattr(maps[0], w), getattr(maps[1], w)) for w in ("sd_mm", "radius_95_mm"))
        return FieldMap(name, height_m, x_m, y_m, sd, radius)
    x, y = np.meshgrid(x_m, y_m)
    places = np.column_stack([x.ravel(), y.ravel()])
    covariance = predicted(estimate, posterior, first, second, places, height_m)
    radius = radius_95(covariance) * posterior.half_width / 1.96
    sd = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    return FieldMap(name, height_m, x_m, y_m, 1e3 * sd.reshape(x.shape), 1e3 * radius.reshape(x.shape))


def predicted(
    estimate: Estimate, posterior: Posterior, first: str, second: str, places: Array, height_m: float
) -> Array:
    """Covariances (N, 2, 2) m^2 of first less second about places (N, 2) m; NaN where not both see them."""
    found, slopes = np.full((len(places), 2, 2), np.nan), np.zeros((len(places), 2, len(posterior.keys)))
    visible = np.ones(len(places), dtype=bool)
    for station, sign in ((first, 1.0), (second, -1.0)):
        keys = station_keys(estimate, posterior, station)
        pixels = shown_pixels(estimate, station, places, height_m)
        visible &= np.isfinite(pixels[:, 0])
        at = posterior.information.columns(keys)
        slopes[:, :, at] += sign * locate_slopes(estimate, keys, station, pixels, height_m)
    found[visible] = posterior.spread.through(slopes[visible])
    return found


@dataclass(frozen=True, eq=False)
class Disagreement:
    """What two stations actually say of what both observed.

    Attributes:
        what: (N) the point, or the curve. places: (N, 2) m, about where.
        off_mm: (N,) first less second: of a point the distance, of a stretch of a curve the sideways one, signed.
        expected_mm: (N,) its standard deviation, by the calibration's uncertainty and the pixels' noise.
    """

    what: tuple[str, ...]
    places: Array
    off_mm: Array
    expected_mm: Array

    @property
    def rms_mm(self) -> float:
        """Root mean square of what was found; NaN where the two observed nothing in common."""
        return float(np.sqrt(np.mean(self.off_mm**2))) if len(self.off_mm) else np.nan

    @property
    def expected_rms_mm(self) -> float:
        """The same of what was expected."""
        return float(np.sqrt(np.mean(self.expected_mm**2))) if len(self.off_mm) else np.nan


@dataclass(frozen=True, eq=False)
class _Sighting:
    """What one station saw of one thing, all frames taken together.

    Attributes:
        place: (3,) where the thing is as drawn. off_m: (2,) by how much the station locates it elsewhere, on average.
        normal: (2,) of a curve, None of a point. noise_m: what the pixels' noise leaves in off_m, along each axis.
    """

    place: Array
    off_m: Array
    normal: Array | None
    noise_m: float


_Thing = tuple[str, int]
"""A point (its name, 0) or a stretch of a curve (its name, how many stretches from its start)."""


def disagreement(
    observations: Observations,
    estimate: Estimate,
    posterior: Posterior,
    inliers: tuple[Mask, Mask],
    scales: tuple[float, float],
    first: str,
    second: str,
    took_part: bool = True,
) -> Disagreement:
    """Compare what two stations say of the points, and of the stretches of curve of half a metre, that both observed.

    Only what lies in the world counts; how it was built does not matter, both saw the same.

    Args:
        inliers: rows of the points and of the curves that count. scales: noise scales of points and curves.
        took_part: whether the calibration was made from these observations: then it has followed their noise a little.
    """
    a, b = (
        _points(observations, estimate, station, inliers[0], scales[0])
        | _stretches(observations, estimate, station, inliers[1], scales[1])
        for station in (first, second)
    )
    common = [thing for thing in a if thing in b]
    places = np.array([a[thing].place for thing in common]).reshape(-1, 3)
    covariances = np.empty((len(common), 2, 2))
    for height_m in np.unique(places[:, 2]):
        here = places[:, 2] == height_m
        covariances[here] = predicted(estimate, posterior, first, second, places[here, :2], float(height_m))
    found = [
        _compare(a[thing], b[thing], covariance, 1.0 if took_part else -1.0)
        for thing, covariance in zip(common, covariances, strict=True)
    ]
    kept = [number for number, (_, expected) in enumerate(found) if np.isfinite(expected)]
    off, expected = 1e3 * np.array([found[number] for number in kept]).reshape(-1, 2).T
    return Disagreement(tuple(common[number][0] for number in kept), places[kept, :2], off, expected)


def _compare(here: _Sighting, there: _Sighting, covariance: Array, taken: float) -> tuple[float, float]:
    """By how much the two differ and its standard deviation, m: what a fit has taken up of its own noise is missing."""
    gap = here.off_m - there.off_m
    noise = (here.noise_m**2 + there.noise_m**2) * np.eye(2) - taken * covariance
    if here.normal is None:
        return float(np.linalg.norm(gap)), float(np.sqrt(np.maximum(np.trace(noise), 0.0)))
    return float(here.normal @ gap), float(np.sqrt(np.maximum(here.normal @ noise @ here.normal, 0.0)))


def _rows(
    observations: Observations, columns: Columns, station: str, inlier: Mask
) -> Iterator[tuple[Target, int, Indices]]:
    """What a station saw of targets that lie in the world: the number of each feature, and its rows."""
    rows: dict[str, list[Indices]] = {}
    for number, view in enumerate(observations.views):
        if view.station == station and view.placement is None:
            first, last = np.searchsorted(columns.view, [number, number + 1])
            rows.setdefault(view.target, []).append(np.arange(first, last)[inlier[first:last]])
    for name, parts in rows.items():
        every = np.concatenate(parts)
        for feature in np.unique(columns.feature[every]):
            yield observations.targets[name], int(feature), every[columns.feature[every] == feature]


def _metres_per_px(estimate: Estimate, station: str, pixels: Array, height_m: float) -> float:
    """Of the map about the mean of some pixels, in the mean over directions."""
    middle = np.mean(pixels, axis=0) + _PIXEL * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    x1, x0, y1, y0 = estimate.camera_at(station).locate(middle, height_m)
    return float(np.sqrt(0.5 * (np.sum((x1 - x0) ** 2) + np.sum((y1 - y0) ** 2)))) / (2.0 * _PIXEL)


def _points(
    observations: Observations, estimate: Estimate, station: str, inlier: Mask, scale: float
) -> dict[_Thing, _Sighting]:
    found: dict[_Thing, _Sighting] = {}
    columns = observations.points
    for target, feature, own in _rows(observations, columns, station, inlier):
        pixels, place = columns.pixels[own], target.point_array[feature]
        off = np.mean(estimate.camera_at(station).locate(pixels, place[2]), axis=0) - place[:2]
        sigma_px = scale * float(np.mean(columns.sigma_px[own])) / np.sqrt(len(own))
        noise = sigma_px * _metres_per_px(estimate, station, pixels, place[2])
        found[target.point_names[feature], 0] = _Sighting(place, off, None, noise)
    return found


def _stretches(
    observations: Observations, estimate: Estimate, station: str, inlier: Mask, scale: float
) -> dict[_Thing, _Sighting]:
    found: dict[_Thing, _Sighting] = {}
    columns = observations.curves
    for target, feature, own in _rows(observations, columns, station, inlier):
        tracks, is_arc = target.tracks[columns.side[own], feature], np.repeat(target.is_arc[feature], len(own))
        height = float(tracks[0, 0, 2])
        located = estimate.camera_at(station).locate(columns.pixels[own], height)
        there = np.column_stack([located, np.full(len(own), height)])
        s = nearest_on_track(tracks, is_arc, there)
        feet = along_track(tracks, is_arc, s)
        turned = s - target.curves[target.curve_names[feature]].parameter_range[0]
        radius = np.linalg.norm(tracks[:, 1], axis=1)
        stretch = np.floor((turned % (2.0 * np.pi) if is_arc[0] else turned) * radius / _BIN_M).astype(int)
        for number in np.unique(stretch):
            part = stretch == number
            if np.count_nonzero(part) < _FEWEST:
                continue
            place, off = np.mean(feet[part], axis=0), np.mean(there[part] - feet[part], axis=0)[:2]
            sigma_px = scale * float(np.mean(columns.sigma_px[own[part]])) / np.sqrt(np.count_nonzero(part))
            noise = sigma_px * _metres_per_px(estimate, station, columns.pixels[own[part]], height)
            normal = _normal(tracks[0], bool(is_arc[0]), place)
            found[target.curve_names[feature], int(number)] = _Sighting(place, off, normal, noise)
    return found


def _normal(track: Array, is_arc: bool, place: Array) -> Array:
    """(2,) across a curve, at a place on it."""
    across = place[:2] - track[0, :2] if is_arc else np.array([-track[1, 1], track[1, 0]])
    return np.asarray(across / np.linalg.norm(across))
