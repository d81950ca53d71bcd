"""diagnose(): residuals read one by one, all together, and for what they say of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.errors import InputError
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.alternatives import all_families, target_families
from ceres_cal.diagnostics.equations import Equations, write_equations
from ceres_cal.diagnostics.findings import Finding
from ceres_cal.diagnostics.labels import Mislabelled, find_mislabelled
from ceres_cal.diagnostics.leftover import Noise, measure_noise
from ceres_cal.diagnostics.linear_model import LinearModel, Weights, make_linear_model
from ceres_cal.diagnostics.new_data import validity_finding, with_newcomers_placed
from ceres_cal.diagnostics.patterns import heard_again, select
from ceres_cal.diagnostics.summaries import Summaries, summarise
from ceres_cal.diagnostics.table import ResidualTable, make_table
from ceres_cal.diagnostics.words import Context, label_findings, noise_findings, pattern_finding
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.residuals import Residuals, residuals
from ceres_cal.observations import Observations
from ceres_cal.solve import Problem
from ceres_cal.solve.noise import USUAL_EQUATIONS, Inliers, Redundancy, judge, relative_lengths

FALSE_ALARM_RATE = 0.01
"""Probability that a calibration of sound data gets any finding at all."""
_OTHER_TESTS = 5  # size and whiteness of the noise of points and of curves, validity on new data


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the residuals say.

    Attributes:
        findings: causes of what is left over, the largest first (by effect in px). None: what is left looks like noise.
        table: every observation. summaries: the same by frame, feature, image region and radius.
        noise: of points and of curves, with the findings taken off; without any it is the calibration's own.
        degrees_of_freedom: spare equations behind it, the calibration's own; infinite where sigmas are as stated.
        new_data: whether the observations are others than those the calibration was made from. tests: how many
            alternatives were tested, and false_alarm_rate: the probability that sound data get any finding at all,
            Bonferroni over all of them. It holds for normal noise; what it does not hold for is said by "correlated".
        model_error: whether some finding says that the model is wrong: then the covariance does not contain that error.
    """

    findings: tuple[Finding, ...]
    table: ResidualTable
    summaries: Summaries
    noise: tuple[Noise, ...]
    degrees_of_freedom: float
    new_data: bool
    tests: int
    false_alarm_rate: float

    @property
    def model_error(self) -> bool:
        return any(finding.is_model_error for finding in self.findings)


def diagnose(
    calibration: Calibration,
    observations: Observations,
    *,
    new_data: bool = False,
    false_alarm_rate: float = FALSE_ALARM_RATE,
) -> Diagnosis:
    """Read the residuals of a calibration.

    Args:
        new_data: that the observations are others than the calibration was made from. Residuals are then taken at the
            calibration as it stands (only placements that it does not know are posed); the tests ask what would be left
            if it were refitted to them, so that they judge the model and not the calibration's own uncertainty.
        false_alarm_rate: of all tests together.

    Raises:
        InputError: the observations are not those of the calibration, and `new_data` does not say so; or they name
            cameras or stations that it does not have.
        SolutionError: it can show none of them.
    """
    _require_known(calibration, observations, new_data)
    problem = calibration.problem(observations, new_data=new_data)
    estimate = calibration.estimate
    if new_data:
        estimate = with_newcomers_placed(observations, problem, calibration)
    there = residuals(observations, problem.sights, estimate)
    inliers = _judged(calibration, observations, there, new_data)
    equations = write_equations(observations, problem.sights, estimate, there)
    case = _Case(observations, problem, estimate, inliers, equations)
    model = make_linear_model(problem, estimate, equations, _weights(case))
    if calibration.refitted is not None and not new_data:
        model = replace(model, known_noise=USUAL_EQUATIONS)
    table = make_table(observations, inliers, model, _weights(case).robust, dict(estimate.cameras))
    findings, noise, tests = _judge_patterns(case, model, table, false_alarm_rate, calibration if new_data else None)
    return Diagnosis(
        findings, table, summarise(observations, table, model, dict(estimate.cameras)), noise,
        inliers.degrees_of_freedom, observations.digest != calibration.digest, tests, false_alarm_rate,
    )  # fmt: skip


def _require_known(calibration: Calibration, observations: Observations, new_data: bool) -> None:
    if not new_data and observations.digest != calibration.digest:
        raise InputError(
            "these are not the observations that the calibration was made from (their digest differs): give those, or "
            "say that they are new data (--new-data)"
        )
    for station, camera in observations.stations.items():
        known = calibration.estimate.stations.get(station)
        if known is None or known.camera != camera:
            raise InputError(
                f"station {station!r} of camera {camera!r} is not in the calibration: it has "
                f"{', '.join(calibration.estimate.stations)}"
            )
    for name, target in observations.targets.items():
        if name in calibration.targets and calibration.targets[name] != target:
            raise InputError(f"target {name!r} is another one than the calibration's: give one of them another name")


