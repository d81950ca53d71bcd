"""The numbers behind the keys: their values in an estimate, natural sizes, steps along them, and possible ranges.

Also how the pixels that a camera shows move with its numbers: exactly, by the kernels of the solve.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import numpy as np

from ceres_cal import kernels
from ceres_cal.base import Array, Frozen, InputError, Pose, replace, rotation_exp, rotation_log, skew, two_digits
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.information import POSE_QUANTITIES, STATION_QUANTITIES, Key, columns_by_owner, pose_keys
from ceres_cal.problem.parameters import (
    Estimate,
    Layout,
    Options,
    Station,
    intrinsic_names,
    intrinsics_scales,
    intrinsics_vector,
    unit_px,
    with_intrinsics,
)
from ceres_cal.problem.residuals import camera_optics
from ceres_cal.problem.structure import Tolerance, dimensions_of
from ceres_cal.scene import Camera, Lens


class PixelSlopes(NamedTuple):
    """Derivatives of the pixels that show N places; NaN where one is not shown.

    Attributes:
        intrinsics: (N, 2, C) by all intrinsics, in the units of the files. turns: (N, 2, 3) px per rad, about the
            camera's axes. places: (N, 2, 3) px per m.
    """

    intrinsics: Array
    turns: Array
    places: Array


def pixel_slopes(camera: Camera, places: Array) -> PixelSlopes:
    """The derivatives for a camera at its pose, for places (N, 3) m; NaN for places that are NaN."""
    optics, scales = camera_optics(camera), intrinsics_scales(camera)
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    count, size = len(known), len(scales)
    points = kernels.PointColumns(
        np.array([0, count]),
        np.ascontiguousarray(places[known]),
        np.zeros((count, 2)),
        kernels.NOTHING,
        np.empty((0, kernels.BUILT), dtype=np.int32),
        np.zeros((count, kernels.BUILT - 2)),
    )
    rows = np.full((len(places), 2, size + 6 + kernels.BUILT), np.nan)
    shown = rows[known]
    kernels.point_rows(optics, camera.cam_from_world.matrix[None], points, shown)
    rows[known] = shown
    intrinsics, turns, shifts, _ = np.split(rows, [size, size + 3, size + 6], axis=2)
    pose = camera.cam_from_world  # a turn about the camera also turns its translation
    return PixelSlopes(intrinsics * scales, turns + shifts @ skew(pose.translation).T, shifts @ pose.rotation)


def natural_sizes(estimate: Estimate, keys: Sequence[Key]) -> Array:
    """(P,) natural size of each number: an error of a hundredth of it moves a picture by about a hundredth.

    It is phi for phi and the principal point, the distance to what is seen for positions, 1 rad for turns, the value
    that moves a pixel half an image diagonal from the middle by as much for coefficients, the tolerance for structure,
    and the dimension itself for dimensions.
    """
    sizes = np.ones(len(keys))
    for (kind, owner), columns in columns_by_owner(keys).items():
        if kind == "camera":
            camera = estimate.cameras[owner]
            known = {"phi": camera.phi, "cx": camera.phi, "cy": camera.phi, "aspect": 1.0, "skew": 1.0}
            natural = camera.lens.natural_sizes(camera.phi, unit_px(camera))
            known |= zip(camera.lens.names, natural, strict=True)
            sizes[columns] = [known[keys[column].quantity] for column in columns]
        elif kind == "structure":
            sizes[columns] = estimate.structure.sizes_m[estimate.structure.places(keys[column] for column in columns)]
        else:
            distance = _distance_m(estimate, kind, owner)
            sizes[columns] = [distance if keys[column].unit == "m" else 1.0 for column in columns]
    return sizes


def _distance_m(estimate: Estimate, kind: str, owner: str) -> float:
    """Distance (m) of a station from the floor, or from the nearest placement if that is larger; or of a placement from
    the nearest station. For a rig that sees no field, the floor means nothing: heights are relative to another camera.
    """
    if kind == "station":
        here, others = estimate.stations[owner].cam_from_world.position, list(estimate.placements.values())
        floor, away = abs(float(here[2])), [np.linalg.norm(one.translation - here) for one in others]
        return max(floor, float(min(away, default=0.0)), 1e-3)
    where = estimate.placements[owner].translation
    away = [np.linalg.norm(where - station.cam_from_world.position) for station in estimate.stations.values()]
    return max(float(min(away)), 1e-3)


def values_of(estimate: Estimate, keys: Sequence[Key]) -> Array:
    """(P,) the estimate's numbers in the units of the keys; 0 for turns."""
    values = np.zeros(len(keys))
    for (kind, owner), columns in columns_by_owner(keys).items():
        names = [keys[column].quantity for column in columns]
        if kind == "camera":
            camera = estimate.cameras[owner]
            numbers = camera.phi, camera.aspect, *camera.principal_point, *camera.lens.values, camera.skew
            known = dict(zip(intrinsic_names(camera.lens), numbers, strict=True))
            values[columns] = [known[name] for name in names]
        elif kind == "structure":
            values[columns] = estimate.structure.values[estimate.structure.places(keys[column] for column in columns)]
        else:
            held = estimate.placements[owner].translation if kind == "placement" else None
            place = estimate.stations[owner].cam_from_world.position if held is None else held
            six = [*place.tolist(), 0.0, 0.0, 0.0]
            values[columns] = [six[POSE_QUANTITIES[kind].index(name)] for name in names]
    return values


