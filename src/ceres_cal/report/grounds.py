"""The verdict of terminal, reports and `--json`: whether a calibration can be trusted, for what, and to how many mm.

Each reason for or against has a level: good, care, no, or "" for a mere statement.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from msgspec import Struct

from ceres_cal.base import HEIGHTS_M, counted, ended, first_of, median, mm, sentence, short
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics import Finding, ResidualTable
from ceres_cal.posterior import FieldMap, Verdict
from ceres_cal.report.quality import Quality
from ceres_cal.robust.as_built import words_of
from ceres_cal.scene.targets.target import PAINT_WANDERS

GOOD_MM, CARE_MM = 10.0, 50.0
"""Limits of the distance within which 95 % of located points are: up to the first (the width of a painted line) the
level is good, up to the second care, beyond it no. If lines are painted wider, both are as many times as large.
"""
MOST_PLACES = 0.95
"""Share of the places seen to which the verdict applies. The worst place is named as well where it is much worse."""
GOOD_PX, CARE_PX = 2.0, 10.0
"""The corresponding limits in the picture, px, for a camera that sees no field: a pixel shows about 5 mm of one."""
LARGE_NOISE = 3.0
"""Ratio of the noise to the stated sigmas from which on it contains more than noise: no number of mm is promised."""
MOVED, MOVED_FAR = 1.0, 3.0
"""Standard deviations by which a named fault moves a result: from the first on the level is care, from the second on
no, unless the accuracy including the fault is GOOD_MM or better.
"""
_UNJUDGED = "its residuals could not be judged"
_ORDER = ("good", "care", "no")


def level_of(radius_mm: float, times: float = 1.0) -> str:
    """Level by GOOD_MM and CARE_MM, scaled by `times`; NaN (nothing seen) is "no"."""
    return "good" if radius_mm <= GOOD_MM * times else "care" if radius_mm <= CARE_MM * times else "no"


def paint_over_usual(quality: Quality) -> float:
    """Ratio of the width of the fields' lines to GOOD_MM, at least 1; 12 for a football pitch."""
    widths = [1e3 * curve.width_m for target in quality.fields for curve in target.curves.values()]
    return max(1.0, median(np.array(widths)) / GOOD_MM) if widths else 1.0


def level_of_px(radius_px: float) -> str:
    """Level by GOOD_PX and CARE_PX; NaN (nothing observed) is "no"."""
    return "good" if radius_px <= GOOD_PX else "care" if radius_px <= CARE_PX else "no"


def worst(*levels: str) -> str:
    """Return the worst level, in the order good, care, no."""
    return max(levels, key=_ORDER.index)


class Judgement(Struct, frozen=True):
    """The verdict.

    Attributes:
        level: good, care or no. headline: one sentence. reasons: level and line of each.
    """

    level: str
    headline: str
    reasons: tuple[tuple[str, str], ...]


def judge_quality(quality: Quality) -> Judgement:
    """Return the verdict on a calibration."""
    reasons = tuple(grounds(quality))
    level, headline = _headline(quality, reaches(quality), worst("good", *(mark for mark, _ in reasons if mark)))
    return Judgement(level, headline, reasons)


def is_against(finding: Finding) -> bool:
    """Whether a finding says that the calibration is wrong. A wrong label did no harm, and noise and correlated errors
    are in the standard deviations.
    """
    return finding.wrong in ("model", "calibration")


def disputed(quality: Quality) -> bool:
    """Whether prior knowledge is contradicted; a contradicted tolerance alone does not affect the calibration."""
    return any(conflict.kind != "tolerance" for conflict in quality.calibration.conflicts)


def noise_ratio(quality: Quality) -> float:
    """Ratio of the noise to the stated sigmas, the larger one of points and curves; 0 where none were stated. Curves
    are ignored if the usual unevenness of paint explains the excess: sigmas of photographs describe the pixels only.
    """
    every = () if quality.diagnosis is None else quality.diagnosis.noise
    paint_mm = 1e3 * PAINT_WANDERS * min((target.usual_aside_m for target in quality.fields), default=0.0)
    found = [one for one in quality.findings if one.kind == "noise" and one.subject == "curves"]
    is_paint = any(one.effect_mm <= paint_mm for one in found)
    told = [one for one in every if np.isfinite(one.stated_px) and not (is_paint and one.kind == "curves")]
    return max((one.scale for one in told), default=0.0)


