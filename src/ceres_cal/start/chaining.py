"""Poses of sights become stations and placements."""

from __future__ import annotations

from collections.abc import Container, Mapping

import numpy as np

from ceres_cal.base.arrays import Array, Indices, distinct
from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.transforms import Pose, Poses, chained, inverted
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.problem.parameters import Station, anchored_stations

_STATED = {"x": "position_m", "y": "position_m", "height": "height_m", "phi": "phi"}
"""What an open number may be stated as."""


def chained_poses(
    observations: Observations,
    sights: Sights,
    numbers: Indices,
    poses: Array,
    standing: Mapping[str, Station] | None = None,
    open_numbers: Mapping[int, tuple[str, ...]] | None = None,
) -> tuple[dict[str, Station], Poses]:
    """Stations and placements from the poses (K, 3, 4) of sights: best-seen first, each one extending what is known.

    Args:
        numbers: (K,) of these sights. standing: stations whose place is known. open_numbers: what other sights leave
            open, by their numbers.

    Raises:
        DegenerateError: naming a sight that nothing places.
    """
    sizes = np.diff(sights.point_bounds) + np.diff(sights.curve_bounds)
    order = np.argsort(-sizes[numbers], kind="stable")
    keys, seen = [sights.keys[i] for i in numbers[order]], poses[order]
    stations = {name: station.cam_from_world.matrix for name, station in (standing or {}).items()}
    stations = stations or {name: np.eye(3, 4) for name in anchored_stations(observations)}
    placements: dict[str | None, Array] = {None: np.eye(3, 4)}
    known = -1
    while len(stations) + len(placements) > known:
        known = len(stations) + len(placements)
        for key, pose in zip(keys, seen, strict=True):
            if key.station not in stations and key.placement in placements:
                stations[key.station] = chained(pose, inverted(placements[key.placement]))
        fresh: dict[str | None, int] = {}
        for row, key in enumerate(keys):
            if key.placement not in placements and key.station in stations:
                fresh.setdefault(key.placement, row)
        if fresh:
            rows = list(fresh.values())
            world_from_cam = inverted(np.array([stations[keys[row].station] for row in rows]))
            placements |= dict(zip(fresh, chained(world_from_cam, seen[rows]), strict=True))
    _require_all(observations, sights, stations, placements, open_numbers or {})
    cameras = observations.stations
    named = [name for name in placements if name is not None]
    return (
        {n: Station(cameras[n], Pose(stations[n][:, :3], stations[n][:, 3])) for n in cameras if n in stations},
        Poses.stacked(named, np.array([placements[name] for name in named]).reshape(-1, 3, 4)),
    )


def _require_all(
    observations: Observations,
    sights: Sights,
    stations: Container[str],
    placements: Container[str | None],
    open_numbers: Mapping[int, tuple[str, ...]],
) -> None:
    for number, key in enumerate(sights.keys):
        if key.station in stations and key.placement in placements:
            continue
        sight = sights[number]
        frames = ", ".join(repr(observations.views[i].frame) for i in sight.views[0][:3])
        said = f"{len(sight.point_rows)} points and {len(sight.curve_rows)} curve observations (on "
        said += f"{len(distinct(sight.track_index))} curves) cannot fix its pose"
        if names := open_numbers.get(number, ()):
            stated = [_STATED[name] for name in names if name in _STATED]
            state = f", state {' or '.join(dict.fromkeys(stated))} as a prior" if stated else ""
            what = f"{', '.join(names)} of the camera stay open: add a point or a line beside these{state}"
        else:
            what = "give at least four points, not on one line, or straight lines in two directions, two of each"
        raise DegenerateError(f"frame {frames} ({key}): {said}: {what}, or remove the view")