def intrinsic_keys(name: str, lens: Lens) -> tuple[Key, ...]:
    """Keys of all intrinsics of a camera, in the order of the solver's vector."""
    return _intrinsic_keys(name, intrinsic_names(lens), lens.units)


@lru_cache(maxsize=64)
def _intrinsic_keys(name: str, quantities: tuple[str, ...], units: tuple[str, ...]) -> tuple[Key, ...]:
    every = zip(quantities, ("px", "1", "px", "px", *units, "1"), strict=True)
    return tuple(Key("camera", name, quantity, unit) for quantity, unit in every)


def every_key(estimate: Estimate) -> frozenset[Key]:
    """Keys of all numbers of an estimate, free or held."""
    intrinsics = (intrinsic_keys(name, camera.lens) for name, camera in estimate.cameras.items())
    stations = (pose_keys("station", name) for name in estimate.stations)
    placements = (pose_keys("placement", name) for name in estimate.placements)
    return frozenset(chain(*intrinsics, *stations, *placements, estimate.structure.keys))


def free_keys(estimate: Estimate, layout: Layout, private: Set[str | None] = frozenset()) -> tuple[Key, ...]:
    """Keys of everything free except private placements: cameras, stations, placements, structure."""
    keys: list[Key] = []
    for name, camera in estimate.cameras.items():
        every = intrinsic_keys(name, camera.lens)
        keys += [every[number] for number in layout.free[name]]
    for name in estimate.stations:
        keys += pose_keys("station", name) if name in layout.stations else []
    shared = layout.placements - private
    for name in estimate.placements if shared else ():
        keys += pose_keys("placement", name) if name in shared else []
    return (*keys, *estimate.structure.keys)


def from_station(cam_from_frame: Array, cam_from_world: Pose) -> Array:
    """(S, 6, 6) left perturbation (turn, shift) of each cam_from_frame (S, 3, 4) by a step of the station's six."""
    chain = np.zeros((len(cam_from_frame), 6, 6))
    chain[:, :3, 3:] = np.eye(3)
    chain[:, 3:, :3] = -cam_from_world.rotation
    chain[:, 3:, 3:] = [-skew(shift) for shift in cam_from_frame[:, :, 3]]
    return chain


def from_placement(cam_from_target: Array, cam_from_world: Pose) -> Array:
    """(S, 6, 6) left perturbation (turn, shift) of each cam_from_target (S, 3, 4) by a step of its placement's six: an
    orthogonal matrix.
    """
    chain = np.zeros((len(cam_from_target), 6, 6))
    chain[:, :3, 3:] = cam_from_target[:, :, :3]
    chain[:, 3:, :3] = cam_from_world.rotation
    return chain


def layout_of(keys: Sequence[Key], estimate: Estimate, placements: Iterable[str] = ()) -> Layout:
    """The layout of a problem whose shared numbers are the keys; `placements` are free besides."""
    free = {}
    for name, camera in estimate.cameras.items():
        place = {quantity: number for number, quantity in enumerate(intrinsic_names(camera.lens))}
        numbers = sorted(place[key.quantity] for key in keys if key[:2] == ("camera", name))
        free[name] = np.array(numbers, dtype=np.int64)
    stations, shared = (frozenset(key.owner for key in keys if key.kind == kind) for kind in ("station", "placement"))
    return Layout(free, stations, shared | frozenset(placements))