def misfit_mm(quality: Quality) -> float:
    """Rms distance, mm, by which a refit to new data would move places; 0 if the calibration holds, or for its own
    data.
    """
    return _largest_mm([finding for finding in quality.findings if finding.wrong == "calibration"])


def _largest_mm(findings: Sequence[Finding]) -> float:
    return float(np.nanmax([0.0, *(finding.effect_mm for finding in findings)]))


def of_the_solve(calibration: Calibration, table: ResidualTable | None = None) -> Iterator[tuple[str, str]]:
    """Yield level and line of what speaks against a solve, if there was one. `table`: of other observations."""
    many_outliers = 0.3
    out = len(calibration.outliers)
    share = out / max(calibration.fit.points + calibration.fit.curves + out, 1)
    if table is not None and len(table):
        share = float(np.mean(table.outlier))
    if calibration.rounds and not calibration.converged:
        yield "no", "the solve did not converge: raise --max-iterations"
    if calibration.rounds and share > many_outliers:
        yield "care", f"{100.0 * share:.0f} % of the observations were taken out: check labels, dimensions and the lens"


def grounds(quality: Quality) -> Iterator[tuple[str, str]]:
    """Yield the level and line of each reason."""
    calibration = quality.calibration
    if calibration.converged:
        yield "good", "The solve converged."
    table = None if quality.diagnosis is None else quality.diagnosis.table
    yield from ((level, ended(text)) for level, text in of_the_solve(calibration, table))
    if quality.undiagnosed:
        yield "care", f"{sentence(_UNJUDGED)}. So it is not known whether the model is right: {quality.undiagnosed}."
    yield from _of_findings(quality)
    yield from (("", ended(words)) for words in words_of(calibration.as_built))
    for conflict in calibration.conflicts:
        yield "care" if conflict.kind == "tolerance" else "no", ended(conflict.words)
    if noise_ratio(quality) >= LARGE_NOISE:
        yield (
            "care",
            f"The noise is {short(noise_ratio(quality))} times the stated sigma: check the lens, the labels and the "
            "dimensions.",
        )
    yield from _of_knowledge(quality)
    known = [conflict.words for conflict in calibration.conflicts]
    for text in calibration.warnings:
        if text not in known:
            yield "no" if text in calibration.ambiguities else "care", ended(text)
    yield from (("", ended(text)) for text in calibration.remarks)  # remarks are included in every standard deviation


def _of_findings(quality: Quality) -> Iterator[tuple[str, str]]:
    if quality.diagnosis is None:
        return
    off_mm = misfit_mm(quality)
    if quality.faults:
        yield _of_faults(quality)
    elif quality.findings:
        yield "", f"{counted(len(quality.findings), 'finding')} below. None says that the model is wrong."
    else:
        yield "good", "The residuals look like noise."
    if off_mm:
        yield (
            "no" if off_mm > GOOD_MM else "care",
            f"A refit to these new data would move places by {mm(off_mm)} rms: the camera may have been moved.",
        )


def _of_faults(quality: Quality) -> tuple[str, str]:
    """Return level and line of the model's faults, by how far they move a result."""
    sigmas, places = quality.fault_sigmas, bool(quality.faulty_maps)
    left_mm = max((one.radius_mm for one in reaches(quality)), default=np.inf)
    far = sigmas >= MOVED_FAR and level_of(left_mm, paint_over_usual(quality)) != "good"
    level = "no" if far else "care" if sigmas >= MOVED else ""
    counted_in = "The accuracy in the first line includes this" if places else "The uncertainties do not include it"
    moved = f"{'places' if places else 'numbers of the cameras'} by {short(sigmas)} standard deviations"
    wrong_mm = mm(_largest_mm(quality.faults))
    names = first_of(list(dict.fromkeys(f"{fault.kind} ({fault.subject})" for fault in quality.faults)), 4)
    return level, f"The model is wrong by up to {wrong_mm} rms: {names}. This moves {moved}. {counted_in}."


