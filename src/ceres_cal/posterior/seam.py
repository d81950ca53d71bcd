"""The seam between two cameras: how much they may, and do, disagree about what both of them see.

Also the relative pose of two cameras: baseline and angle, with standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, distinct, replace, rms, rotation_log
from ceres_cal.observations import Columns, Observations
from ceres_cal.posterior.maps import (
    FieldGrid,
    FieldMap,
    Functional,
    located_by,
    read,
    station_keys,
    visible_pixels,
)
from ceres_cal.posterior.mixture import Reading
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import Estimate, Key, moved, natural_sizes
from ceres_cal.scene import Camera, Target, along_track, nearest_on_track, turned_on

_STEP = 1e-6  # step of central differences, as a share of a number's natural size


class RigPair(Frozen, eq=True):
    """Two stations, and the relative pose of the second to the first.

    Attributes:
        baseline_m, baseline_sd_m: between their positions. angle_rad, angle_sd_rad: between their orientations, about
            any axis; a standard deviation is infinite where one of them is unknown.
    """

    stations: tuple[str, str]
    baseline_m: float
    baseline_sd_m: float
    angle_rad: float
    angle_sd_rad: float


def rig_pairs(estimate: Estimate, posterior: Posterior) -> tuple[RigPair, ...]:
    """Return the pairs of the first station and each station of another camera; none where several stations are worlds
    of their own, whose relative poses are unknown.
    """
    first, *others = estimate.stations
    camera = estimate.stations[first].camera
    held = [name for name in estimate.stations if not posterior.knows_station(name)]
    if len(held) > 1 or (held and held != [first]):
        return ()
    return tuple(_pair(estimate, posterior, first, o) for o in others if estimate.stations[o].camera != camera)


def _pair(estimate: Estimate, posterior: Posterior, first: str, second: str) -> RigPair:
    baseline, angle = _numbers(estimate, first, second).tolist()
    between = Functional(
        lambda there: _numbers(there, first, second)[None],
        lambda there, keys: _slopes(there, keys, first, second)[None],
    )
    variance = np.diagonal(read(posterior, estimate, between).covariance[0])
    sd = np.sqrt(variance).tolist()
    return RigPair((first, second), baseline, sd[0], angle, sd[1])


def _slopes(estimate: Estimate, keys: Sequence[Key], first: str, second: str) -> Array:
    """(2, K) derivatives of baseline and angle by each of the keys."""
    slopes = np.zeros((2, len(keys)))
    for column, (key, step) in enumerate(zip(keys, _STEP * natural_sizes(estimate, keys), strict=True)):
        if key[:2] in (("station", first), ("station", second)):
            there = [_numbers(moved(estimate, [key], np.array([sign * step])), first, second) for sign in (1.0, -1.0)]
            slopes[:, column] = (there[0] - there[1]) / (2.0 * step)
    return slopes


def _numbers(estimate: Estimate, first: str, second: str) -> Array:
    """Baseline (m) and angle (rad)."""
    a, b = (estimate.stations[name].cam_from_world for name in (first, second))
    turn = rotation_log(b.rotation @ a.rotation.T)
    return np.array([np.linalg.norm(b.position - a.position), np.linalg.norm(turn)])


def seam_map(
    estimate: Estimate,
    posterior: Posterior,
    pair: tuple[str, str],
    grid: FieldGrid,
    map_of: Callable[[str], FieldMap],
) -> FieldMap:
    """Return the predicted disagreement of two stations about places that both see, over a grid; `station` names both.

    What they have in common (one field, one camera, shared boards) is taken into account, except for cameras with a
    mixture of their own, as where phi is followed: those count as independent.

    Args:
        map_of: the map of one station over the same grid.

    Raises:
        InputError: see `maps.station_keys`.
    """
    both = " - ".join(pair)
    if {estimate.stations[s].camera for s in pair if s in estimate.stations} & posterior.mixtures.keys():
        a, b = map(map_of, pair)
        sd_mm, radius_mm = np.hypot(a.sd_mm, b.sd_mm), np.hypot(a.radius_95_mm, b.radius_95_mm)
        return replace(a, station=both, sd_mm=sd_mm, radius_95_mm=radius_mm)
    known, visible = predicted(estimate, posterior, pair, grid.places, grid.height_m)
    return FieldMap.of_visible(grid, both, visible, known.sd, known.radius_95)


def predicted(
    estimate: Estimate, posterior: Posterior, pair: tuple[str, str], places: Array, height_m: float
) -> tuple[Reading, Mask]:
    """Return the distribution of first minus second at the places (N, 2) m that both see, and which (N,) these are."""
    pixels = []
    for station in pair:
        station_keys(estimate, posterior, station)
        pixels.append(visible_pixels(estimate, station, places, height_m))
    visible = np.isfinite(pixels[0][:, 0]) & np.isfinite(pixels[1][:, 0])
    first, second = (located_by(estimate, name, own[visible], height_m) for name, own in zip(pair, pixels, strict=True))
    seam = Functional(
        lambda there: first.values(there) - second.values(there),
        lambda there, keys: first.slopes(there, keys) - second.slopes(there, keys),
    )
    return read(posterior, estimate, seam), visible


class Disagreement(Frozen):
    """The measured disagreement of two stations about what both observed.

    Attributes:
        what: (N) the point, or the curve. places: (N, 2) m, approximately.
        off_mm: (N,) first minus second: for a point the distance, for a stretch of a curve the signed distance across
            it.
        expected_mm: (N,) its standard deviation, by the calibration's uncertainty and the pixels' noise.
    """

    what: tuple[str, ...]
    places: Array
    off_mm: Array
    expected_mm: Array

    @property
    def rms_mm(self) -> float:
        """Root mean square of the differences; NaN where the two observed nothing in common."""
        return rms(self.off_mm)

    @property
    def expected_rms_mm(self) -> float:
        """Root mean square of the expected standard deviations; NaN where the two observed nothing in common."""
        return rms(self.expected_mm)


class _Sighting(Frozen):
    """One station's observations of one point or stretch of a curve, averaged over all frames.

    Attributes:
        place: (3,) m, as drawn. off_m: (2,) mean displacement of the located place from that.
        noise_m: standard deviation of off_m by the pixels' noise, along each axis. normal: (2,) of a curve, None of a
            point.
    """

    place: Array
    off_m: Array
    noise_m: float
    normal: Array | None = None


_Thing = tuple[str, int]
"""A point (its name, 0) or a stretch of a curve (its name, the number of stretches from its start)."""


def disagreement(
    observations: Observations,
    estimate: Estimate,
    posterior: Posterior,
    scales: tuple[float, float],
    pair: tuple[str, str],
) -> Disagreement:
    """Compare where two stations locate the points, and the stretches of curve of half a metre, that both observed.

    Only what lies in the world counts. How it was built does not matter, because both saw the same.

    Args:
        observations: of the calibration, without those that were rejected.
        scales: noise scales of points and curves.
    """
    fitted = Posterior(posterior.by_model or posterior.information)  # alternatives absorb no noise
    a, b = (dict(_sightings(observations, estimate, station, scales)) for station in pair)
    common = [thing for thing in a if thing in b]
    places = np.array([a[thing].place for thing in common]).reshape(-1, 3)
    covariances = np.full((len(common), 2, 2), np.nan)
    for height_m in distinct(places[:, 2]):
        here = places[:, 2] == height_m
        reading, visible = predicted(estimate, fitted, pair, places[here, :2], float(height_m))
        covariances[np.flatnonzero(here)[visible]] = reading.covariance
    gaps = [_gap(a[thing], b[thing], covariance) for thing, covariance in zip(common, covariances, strict=True)]
    known = [number for number, (_, expected) in enumerate(gaps) if np.isfinite(expected)]
    off, expected = 1e3 * np.array([gaps[number] for number in known]).reshape(-1, 2).T
    return Disagreement(tuple(common[number][0] for number in known), places[known, :2], off, expected)


def _gap(here: _Sighting, there: _Sighting, covariance: Array) -> tuple[float, float]:
    """Return the difference of the two and its standard deviation, m, reduced by the noise that the fit absorbed."""
    gap = here.off_m - there.off_m
    noise = (here.noise_m**2 + there.noise_m**2) * np.eye(2) - covariance
    if here.normal is None:
        return float(np.linalg.norm(gap)), float(np.sqrt(np.maximum(np.trace(noise), 0.0)))
    return float(here.normal @ gap), float(np.sqrt(np.maximum(here.normal @ noise @ here.normal, 0.0)))


def _sightings(
    observations: Observations, estimate: Estimate, station: str, scales: tuple[float, float]
) -> Iterator[tuple[_Thing, _Sighting]]:
    """Yield what a station observed of the points and of the stretches of curve that lie in the world."""
    fewest = 2  # observations of a stretch by each of the two stations
    bin_m = 0.5  # along a curve; observations of one stretch are taken together
    camera = estimate.camera_at(station)
    points, curves = observations.points, observations.curves
    for target, feature, rows in _rows(observations, points, station):
        drawn = np.broadcast_to(target.point_array[feature], (len(rows), 3))
        yield (target.point_names[feature], 0), _sighting(camera, points, rows, drawn, scales[0])
    for target, feature, every in _rows(observations, curves, station):
        name, is_arc = target.curve_names[feature], bool(target.is_arc[feature])
        curve, height_m = target.curves[name], float(target.tracks[0, feature, 0, 2])
        located = camera.locate(curves.pixels[every], height_m)
        shown = np.isfinite(located[:, 0])  # others lie where the lens folds
        rows, located = every[shown], located[shown]
        tracks = target.tracks[curves.side[rows], feature]
        s = nearest_on_track(tracks, is_arc, np.column_stack([located, np.full(len(rows), height_m)]))
        feet, start = along_track(tracks, is_arc, s), curve.parameter_range[0]
        length = (turned_on(curve, s) - start) * np.linalg.norm(tracks[:, 1], axis=1)
        stretch = np.floor(length / bin_m).astype(int)
        for number in distinct(stretch):
            part = stretch == number
            if np.count_nonzero(part) >= fewest:
                sighting = _sighting(camera, curves, rows[part], feet[part], scales[1])
                normal = _normal(tracks[0], is_arc, sighting.place)
                yield (name, int(number)), replace(sighting, normal=normal)


def _sighting(camera: Camera, columns: Columns, rows: Indices, drawn: Array, scale: float) -> _Sighting:
    """Combine some rows that show what is drawn at (N, 3), all of it at one height."""
    pixels, height_m = columns.pixels[rows], float(drawn[0, 2])
    off_m = np.mean(camera.locate(pixels, height_m) - drawn[:, :2], axis=0)
    sigma_px = scale * float(np.mean(columns.sigma_px[rows])) / np.sqrt(len(rows))
    return _Sighting(np.mean(drawn, axis=0), off_m, sigma_px * _metres_per_px(camera, pixels, height_m))


def _rows(observations: Observations, columns: Columns, station: str) -> Iterator[tuple[Target, int, Indices]]:
    """Yield what a station observed of targets that lie in the world: the number of each feature, and its rows."""
    rows: dict[str, list[Indices]] = {}
    for number, view in enumerate(observations.views):
        if view.station == station and view.placement is None:
            first, last = np.searchsorted(columns.view, [number, number + 1])
            rows.setdefault(view.target, []).append(np.arange(first, last))
    for name, parts in rows.items():
        every = np.concatenate(parts)
        for feature in distinct(columns.feature[every]):
            yield observations.targets[name], int(feature), every[columns.feature[every] == feature]


def _metres_per_px(camera: Camera, pixels: Array, height_m: float) -> float:
    """Return metres per pixel of the map at the mean of some pixels, averaged over directions."""
    pixel = 0.5  # step of a difference quotient
    middle = np.mean(pixels, axis=0) + pixel * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    x1, x0, y1, y0 = camera.locate(middle, height_m)
    return float(np.sqrt(0.5 * (np.sum((x1 - x0) ** 2) + np.sum((y1 - y0) ** 2)))) / (2.0 * pixel)


def _normal(track: Array, is_arc: bool, place: Array) -> Array:
    """(2,) unit normal of a curve, at a place on it."""
    across = place[:2] - track[0, :2] if is_arc else np.array([-track[1, 1], track[1, 0]])
    return np.asarray(across / np.linalg.norm(across))
