"""diagnose(): residuals read one by one, all together, and for what they say of the model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import InputError
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.alternatives import all_families, target_families
from ceres_cal.diagnostics.equations import Equations, write_equations
from ceres_cal.diagnostics.findings import Finding
from ceres_cal.diagnostics.freedom import Freedom, make_freedom
from ceres_cal.diagnostics.labels import Mislabelled, find_mislabelled
from ceres_cal.diagnostics.leftover import Noise, measure_noise
from ceres_cal.diagnostics.new_data import validity_finding, with_newcomers_placed
from ceres_cal.diagnostics.patterns import heard_again, select
from ceres_cal.diagnostics.summaries import Summaries, summarise
from ceres_cal.diagnostics.table import ResidualTable, make_table
from ceres_cal.diagnostics.words import Context, label_findings, noise_findings, pattern_finding
from ceres_cal.model.parameters import Estimate, Layout, make_layout
from ceres_cal.model.residuals import Residuals, residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import gather_sights
from ceres_cal.solve.noise import Inliers, judge, relative_lengths

FALSE_ALARM_RATE = 0.01
"""Probability that a calibration of sound data gets any finding at all."""
_OTHER_TESTS = 5  # size and whiteness of the noise of points and of curves, validity on new data


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What the residuals say.

    Attributes:
        findings: causes of what is left over, the largest first (by effect in px). None: what is left looks like noise.
        table: every observation. summaries: the same by frame, feature, image region and radius.
        noise: of points and of curves, with the findings taken off.
        new_data: whether the observations are others than those the calibration was made from. tests: how many
            alternatives were tested, and false_alarm_rate: the probability that sound data get any finding at all,
            Bonferroni over all of them. It holds for normal noise; what it does not hold for is said by "correlated".
        model_error: whether some finding says that the model is wrong: then the covariance does not contain that error.
    """

    findings: tuple[Finding, ...]
    table: ResidualTable
    summaries: Summaries
    noise: tuple[Noise, ...]
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
    sights = gather_sights(observations)
    estimate = calibration.estimate
    if new_data:
        estimate = with_newcomers_placed(observations, sights, calibration)
    found = residuals(observations, sights, estimate)
    inliers = _judged(calibration, observations, found, new_data)
    layout = make_layout(observations, calibration.options)
    equations = write_equations(observations, sights, estimate, found)
    model = _Model(observations, estimate, layout, inliers, calibration.options.reject_sigma, equations)
    weight, used, robust = _weights(calibration, inliers, model)
    freedom = make_freedom(equations, estimate, layout, weight, used, robust)
    table = make_table(observations, inliers, freedom, robust, dict(estimate.cameras))
    findings, noise, tests = _judge_patterns(model, freedom, table, false_alarm_rate, calibration if new_data else None)
    return Diagnosis(
        findings, table, summarise(observations, table, freedom, dict(estimate.cameras)), noise,
        observations.digest != calibration.digest, tests, false_alarm_rate,
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
class _Model:
    """What the steps of a diagnosis share."""

    observations: Observations
    estimate: Estimate
    layout: Layout
    inliers: Inliers
    reject_sigma: float
    equations: Equations

    @property
    def scales(self) -> tuple[float, float]:
        return self.inliers.point_scale, self.inliers.curve_scale


def _judged(calibration: Calibration, observations: Observations, found: Residuals, new_data: bool) -> Inliers:
    """The calibration's own verdict on its observations, a fresh one on new ones."""
    if new_data:
        estimated = calibration.options.noise_scale == "estimate"
        return judge(observations, found, 0, calibration.options.reject_sigma, estimate_noise=estimated)
    masks = np.ones(len(observations.points), bool), np.ones(len(observations.curves), bool)
    for entry in calibration.rejected:
        masks[entry.kind == "curve"][entry.row] = False
    points, curves = relative_lengths(observations, found)
    p, c = calibration.fit.point_scale, calibration.fit.curve_scale
    return Inliers(masks[0] & np.isfinite(points), masks[1] & np.isfinite(curves), p, c, points / p, curves / c)


def _weights(calibration: Calibration, inliers: Inliers, model: _Model) -> tuple[Array, Mask, Array]:
    """Of each equation: 1 / sigma (px^-1), whether it takes part, and the robust weight of its observation."""
    observations, at = model.observations, model.equations.observation
    sigma = np.concatenate(
        [inliers.point_scale * observations.points.sigma_px, inliers.curve_scale * observations.curves.sigma_px]
    )
    lengths = np.concatenate([inliers.point_sigmas, inliers.curve_sigmas])
    options = calibration.options
    squared = np.where(np.isfinite(lengths), lengths, 0.0) ** 2
    robust = kernels.loss_weights(kernels.LOSS_CODES[options.loss], options.loss_scale, squared)
    inlier = np.concatenate([inliers.points, inliers.curves])
    return 1.0 / sigma[at], inlier[at], robust[at]


def _judge_patterns(
    model: _Model, freedom: Freedom, table: ResidualTable, rate: float, calibration: Calibration | None
) -> tuple[tuple[Finding, ...], tuple[Noise, ...], int]:
    """Findings, noise and how many tests there were. `calibration`: that may not hold, where the data are new."""
    rejected = np.flatnonzero(~model.inliers.points), np.flatnonzero(~model.inliers.curves)
    labels, groups = find_mislabelled(model.observations, model.estimate, *rejected, model.scales, model.reject_sigma)
    freedom = _with_the_rejected(model, freedom, labels)
    families = all_families(model.observations, model.equations, model.estimate, model.layout, freedom.used)
    extra = groups + _OTHER_TESTS
    selection = select(freedom, families, rate, extra)
    noise = measure_noise(model.observations, selection.freedom, model.scales)
    level = selection.log_level
    agreeing = max((one.inflation for one in noise if one.correlation_log_p < level), default=1.0)
    if agreeing > 1.0 and selection.chosen:  # correlated noise makes every other test too eager
        selection = select(freedom, families, rate, extra, agreeing)
        noise = measure_noise(model.observations, selection.freedom, model.scales)
    context = Context(
        model.observations, model.estimate, model.layout, model.equations, freedom, table, selection.tests
    )
    findings = [
        *(pattern_finding(context, selection, number) for number in range(len(selection.chosen))),
        *label_findings(context, labels, level),
        *noise_findings(context, noise, level),
        *([] if calibration is None else validity_finding(context, freedom, calibration, level)),
    ]
    return tuple(sorted(findings, key=lambda finding: -finding.effect_px)), noise, selection.tests


def _with_the_rejected(model: _Model, freedom: Freedom, labels: Sequence[Mislabelled]) -> Freedom:
    """The model in which lines and points that were taken out nearly whole take part where they agree."""
    explained = np.zeros(len(model.observations.points) + len(model.observations.curves), dtype=bool)
    for label in labels:
        explained[label.rows + (len(model.observations.points) if label.is_curve else 0)] = True
    silent = explained[model.equations.observation]
    families = list(target_families(model.observations, model.equations, model.estimate, ~silent))
    used = heard_again(model.equations, freedom.weight, freedom.used, families, model.reject_sigma, silent)
    if np.array_equal(used, freedom.used):
        return freedom
    robust = np.where(freedom.score != 0.0, freedom.score / (freedom.weight * model.equations.residual), 1.0)
    return make_freedom(model.equations, model.estimate, model.layout, freedom.weight, used, robust)
