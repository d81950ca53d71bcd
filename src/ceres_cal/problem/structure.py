"""The target as built: how far painted lines, points and boards are off their drawing, as numbers with a tolerance.

One vector holds everything observed, shared by all frames and cameras: for each segment its offset to the left; for
each arc its centre's x and y and its radius; for each point its x and y; for each board its warp (two bows, a twist and
two waves), the heights of its points beside the warp, and its stretch along columns and along rows. All are in metres,
and 0 is the nominal target. After them come dimensions of targets that are not known, such as a field's length: each
moves the offsets of many features at once.

Also the dimensions by which targets are drawn, and how another value of one displaces points and curves.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import repeat
from typing import Literal

import numpy as np

from ceres_cal.base import Array, Indices, Indices32, InputError, Mask, no_such, take_types
from ceres_cal.base.frozen import Frozen, cached_property, field, replace
from ceres_cal.observations.sights import Sights
from ceres_cal.problem.information import Key
from ceres_cal.scene import Arc, Curve, Segment, Target, target_from_spec
from ceres_cal.scene.targets.target import STRETCH as STRETCH
from ceres_cal.scene.targets.target import WARP as WARP

Kind = Literal["lines", "points", "warp", "heights", "stretch"]
"""The kinds of features that a tolerance is about."""


class Tolerance(Frozen, eq=True):
    """Standard deviations of a target as built; 0 means exactly as drawn.

    Attributes:
        lines_m: of the offset of each segment, and of the centre and radius of each arc.
        points_m: of x and y of each point.
        warp_m: of each of WARP at its largest: a board's bow along each side, its twist, a wave along each side.
        heights_m: of the height of each point of a board, beside its warp.
        stretch_m: of each of STRETCH: by how much a board is longer along a side, in proportion to the longer side.
        curve_m: name of a curve -> its own standard deviation, which replaces lines_m.
    """

    lines_m: float = 0.0
    points_m: float = 0.0
    warp_m: float = 0.0
    heights_m: float = 0.0
    stretch_m: float = 0.0
    curve_m: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        take_types(self)
        for name, value in ({**vars(self), **self.curve_m}).items():
            if name != "curve_m" and not (np.isfinite(value) and value >= 0.0):
                raise InputError(f"tolerance {name} must be a number of metres from 0 on, not {value}")


class Structure(Frozen):
    """The corrections of all targets.

    Attributes:
        names: (Z) "target/feature" or "target/feature.x", what each number moves; the last D are dimensions,
            "target/dimension". values: (Z,) offsets, m, and dimensions, m. sigma_m: (Z,) tolerance of each; infinite
            for a dimension, which has a prior or none.
        point_slots: (P, 2 + W + 3) number of the offset that moves each point of all targets: x, y, each of WARP, its
            own height and each of STRETCH; -1 for none. bends: (P, W + 3) share of a board's offsets that each point
            gets, along +z, and along x and y.
        track_slots: (T, 3) number of the offset that moves each track: for a segment the offset, for an arc x, y and
            radius. These three are empty if nothing moves at all.
        slopes: (Q, D) by how much a dimension moves each of the Q offsets: those among the numbers, and those of
            features that only dimensions move. drawn_m: (D,) the dimensions of the targets as drawn.
    """

    names: tuple[str, ...]
    values: Array
    sigma_m: Array
    point_slots: Indices32
    bends: Array
    track_slots: Indices32
    slopes: Array = field(default_factory=lambda: np.empty((0, 0)))
    drawn_m: Array = field(default_factory=lambda: np.empty(0))

    @property
    def own(self) -> int:
        """How many of the numbers are offsets."""
        return len(self.names) - len(self.drawn_m)

    @property
    def dimensions(self) -> dict[str, float]:
        """Name and length, m, of each dimension among the numbers."""
        return dict(zip(self.names[self.own :], self.values[self.own :].tolist(), strict=True))

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """(Z) keys of the numbers."""
        kinds = ["structure"] * self.own + ["dimension"] * len(self.drawn_m)
        return tuple(Key.of_structure(name, kind) for name, kind in zip(self.names, kinds, strict=True))

    @cached_property
    def sizes_m(self) -> Array:
        """(Z,) natural sizes, m: tolerances, and the dimensions as drawn."""
        return np.concatenate([self.sigma_m[: self.own], self.drawn_m])

    @property
    def offsets(self) -> Array:
        """(Q,) m, all offsets, including those due to dimensions."""
        if not len(self.drawn_m):
            return self.values
        offsets = self.slopes @ (self.values[self.own :] - self.drawn_m)
        offsets[: self.own] += self.values[: self.own]
        return np.asarray(offsets)

    @cached_property
    def mixing(self) -> Array | None:
        """(Q, Z) derivatives of the offsets by the numbers; None if the numbers are the offsets."""
        if not len(self.drawn_m):
            return None
        return np.hstack([np.eye(len(self.slopes))[:, : self.own], self.slopes])

    def chain(self, before: int, behind: int) -> Array | None:
        """(before + Q + behind, before + Z + behind) `mixing` among other numbers, which stay unchanged; or None."""
        if self.mixing is None:
            return None
        rows, columns = self.mixing.shape
        whole = np.zeros((before + rows + behind, before + columns + behind))
        whole[:before, :before], whole[before + rows :, before + columns :] = np.eye(before), np.eye(behind)
        whole[before : before + rows, before : before + columns] = self.mixing
        return whole

    def places(self, keys: Iterable[Key]) -> list[int]:
        """The positions of the numbers of some keys."""
        return [self.names.index(key.structure_name) for key in keys]

    def with_values(self, values: Array) -> Structure:
        """The same corrections with other values."""
        return replace(self, values=np.array(values, dtype=float)) if len(self.values) else self

    def carrying(self, *others: Structure) -> Structure:
        """The same corrections with values from others, by name; values that others lack are as drawn."""
        known = dict(zip(self.names[self.own :], self.drawn_m.tolist(), strict=True))
        for other in others:
            known |= zip(other.names, other.values.tolist(), strict=True)
        return self.with_values(np.array(list(map(known.get, self.names, repeat(0.0)))))

    def redrawn(self) -> Structure:
        """The same corrections for targets that are drawn with the present dimensions."""
        return replace(self, drawn_m=self.values[self.own :].copy())

    def points(self, sights: Sights) -> Array:
        """(N, 3) m, the observed points of the sights as built."""
        return self._points(sights.points, sights.point_index)

    def tracks(self, sights: Sights) -> Array:
        """(T, 3, 3) the tracks of all targets as built."""
        return self._tracks(sights.tracks, sights.is_arc)

    def built_into(self, sights: Sights) -> Sights:
        """The sights of targets that are drawn as they are built."""
        if not len(self.values):
            return sights
        return replace(sights, points=self.points(sights), tracks=self.tracks(sights))

    def built(self, targets: Mapping[str, Target]) -> dict[str, tuple[Array, Array]]:
        """The points (P, 3) of every target as built, m, and its tracks (3, C, 3, 3) in the form of `Target.tracks`.
        `targets` must be those for which the corrections were made, in the same order.
        """
        points = np.concatenate([target.point_array for target in targets.values()])
        tracks = np.concatenate([target.tracks.reshape(-1, 3, 3) for target in targets.values()])
        is_arc = np.concatenate([np.tile(target.is_arc, 3) for target in targets.values()])
        points, tracks = self._points(points, np.arange(len(points))), self._tracks(tracks, is_arc)
        built = {}
        for name, target in targets.items():
            own, points = np.split(points, [len(target.points)])
            curves, tracks = np.split(tracks, [3 * len(target.curves)])
            built[name] = own, curves.reshape(3, -1, 3, 3)
        return built

    def _points(self, points: Array, feature: Indices) -> Array:
        if not len(self.values):
            return points
        moved = np.append(self.offsets, 0.0)[self.point_slots[feature]]  # slot -1 is the 0 at the end
        heights, stretches = np.split(moved[:, 2:] * self.bends[feature], [-len(STRETCH)], axis=1)
        return np.asarray(points + np.column_stack([moved[:, :2] + stretches, heights.sum(axis=1)]))

    def _tracks(self, given: Array, is_arc: Mask) -> Array:
        if not len(self.values):
            return given
        moved = np.append(self.offsets, 0.0)[self.track_slots]
        tracks = given.copy()
        straight = ~is_arc
        along = tracks[straight, 1, :2]
        length = np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
        tracks[straight, 0, :2] += moved[straight, :1] * np.column_stack([-along[:, 1], along[:, 0]]) / length
        tracks[is_arc, 0, :2] += moved[is_arc, :2]
        tracks[is_arc, 1, 0] += moved[is_arc, 2]
        tracks[is_arc, 2, 1] += moved[is_arc, 2]
        return tracks


EXACT = Structure(
    (),
    np.empty(0),
    np.empty(0),
    np.empty((0, 3 + len(WARP) + len(STRETCH)), dtype=np.int32),
    np.empty((0, 1 + len(WARP) + len(STRETCH))),
    np.empty((0, 3), dtype=np.int32),
)
"""The structure of targets exactly as drawn."""


def make_structure(
    targets: Mapping[str, Target], tolerances: Mapping[str, Tolerance], dimensions: Collection[str] = ()
) -> Structure:
    """Make the corrections that the tolerances free, all 0, with dimensions, "target/dimension", as drawn.

    Raises:
        InputError: a tolerance or a dimension names a target that does not exist, a dimension that the target does not
            have or that moves nothing, or a warp of a target that does not bow.
    """
    for name in tolerances:
        if name not in targets:
            raise InputError(f"a tolerance: {no_such('target', name, targets)}")
    if all(tolerance == Tolerance() for tolerance in tolerances.values()) and not dimensions:
        return EXACT
    parts = [_tolerated(name, target, tolerances.get(name, Tolerance())) for name, target in targets.items()]
    every, sigmas = [name for names, _ in parts for name in names], np.concatenate([sigma_m for _, sigma_m in parts])
    free = np.flatnonzero(sigmas > 0.0)
    order = np.concatenate([free, np.flatnonzero(sigmas == 0.0)]) if dimensions else free
    names = [every[number] for number in order.tolist()]
    drawn_m, slopes = dimension_slopes(names, targets, dimensions)
    for name, column in zip(dimensions, slopes.T, strict=True):
        if not np.any(column):
            raise InputError(f"no line or point depends on {name}: it cannot be solved for")
    moved = np.any(slopes != 0.0, axis=1) | (np.arange(len(slopes)) < len(free))
    place = np.full(len(every), -1, dtype=np.int32)
    place[order[moved]] = np.arange(np.count_nonzero(moved))
    return Structure(
        (*names[: len(free)], *dimensions),
        np.concatenate([np.zeros(len(free)), drawn_m]),
        np.concatenate([sigmas[free], np.full(len(drawn_m), np.inf)]),
        *_slots(targets, place),
        slopes[moved],
        drawn_m,
    )


def _tolerated(name: str, target: Target, tolerance: Tolerance) -> tuple[list[str], Array]:
    """Names and tolerances of all offsets that a target may have, in the order of the solver's numbers."""
    if max(tolerance.warp_m, tolerance.heights_m, tolerance.stretch_m) > 0.0 and not target.bows:
        raise InputError(
            "warp_m, heights_m and stretch_m are for checkerboards and similar boards only: "
            f"target {name!r} is of kind {target.kind!r}"
        )
    curves = [(one, part) for one, curve in target.curves.items() for part in _parts_of(curve)]
    names = [
        *[f"{name}/{one}{part}" for one, part in curves],
        *[f"{name}/{part}" for part in WARP],
        *[f"{name}/{one}.{axis}" for one in target.points for axis in "xy"],
        *[f"{name}/{one}.z" for one in target.points],
        *[f"{name}/{part}" for part in STRETCH],
    ]
    sigmas = [tolerance.curve_m.get(one, tolerance.lines_m) for one, _ in curves]
    others = (tolerance.warp_m, tolerance.points_m, tolerance.heights_m, tolerance.stretch_m)
    count = len(target.points)
    return names, np.concatenate([sigmas, np.repeat(others, (len(WARP), 2 * count, count, len(STRETCH)))])