def camera_moved(camera: Camera, quantities: Sequence[str], step: Array) -> Camera:
    """A camera after a step along some of its intrinsics, in the units of the files.

    Raises:
        InputError: phi or aspect is no longer above 0.
    """
    vector, known = intrinsics_vector(camera), intrinsic_names(camera.lens)
    at = [known.index(name) for name in quantities]
    vector[at] += step * intrinsics_scales(camera)[at]
    return with_intrinsics(camera, vector)


def moved(estimate: Estimate, keys: Sequence[Key], step: Array) -> Estimate:
    """The estimate after a step (P,) along the keys.

    Raises:
        InputError: the step leads to no camera (phi or aspect below 0).
    """
    cameras, stations = dict(estimate.cameras), dict(estimate.stations)
    placements: dict[str, Pose] = {}
    values = estimate.structure.values.copy()
    for (kind, owner), columns in columns_by_owner(keys).items():
        names = [keys[column].quantity for column in columns]
        if kind == "camera":
            cameras[owner] = camera_moved(cameras[owner], names, step[columns])
        elif kind == "structure":
            values[estimate.structure.places(keys[column] for column in columns)] += step[columns]
        else:
            change = np.zeros(6)
            change[[POSE_QUANTITIES[kind].index(name) for name in names]] = step[columns]
            if kind == "station":
                old = stations[owner].cam_from_world
                pose = Pose.looking(old.position + change[:3], rotation_exp(change[3:]) @ old.rotation)
                stations[owner] = Station(stations[owner].camera, pose)
            else:
                held = estimate.placements[owner]
                placements[owner] = Pose(held.rotation @ rotation_exp(change[3:]), held.translation + change[:3])
    return replace(
        estimate,
        cameras=cameras,
        stations=stations,
        placements={**estimate.placements, **placements} if placements else estimate.placements,
        structure=estimate.structure.with_values(values),
    )


def difference(estimate: Estimate, reference: Estimate, keys: Sequence[Key]) -> Array:
    """The step (P,) along the keys that leads from the reference to the estimate."""
    step = values_of(estimate, keys) - values_of(reference, keys)
    for (kind, owner), columns in columns_by_owner(keys).items():
        if kind == "station":
            here, there = (one.stations[owner].cam_from_world.rotation for one in (estimate, reference))
            turn = rotation_log(here @ there.T)
        elif kind == "placement":
            here, there = (one.placements[owner].rotation for one in (estimate, reference))
            turn = rotation_log(there.T @ here)
        else:
            continue
        for column in columns:
            if keys[column].unit == "rad":
                step[column] = turn[STATION_QUANTITIES.index(keys[column].quantity) - 3]
    return step


# ---- what a stated number can be ------------------------------------------------------------------------------------


# The range of each kind of number, checked once for all that is stated before a solve. A range is wide: values beyond
# it are impossible, not unusual. Values within it are judged by the observations (`robust/conflicts.py`).

PHI_RANGE = (0.15, 15.0)
"""Range of phi in half image diagonals: 163 to 8 degrees across the image's diagonal, all lenses used over fields."""


def is_lens(camera: Camera) -> bool:
    """Whether its phi is possible for a lens over a field."""
    return PHI_RANGE[0] <= camera.phi / unit_px(camera) <= PHI_RANGE[1]


_REDRAWN = 20.0  # largest ratio of a dimension to the drawing, or its inverse: beyond it another target was drawn
# Largest tolerance, relative to the longest side of the target's box. Paper held by hand bends by a fiftieth.
_BUILT = 0.05
FINEST = 1e-6
"""Least standard deviation, m and px: nobody measures to a millionth of either. A hundredth of it is solved for without
loss; at a ten-thousandth the solve no longer converges."""


