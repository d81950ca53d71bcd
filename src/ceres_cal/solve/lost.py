"""Boards that the start lost: posed again once the camera is known.

A start that is far off leaves most of a board's corners outside the rejection bound, and what is rejected pulls no
more. With the lens solved from the other boards, four good corners pose a lost one by consensus.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Array, median
from ceres_cal.model.parameters import Estimate
from ceres_cal.observations.sights import Sights
from ceres_cal.solve.bundle import placement_costs
from ceres_cal.solve.mirrored import mirrored
from ceres_cal.solve.noise import Inliers
from ceres_cal.solve.problem import Problem, Weighting
from ceres_cal.start.closed_forms import pose_from_homography
from ceres_cal.start.planes import consensus_homography

# Share of a sight's observations; with less of them in use its pose was not understood. Of 40 boards before a
# fisheye, 30 % outliers, 9 end in a wrong pose, 19 at 0.33; nothing changes at 0.67.
_LOST = 0.5
# Points that a consensus is sought among: four make a pose, two more agree by chance hardly ever. Nothing changes
# from half to double.
_FEWEST = 6


def with_lost_boards_posed(problem: Problem, inliers: Inliers, estimate: Estimate) -> tuple[Estimate, int]:
    """The estimate with lost private placements posed again where that lowers their cost, and how many were.

    Args:
        problem: of all observations, those rejected too, weighted with a loss that bears outliers.
    """
    sights, weighting, count = problem.sights, problem.weighting, 0
    for number in np.flatnonzero(sights.used_share(inliers.points, inliers.curves) < _LOST):
        sight = sights[int(number)]
        pose = _by_consensus(sight, estimate, weighting) if sight.key.placement in problem.private else None
        if pose is None:
            continue
        as_is, _ = placement_costs(sight, estimate, weighting, estimate.pose_stack(sight.keys))
        tried = [placement_costs(sight, estimate, weighting, p) for p in (pose, mirrored(sight, pose))]
        cost, best = min(tried, key=lambda one: float(one[0][0]))
        if cost[0] < 0.99 * as_is[0]:
            estimate = estimate.with_placements(sight.keys, best)
            count += 1
    return estimate, count


def _by_consensus(sight: Sights, estimate: Estimate, weighting: Weighting) -> Array | None:
    """cam_from_target (1, 3, 4) that most points agree on, or None."""
    camera = estimate.cameras[sight.key.camera]
    rays = camera.rays(sight.pixels)
    ahead = rays[:, 2] > 0.0  # NaN is not
    points, rays = sight.points[ahead], rays[ahead]
    if len(points) < _FEWEST or np.ptp(points[:, 2]) > 1e-9:
        return None
    ideal = np.column_stack([camera.phi * rays[:, :2] / rays[:, 2:], np.ones(len(rays))])
    limit_px = max(5.0 * weighting.point_scale * median(sight.sigma_px), 1.0)
    homography = consensus_homography(points[:, :2], ideal, limit_px)
    if homography is None:
        return None
    pose = pose_from_homography(homography, camera.phi)
    translation = pose.translation - points[0, 2] * pose.rotation[:, 2]
    return np.column_stack([pose.rotation, translation])[None]
