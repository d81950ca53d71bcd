"""What `ceres-cal diagnose` says, to people and to scripts."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.words import chance, plural
from ceres_cal.cli.arguments import Reporting
from ceres_cal.cli.outputs import WIDTH, section, wrapped, written, written_data
from ceres_cal.diagnostics import Diagnosis, Finding, Noise, ResidualTable, Summary
from ceres_cal.diagnostics.held_out import Choice, HeldOut
from ceres_cal.report.findings import CHOSEN_BY, choice_marks, chosen_lens

_MOST_ROWS = 8
_MOST_SAID = 3  # amounts that the sentence of a finding says itself
_MODEL_ERROR = (
    "the model is wrong by more than its noise can hide: no covariance or standard deviation of this calibration "
    "contains that error"
)


def diagnosis_data(diagnosis: Diagnosis, choice: Choice | None, args: Reporting) -> dict[str, Any]:
    """Everything but the table of single observations, for --json."""
    summaries = diagnosis.summaries
    return {
        "verdict": _verdict(diagnosis),
        "model_error": diagnosis.model_error,
        "conflicts": [asdict(conflict) for conflict in diagnosis.conflicts],
        "new_data": diagnosis.new_data,
        "tests": diagnosis.tests,
        "false_alarm_rate": diagnosis.false_alarm_rate,
        "findings": [asdict(finding) for finding in diagnosis.findings],
        "noise": [asdict(noise) for noise in diagnosis.noise],
        "rejected": _rejected(diagnosis.table),
        "summaries": {name: vars(getattr(summaries, name)) for name in ("frames", "features", "regions", "radii")},
        "radius_trend": [vars(trend) for trend in summaries.trends],
        "held_out": None if choice is None else _choice_data(choice),
        **written_data(args),
    }


def _choice_data(choice: Choice) -> dict[str, Any]:
    return {
        "candidates": [vars(one) for one in choice.candidates],
        "best": choice.candidates[choice.best].label,
        "chosen": choice.candidates[choice.chosen].label,
        "current": choice.candidates[choice.current].label,
        "share_of_observations": choice.thinned,
    }


def diagnosis_text(diagnosis: Diagnosis, choice: Choice | None, args: Reporting) -> str:
    """A page: the verdict, the findings by size, then tables."""
    table, summaries = diagnosis.table, diagnosis.summaries
    sections = [section("verdict", wrapped(*_verdict(diagnosis)))]
    sections += [section("conflict", wrapped(conflict.words)) for conflict in diagnosis.conflicts]
    sections += [
        section(f"finding {number}", _finding(finding)) for number, finding in enumerate(diagnosis.findings, start=1)
    ]
    sections.append(section("noise", [_noise(noise) for noise in diagnosis.noise]))
    if choice is not None:
        sections.append(section("held out", _choice(choice)))
    sections.append(section("outliers", _outliers(table)))
    for title, summary, by_size in (
        ("frames", summaries.frames, True),
        ("features", summaries.features, True),
        ("radius", summaries.radii, False),
        ("regions", summaries.regions, True),
    ):
        sections.append(section(title, _summary(summary, by_size)))
    sections.append(section("leverage", _leverage(table)))
    return "\n".join([*sections, *written(args)])


def _verdict(diagnosis: Diagnosis) -> list[str]:
    rate = f"{diagnosis.tests} tests; sound data raise a finding in {100.0 * diagnosis.false_alarm_rate:g} % of cases"
    lines = []
    if diagnosis.new_data:
        lines.append(
            "new data: residuals are those of the calibration as it stands; the findings are what would be left if it "
            "were refitted to them"
        )
    if diagnosis.conflicts:
        lines.append(
            "what was known beforehand is contradicted: its standard deviations hold what is in dispute, and findings "
            "may follow from it"
        )
    if not diagnosis.findings and diagnosis.conflicts:
        return [*lines, f"nothing else: what is left over looks like noise ({rate})"]
    if not diagnosis.findings:
        return [*lines, f"sound: what is left over looks like noise ({rate})"]
    return [
        *lines,
        f"{plural(len(diagnosis.findings), 'finding')}, the largest first ({rate})",
        *([_MODEL_ERROR] if diagnosis.model_error else []),
    ]


def _finding(finding: Finding) -> list[str]:
    lines = wrapped(finding.sentence, f"-> {finding.advice}")
    size = f"{finding.effect_px:.2f} px, {_mm(finding.effect_mm)} mm; {plural(finding.observations, 'observation')}"
    lines.append(f"   {size}; false alarm: {chance(finding.log10_p)}")
    if len(finding.amounts) > _MOST_SAID:
        lines += [f"   {one.name:28}{one.value:9.3f} ± {one.sd:.3f} {one.unit}" for one in finding.amounts]
    return lines


def _mm(value: float) -> str:
    return "-" if not np.isfinite(value) else f"{value:.2f}"


def _noise(noise: Noise) -> str:
    stated = "no sigma stated" if not np.isfinite(noise.stated_px) else f"{noise.scale:.3f} times what was stated"
    neighbours = "" if not np.isfinite(noise.correlation) else f", neighbours correlated {noise.correlation:+.2f}"
    return f"{noise.kind}  {noise.sigma_px:.4f} px over {noise.observations}, {stated}{neighbours}"


def _choice(choice: Choice) -> list[str]:
    lines = [f"{'':24}held-out px      mm   fit px"]
    for number, one in enumerate(choice.candidates):
        lines.append(f"{one.label:24}{_errors(one)}  {choice_marks(choice, number)}".rstrip())
    parts = max(one.folds for one in choice.candidates)
    rule = f"{parts} parts of the frames; chosen: {CHOSEN_BY}"
    if choice.thinned < 1.0:
        rule += f"; on {100.0 * choice.thinned:.0f} % of the observations"
    return [*lines, rule, chosen_lens(choice)]


def _errors(one: HeldOut) -> str:
    if one.failed:
        return f"none: {one.failed}"[: WIDTH - 24]
    text = f"{one.rms_px:11.4f}{one.rms_mm:9.3f}{one.fit_rms_px:9.4f}"
    return text + (f" without {plural(one.failed_folds, 'part')} that failed" if one.failed_folds else "")


def _rejected(table: ResidualTable) -> Counter[str]:
    names = np.array(table.features)[table.feature[table.outlier]]
    return Counter(names.tolist())


def _outliers(table: ResidualTable) -> list[str]:
    rejected = _rejected(table)
    if not rejected:
        return [f"none of {len(table)}"]
    lines = [f"{sum(rejected.values())} of {len(table)} taken out"]
    lines += [f"{count:5}  {name}" for name, count in rejected.most_common(_MOST_ROWS)]
    rest = len(rejected) - _MOST_ROWS
    return [*lines, f"and on {plural(rest, 'other feature')}"] if rest > 0 else lines


def _summary(summary: Summary, by_size: bool) -> list[str]:
    """Rows of one summary: all, or those of the largest residuals beside their noise."""
    order: Sequence[int] = range(len(summary.names))
    if by_size:
        order = np.argsort(-np.nan_to_num(summary.rms_sigma), kind="stable")[:_MOST_ROWS].tolist()
    width = max(24, *(len(summary.names[i]) + 2 for i in order))
    lines = [f"{'':{width}}points     px  curves     px      mm  sigma   out"]
    for i in order:
        numbers = (
            f"{summary.points[i]:6}{_px(summary.points_rms_px, i)}{summary.curves[i]:8}{_px(summary.curves_rms_px, i)}"
        )
        rest = f"{_mm(float(summary.rms_mm[i])):>8}{_px(summary.rms_sigma, i)}{summary.rejected[i]:6}"
        lines.append(f"{summary.names[i]:{width}}{numbers}{rest}")
    rest_count = len(summary.names) - len(order)
    return [*lines, f"and {rest_count} more with smaller residuals"] if rest_count else lines


def _px(values: Array, number: int) -> str:
    return f"{'-':>7}" if not np.isfinite(values[number]) else f"{values[number]:7.3f}"


def _leverage(table: ResidualTable) -> Iterable[str]:
    """The observations that the answer hangs on most."""
    leverage = np.where(table.inlier, np.nan_to_num(table.leverage), 0.0)
    for i in np.argsort(-leverage, kind="stable")[:3]:
        view, feature = table.views[table.view[i]], table.features[table.feature[i]]
        yield f"{leverage[i]:.2f}  {table.id_of(int(i))}, frame {view['frame']!r}, {feature}"
