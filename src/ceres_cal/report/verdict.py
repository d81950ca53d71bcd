"""The first chapter: may this calibration be trusted, for what, to how many mm."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ceres_cal.report.material import HEIGHTS_M, Material
from ceres_cal.report.page import Chapter, Piece, Points, Text, Tile, Tiles
from ceres_cal.report.words import bounds, count, fixed, listed, metres, mm, short
from ceres_cal.uncertainty import FieldMap, Verdict

GOOD_MM, CARE_MM = 10.0, 50.0
"""95 % of located points nearer than the first is good (the width of a painted line), than the second to be used with
care, beyond it not to be used."""
_MEANING = (
    "The headline holds for 95 % of the points located at the worst place that a camera sees; ± is a standard "
    "deviation. Both are the calibration's own share: the noise of the pixel that is asked about comes on top. Green: "
    f"up to {GOOD_MM:g} mm, a painted line's width; amber: up to {CARE_MM:g} mm."
)
_MANY_OUTLIERS = 0.3
_MOST_LINES = 6
_ORDER = ("good", "care", "no")


@dataclass(frozen=True)
class Reach:
    """How well places at one height are told, over all stations.

    Attributes:
        height_m: of the places. radius_mm: 95 % of the points located at the worst place are nearer, infinite where it
            cannot be told, NaN where no image shows any. level: "good", "care" or "no".
    """

    height_m: float
    radius_mm: float
    level: str

    @property
    def where(self) -> str:
        return "on the floor" if self.height_m == 0.0 else f"at robot height ({mm(1e3 * self.height_m)})"


def reaches(material: Material) -> tuple[Reach, ...]:
    """One for each of HEIGHTS_M; none where no station sees the world."""
    if not material.maps:
        return ()
    found = []
    for number, height_m in enumerate(HEIGHTS_M):
        values = np.concatenate([maps[number].radius_95_mm.ravel() for maps in material.maps.values()])
        values = values[~np.isnan(values)]
        radius = float(values.max()) if len(values) else np.nan
        found.append(Reach(height_m, radius, level_of(radius)))
    return tuple(found)


def level_of(radius_mm: float) -> str:
    """By GOOD_MM and CARE_MM; nothing seen is nothing to trust."""
    return "good" if radius_mm <= GOOD_MM else "care" if radius_mm <= CARE_MM else "no"


def worst(*levels: str) -> str:
    """The last of them in the order good, care, no."""
    return max(levels, key=_ORDER.index)


def verdict(material: Material) -> Chapter:
    """The chapter, its level the colour of the page's first box."""
    grounds = tuple(_grounds(material))
    found = reaches(material)
    level, sentence = _sentence(material, found, worst("good", *(mark for mark, _ in grounds if mark)))
    pieces: list[Piece] = [Tiles(tuple(_tiles(material))), Points(grounds)]
    if found:
        pieces.append(Text(_MEANING, "note"))
    return Chapter("verdict", sentence, tuple(pieces), level)


def _sentence(material: Material, found: tuple[Reach, ...], grounds: str) -> tuple[str, str]:
    """Level and headline."""
    if material.known is None:
        return "no", "Not to be used: nothing was minimised, this is the paper's closed form alone."
    if not found:
        level = worst(grounds, *(_level_of_verdict(verdict) for verdict in _focal(material)))
        how = {"good": "can be trusted", "care": "are to be used with care", "no": "cannot be trusted"}[level]
        return level, f"The intrinsics {how}. No station sees a field: places in the world cannot be told."
    floor, above = found
    told = " and ".join(f"to {mm(r.radius_mm)} {r.where}" for r in found if r.level != "no")
    if grounds == "no" or floor.level == "no":
        return "no", "Do not trust this calibration" + (f", though its sigmas promise places {told}." if told else ".")
    if above.level == "no":
        how = f"are known to {mm(above.radius_mm)} only" if np.isfinite(above.radius_mm) else "cannot be told"
        but = _but(material) or "."
        return "care", f"Trust it on the floor alone, to {mm(floor.radius_mm)}: places {above.where} {how}{but}"
    level = worst(grounds, floor.level, above.level)
    if level == "good":
        return level, f"This calibration can be trusted: {told}."
    return level, f"Use it with care: {told}{_but(material) or '.'}"


def _but(material: Material) -> str:
    """The end of a headline whose numbers do not contain everything, "" where they do."""
    wrong = model_error_mm(material)
    return f", but the model is wrong by {mm(wrong)} (rms) beside that." if wrong else ""


def model_error_mm(material: Material) -> float:
    """The largest effect of what is wrong with the model, rms mm; 0 where nothing is known to be."""
    wrong = [finding.effect_mm for finding in material.diagnosis.findings if finding.is_model_error]
    return float(np.nanmax([0.0, *wrong]))


# ---- large numbers --------------------------------------------------------------------------------------------------