def _parts_of(curve: Curve) -> tuple[str, ...]:
    return (".x", ".y", ".radius") if isinstance(curve, Arc) else ("",)


def _slots(targets: Mapping[str, Target], place: Indices32) -> tuple[Indices32, Array, Indices32]:
    """Point slots, bends and track slots, from the position of each offset in the order of `_tolerated`."""
    none = -1
    point_slots, track_slots, start = [], [], 0
    for target in targets.values():
        curves = []
        for curve in target.curves.values():
            parts = len(_parts_of(curve))
            curves.append([*place[start : start + parts], *[none] * (3 - parts)])
            start += parts
        track_slots += curves * 3  # the paint's centre and both edges move together
        count = len(target.points)
        ends = np.cumsum([len(WARP), 2 * count, count, len(STRETCH)])
        warp, flat, heights, stretch, _ = np.split(place[start:], ends)
        warp, stretch = (np.tile(part, (count, 1)) for part in (warp, stretch))
        point_slots.append(np.column_stack([flat.reshape(-1, 2), warp, heights, stretch]))
        start += int(ends[-1])
    return (
        np.concatenate(point_slots),
        np.concatenate([target.bends for target in targets.values()]),
        np.array(track_slots, dtype=np.int32).reshape(-1, 3),
    )


def numbers_by_kind(structure: Structure, targets: Mapping[str, Target]) -> dict[tuple[str, Kind], Indices]:
    """(target, kind) -> positions of its numbers in the structure, where there are any."""
    numbers: dict[tuple[str, Kind], Indices] = {}
    if not structure.names:
        return numbers
    points = np.cumsum([0, *(len(target.points) for target in targets.values())])
    curves = 3 * np.cumsum([0, *(len(target.curves) for target in targets.values())])
    for place, name in enumerate(targets):
        own = structure.point_slots[points[place] : points[place + 1]]
        tracks = structure.track_slots[curves[place] : curves[place + 1]]
        kinds: tuple[tuple[Kind, Indices32], ...] = (
            ("lines", tracks), ("points", own[:, :2]), ("warp", own[:, 2 : 2 + len(WARP)]),
            ("heights", own[:, 2 + len(WARP), None]), ("stretch", own[:, -len(STRETCH) :]),
        )  # fmt: skip
        every = {
            (name, kind): np.flatnonzero(np.bincount(slots[(slots >= 0) & (slots < structure.own)]))
            for kind, slots in kinds
        }
        numbers |= {of: slots for of, slots in every.items() if len(slots)}
    return numbers


