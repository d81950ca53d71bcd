"""diagnose(): the residuals one by one, summarised, and what they show about the model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ceres_cal.base import Array, DegenerateError, Indices, InputError, Mask, Pose, checked, numerical, plural
from ceres_cal.base.frozen import Frozen, cached_property, replace
from ceres_cal.base.shown import Shown, drawn, html_of, text_of
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics.checks import CHECKS, DiagnosisCase, Noise, TestResults, measure_noise, solved_for
from ceres_cal.diagnostics.labels import find_mislabelled
from ceres_cal.diagnostics.table import ResidualTable, make_table
from ceres_cal.effects import EffectSums, Finding, Weights, equation_weights, least_absolute, make_linear_model, select
from ceres_cal.effects.table import EFFECTS, JointStep, columns_of_all, joint_step
from ceres_cal.effects.table.targets import CURVE_ASIDE, POINT_ASIDE
from ceres_cal.observations import Observations
from ceres_cal.problem import Estimate, Layout, Problem, Weighting
from ceres_cal.problem.residuals import Residuals, relative_lengths, residuals, write_equations
from ceres_cal.robust import USUAL_EQUATIONS, Conflict, Inliers, judge, with_lost_boards_posed

if TYPE_CHECKING:
    from ceres_cal.diagnostics.summaries import Summaries

FALSE_ALARM_RATE = 0.01
"""Probability that a calibration of sound data gets any finding."""


class Diagnosis(Frozen):
    """The result of `diagnose`.

    Attributes:
        findings: causes of the remaining residuals, the largest first (by effect in px); empty where they look like
            noise.
        table: every observation.
        noise: of points and of curves, with the findings subtracted; without findings it is the calibration's own.
        degrees_of_freedom: spare equations behind the calibration's noise; infinite where sigmas are as stated.
        conflicts: statements that everything else contradicts, from the calibration.
        step: the calibration with all causes taken into account at once that are errors of the model.
        new_data: whether the observations are not those of the calibration. tests: number of alternatives that were
            tested, and false_alarm_rate: the probability that sound data get any finding, by Bonferroni over all of
            them. It holds for normal noise; where it does not hold, there is a finding "correlated".
        model_error: whether some finding says that the model is wrong: then the covariance does not contain that error.
    """

    findings: tuple[Finding, ...]
    table: ResidualTable
    noise: tuple[Noise, ...]
    degrees_of_freedom: float
    new_data: bool
    tests: int
    false_alarm_rate: float
    step: JointStep
    conflicts: tuple[Conflict, ...] = ()

    @property
    def _shown(self) -> Shown:
        rows = [(one.kind, f"{one.effect_px:.2f} px", one.sentence) for one in self.findings]
        count = plural(len(rows), "finding") if rows else "nothing found, residuals look like noise"
        return f"Diagnosis: {count} ({self.tests} tests)", rows

    def __repr__(self) -> str:
        return text_of(self._shown)

    def _repr_html_(self) -> str:
        return html_of(self._shown)

    def plot(self, ax: Any = None, camera: str | None = None) -> Any:
        """Draw the residual vectors over one camera's image into Matplotlib's Axes; returns the Axes.

        Args:
            camera: its name; may be omitted where there is only one.
        """
        return drawn("residual_pictures.plot_residuals", self, ax, camera=camera)

    @cached_property
    def summaries(self) -> Summaries:
        """The table by frame, feature, image region and radius."""
        from ceres_cal.diagnostics.summaries import summarise

        return summarise(self.step.case, self.table)

    @property
    def model_error(self) -> bool:
        return any(finding.is_model_error for finding in self.findings)


_FIRST = "first correct the stated value that the observations contradict: it may cause this finding"


@checked
@numerical("the diagnosis")
def diagnose(
    calibration: Calibration,
    observations: Observations,
    *,
    new_data: bool = False,
    false_alarm_rate: float = FALSE_ALARM_RATE,
) -> Diagnosis:
    """Examine the residuals of a calibration.

    Args:
        new_data: whether the observations are not those of the calibration. Residuals are then taken at the calibration
            as it is (only placements that it does not know are posed); the tests are on what a refit to them would
            leave, so that they judge the model and not the calibration's own uncertainty.
        false_alarm_rate: of all tests together.

    Raises:
        InputError: other observations than those of the calibration, without `new_data`; or cameras or stations that it
            does not have.
        SolutionError: another camera or target than those calibrated, or none of the observations can be shown.
    """
    observations = calibration.as_taken(observations)
    _require_known(calibration, observations, new_data)
    case = _case(calibration, observations, new_data)
    tested = _tested(case, false_alarm_rate)
    findings = list(_findings(tested))
    if any(conflict.kind != "tolerance" for conflict in calibration.conflicts):  # these bias the rest
        findings = [replace(f, advice=f"{_FIRST}; {f.advice}") if f.is_model_error else f for f in findings]
    return Diagnosis(
        tuple(sorted(findings, key=lambda finding: -finding.effect_px)),
        case.table,
        tested.noise,
        case.inliers.degrees_of_freedom,
        observations.digest != calibration.digest,
        tested.selection.tests,
        false_alarm_rate,
        joint_step(case, tested.selection, _solved(case)),
        calibration.conflicts,
    )


def _findings(tested: TestResults) -> Iterator[Finding]:
    """Yield the findings of effects, including those that the calibration solved for, and of checks."""
    solved = _solved(tested.case)
    for effect in EFFECTS.values():
        for finding in effect.findings(tested.case, tested.selection):
            if (finding.kind, finding.subject, finding.frame) in solved:
                finding = replace(finding, wrong="observations", sentence=f"{finding.sentence}; it was solved for")
            yield finding
        for one in tested.case.as_built:
            if one.kind == effect.built and one.probability >= 1.0 - tested.rate:
                yield solved_for(effect.kind, one, tested)
    for findings, _ in CHECKS.values():
        yield from findings(tested)


def _solved(case: DiagnosisCase) -> set[tuple[str, str, str | None]]:
    """Effects by kind, subject and frame that the calibration solved for by itself."""
    return {(one.kind, one.subject, one.frame) for one in case.effects if one.is_solved}


def _require_known(calibration: Calibration, observations: Observations, new_data: bool) -> None:
    if not new_data and observations.digest != calibration.digest:
        raise InputError(
            "these are not the observations that the calibration was made from (their digest differs): give those, or "
            "say that they are new data (--new-data)"
        )
    if new_data:
        from ceres_cal.moves.agreement import matched, require_stations  # which `calibrate` does not need

        matched(calibration, observations)
        require_stations(calibration, observations)


def _case(calibration: Calibration, observations: Observations, new_data: bool) -> DiagnosisCase:
    """Return the case with all observations, including rejected ones that may take part again."""
    problem = calibration.problem(observations, new_data=new_data)
    estimate = calibration.estimate
    if new_data:
        estimate = _with_newcomers_placed(problem, calibration)
    there = residuals(problem.sights, estimate)
    inliers = _judged(calibration, observations, there, new_data)
    equations = write_equations(problem.sights, estimate, there)
    weighting, taking_part = inliers.weighting(problem.options), (inliers.points, inliers.curves)
    weights = equation_weights(weighting, equations, there, taking_part)
    model = make_linear_model(problem, estimate, equations, weights)
    if calibration.refitted is not None and not new_data:
        model = replace(model, known_noise=USUAL_EQUATIONS)
    table = make_table(inliers, model, weights.robust, estimate.cameras)
    judged = taking_part, inliers.scales, problem.options.reject_sigma
    labels, tried = find_mislabelled(observations, estimate, *judged)
    known = (calibration,) if new_data else (None, calibration.as_built, calibration.effects)
    case = DiagnosisCase(problem, estimate, model, inliers, table, labels, tried, *known)
    used = _recalled(case)
    if np.array_equal(used, model.used):
        return case
    again = Weights(weights.inverse_sigma, used, np.where(model.used, weights.robust, 1.0))
    anew = make_linear_model(problem, estimate, equations, again)
    return replace(case, model=replace(anew, known_noise=model.known_noise), solved=model)


def _judged(calibration: Calibration, observations: Observations, there: Residuals, new_data: bool) -> Inliers:
    """Return the calibration's own inliers of its observations; for new observations, judge them."""
    if new_data:
        return judge(observations, there, (1.0, 1.0), calibration.options)
    inliers, posterior = calibration.inlier_masks(observations), calibration.posterior
    points, curves = relative_lengths(observations, there)
    p, c = calibration.fit.point_scale, calibration.fit.curve_scale
    degrees = np.inf if posterior is None else posterior.degrees_of_freedom
    return Inliers(
        inliers[0] & np.isfinite(points), inliers[1] & np.isfinite(curves), p, c, points / p, curves / c, degrees
    )