def _tiles(material: Material) -> Iterator[Tile]:
    several = len(material.maps) > 1
    for station, maps in material.maps.items():
        for one in maps:
            where = "On the floor" if one.height_m == 0.0 else f"At {1e3 * one.height_m:.0f} mm"
            yield _map_tile(where + (f", {station}" if several else ""), one)
    if not material.maps:
        for found in _focal(material):
            yield _focal_tile(found)
    fit, table = material.calibration.fit, material.diagnosis.table
    if material.diagnosis.new_data:
        distance = table.distance_px[table.inlier]
        rms = float(np.sqrt(np.mean(distance**2))) if len(distance) else np.nan
        yield Tile("Residuals of new data", short(rms), "px rms", f"over {count(len(distance), 'observation')}")
    else:
        total = count(fit.points + fit.curves, "observation")
        yield Tile("Residuals", short(fit.rms_px), "px rms", f"over {total}: how well data and model agree")
    out = int(np.count_nonzero(~table.inlier))
    share = 100.0 * out / max(len(table), 1)
    yield Tile("Taken out", short(share), "%", f"{count(out, 'outlier')} of {count(len(table), 'observation')}")


def _map_tile(label: str, one: FieldMap) -> Tile:
    seen = one.radius_95_mm[~np.isnan(one.radius_95_mm)]
    if not len(seen):
        return Tile(label, "unseen", "", "the image shows no place of the field", "no")
    level = level_of(float(seen.max()))
    if np.isinf(one.mean_mm):
        return Tile(
            label, "unknown", "", "the observations do not tell it: add tilted boards or measure the height", level
        )
    note = f"of a located point, in the mean; at worst {mm(one.worst_mm)}, at {metres(one.worst_place_m)}"
    return Tile(label, f"± {short(one.mean_mm)}", "mm", note, level)


def _focal(material: Material) -> Iterator[Verdict]:
    """What is known of phi of each camera."""
    for name in material.observations.cameras:
        found = material.verdicts.get(("camera", name, "phi"))
        if found is not None:
            yield found


def _level_of_verdict(found: Verdict) -> str:
    return {"known": "good", "weak": "care", "unknown": "no"}[found.verdict]


def _focal_tile(found: Verdict) -> Tile:
    known = np.isfinite(found.relative)
    value = f"± {short(100.0 * found.relative)}" if known else "unknown"
    note = f"{fixed(found.value, 1)} px, 95 %: {bounds(found)}"
    return Tile(f"phi of {found.key.owner}", value, "%" if known else "", note, _level_of_verdict(found))


# ---- grounds --------------------------------------------------------------------------------------------------------


def _grounds(material: Material) -> Iterator[tuple[str, str]]:
    """What speaks for and against it, each with its level."""
    calibration, diagnosis = material.calibration, material.diagnosis
    if calibration.rounds:
        yield (
            ("good", "The solve came to rest.")
            if calibration.converged
            else (
                "no",
                "The solve did not come to rest: raise --max-iterations.",
            )
        )
    yield from _of_findings(material)
    out = 1.0 - float(np.mean(diagnosis.table.inlier)) if len(diagnosis.table) else 0.0
    if out > _MANY_OUTLIERS:
        yield "care", f"{100.0 * out:.0f} % of the observations were taken out: check labels, dimensions and the lens."
    if material.known is not None:
        weak = [direction.words for direction in material.known.weak_directions]
        mark = "" if material.maps else "care"  # what they do to places is in the maps
        yield from ((mark, f"{words[0].upper()}{words[1:]}.") for words in weak[:_MOST_LINES])
        if len(weak) > _MOST_LINES:
            yield mark, f"{len(weak) - _MOST_LINES} more such directions: see the numbers."
        if not weak:
            yield "good", "Every number of the cameras and stations is known to 1 % or better."
        lost = material.known.unknown_placements
        if lost:
            named = listed([f"{' and '.join(parts)} of {name}" for name, parts in lost.items()], 3)
            yield "", f"Not known of placements: {named}. The cameras do not need it."
    yield from (("care", f"{text[0].upper()}{text[1:]}.") for text in calibration.warnings)


def _of_findings(material: Material) -> Iterator[tuple[str, str]]:
    diagnosis = material.diagnosis
    if not diagnosis.findings:
        yield "good", "What the model leaves over looks like noise."
    elif not diagnosis.model_error:
        yield "", f"{count(len(diagnosis.findings), 'finding')} below; none says that the model is wrong."
    else:
        wrong = [finding for finding in diagnosis.findings if finding.is_model_error]
        level = "no" if model_error_mm(material) > CARE_MM else "care"
        kinds = listed(list(dict.fromkeys(f"{finding.kind} ({finding.subject})" for finding in wrong)), 4)
        yield (
            level,
            (
                f"The model is wrong: {kinds}; up to {mm(model_error_mm(material))} rms. No standard deviation on this "
                "page contains that."
            ),
        )
