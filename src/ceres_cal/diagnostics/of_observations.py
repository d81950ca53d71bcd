"""Diagnostics of the observations: wrong labels, shifted points, noise larger than stated, neighbours that agree.

Observations that the calibration was not made from: whether it holds on them, and boards that it does not know.
"""

from __future__ import annotations

from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import DegenerateError
from ceres_cal.base.tails import log_f_tail
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.diagnostic import (
    Amount,
    Case,
    Diagnostic,
    Evidence,
    Finding,
    ScoreTest,
    Tested,
    Words,
    Wrong,
    amounts,
)
from ceres_cal.diagnostics.labels import Mislabelled
from ceres_cal.diagnostics.leftover import Noise
from ceres_cal.diagnostics.scores import Family
from ceres_cal.observations import Observations
from ceres_cal.problem.noise import Inliers
from ceres_cal.problem.parameters import Estimate, Layout
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.robust.poses import with_lost_boards_posed

_MOST_NAMED = 5
# How near to half a pixel a shift must be to be called that: in standard deviations, and px.
_HALF_SD, _HALF_PX = 3.0, 0.1
_HALF = "this is the half pixel between counting from the centre and from the corner of the top-left pixel: "


class WrongLabel(Diagnostic):
    """A label that stands for another feature, over all its frames."""

    kind = "wrong label"
    wrong: ClassVar[Wrong] = "observations"

    def tests(self, case: Case) -> int:
        return case.labels.tried

    def findings(self, tested: Tested) -> Iterator[Finding]:
        groups: dict[tuple[bool, str, int, int], list[Mislabelled]] = defaultdict(list)
        for label in tested.case.labels.mislabelled:
            if label.log_p <= tested.selection.log_level:
                name = tested.case.observations.views[label.view].target
                groups[label.is_curve, name, label.feature, label.instead].append(label)
        for (_, target, _, _), labels in groups.items():
            yield self._finding(tested, target, labels)

    def _finding(self, tested: Tested, target: str, labels: list[Mislabelled]) -> Finding:
        observations, table, one = tested.case.observations, tested.case.table, labels[0]
        described = observations.targets[target]
        names = described.curve_names if one.is_curve else described.point_names
        kind = "curve" if one.is_curve else "point"
        rows = np.concatenate([label.rows for label in labels])
        at = rows + (len(observations.points) if one.is_curve else 0)
        frames = list(dict.fromkeys(observations.views[label.view].frame for label in labels))
        listing = ", ".join(map(repr, frames[:_MOST_NAMED])) + (" ..." if len(frames) > _MOST_NAMED else "")
        away = float(np.mean(np.concatenate([label.distance_px for label in labels])))
        px, mm = _mean(np.abs(table.distance_px[at])), _mean(np.abs(table.error_mm[at]))
        sentence = (
            f"frame {listing}: {names[one.feature]!r} observed where {names[one.instead]!r} projects ({len(rows)} "
            f"{kind} observation{'s' if len(rows) > 1 else ''}, {away:.2f} px from it)"
        )
        return Finding(
            self.kind, self.wrong, f"{target}/{names[one.feature]}", frames[0], sentence,
            "correct the label; it was taken out and did no harm", px, mm, px / away, (),
            tested.log10_p(min(label.log_p for label in labels)), len(rows), tuple((kind, int(row)) for row in rows),
        )  # fmt: skip


def _mean(values: Array) -> float:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else float("nan")


class PointsShifted(ScoreTest):
    """A camera's points lie aside of its curves: two detectors that count pixels from different places."""

    kind = "points shifted"
    absorbed = True

    def families(self, case: Case) -> Iterator[Family]:
        is_curve, camera = case.equations.is_curve, case.camera
        both = np.isin(camera, camera[is_curve & case.model.used])
        group = np.where(~is_curve & both, camera, -1)
        yield Family(self.kind, case.equations.direction * ~is_curve[:, None], group, case.cameras)

    def words(self, evidence: Evidence) -> Words:
        px, sd = evidence.score.amount, evidence.score.sd
        half = bool(np.all(np.abs(np.abs(px) - 0.5) < np.maximum(_HALF_SD * sd, _HALF_PX)))
        return Words(
            f"camera {evidence.score.subject!r}: its points are shifted against its curves by ({px[0]:+.2f} ± "
            f"{sd[0]:.2f}, {px[1]:+.2f} ± {sd[1]:.2f}) px ({evidence.size})",
            f"{_HALF if half else ''}let both detectors count from the centre of the top-left pixel",
            amounts(("x", "y"), px, sd, "px"),
        )


class _OfNoise(Diagnostic):
    """What the noise of points and of curves is like."""

    wrong: ClassVar[Wrong] = "observations"

    def tests(self, case: Case) -> int:
        return 2

    @abstractmethod
    def about(self, noise: Noise) -> tuple[float, float, Words]:
        """log P of as much by chance, px that it is of, and its words."""

    def findings(self, tested: Tested) -> Iterator[Finding]:
        case = tested.case
        for noise in tested.noise:
            log_p, px, words = self.about(noise)
            if log_p <= tested.selection.log_level:
                rows = case.model.used & (case.equations.is_curve == (noise.kind == "curves"))
                all_px, all_mm, _ = case.effect(case.equations.residual, rows)
                mm = px * all_mm / all_px if all_px > 0.0 else float("nan")
                yield Finding(
                    self.kind, self.wrong, noise.kind, None, words.sentence, words.advice, px, mm, px / noise.sigma_px,
                    words.amounts, tested.log10_p(log_p), noise.observations,
                )  # fmt: skip


class LargerNoise(_OfNoise):
    """Noise beyond what was stated."""

    kind = "noise"

    def about(self, noise: Noise) -> tuple[float, float, Words]:
        sentence = (
            f"the noise of {noise.kind} is {noise.scale:.2f} times what was stated: {noise.sigma_px:.3f} px, not "
            f"{noise.sigma_px / noise.scale:.3f}"
        )
        amount = Amount("scale", noise.scale, noise.scale / float(np.sqrt(2.0 * noise.observations)), "")
        advice = "state the larger sigma where sigmas are taken as stated; the estimated scale is right already"
        return noise.log_p, noise.sigma_px, Words(sentence, advice, (amount,))


class Correlated(_OfNoise):
    """Neighbouring residuals that agree."""

    kind = "correlated"

    def about(self, noise: Noise) -> tuple[float, float, Words]:
        sentence = (
            f"neighbouring residuals of {noise.kind} agree (correlation {noise.correlation:.2f}): "
            f"{noise.observations} observations say as much as {noise.effective:.0f} independent ones"
        )
        amount = Amount("correlation", noise.correlation, 1.0 / float(np.sqrt(noise.observations)), "")
        advice = "look for what shifts whole features; the standard deviations have it in them"
        shared_px = noise.sigma_px * float(np.sqrt(max(noise.correlation, 0.0)))
        return noise.correlation_log_p, shared_px, Words(sentence, advice, (amount,))


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
