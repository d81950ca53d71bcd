"""Observations that the calibration was not made from: boards that it does not know are posed first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.model.parameters import Estimate, Layout
from ceres_cal.observations import Observations
from ceres_cal.solve import Problem, Weighting
from ceres_cal.solve.lost import with_lost_boards_posed
from ceres_cal.solve.noise import Inliers


def with_newcomers_placed(observations: Observations, problem: Problem, calibration: Calibration) -> Estimate:
    """The calibration's estimate with every placement that is new among the observations in its best pose.

    Raises:
        DegenerateError: one of them cannot be posed: fewer than six points, or points in disagreement.
    """
    estimate = calibration.estimate
    new = frozenset(observations.placements) - set(estimate.placements)
    if not new:
        return estimate
    fit, options = calibration.fit, calibration.options
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -1e6]))  # no camera sees it: any pose is better
    unplaced = {
        name: estimate.stations[_first_station(observations, name)].cam_from_world.inverse @ behind for name in new
    }
    start = replace(estimate, placements={**estimate.placements, **unplaced})
    nothing = np.zeros(len(observations.points), bool), np.zeros(len(observations.curves), bool)
    blank = Inliers(*nothing, fit.point_scale, fit.curve_scale, np.empty(0), np.empty(0))
    free = {name: np.empty(0, dtype=np.int64) for name in estimate.cameras}
    weighting = Weighting(fit.point_scale, fit.curve_scale, "cauchy", options.loss_scale)
    newcomers = Problem(
        problem.sights.take(problem.sights.numbers(placements=new)), Layout(free, frozenset(), new), weighting=weighting
    )
    posed, _ = with_lost_boards_posed(newcomers, blank, start)
    for name, pose in unplaced.items():
        if posed.placements[name] == pose:
            raise DegenerateError(
                f"placement {name!r} is not in the calibration and cannot be posed from its points: give at least six "
                "points of it in one view, or leave its views out"
            )
    return posed


def _first_station(observations: Observations, placement: str) -> str:
    return next(view.station for view in observations.views if view.placement == placement)