def _tested(case: DiagnosisCase, rate: float) -> TestResults:
    """Select alternatives at a rate of false alarms, and measure the noise that they leave."""
    alternatives = [EffectSums.of(case.model, columns) for columns in columns_of_all(case)]
    extra = sum(tests(case) for _, tests in CHECKS.values())
    selection = select(case.model, alternatives, rate, extra)
    noise = measure_noise(selection.model, case.model, case.inliers)
    level = selection.log_level
    inflation = max((one.inflation for one in noise if one.correlation_log_p < level), default=1.0)
    if inflation > 1.0 and selection.chosen:  # correlated noise makes every other test too sensitive
        selection = select(case.model, alternatives, rate, extra, inflation)
        noise = measure_noise(selection.model, case.model, case.inliers)
    return TestResults(case, selection, noise, rate)


# Rejected observations of one line that must agree on its position: two determine it, three more do not agree by
# chance. Nothing changes from half to double.
_FEWEST_AGREE = 5
# Offset (m) above which a feature is not painted inaccurately, but has a wrong label. Nothing changes from half to
# double.
_FAR_M = 0.1


# ---- rejected observations that may take part again -----------------------------------------------------------------


def _recalled(case: DiagnosisCase) -> Mask:
    """(E,) which equations take part when lines and points that were rejected nearly completely may do so, too.

    A feature off its nominal position is an outlier everywhere. Where more of its observations agree on another
    position than agree with the drawing, those take part instead.
    """
    equations, weight, used = case.equations, case.model.weight, case.model.used.copy()
    open_to_it = ~_mislabelled(case)[equations.observation]
    counted = replace(case, model=replace(case.model, used=open_to_it))
    for effect in (*CURVE_ASIDE.columns(counted), *POINT_ASIDE.columns(counted)):
        own = (effect.group >= 0) & open_to_it
        rejected = np.bincount(effect.group[own & ~used], minlength=len(effect.subjects))
        for number in np.flatnonzero(rejected >= _FEWEST_AGREE):
            rows = np.flatnonzero(own & (effect.group == number))
            agree = _agreeing(effect.columns[rows] * weight[rows, None], equations.residual[rows] * weight[rows],
                              equations.observation[rows], case.problem.options.reject_sigma)  # fmt: skip
            if np.count_nonzero(agree) > max(int(np.count_nonzero(used[rows])), _FEWEST_AGREE - 1):
                used[rows] = agree
    return used


