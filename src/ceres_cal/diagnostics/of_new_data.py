"""Observations that the calibration was not made from: whether it holds on them, and boards that it does not know."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

import numpy as np

from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.tails import log_f_tail
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.diagnostic import Case, Diagnostic, Tested
from ceres_cal.diagnostics.findings import Finding, Wrong
from ceres_cal.model.parameters import Estimate, Layout
from ceres_cal.observations import Observations
from ceres_cal.solve import Problem, Weighting
from ceres_cal.solve.lost import with_lost_boards_posed
from ceres_cal.solve.noise import Inliers


class DoesNotHold(Diagnostic):
    """A refit to new observations would fit them better than chance explains.

    The gain of a refit is chi-square where the calibration is exact; its own uncertainty adds as much again for every
    time that the new observations are as many as those it was made from. That holds where both see the same part of the
    image: what is new at places that the calibration never saw is held against it.
    """

    kind = "does not hold"
    wrong: ClassVar[Wrong] = "calibration"

    def tests(self, case: Case) -> int:
        return 1

    def findings(self, tested: Tested) -> Iterator[Finding]:
        case, model = tested.case, tested.case.model
        step, used = model.step, model.used
        if case.calibration is None or not len(step):
            return
        own = 2 * case.calibration.fit.points + case.calibration.fit.curves
        inflation = 1.0 + np.count_nonzero(used) / max(own, 1)
        left = model.left_over
        variance = float(left @ left) / max(model.spare, 1)
        statistic = float(step @ step) / (inflation * len(step) * variance)
        log_p = float(log_f_tail(statistic, len(step), max(model.spare, 1)))
        if log_p > tested.selection.log_level:
            return
        px, mm, count = case.effect(np.where(used, (model.shared @ step) / model.weight, 0.0), used)
        sentence = (
            "the calibration does not hold on these observations: a refit would move it by "
            f"{px:.2f} px, {mm:.1f} mm rms"
        )
        yield Finding(
            self.kind, self.wrong, ", ".join(case.observations.stations), None, sentence,
            "find out with `ceres-cal check` whether the camera was moved, and refit", px, mm,
            px / case.noise_px(left, used), (), tested.log10_p(log_p), count,
        )  # fmt: skip


def with_newcomers_placed(observations: Observations, problem: Problem, calibration: Calibration) -> Estimate:
    """The calibration's estimate with every placement that is new among the observations in its best pose.

    Raises:
        DegenerateError: one of them cannot be posed: fewer than six points, or points in disagreement.
    """
    estimate = calibration.estimate
    new = frozenset(key.placement for key in problem.sights.keys if key.placement) - set(estimate.placements)
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