@dataclass(frozen=True, eq=False)
class _Case:
    """What the steps of a diagnosis share. `problem`: of all the observations."""

    observations: Observations
    problem: Problem
    estimate: Estimate
    inliers: Inliers
    equations: Equations

    @property
    def scales(self) -> tuple[float, float]:
        return self.inliers.point_scale, self.inliers.curve_scale

    @property
    def reject_sigma(self) -> float:
        return self.problem.options.reject_sigma


def _judged(calibration: Calibration, observations: Observations, there: Residuals, new_data: bool) -> Inliers:
    """The calibration's own verdict on its observations, a fresh one on new ones."""
    if new_data:
        return judge(observations, there, Redundancy(1.0, 1.0), calibration.options)
    inliers, posterior = calibration.inlier_masks(observations), calibration.posterior
    points, curves = relative_lengths(observations, there)
    p, c = calibration.fit.point_scale, calibration.fit.curve_scale
    degrees = np.inf if posterior is None else posterior.degrees_of_freedom
    return Inliers(
        inliers[0] & np.isfinite(points), inliers[1] & np.isfinite(curves), p, c, points / p, curves / c, degrees
    )


def _weights(case: _Case) -> Weights:
    """Of each equation."""
    observations, inliers, options = case.observations, case.inliers, case.problem.options
    sigma = np.concatenate(
        [inliers.point_scale * observations.points.sigma_px, inliers.curve_scale * observations.curves.sigma_px]
    )
    lengths = np.concatenate([inliers.point_sigmas, inliers.curve_sigmas])
    squared = np.where(np.isfinite(lengths), lengths, 0.0) ** 2
    robust = kernels.loss_weights(kernels.Loss(kernels.LOSS_CODES[options.loss], options.loss_scale), squared)
    inlier, at = np.concatenate([inliers.points, inliers.curves]), case.equations.observation
    return Weights(1.0 / sigma[at], inlier[at], robust[at])


def _judge_patterns(
    case: _Case, model: LinearModel, table: ResidualTable, rate: float, calibration: Calibration | None
) -> tuple[tuple[Finding, ...], tuple[Noise, ...], int]:
    """Findings, noise and how many tests there were. `calibration`: that may not hold, where the data are new."""
    rejected = np.flatnonzero(~case.inliers.points), np.flatnonzero(~case.inliers.curves)
    labels, groups = find_mislabelled(case.observations, case.estimate, *rejected, case.scales, case.reject_sigma)
    model = _with_the_rejected(case, model, labels)
    families = all_families(case.observations, case.equations, case.estimate, case.problem, model.used)
    extra = groups + _OTHER_TESTS
    selection = select(model, families, rate, extra)
    noise = measure_noise(case.observations, selection.model, model, case.scales)
    level = selection.log_level
    agreeing = max((one.inflation for one in noise if one.correlation_log_p < level), default=1.0)
    if agreeing > 1.0 and selection.chosen:  # correlated noise makes every other test too eager
        selection = select(model, families, rate, extra, agreeing)
        noise = measure_noise(case.observations, selection.model, model, case.scales)
    context = Context(
        case.observations, case.estimate, case.problem.layout, case.equations, model, table, selection.tests
    )
    findings = [
        *(pattern_finding(context, selection, number) for number in range(len(selection.chosen))),
        *label_findings(context, labels, level),
        *noise_findings(context, noise, level),
        *([] if calibration is None else validity_finding(context, model, calibration, level)),
    ]
    return tuple(sorted(findings, key=lambda finding: -finding.effect_px)), noise, selection.tests


def _with_the_rejected(case: _Case, model: LinearModel, labels: Sequence[Mislabelled]) -> LinearModel:
    """The model in which lines and points that were taken out nearly whole take part where they agree."""
    explained = np.zeros(len(case.observations.points) + len(case.observations.curves), dtype=bool)
    for label in labels:
        explained[label.rows + (len(case.observations.points) if label.is_curve else 0)] = True
    silent = explained[case.equations.observation]
    families = list(target_families(case.observations, case.equations, case.estimate, ~silent))
    used = heard_again(case.equations, model.weight, model.used, families, case.reject_sigma, silent)
    if np.array_equal(used, model.used):
        return model
    robust = np.where(model.score != 0.0, model.score / (model.weight * case.equations.residual), 1.0)
    anew = make_linear_model(case.problem, case.estimate, case.equations, Weights(model.weight, used, robust))
    return replace(anew, known_noise=model.known_noise)