_STEP = 1e-3  # relative change of a dimension in a difference: features move in proportion


def dimensions_of(targets: Mapping[str, Target]) -> dict[str, float]:
    """The dimensions, m, of all targets, as "target/dimension"."""
    return {f"{name}/{one}": length for name, target in targets.items() for one, length in target.dimensions.items()}


def dimension_slopes(
    offsets: Sequence[str], targets: Mapping[str, Target], dimensions: Collection[str]
) -> tuple[Array, Array]:
    """Lengths (D,) of dimensions, m, and derivatives (Q, D) of offsets by them, m per m.

    Raises:
        InputError: no target has one of the dimensions.
    """
    known, columns = dimensions_of(targets), np.zeros((len(offsets), len(dimensions)))
    place = {name: row for row, name in enumerate(offsets)} if dimensions else {}
    for column, name in enumerate(dimensions):
        if name not in known:
            raise InputError(no_such("dimension to solve for", name, known))
        target, _, dimension = name.partition("/")
        spec = targets[target].spec
        other = target_from_spec({**spec, dimension: (1.0 + _STEP) * known[name]}, target)
        for feature, moved_m in _differences(target, targets[target], other):
            if feature in place:
                columns[place[feature], column] = moved_m / (_STEP * known[name])
    return np.array([known[name] for name in dimensions]), columns


