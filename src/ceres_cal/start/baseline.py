"""The paper's own method from beginning to end, corrected where it errs: a baseline for comparison with the bundle.

Radial coefficients come from rings (section 2), the homography from four points (section 3.2), and lambda is the larger
norm of its first two columns (section 3.5). phi is taken as known, as in the paper.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import combinations

import numpy as np

from ceres_cal.base import Array, DegenerateError, Pose, replace
from ceres_cal.observations.sights import Sights
from ceres_cal.problem.parameters import Estimate, Station
from ceres_cal.scene import Camera, Radial
from ceres_cal.start.closed_forms import fit_rings, homography_from_points, pose_from_homography
from ceres_cal.start.planes import ring_radii


def four_point_baseline(sights: Sights, start: Estimate) -> Estimate:
    """Pose every station that sees the world from four points, and fit a radial lens to rings where there are any.

    `start` gives phi, the principal point and everything for which the paper has no method.

    Raises:
        DegenerateError: a station of the world shows fewer than four points of its floor.
    """
    cameras = {name: _with_rings(camera, name, sights) for name, camera in start.cameras.items()}
    stations, placements = dict(start.stations), dict(start.placements)
    for name, sight in sights.of_world.items():
        camera = sight.key.camera
        stations[name] = Station(camera, _from_four_points(cameras[camera], sight))
    for key in sights.keys:
        if key.placement is not None:  # it stays where its station saw it
            seen = start.stations[key.station].cam_from_world @ start.placements[key.placement]
            placements[key.placement] = stations[key.station].cam_from_world.inverse @ seen
    return Estimate(cameras, stations, placements, start.structure)


def _with_rings(camera: Camera, name: str, sights: Sights) -> Camera:
    for sight in sights.of_camera(name):
        if isinstance(camera.lens, Radial) and len(set(sight.track_index[sight.on_arc])) > 2:
            _, measured_px, ring_m = ring_radii(sight.about(camera))
            a1, *rest = fit_rings(measured_px, ring_m, (1, *camera.lens.powers))
            return replace(camera, lens=camera.lens.with_values(np.array(rest) / a1))
    return camera


def _from_four_points(camera: Camera, sight: Sights) -> Pose:
    floor = np.flatnonzero(np.abs(sight.points[:, 2]) < 1e-9)
    places, first = np.unique(sight.points[floor, :2], axis=0, return_index=True)
    if len(places) < 4:
        raise DegenerateError(
            f"{sight.key}: the paper's method needs four points of the floor, not {len(places)}: observe its corners "
            "(`ceres-cal detect field --points` does in photographs)"
        )
    chosen = floor[first[_widest_four(places)]]
    rays = camera.rays(sight.pixels[chosen])
    return pose_from_homography(homography_from_points(sight.points[chosen, :2], rays[:, :2] / rays[:, 2:]))


def _widest_four(places: Array) -> list[int]:
    """The four points that span the largest quadrilateral, which noise disturbs least."""

    def area(four: Iterable[int]) -> float:
        around = places[list(four)] - places[list(four)].mean(axis=0)
        around = around[np.argsort(np.arctan2(around[:, 1], around[:, 0]))]
        ahead = np.roll(around, -1, axis=0)
        return float(np.sum(around[:, 0] * ahead[:, 1] - around[:, 1] * ahead[:, 0]))

    extreme = {
        int(np.argmax(places @ d)) for d in ((1, 1), (1, -1), (-1, 1), (-1, -1), (1, 0), (-1, 0), (0, 1), (0, -1))
    }
    candidates = sorted(extreme) if len(extreme) >= 4 else range(len(places))
    return list(max(combinations(candidates, 4), key=area))