def _mislabelled(case: DiagnosisCase) -> Mask:
    """(N + M,) which observations a wrong label explains."""
    points = len(case.problem.observations.points)
    explained = np.zeros(len(case.table), dtype=bool)
    for label in case.labels:
        explained[label.rows + (points if label.is_curve else 0)] = True
    return explained


def _agreeing(columns: Array, residual: Array, observation: Indices, reject_sigma: float) -> Mask:
    """(N,) which equations one amount brings within the bound, by least absolute deviations; none if it is large."""
    amount = least_absolute(columns, residual)
    _, of = np.unique(observation, return_inverse=True)
    lengths = np.sqrt(np.bincount(of, (residual + columns @ amount) ** 2))
    return np.asarray((lengths <= reject_sigma)[of] & np.all(np.abs(amount) < _FAR_M))


# ---- new observations ------------------------------------------------------------------------------------------------


def _with_newcomers_placed(problem: Problem, calibration: Calibration) -> Estimate:
    """Return the calibration's estimate with every new placement of the observations in its best pose.

    Raises:
        DegenerateError: a placement cannot be posed: it has fewer than six points, or its points disagree.
    """
    estimate = calibration.estimate
    new = frozenset(key.placement for key in problem.sights.keys if key.placement) - set(estimate.placements)
    if not new:
        return estimate
    fit, options = calibration.fit, calibration.options
    behind = Pose(np.eye(3), np.array([0.0, 0.0, -1e6]))  # no camera sees it: any pose is better
    observations = problem.observations
    first = {view.placement: view.station for view in reversed(observations.views)}
    unplaced = {name: estimate.stations[first[name]].cam_from_world.inverse @ behind for name in new}
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
