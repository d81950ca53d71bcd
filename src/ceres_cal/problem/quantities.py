"""The numbers behind the keys: their values in an estimate, their natural sizes, and steps along them.

How what a camera shows moves with its numbers: exactly, by the loops of the solve.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence, Set
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.arrays import Array
from ceres_cal.base.frozen import replace
from ceres_cal.base.transforms import Pose, rotation_exp, rotation_log, skew
from ceres_cal.problem.information import POSE_QUANTITIES, STATION_QUANTITIES, Key, columns_by_owner, pose_keys
from ceres_cal.problem.parameters import (
    Estimate,
    Layout,
    Station,
    intrinsic_names,
    intrinsics_scales,
    intrinsics_vector,
    unit_px,
    with_intrinsics,
)
from ceres_cal.problem.residuals import camera_optics
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Lens


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
    """Of a camera at its pose, of places (N, 3) m; NaN among these are shown nowhere."""
    optics, scales = camera_optics(camera), intrinsics_scales(camera)
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    count, size = len(known), len(scales)
    points = kernels.PointColumns(
        np.arange(count + 1),  # a sight each: one that is not shown keeps no other one's from being known
        np.ascontiguousarray(places[known]),
        np.zeros((count, 2)),
        kernels.NOTHING,
        np.empty((0, kernels.BUILT), dtype=np.int32),
        np.zeros((count, kernels.BUILT - 2)),
    )
    rows = np.full((len(places), 2, size + 6 + kernels.BUILT), np.nan)
    shown = rows[known]
    kernels.point_rows(optics, np.repeat(camera.cam_from_world.matrix[None], count, axis=0), points, shown)
    rows[known] = shown
    intrinsics, turns, shifts, _ = np.split(rows, [size, size + 3, size + 6], axis=2)
    pose = camera.cam_from_world  # whose translation turns along about the camera
    return PixelSlopes(intrinsics * scales, turns + np.cross(pose.translation, shifts), shifts @ pose.rotation)


def natural_sizes(estimate: Estimate, keys: Sequence[Key]) -> Array:
    """(P,) what each number is compared with: an error of a hundredth of it moves a picture by about a hundredth.

    phi and the principal point go with phi, positions with the distance to what is seen, turns with 1 rad, coefficients
    with the one that moves a pixel half an image diagonal from the middle by as much; structure with its tolerance,
    dimensions with themselves.
    """
    sizes = np.ones(len(keys))
    for (kind, owner), columns in columns_by_owner(keys).items():
        if kind == "camera":
            camera = estimate.cameras[owner]
            known = {"phi": camera.phi, "cx": camera.phi, "cy": camera.phi, "aspect": 1.0, "skew": 1.0}
            known |= zip(camera.lens.names, camera.lens.natural_sizes(camera.phi, unit_px(camera)), strict=True)
            sizes[columns] = [known[keys[column].quantity] for column in columns]
        elif keys[columns[0]].is_structure:
            names = [keys[column].structure_name for column in columns]
            sizes[columns] = estimate.structure.sizes_m[[estimate.structure.names.index(name) for name in names]]
        else:
            distance = _distance_m(estimate, kind, owner)
            sizes[columns] = [distance if keys[column].unit == "m" else 1.0 for column in columns]
    return sizes


def _distance_m(estimate: Estimate, kind: str, owner: str) -> float:
    """From a station to the floor, or from a placement to the nearest station."""
    if kind == "station":
        return max(abs(float(estimate.stations[owner].cam_from_world.position[2])), 1e-3)
    where = estimate.placements[owner].translation
    away = [np.linalg.norm(where - station.cam_from_world.position) for station in estimate.stations.values()]
    return max(float(min(away)), 1e-3)


def values_of(estimate: Estimate, keys: Sequence[Key]) -> Array:
    """(P,) the estimate's numbers in the units of the keys; 0 for a turn."""
    values = np.zeros(len(keys))
    for (kind, owner), columns in columns_by_owner(keys).items():
        names = [keys[column].quantity for column in columns]
        if kind == "camera":
            camera = estimate.cameras[owner]
            numbers = camera.phi, camera.aspect, *camera.principal_point, *camera.lens.values, camera.skew
            known = dict(zip(intrinsic_names(camera.lens), numbers, strict=True))
            values[columns] = [known[name] for name in names]
        elif keys[columns[0]].is_structure:
            at = [estimate.structure.names.index(keys[column].structure_name) for column in columns]
            values[columns] = estimate.structure.values[at]
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
    """Keys of everything that an estimate has, free or held."""
    intrinsics = (intrinsic_keys(name, camera.lens) for name, camera in estimate.cameras.items())
    stations = (pose_keys("station", name) for name in estimate.stations)
    placements = (pose_keys("placement", name) for name in estimate.placements)
    return frozenset(chain(*intrinsics, *stations, *placements, estimate.structure.keys))


def free_keys(estimate: Estimate, layout: Layout, private: Set[str | None] = frozenset()) -> tuple[Key, ...]:
    """Keys of everything free but the private placements: cameras, stations, placements, structure."""
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
    """The layout of the problem whose shared numbers are the keys, and of placements besides."""
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
        elif keys[columns[0]].is_structure:
            values[[estimate.structure.names.index(f"{owner}/{name}") for name in names]] += step[columns]
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
