"""Geometry that cannot be: a camera under the floor that it sees from above, or what it sees behind it.

A flat scene fits as well when its picture is mirrored: its columns h1 and h2 of R are mirrored, and r3 = h1 x h2 turns
round, so that the camera stands as far under the floor as it stood above. Exchanged axes and y upwards are mirrored
pictures, too, turned about the principal point; residuals tell nothing of any of it.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Array, distinct
from ceres_cal.base.errors import SolutionError
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.residuals import Residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.scene.camera import Camera

# The principal point decides where it lies so much nearer to one centre than to the other, that of the image turned
# over its diagonal; it is a tenth of their distance from its own in the tests' scenes.
_NEARER = 0.5
_LARGEST_M = 50.0  # of a target that somebody holds before a camera, from its origin
_BELOW = 0.5  # of the camera's height over the floor: noise sinks a board by centimetres


def require_possible(observations: Observations, sights: Sights, estimate: Estimate, residuals: Residuals) -> None:
    """Raise SolutionError where a station cannot stand where it does.

    Only a floor is asked that lies in the world: boards are seen from either side, a wall stands upright, a ceiling is
    above the origin. Give what is seen from below in coordinates whose z points to the camera.

    Args:
        sights: of all the observations, as the solve took them.
    """
    _require_handy(observations)
    for station, sight in sights.of_world.items():
        camera = estimate.camera_at(station)
        floor_m = _floor_m(_places_of_world(observations, sight))
        if floor_m is not None and camera.position[2] <= min(floor_m, 0.0):
            raise SolutionError(
                f"station {station!r}: the camera stands {floor_m - camera.position[2]:.2f} m under the floor that it "
                f"sees: {_cause(camera)}, or left and right are exchanged in the labels: correct the observations"
            )
        _require_ahead(station, sight, residuals)
        if floor_m is not None:
            _require_above(floor_m - _BELOW * (camera.position[2] - floor_m), observations, estimate)


def _require_handy(observations: Observations) -> None:
    """Raise SolutionError where nobody could hold a target before a camera: boards alone fit in any unit."""
    for name, target in observations.targets.items():
        reach_m = float(np.max(np.linalg.norm(target.places, axis=1)))
        if target.movable and reach_m > _LARGEST_M:
            raise SolutionError(
                f"target {name!r} reaches {reach_m:.0f} m from its origin: give its dimensions in metres"
            )


def _require_above(least_m: float, observations: Observations, estimate: Estimate) -> None:
    """Raise SolutionError where most placements of a target lie so deep under the floor that its size is wrong."""
    for name, target in observations.targets.items():
        placed = dict.fromkeys(v.placement for v in observations.shown_views if v.target == name and v.placement)
        tops = [float(np.max(estimate.placements[one].transform(target.places)[:, 2])) for one in placed]
        if target.movable and 2 * np.count_nonzero(np.array(tops) < least_m) > len(tops):
            raise SolutionError(
                f"target {name!r} lies up to {-min(tops):.0f} m under the floor: its dimensions are too large, or not "
                "in metres"
            )


def _require_ahead(station: str, sight: Sights, residuals: Residuals) -> None:
    """Raise SolutionError where the station has most of what it saw behind it, or beyond its lens."""
    points, curves = residuals.lengths
    lengths = np.concatenate([points[sight.point_rows], curves[sight.curve_rows]])
    behind = np.count_nonzero(~np.isfinite(lengths))
    if 2 * behind > len(lengths):
        raise SolutionError(
            f"station {station!r}: {behind} of the {len(lengths)} observations it has of the world lie behind the "
            "camera or beyond its lens: check labels and target dimensions"
        )


def _places_of_world(observations: Observations, sight: Sights) -> Array:
    """(P, 3) m of what a sight shows of targets that nobody put there: its points, starts and ends of its lines, and
    of its arcs the centre and a quarter.
    """
    world = np.array([not observations.targets[view.target].movable for view in observations.views])
    points = sight.points[world[observations.points.view[sight.point_rows]]]
    tracks = sight.tracks[distinct(sight.track_index[world[observations.curves.view[sight.curve_rows]]])]
    return np.concatenate([points, *(tracks[:, 0] + along for along in (0.0, tracks[:, 1], tracks[:, 2]))])


def _floor_m(places: Array) -> float | None:
    """Height of the lowest place, where they lie about level; None where they stand upright, or on a line."""
    if len(places) < 3:
        return None
    _, sizes, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    level = abs(axes[2, 2]) > np.sqrt(0.5) and sizes[1] > 1e-6 * sizes[0]
    return float(places[:, 2].min()) if level else None


def _cause(camera: Camera) -> str:
    """Which mirrored picture it may be: of an image that is not square the principal point tells swapped axes."""
    width, height = camera.image_size
    sizes = np.array([[width, height], [height, width]])
    off, other = np.linalg.norm(camera.principal_point - (sizes - 1.0) / 2.0, axis=1)
    if other < _NEARER * off:
        return "x and y are swapped (its principal point is where that puts it)"
    swapped = "x and y are swapped" + (", image_size too" if off < _NEARER * other else "")
    return f"the image is mirrored, or {swapped}, or y points upwards"
