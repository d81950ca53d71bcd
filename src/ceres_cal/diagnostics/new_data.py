"""Observations that the calibration was not made from: boards that it does not know, and whether it holds on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.tails import log_f_tail
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.findings import Finding
from ceres_cal.diagnostics.linear_model import LinearModel
from ceres_cal.diagnostics.words import Context
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
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -1e6]))  # no camera sees it: any pose that is found is better
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
    found, _ = with_lost_boards_posed(newcomers, blank, start)
    for name, pose in unplaced.items():
        if found.placements[name] == pose:
            raise DegenerateError(
                f"placement {name!r} is not in the calibration and cannot be posed from its points: give at least six "
                "points of it in one view, or leave its views out"
            )
    return found


def _first_station(observations: Observations, placement: str) -> str:
    return next(view.station for view in observations.views if view.placement == placement)


def validity_finding(context: Context, model: LinearModel, calibration: Calibration, log_level: float) -> list[Finding]:
    """That the calibration does not hold on new observations, where a refit would fit them better than chance explains.

    The gain of a refit is chi-square where the calibration is exact; its own uncertainty adds as much again for every
    time that the new observations are as many as those it was made from. That holds where both see the same part of the
    image: what is new at places that the calibration never saw is held against it.
    """
    step, used = model.step, model.used
    if not len(step):
        return []
    own = 2 * calibration.fit.points + calibration.fit.curves
    inflation = 1.0 + np.count_nonzero(used) / max(own, 1)
    left = model.left_over
    variance = float(left @ left) / max(model.spare, 1)
    statistic = float(step @ step) / (inflation * len(step) * variance)
    log_p = float(log_f_tail(statistic, len(step), max(model.spare, 1)))
    if log_p > log_level:
        return []
    shift = np.where(used, (model.shared @ step) / model.weight, 0.0)
    px, mm, count = context.effect(shift, used)
    sentence = (
        f"the calibration does not hold on these observations: a refit would move it by {px:.2f} px, {mm:.1f} mm rms"
    )
    ratio = px / context.noise_px(left, used)
    return [
        Finding(
            "does not hold", ", ".join(context.observations.stations), None, sentence,
            "find out with `ceres-cal check` whether the camera was moved, and refit", px, mm, ratio, (),
            context.log10_p(log_p), count,
        )
    ]  # fmt: skip