class Range(Frozen, eq=True):
    """The possible values of one kind of number.

    Attributes:
        least, most: in its unit. unit: "m", "px" or "". finest: least standard deviation. why: reason of the limits.
    """

    least: float
    most: float
    unit: str
    finest: float
    why: str

    def holds(self, value: float) -> bool:
        """Whether a value is possible."""
        return self.least <= value <= self.most

    def require(self, value: float, what: str) -> None:
        """Raise InputError if a value is impossible; `what` names the number."""
        if self.holds(value):
            return
        bound = f"at most {self.most:.3g}" if value > self.most else f"at least {self.least:.3g}"
        unit = f" {self.unit}" if self.unit else ""
        raise InputError(f"{what} is {value:g}{unit}, but must be {bound}{unit}: {self.why}{self._in_mm(value)}")

    def require_sigma(self, sigma: float, what: str) -> None:
        """Raise InputError if a standard deviation is smaller than anything measured; `what` names the number."""
        if sigma < self.finest:
            unit = f" {self.unit}" if self.unit else ""
            raise InputError(f"{what} has a sigma of {sigma:g}{unit}: give at least {self.finest:.3g}{unit}")

    def _in_mm(self, value: float) -> str:
        """The likely cause: a length, or a focal length, in millimetres."""
        if self.unit == "m":
            far = "; give metres" if abs(value) > self.most else ""
            return "; is it in mm? Give metres" if self.holds(value / 1000.0) else far
        if self.unit == "px" and value < self.least:
            return "; is it in mm? Divide it by the size of a pixel"
        return ""


def require_possible_numbers(observations: Observations, options: Options) -> None:
    """Check all that is stated: priors of the observations and of the options, numbers that are held, and tolerances.

    Raises:
        InputError: it names a number that is impossible, or a standard deviation that nobody can have measured.
    """
    for prior in dict.fromkeys((*observations.priors, *options.priors)):
        observations.require_owner(prior)
        here = f"the prior on {prior.quantity} of {prior.owner} {prior.name!r}"
        for bounds, value, sigma in zip(_ranges(prior, observations, options), prior.value, prior.sigma, strict=False):
            bounds.require(value, here)
            bounds.require_sigma(sigma, here)
    for name, value in options.fixed.items():
        for camera, size in observations.cameras.items():
            here = f"{name}, which is held for camera {camera!r},"
            _of_camera(name, size, _named_lens(options, camera)).require(value, here)
    for target, tolerance in options.tolerances.items():
        if target in observations.targets:
            _require_tolerance(tolerance, target, observations)


def _ranges(prior: Prior, observations: Observations, options: Options) -> Iterator[Range]:
    """The range of each number of a prior."""
    if prior.owner == "camera":
        yield from camera_ranges(prior.quantity, observations.cameras[prior.name], _named_lens(options, prior.name))
    elif prior.owner == "station":
        yield from _of_place(prior.name, observations)[-len(prior.value) :]
    elif prior.dimension:
        drawn_m = dimensions_of(observations.targets).get(prior.dimension, np.nan)
        if np.isfinite(drawn_m):  # a dimension that does not exist is reported elsewhere
            yield dimension_range(drawn_m)
    elif prior.curve:
        yield Range(0.0, 0.0, "m", FINEST, "an offset is about 0")


def _named_lens(options: Options, camera: str) -> Lens | None:
    """A camera's lens; None if it is still to be chosen."""
    return None if options.lens == "auto" else options.of_camera(camera).blank_lens


def camera_ranges(quantity: str, image_size: tuple[int, int], lens: Lens | None) -> Iterator[Range]:
    """The range of each number of a quantity on which a camera prior may be."""
    names = ("cx", "cy") if quantity == "principal_point" else (quantity,)
    yield from (_of_camera(name, image_size, lens) for name in names)


def dimension_range(drawn_m: float) -> Range:
    """The range of a target's dimension, relative to its drawing."""
    why = f"the target states {drawn_m:g} m"
    return Range(drawn_m / _REDRAWN, drawn_m * _REDRAWN, "m", FINEST, why)