def _of_knowledge(quality: Quality) -> Iterator[tuple[str, str]]:
    most_lines = 6
    if quality.uncertainty is None:
        return
    if quality.uncertainty.widening:
        yield "", ended(quality.uncertainty.widening)
    some = 0.005  # least probability that is stated
    floors = [one for one in quality.calibration.effects if not one.is_solved and one.probability >= some]
    likely = [f"'{one.kind} by {mm(1e3 * one.sigma)}' is {100.0 * one.probability:.0f} % likely" for one in floors]
    if likely:
        included = "the accuracy includes this, and --as-drawn leaves it out"
        yield "", f"According to the observations {' and '.join(likely)}: {included}."
    weak = [direction.words for direction in quality.uncertainty.weak_directions]
    # Their effect on places is included in the maps, that on the picture in its radius.
    level = "" if quality.maps or level_of_px(quality.observed_px) == "good" else "care"
    # These lines begin with names, which are not capitalised.
    yield from ((level, f"{words}.") for words in weak[:most_lines])
    if len(weak) > most_lines:
        yield level, f"{len(weak) - most_lines} more such directions: see the numbers."
    if not weak and not disputed(quality):
        yield "good", "Every number of the cameras and stations is known to 1 % or better."
    lost = quality.uncertainty.unknown_placements
    if lost:
        named = first_of([f"{' and '.join(parts)} of {name}" for name, parts in lost.items()], 3)
        yield "", f"Not determined: {named}. The cameras do not depend on it."


# ---- the headline -------------------------------------------------------------------------------------------------


class Reach(Struct, frozen=True):
    """Accuracy of places at one height, over all stations.

    Attributes:
        height_m: height of the places.
        radius_mm: distance within which 95 % of located points are, at 95 of 100 of the places seen; infinite where it
            is unknown, NaN where no image shows a place.
        worst_mm: the same at the worst place. worst_at: the worst place.
        level: "good", "care" or "no". is_worse: whether the worst place has another level.
    """

    height_m: float
    radius_mm: float
    worst_mm: float
    worst_at: str
    level: str
    is_worse: bool

    @property
    def plane(self) -> str:
        return "on the floor" if self.height_m == 0.0 else "at robot height"

    @property
    def where(self) -> str:
        return self.plane if self.height_m == 0.0 else f"{self.plane} ({mm(1e3 * self.height_m)})"


def reaches(quality: Quality) -> tuple[Reach, ...]:
    """Return the accuracy at each of HEIGHTS_M, including named faults; empty where no station sees the world."""
    if not quality.maps:
        return ()
    times = paint_over_usual(quality)
    return tuple(
        reach(height, [maps[number][0] for maps in quality.faulty_maps], times)
        for number, height in enumerate(HEIGHTS_M)
    )


def reach(height_m: float, maps: Sequence[FieldMap], times: float) -> Reach:
    """Summarise maps. A little known corner of the picture beyond the paint lowers the level to care at most."""
    radii = np.concatenate([one.radius_95_mm.ravel() for one in maps])
    places = np.concatenate([one.places for one in maps])[~np.isnan(radii)]
    radii = radii[~np.isnan(radii)]
    if not len(radii):
        return Reach(height_m, np.nan, np.nan, "", "no", False)
    most, at = float(np.sort(radii)[int(np.ceil(MOST_PLACES * (len(radii) - 1)))]), int(np.argmax(radii))
    farthest, (x, y) = float(radii[at]), places[at, :2]
    level, worst_level = level_of(most, times), level_of(farthest, times)
    level = "care" if level == "good" and worst_level == "no" else level
    return Reach(height_m, most, farthest, f"x {x:.1f}, y {y:.1f} m", level, worst_level != level_of(most, times))


