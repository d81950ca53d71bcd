"""What a calibration says of itself: its verdict, beside its numbers and how well each is known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.words import counted, fixed, metres, mm, plural, sentence, short
from ceres_cal.report.accuracy import accuracy_sections
from ceres_cal.report.document import BulletList, Chapter, Piece, Section, Text, Tile, Tiles, wrapped
from ceres_cal.report.grounds import (
    CARE_MM,
    GOOD_MM,
    disputed,
    focal,
    is_against,
    judge_quality,
    level_of,
    level_of_verdict,
    promises,
    worst,
    worst_radius,
)
from ceres_cal.report.numbers import bounds, number_sections, observed, outliers, stopped, warnings
from ceres_cal.report.quality import Quality
from ceres_cal.scene.heights import at_height
from ceres_cal.uncertainty import FieldMap, Verdict

if TYPE_CHECKING:
    from ceres_cal.report.material import Material

_MOST_FINDINGS = 3
_MEANING = (
    "The headline holds for 95 % of the points located at the worst place that a camera sees; ± is a standard "
    "deviation. Both are the calibration's own share: the noise of the pixel that is asked about comes on top. Green: "
    f"up to {GOOD_MM:g} mm, a painted line's width; amber: up to {CARE_MM:g} mm."
)


def calibration_sections(quality: Quality, inputs: Sequence[str]) -> Iterator[Section]:
    """The answer of `calibrate` and `refit`; `inputs`: the files of observations."""
    calibration, observations = quality.calibration, quality.observations
    read = {"inputs": list(inputs), "counts": observations.counts, "calibration": calibration.to_file()}
    yield Section("read", [", ".join(map(str, inputs)), *observed(observations)], read)
    yield from number_sections(quality)
    yield from accuracy_sections(quality, tuple(quality.each_seam()))
    yield outliers(calibration)
    yield stopped(calibration)
    warned = list(warnings(calibration))
    yield Section(data={"warnings": warned})
    yield from (Section("warning", wrapped(text)) for text in warned)
    yield _verdict(quality)


def _verdict(quality: Quality) -> Section:
    """The headline of the report, and what stands behind it and was not said yet."""
    judged, findings = judge_quality(quality), () if quality.diagnosis is None else quality.diagnosis.findings
    cause = disputed(quality)
    named = [one for one in findings if is_against(one) and not cause][:_MOST_FINDINGS]
    lines = wrapped(judged.headline, *(f"{one.kind}: {one.sentence}" for one in named))
    if findings:
        whence = " may follow from that" if cause else ": `ceres-cal diagnose` says what to do"
        lines.append(f"{plural(len(findings), 'finding')}{whence}")
    reasons = [{"level": level, "text": text} for level, text in judged.reasons]
    data = {"level": judged.level, "headline": judged.headline, "reasons": reasons, "findings": findings}
    return Section("verdict", lines, {"verdict": data})


# ---- on a page ------------------------------------------------------------------------------------------------------


def verdict_chapter(material: Material) -> Chapter:
    """The chapter, its level the colour of the page's first box."""
    judged = judge_quality(material)
    tiles = tuple(_tiles(material))
    if not promises(material):  # the verdict's colour, not that of a number nobody vouches for
        tiles = tuple(replace(tile, level=worst(judged.level, tile.level)) if tile.level else tile for tile in tiles)
    pieces: list[Piece] = [Tiles(tiles), BulletList(judged.reasons)]
    if material.maps:
        pieces.append(Text(_MEANING, "note"))
    return Chapter("verdict", judged.headline, tuple(pieces), judged.level)


# ---- large numbers --------------------------------------------------------------------------------------------------


def _tiles(material: Material) -> Iterator[Tile]:
    several = len(material.maps) > 1
    for station, maps in material.maps.items():
        for one in maps:
            yield _map_tile(sentence(at_height(one.height_m)) + (f", {station}" if several else ""), one)
    if not material.maps:
        for verdict in focal(material):
            yield _focal_tile(verdict)
    fit, table = material.calibration.fit, material.diagnosis.table
    if material.diagnosis.new_data:
        distance = table.distance_px[table.inlier]
        rms = float(np.sqrt(np.mean(distance**2))) if len(distance) else np.nan
        yield Tile("Residuals of new data", short(rms), "px rms", f"over {counted(len(distance), 'observation')}")
    else:
        total = counted(fit.points + fit.curves, "observation")
        yield Tile("Residuals", short(fit.rms_px), "px rms", f"over {total}: how well data and model agree")
    out = int(np.count_nonzero(table.outlier))
    share = 100.0 * out / max(len(table), 1)
    yield Tile("Taken out", short(share), "%", f"{counted(out, 'outlier')} of {counted(len(table), 'observation')}")


def _map_tile(label: str, one: FieldMap) -> Tile:
    radius = worst_radius(one)
    if np.isnan(radius):
        return Tile(label, "unseen", "", "the image shows no place of the field", "no")
    level = level_of(radius)
    if np.isinf(one.mean_mm):
        return Tile(
            label, "unknown", "", "the observations do not tell it: add tilted boards or measure the height", level
        )
    note = f"of a located point, in the mean; at worst {mm(one.worst_mm)}, at {metres(one.worst_place_m)}"
    return Tile(label, f"± {short(one.mean_mm)}", "mm", note, level)


def _focal_tile(verdict: Verdict) -> Tile:
    known = np.isfinite(verdict.relative)
    value = f"± {short(100.0 * verdict.relative)}" if known else "unknown"
    note = f"{fixed(verdict.value, 1)} px, 95 %: {bounds(verdict)}"
    return Tile(f"phi of {verdict.key.owner}", value, "%" if known else "", note, level_of_verdict(verdict))