def _of_camera(name: str, image_size: tuple[int, int], lens: Lens | None) -> Range:
    """The range of a camera's number, by its name."""
    finest_ratio = 1e-9  # least standard deviation of numbers without a unit, which are of order one
    # In the solver's unit, in which a coefficient is of order one; those of the rational model reach a few hundred.
    coefficient = 1e6
    skew = (-1.0, 1.0)  # columns that lean by 45 degrees
    aspect = (0.1, 10.0)  # anamorphic lenses and skipped rows have 0.5 to 2
    off_centre = 10.0  # in half image diagonals: a picture that was cropped from one ten times as large
    # In half image diagonals: from a fisheye whose image circle fills a tenth of the picture to a telescope that shows
    # one degree. A focal length in millimetres is below it.
    phi = (0.05, 100.0)
    size = np.array(image_size, dtype=float)
    half = 0.5 * float(np.hypot(*size))
    image = f"the image is {image_size[0]} x {image_size[1]} px"
    if name == "phi":
        return Range(phi[0] * half, phi[1] * half, "px", FINEST, f"the focal length in pixels, where {image}")
    if name in ("cx", "cy"):
        middle, reach = 0.5 * (size[int(name == "cy")] - 1.0), off_centre * half
        return Range(middle - reach, middle + reach, "px", FINEST, image)
    if name == "aspect":
        return Range(*aspect, "", finest_ratio, "it is fy / fx, near 1")
    if name == "skew":
        return Range(*skew, "", finest_ratio, "it is 0 where pixel axes are perpendicular")
    scale = 1.0 if lens is None or name not in lens.names else lens.scales(half)[lens.names.index(name)]
    return Range(-coefficient / scale, coefficient / scale, "", finest_ratio / scale, "no lens bends more")


def _of_place(station: str, observations: Observations) -> tuple[Range, Range, Range]:
    """The ranges of a station's position: from farther away no lens would show what was observed as large as it is.

    Points at most L apart, seen from d, are at most phi L / d apart in the image.
    """
    spread_px, places, floors = 0.0, [np.empty((0, 3))], [np.empty((0, 3))]
    for number, view in enumerate(observations.views):
        if view.station != station or view.placement is not None:
            continue
        places.append(observations.targets[view.target].places)
        floors += [] if observations.targets[view.target].movable else places[-1:]
        for ends, column in zip(observations.ends, (observations.points, observations.curves), strict=True):
            pixels = column.pixels[ends[number] : ends[number + 1]]
            if len(pixels):
                spread_px = max(spread_px, float(np.hypot(*(pixels.max(axis=0) - pixels.min(axis=0)))))
    seen = np.concatenate(places)
    if not len(seen) or spread_px == 0.0:  # with boards alone, the place of the world is arbitrary
        return (Range(-np.inf, np.inf, "m", FINEST, ""),) * 3
    diagonal_px = float(np.hypot(*observations.cameras[observations.stations[station]]))
    return place_ranges(seen, spread_px / diagonal_px, f"{spread_px:.0f} px", floor_of(np.concatenate(floors)))


def floor_of(places: Array) -> float | None:
    """Height (m) of the lowest place if the places are about level; None if they stand upright, or lie on a line."""
    if len(places) < 3:
        return None
    _, sizes, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    level = abs(axes[2, 2]) > np.sqrt(0.5) and sizes[1] > 1e-6 * sizes[0]
    return float(places[:, 2].min()) if level else None


def place_ranges(seen: Array, spread: float, said: str, floor_m: float | None) -> tuple[Range, Range, Range]:
    """The ranges of x, y and height of a station whose view of places (P, 3) m fills a share `spread` of its image's
    diagonal; `said` is that extent in words.

    Args:
        floor_m: height of a floor among the places, which is seen from above.
    """
    size_m = 2.0 * float(np.linalg.norm(seen.max(axis=0) - seen.min(axis=0)))  # the places have half of an arc
    most_m = 0.5 * PHI_RANGE[1] * size_m / spread + float(np.max(np.linalg.norm(seen, axis=1)))
    place = Range(-most_m, most_m, "m", FINEST, f"from farther away no lens shows its target {said} large")
    if floor_m is None:
        return place, place, place
    why = f"z points upwards, the camera is above its floor, and {place.why}"
    return place, place, replace(place, least=min(floor_m, 0.0) + FINEST, why=why)


def _require_tolerance(tolerance: Tolerance, target: str, observations: Observations) -> None:
    sizes_m = {name: float(np.max(np.diff(one.box, axis=0))) for name, one in observations.targets.items()}
    size_m = sizes_m[target] or max(sizes_m.values()) or np.inf  # a pole's top has no size, and is placed on the field
    bounds = Range(0.0, _BUILT * size_m, "m", 0.0, f"the target is {two_digits(size_m, 3)} m long")
    plain: Mapping[str, float] = {name: value for name, value in vars(tolerance).items() if name != "curve_m"}
    for name, value in {**plain, **tolerance.curve_m}.items():
        bounds.require(value, f"the tolerance {name} of target {target!r}")