def focal(quality: Quality) -> Iterator[Verdict]:
    """Yield the verdict on each camera's phi."""
    for name in quality.observations.cameras:
        verdict = quality.verdicts.get(("camera", name, "phi"))
        if verdict is not None:
            yield verdict


def level_of_verdict(verdict: Verdict) -> str:
    """Level of a number: good where it is known, care where it is weak."""
    return {"known": "good", "weak": "care"}.get(verdict.verdict, "no")


def _headline(quality: Quality, every: tuple[Reach, ...], reasons: str) -> tuple[str, str]:
    """Return level and headline."""
    if quality.uncertainty is None:
        return "no", "Not to be used: this is the closed form of the paper. Nothing was minimised."
    if not every:
        px = quality.observed_px
        level = worst(reasons, level_of_px(px), *(level_of_verdict(verdict) for verdict in focal(quality)))
        how = {"good": "can be trusted", "care": "are usable with limits", "no": "cannot be trusted"}[level]
        promised = f", to {short(px)} px in the observed part of the image" if level != "no" and px <= CARE_PX else ""
        return level, f"The intrinsics {how}{promised}. No station sees a field, so places in the world are not known."
    if misfit_mm(quality) > GOOD_MM:
        return "no", f"It does not hold: it is off by {mm(misfit_mm(quality))} rms on these new data."
    floor, above = every
    doubt = _doubt(quality)
    if reasons == "no" or floor.level == "no":
        why = doubt or (_short_of(floor) if floor.level == "no" else "")
        return "no", f"Do not trust this calibration{f': {why}' if why else ''}."
    if doubt:
        return "care", f"Usable with limits, without a stated accuracy: {doubt}."
    if above.level == "no":
        how = f"to {mm(floor.radius_mm)}{_except_at([floor])}"
        return "care", f"Usable on the floor only, {how}: {_short_of(above)}."
    level = worst(reasons, floor.level, above.level)
    how = " and ".join(f"to {mm(one.radius_mm)} {one.where}" for one in every) + _except_at(every)
    return level, f"{'This calibration can be trusted' if level == 'good' else 'Usable with limits'}: {how}."


def _except_at(every: Sequence[Reach]) -> str:
    """Words on the worst place if its level differs from that of most places; else ""."""
    worse = [one for one in every if one.is_worse]
    if not worse:
        return ""
    farthest = max(worse, key=lambda one: one.worst_mm)
    how = f"only to {mm(farthest.worst_mm)}" if np.isfinite(farthest.worst_mm) else "not known"
    return f", but {how} {farthest.plane} at {farthest.worst_at}"


def _short_of(reach: Reach) -> str:
    """Words that places there are not known well enough."""
    how = f"are known to {mm(reach.radius_mm)} only" if np.isfinite(reach.radius_mm) else "are not known"
    return f"places {reach.where} {how}"


def promises(quality: Quality) -> bool:
    """Whether the headline states an accuracy; if not, no number of mm is shown as good."""
    return judge_quality(quality).level != "no" and not _doubt(quality)


def _doubt(quality: Quality) -> str:
    """Return the reason why a headline states no accuracy; "" if there is none."""
    if quality.undiagnosed:
        return _UNJUDGED
    if disputed(quality):
        return "the observations contradict what was stated beforehand"
    if quality.calibration.ambiguities:  # once two solutions were 3.8 m apart, each known to 42 mm
        return "the observations of a station fit equally well from another position"
    if noise_ratio(quality) >= LARGE_NOISE:
        return f"the noise is {short(noise_ratio(quality))} times the stated sigma"
    if off := misfit_mm(quality):
        return f"it is off by {mm(off)} rms on these new data"
    if quality.fault_sigmas >= MOVED_FAR and not all(
        level_of(one.radius_mm, paint_over_usual(quality)) == "good" for one in reaches(quality)
    ):
        return f"the faults below move it by {short(quality.fault_sigmas)} standard deviations"
    return ""
