"""What speaks for a calibration and against it, each with its level: good, care, no, or "" where it is only said."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.base.words import counted, first_of, mm, sentence, short
from ceres_cal.diagnostics import DIAGNOSTICS, Finding
from ceres_cal.report.material import Material

GOOD_MM, CARE_MM = 10.0, 50.0
"""95 % of located points nearer than the first is good (the width of a painted line), than the second to be used with
care, beyond it not to be used."""
_MANY_OUTLIERS = 0.3
_MOST_LINES = 6
_ORDER = ("good", "care", "no")


def level_of(radius_mm: float) -> str:
    """By GOOD_MM and CARE_MM; nothing seen is nothing to trust."""
    return "good" if radius_mm <= GOOD_MM else "care" if radius_mm <= CARE_MM else "no"


def worst(*levels: str) -> str:
    """The last of them in the order good, care, no."""
    return max(levels, key=_ORDER.index)


def is_against(finding: Finding) -> bool:
    """Whether it says that the calibration is wrong, not only that some observation or its noise is."""
    return finding.wrong in ("model", "calibration")


def model_error_mm(material: Material) -> float:
    """The largest effect of what is wrong with the model, rms mm; 0 where nothing is known to be."""
    return _largest_mm([finding for finding in material.diagnosis.findings if finding.is_model_error])


def misfit_mm(material: Material) -> float:
    """By how much a refit to new data would move it, rms mm; 0 where it holds on them, or they are its own."""
    return _largest_mm([finding for finding in material.diagnosis.findings if finding.wrong == "calibration"])


def _largest_mm(findings: list[Finding]) -> float:
    return float(np.nanmax([0.0, *(finding.effect_mm for finding in findings)]))


def grounds(material: Material) -> Iterator[tuple[str, str]]:
    """Level and line of each."""
    calibration, table = material.calibration, material.diagnosis.table
    if calibration.converged:
        yield "good", "The solve came to rest."
    elif calibration.rounds:
        yield "no", "The solve did not come to rest: raise --max-iterations."
    yield from _of_findings(material)
    out = 1.0 - float(np.mean(table.inlier)) if len(table) else 0.0
    if out > _MANY_OUTLIERS:
        yield "care", f"{100.0 * out:.0f} % of the observations were taken out: check labels, dimensions and the lens."
    yield from _of_knowledge(material)
    yield from (("care", f"{sentence(text)}.") for text in calibration.warnings)


def _of_findings(material: Material) -> Iterator[tuple[str, str]]:
    diagnosis, wrong_mm, off_mm = material.diagnosis, model_error_mm(material), misfit_mm(material)
    wrong = [f"{finding.kind} ({finding.subject})" for finding in diagnosis.findings if finding.is_model_error]
    if not diagnosis.findings:
        yield "good", "What the model leaves over looks like noise."
    elif not wrong:
        yield "", f"{counted(len(diagnosis.findings), 'finding')} below; none says that the model is wrong."
    if wrong:
        yield (
            "no" if wrong_mm > CARE_MM else "care",
            f"The model is wrong: {first_of(list(dict.fromkeys(wrong)), 4)}; up to {mm(wrong_mm)} rms. No standard "
            "deviation on this page contains that.",
        )
    if off_mm:
        yield (
            "no" if off_mm > GOOD_MM else "care",
            f"A refit to these new data would move it by {mm(off_mm)} rms: was the camera bumped?",
        )
    if any(DIAGNOSTICS[finding.kind].widens for finding in diagnosis.findings):
        factor = max(one.inflation for one in diagnosis.noise) ** 0.5
        yield "care", f"Neighbouring residuals agree: take every standard deviation {short(factor)} times as large."


def _of_knowledge(material: Material) -> Iterator[tuple[str, str]]:
    if material.uncertainty is None:
        return
    weak = [direction.words for direction in material.uncertainty.weak_directions]
    level = "" if material.maps else "care"  # what they do to places is in the maps
    yield from ((level, f"{sentence(words)}.") for words in weak[:_MOST_LINES])
    if len(weak) > _MOST_LINES:
        yield level, f"{len(weak) - _MOST_LINES} more such directions: see the numbers."
    if not weak:
        yield "good", "Every number of the cameras and stations is known to 1 % or better."
    lost = material.uncertainty.unknown_placements
    if lost:
        named = first_of([f"{' and '.join(parts)} of {name}" for name, parts in lost.items()], 3)
        yield "", f"Not known of placements: {named}. The cameras do not need it."
