"""Sights: the observations as the method uses them, sorted by the pose that they depend on.

A view is what one frame shows of one target. A *sight* is what one camera at one station sees of one rigid frame, over
all its views; the frame is the world or a placement. All observations of a sight are projected by one pose,
cam_from_frame, so a sight is a block of rows of the least-squares problem: a static camera's thousand frames of a field
are one sight, a board held at twenty places is twenty. Nearly all later steps work on sights, and row numbers are kept
so that residuals can be assigned to the observations' permanent ids.

Features are numbered in two ways. Observations number them within their target, in the order of its names (`feature` of
`Points` and `Curves`). Sights number them across all targets, one target after the other: `point_index` is a row of all
points; `track_index` is a row of all tracks, which are three sets for each target: the curves' centres, their left
borders and their right borders.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Container, Sequence
from operator import itemgetter
from typing import NamedTuple, TypeAlias

import numpy as np

from ceres_cal.base import Frozen, cached_property, replace
from ceres_cal.base.arrays import AnyArray, Array, Indices, Indices32, Mask, evenly, median, numbers_of
from ceres_cal.observations import Columns, Observations
from ceres_cal.scene import Camera, nearest_to_rays

_RUN = 256  # mean number of rows between two removed ones from which on the rows between are copied as runs
_Rows: TypeAlias = "Indices | slice | list[slice]"

Owner = tuple[str, str]
"""Owner of numbers that a solver updates together: "camera", "station" or "placement", and its name."""

STRUCTURE: Owner = ("structure", "")
"""Owner of the structure of all targets."""


class SightKey(NamedTuple):
    """Camera, station and frame of a sight; `placement` None is the world."""

    camera: str
    station: str
    placement: str | None

    def __str__(self) -> str:
        return f"station {self.station!r}" + (f", placement {self.placement!r}" if self.placement is not None else "")

    @property
    def owners(self) -> tuple[Owner, ...]:
        """Owners of the numbers that the sight depends on: its camera, station, placement, and the structure."""
        return ("camera", self.camera), ("station", self.station), ("placement", self.placement or ""), STRUCTURE


class Sights(Frozen, Sequence["Sights"]):
    """Some sights, with their observations one after the other; one sight is a `Sights` of length one.

    Attributes:
        observations: the whole set. keys: (S,) of the sights. views: numbers of the views of each sight.
        point_bounds: (S + 1,) where each sight's points begin. point_rows: (N,) rows of the observations' columns.
        point_index: (N,) number among the points of all targets. points: (N, 3) m in the sight's frame.
        pixels: (N, 2) px. sigma_px: (N,).
        curve_bounds, curve_rows, curve_pixels, curve_sigma_px: the corresponding columns of the M curve observations.
        track_index: (M,) number among the tracks.
        tracks, is_arc: (T, 3, 3) and (T,) of every side and curve of every target (see `curves.along_track`).
    """

    observations: Observations
    keys: tuple[SightKey, ...]
    views: tuple[tuple[int, ...], ...]
    point_bounds: Indices
    point_rows: Indices
    point_index: Indices
    points: Array
    pixels: Array
    sigma_px: Array
    curve_bounds: Indices
    curve_rows: Indices
    track_index: Indices32
    curve_pixels: Array
    curve_sigma_px: Array
    tracks: Array
    is_arc: Mask

    def __len__(self) -> int:
        return len(self.keys)

    def __getitem__(self, number: int | slice) -> Sights:
        if isinstance(number, slice):
            return self.take(np.arange(len(self))[number])
        if not -len(self) <= number < len(self):
            raise IndexError(number)
        number %= len(self)
        p = slice(self.point_bounds[number], self.point_bounds[number + 1])
        c = slice(self.curve_bounds[number], self.curve_bounds[number + 1])
        return self._rows(np.array([number]), p, c, np.array([p.stop - p.start]), np.array([c.stop - c.start]))

    @property
    def key(self) -> SightKey:
        """The key of a single sight."""
        (key,) = self.keys
        return key

    @cached_property
    def seen_once(self) -> frozenset[str | None]:
        """Placements that only one of the sights shows."""
        times = Counter(map(itemgetter(2), self.keys))
        return frozenset(name for name, count in times.items() if count == 1)

    @property
    def on_arc(self) -> Mask:
        """(M,) whether each curve observation is on an arc rather than a straight line."""
        return np.asarray(self.is_arc[self.track_index])

    @property
    def equations(self) -> int:
        """Number of measured numbers: two for each point, one for each curve observation."""
        return 2 * len(self.point_rows) + len(self.curve_rows)

    @cached_property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, without repetition."""
        return tuple(dict.fromkeys(map(itemgetter(0), self.keys)))

    def numbers(
        self, camera: str | None = None, station: str | None = None, placements: Container[str | None] | None = None
    ) -> Indices:
        """Numbers of the sights of this camera, station and these placements; None is no restriction."""
        if self.cameras == (camera,):
            camera = None
        if camera is station is placements is None:
            return np.arange(len(self))
        chosen = np.ones(len(self), dtype=bool)
        asked = (camera and (camera,), station and (station,), placements)
        for place, among in enumerate(asked):
            if among is not None:
                chosen &= np.array([name in among for name in map(itemgetter(place), self.keys)], dtype=bool)
        return np.flatnonzero(chosen)

    def of_camera(self, name: str) -> Sights:
        """Return the sights of one camera."""
        return self.take(self.numbers(camera=name))

    @property
    def of_world(self) -> dict[str, Sights]:
        """Name of a station -> its sight of the world."""
        return {self.keys[number].station: self[int(number)] for number in self.numbers(placements=(None,))}

    def take(self, numbers: Indices) -> Sights:
        """Return the sights with these numbers, in this order."""
        if len(numbers) == len(self) and np.array_equal(numbers, np.arange(len(self))):
            return self
        p, c = ranges(self.point_bounds, numbers), ranges(self.curve_bounds, numbers)
        return self._rows(numbers, p, c, np.diff(self.point_bounds)[numbers], np.diff(self.curve_bounds)[numbers])

    def used_share(self, points: Mask, curves: Mask) -> Array:
        """(S,) share of each sight's observations that are used."""
        if points.all() and curves.all():
            return np.ones(len(self))
        p = bounds_of(points[self.point_rows])[self.point_bounds]
        c = bounds_of(curves[self.curve_rows])[self.curve_bounds]
        return np.asarray((np.diff(p) + np.diff(c)) / (np.diff(self.point_bounds) + np.diff(self.curve_bounds)))

    def about(self, camera: Camera) -> Sights:
        """Return the sights of this camera with pixels as offsets from its principal point, on square pixels."""
        return replace(self, pixels=camera.offsets(self.pixels), curve_pixels=camera.offsets(self.curve_pixels))

    @property
    def reach_px(self) -> float:
        """Largest length of a pixel vector; after `about`, how far observations are from the principal point, px."""
        columns = (self.pixels.T, self.curve_pixels.T)
        return float(np.sqrt(max(np.max(x * x + y * y, initial=0.0) for x, y in columns)))

    def part(self, number: int, count: int) -> Sights:
        """Return part `number` of `count` nearly equal parts of a single sight's observations."""
        first, last = (int(self.point_bounds[-1]) * n // count for n in (number, number + 1))
        start, stop = (int(self.curve_bounds[-1]) * n // count for n in (number, number + 1))
        here = np.zeros(1, dtype=np.int64)
        return self._rows(
            here, slice(first, last), slice(start, stop), np.array([last - first]), np.array([stop - start])
        )

    def used(self, points: Mask, curves: Mask) -> Sights:
        """Return the sights with only these rows of the observations; empty sights are left out."""
        if points.all() and curves.all():
            return self
        p, point_sizes = _left(points[self.point_rows], self.point_bounds)
        c, curve_sizes = _left(curves[self.curve_rows], self.curve_bounds)
        numbers = np.flatnonzero(point_sizes + curve_sizes)
        return self._rows(numbers, p, c, point_sizes[numbers], curve_sizes[numbers])

    def by_feature(self, whole: Mask, *, halved: bool = False) -> Sights:
        """Split each sight into one for every feature that it shows, or for every half of a curve in the image; the
        sights in the mask `whole` (S,) are not split.
        """
        if whole.all():
            return self
        numbers = np.arange(len(self))
        sight = np.concatenate([np.repeat(numbers, np.diff(b)) for b in (self.point_bounds, self.curve_bounds)])
        half = self._halves(sight[len(self.point_rows) :]) if halved else 0
        feature = np.concatenate([2 * self.point_index + 1, 2 * (2 * self.track_index + half) + 2])
        feature[whole[sight]] = 0
        span = 1 + int(feature.max(initial=0))
        names, group = np.unique(sight * span + feature, return_inverse=True)
        p, c = np.split(group, [len(self.point_rows)])
        sizes = np.bincount(p, minlength=len(names)), np.bincount(c, minlength=len(names))
        return self._rows(names // span, np.argsort(p, kind="stable"), np.argsort(c, kind="stable"), *sizes)

    def _halves(self, sight: Indices) -> Indices:
        """(M,) which half of its curve each observation of a sight (M,) lies in, 0 or 1."""
        half = np.zeros(len(sight), dtype=np.int64)
        curve = sight * (1 + int(self.track_index.max(initial=0))) + self.track_index
        for one in np.unique(curve):
            rows = np.flatnonzero(curve == one)
            along = self.curve_pixels[rows][:, np.argmax(np.ptp(self.curve_pixels[rows], axis=0))]
            half[rows] = along > median(along)
        return half

    def displaced(self, points: Array, curves: Array) -> Sights:
        """Return the sights with every observation shifted, by (N, 2) and (M, 2) px in the rows of the observations."""
        pixels, curve_pixels = self.pixels + points[self.point_rows], self.curve_pixels + curves[self.curve_rows]
        return replace(self, pixels=pixels, curve_pixels=curve_pixels)

    def renumbered(self, points: Indices, curves: Indices) -> Sights:
        """Return the sights of some of the observations, given by ascending rows, renumbered as rows of these alone."""
        p, c = (np.full(int(rows.max(initial=-1)) + 1, -1) for rows in (self.point_rows, self.curve_rows))
        p[points], c[curves] = np.arange(len(points)), np.arange(len(curves))
        own = self.used(p >= 0, c >= 0)
        few = self.observations.part(points, curves)
        return replace(own, observations=few, point_rows=p[own.point_rows], curve_rows=c[own.curve_rows])

    @property
    def by_kind(self) -> tuple[Sights, Sights]:
        """The sights with their points alone, and with their curve observations alone."""
        nothing, every = np.zeros(len(self), dtype=np.int64), np.arange(len(self))
        return (
            self._rows(every, slice(None), slice(0, 0), np.diff(self.point_bounds), nothing),
            self._rows(every, slice(0, 0), slice(None), nothing, np.diff(self.curve_bounds)),
        )

    def _rows(self, numbers: Indices, p: _Rows, c: _Rows, point_sizes: Indices, curve_sizes: Indices) -> Sights:
        every = len(numbers) == len(self) and np.array_equal(numbers, np.arange(len(self)))
        chosen = () if every else numbers.tolist()
        return Sights(
            self.observations,
            self.keys if every else tuple(map(self.keys.__getitem__, chosen)),
            self.views if every else tuple(map(self.views.__getitem__, chosen)),
            bounds_of(point_sizes),
            _at(self.point_rows, p),
            _at(self.point_index, p),
            _at(self.points, p),
            _at(self.pixels, p),
            _at(self.sigma_px, p),
            bounds_of(curve_sizes),
            _at(self.curve_rows, c),
            _at(self.track_index, c),
            _at(self.curve_pixels, c),
            _at(self.curve_sigma_px, c),
            self.tracks,
            self.is_arc,
        )


def _at(values: AnyArray, rows: _Rows) -> AnyArray:
    """values[rows]. `take` is several times as fast where a row holds more than one number; runs of rows are faster
    still.
    """
    if isinstance(rows, list):
        return np.concatenate([values[run] for run in rows])
    return values[rows] if isinstance(rows, slice) else values.take(rows, axis=0)


def _left(stays: Mask, bounds: Indices) -> tuple[_Rows, Indices]:
    """Return the rows that stay, as runs if few are removed, and the number of rows that stay in each sight."""
    gone = np.flatnonzero(~stays)
    sizes = np.diff(bounds) - np.diff(np.searchsorted(gone, bounds))
    if len(gone) * _RUN > len(stays):
        return np.flatnonzero(stays), sizes
    return list(map(slice, [0, *(gone + 1).tolist()], [*gone.tolist(), len(stays)])), sizes


def bounds_of(sizes: Sequence[int] | AnyArray) -> Indices:
    """(S + 1,) where each of S consecutive runs of these sizes begins, and where the last one ends."""
    bounds = np.zeros(len(sizes) + 1, dtype=np.int64)
    np.cumsum(sizes, out=bounds[1:])
    return bounds


def ranges(bounds: Indices, numbers: Indices) -> Indices:
    """Row numbers from bounds[i] to bounds[i + 1], for each i of `numbers` in turn."""
    sizes = np.diff(bounds)[numbers]
    starts = np.repeat(bounds[numbers] - bounds_of(sizes)[:-1], sizes)
    return np.asarray(starts + np.arange(sizes.sum()))


def gather_sights(observations: Observations, *, predicted: bool = False) -> Sights:
    """Return the sights of all observations that are no copies of others; empty sights are left out.

    Args:
        predicted: whether the observations are predictions: without noise, frames of a static camera look like copies.
    """
    every = sights_of(observations)
    return every if predicted else every.used(*observations.copies.originals)


def sights_of(observations: Observations) -> Sights:
    """Return the sights of all observations; empty sights are left out."""
    keys = [SightKey(view.camera, view.station, view.placement) for view in observations.views]
    order = tuple(dict.fromkeys(keys))
    sight_of_view, views_of = numbers_of(keys, order), [list[int]() for _ in order]
    for number, sight in enumerate(sight_of_view.tolist()):
        views_of[sight].append(number)

    targets = list(observations.targets.values())
    target_of_view = numbers_of((view.target for view in observations.views), observations.targets)
    first_point = bounds_of([len(t.points) for t in targets])[target_of_view]
    first_track = bounds_of([3 * len(t.curves) for t in targets])[target_of_view]
    curve_count = np.array([len(t.curves) for t in targets], dtype=np.int64)[target_of_view]

    points, curves = observations.points, observations.curves
    p, point_bounds = _grouped(points, sight_of_view, len(order))
    c, curve_bounds = _grouped(curves, sight_of_view, len(order))
    point_index = first_point[points.view[p]] + points.feature[p]
    side = curves.side[c] % 3  # -1 is the last of a target's three sets of tracks
    track_index = first_track[curves.view[c]] + side * curve_count[curves.view[c]] + curves.feature[c]
    every = Sights(
        observations,
        order,
        tuple(tuple(views) for views in views_of),
        point_bounds,
        np.arange(len(points))[p],
        point_index,
        np.concatenate([t.point_array for t in targets]).take(point_index, axis=0),
        _at(points.pixels, p),
        _at(points.sigma_px, p),
        curve_bounds,
        np.arange(len(curves))[c],
        track_index.astype(np.int32),
        _at(curves.pixels, c),
        _at(curves.sigma_px, c),
        np.concatenate([t.tracks.reshape(-1, 3, 3) for t in targets]),
        np.concatenate([np.tile(t.is_arc, 3) for t in targets]),
    )
    filled = np.flatnonzero(np.diff(point_bounds) + np.diff(curve_bounds))
    return every if len(filled) == len(every) else every.take(filled)


def _grouped(columns: Columns, sight_of_view: Indices, count: int) -> tuple[Indices | slice, Indices]:
    """Return the rows in the order of their sights (a slice if already sorted), and where each sight begins."""
    sight = sight_of_view[columns.view]
    if np.all(sight[1:] >= sight[:-1]):
        return slice(None), np.searchsorted(sight, np.arange(count + 1))
    order = np.argsort(sight, kind="stable")
    return order, np.searchsorted(sight[order], np.arange(count + 1))


def nearest_feet(sight: Sights, camera: Camera) -> Array:
    """(M,) parameter on the track where each curve observation's ray passes nearest: the initial estimate of its foot.

    `camera` is posed in the frame of the single sight (cam_from_frame). Where the lens has no ray the track's origin is
    taken.
    """
    block = 1 << 16  # rows processed at once, so that memory stays small compared with the observations
    blocks = range(0, len(sight.curve_pixels), block)
    return np.concatenate([np.empty(0), *(_nearest(sight, camera, slice(at, at + block)) for at in blocks)])


def _nearest(sight: Sights, camera: Camera, rows: slice) -> Array:
    rays = np.nan_to_num(camera.rays(sight.curve_pixels[rows]) @ camera.cam_from_world.rotation)
    track = sight.track_index[rows]
    return nearest_to_rays(sight.tracks[track], sight.on_arc[rows], camera.position, rays)


# ---- some of the observations, evenly, where all of them would take too long ----------------------------------------

MANY = 2_000_000
"""Number of observations of the world above which a subset decides, and the others contribute by sums."""


def is_bulk(observations: Observations) -> bool:
    """Whether a subset of the observations is to decide."""
    if observations.rows <= MANY:
        return False
    world = np.array([view.placement is None for view in observations.views])
    return sum(int(np.diff(ends)[world].sum()) for ends in observations.ends) > MANY


def column_of(observations: Observations, name: str) -> AnyArray:
    """(N + M,) one column of the points followed by that of the curves."""
    return np.concatenate([getattr(observations.points, name), getattr(observations.curves, name)])


def shown_rows(sights: Sights) -> Mask:
    """(N + M,) mask of the observations in the sights: points by row, then curves by row."""
    rows = np.zeros(sights.observations.rows, dtype=bool)
    rows[sights.point_rows] = rows[len(sights.observations.points) + sights.curve_rows] = True
    return rows


def frames_of(observations: Observations) -> tuple[tuple[str, ...], Indices]:
    """Return the names of the frames that show anything, and (N + M,) the number of each observation's frame."""
    views = column_of(observations, "view")
    shown = np.flatnonzero(np.bincount(views)).tolist()
    names = dict.fromkeys(observations.views[view].frame for view in shown)
    order = {name: number for number, name in enumerate(names)}
    return tuple(names), np.array([order.get(view.frame, -1) for view in observations.views])[views]


def thinned(observations: Observations, most: int, fewest_frames: int = 40) -> Observations:
    """Select evenly spread frames, and evenly spread observations in them, about `most` in all."""
    if observations.rows <= most:
        return observations
    names, frame = frames_of(observations)
    count = max(min(fewest_frames, len(names)), int(len(names) * most / observations.rows))
    taken = np.zeros(len(names), dtype=bool)
    taken[evenly(len(names), count)] = True
    chosen = taken[frame]
    step = max(1, round(np.count_nonzero(chosen) / most))
    masks = np.split(chosen, [len(observations.points)])
    for mask in masks:
        mask[np.flatnonzero(mask)[np.arange(np.count_nonzero(mask)) % step > 0]] = False
    return observations.part(*masks)


def some_views(counts: Indices, most: int, fewest: int) -> Indices:
    """Numbers of an evenly spread selection of the views with observations: enough views for about `most` observations,
    but at least `fewest` views. `counts` (V,) is the number of observations in each view.
    """
    shown = np.flatnonzero(counts)
    taken = min(max(fewest, len(shown) * most // int(counts.sum())), len(shown))
    return np.asarray(shown[np.linspace(0, len(shown) - 1, taken).astype(np.int64)])


def thinned_by_key(rows: Indices, key: Indices, of_group: Mask, most_rows: int) -> Indices:
    """Thin rows of a group evenly to at most `most_rows` for each key; rows outside the group are kept."""
    order = np.argsort(key, kind="stable")
    _, starts, count = np.unique(key[order], return_index=True, return_counts=True)
    place, size = np.arange(len(order)) - np.repeat(starts, count), np.repeat(count, count)
    most = np.where(of_group[order], np.minimum(size, most_rows), size)
    return np.asarray(rows[order[(place * most) // size != ((place - 1) * most) // size]])