def features_of(target: Target, dimension: str) -> frozenset[str]:
    """The points and curves that lie elsewhere for another value of a dimension."""
    other = redrawn(target, {dimension: (1.0 + _STEP) * target.dimensions[dimension]})
    moved = (name for name, moved_m in _differences("", target, other) if moved_m != 0.0)
    return frozenset(name[1:].partition(".")[0] for name in moved)


def redrawn(target: Target, lengths_m: Mapping[str, float]) -> Target:
    """A target with other dimensions."""
    return target_from_spec({**target.spec, **lengths_m}, "target") if lengths_m else target


def _differences(name: str, target: Target, other: Target) -> Iterator[tuple[str, float]]:
    """The change of each structure number, in m, that turns one target into another."""
    for feature, curve in target.curves.items():
        there = other.curves[feature]
        if isinstance(curve, Arc) and isinstance(there, Arc):
            x, y = np.subtract(there.centre, curve.centre)[:2]
            yield f"{name}/{feature}.x", float(x)
            yield f"{name}/{feature}.y", float(y)
            yield f"{name}/{feature}.radius", there.radius_m - curve.radius_m
        elif isinstance(curve, Segment) and isinstance(there, Segment):
            x, y = np.subtract(curve.end, curve.start)[:2] / curve.length_m
            yield f"{name}/{feature}", float(np.subtract(there.start, curve.start)[:2] @ (-y, x))
    for feature, place in target.points.items():
        x, y = np.subtract(other.points[feature], place)[:2]
        yield f"{name}/{feature}.x", float(x)
        yield f"{name}/{feature}.y", float(y)
