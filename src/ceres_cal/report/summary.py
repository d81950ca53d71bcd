"""Summary of a calibration: its verdict, its numbers and how well each is known.

Also the same as plain data, for a page that draws it itself: verdict, numbers, maps, advice.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ceres_cal.base import answer_or_reason, replace, rms, words
from ceres_cal.base.words import DASH, HEIGHTS_M, at_height, counted, mm, plural, short, two_digits, with_sd
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics import ResidualTable
from ceres_cal.posterior import FieldMap, Uncertainty, Verdict
from ceres_cal.report import grounds
from ceres_cal.report.document import BulletList, Chapter, Piece, Section, Table, Text, Tile, wrapped
from ceres_cal.report.numbers import bounds, number_row, number_sections, observed, outliers, stopped, warnings
from ceres_cal.report.quality import Material, Quality, Seam, paint_of

if TYPE_CHECKING:
    from ceres_cal.posterior.seam import RigPair

_MOST_FINDINGS, _MOST_DIRECTIONS = 3, 4
_MEANING = (
    "The accuracy in the headline holds for 95 % of the points located, at 95 of 100 places that a camera sees. The "
    "worst place is named where it is much worse. ± is a standard deviation. Both describe the calibration; the noise "
    f"of the located pixel adds to them. Green: up to {grounds.GOOD_MM:g} mm, the width of a painted line. Amber: up "
    f"to {grounds.CARE_MM:g} mm. Where lines are wider, both are as many times as large."
)


def calibration_sections(
    quality: Quality, inputs: Sequence[str], *, is_observed_now: bool = False
) -> Iterator[Section]:
    """Yield the answer of `calibrate` and `refit`; `inputs`: the files of observations, or photographs where these are
    observed now, so that no file has the observations.
    """
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
    yield _verdict(quality, is_observed_now)


def _verdict(quality: Quality, is_observed_now: bool) -> Section:
    """Section with the headline of the report and its causes that were not stated before."""
    data, findings = _judged(quality), quality.findings
    cause = grounds.disputed(quality)
    named = [one for one in findings if grounds.is_against(one) and not cause][:_MOST_FINDINGS]
    lines = [data["headline"], *(f"{one.kind}: {one.sentence}" for one in named)]
    if findings:
        where = "the report (--report PAGE)" if is_observed_now else "`ceres-cal diagnose`"
        whence = " may follow from that" if cause else f": {where} says what to do"
        lines.append(f"{plural(len(findings), 'finding')}{whence}")
    return Section("verdict", lines, {"verdict": {**data, "findings": findings}})


def _judged(quality: Quality) -> dict[str, Any]:
    judged = grounds.judge_quality(quality)
    reasons = [{"level": level, "text": text} for level, text in judged.reasons]
    return {"level": judged.level, "headline": judged.headline, "reasons": reasons}


# ---- how well places are known --------------------------------------------------------------------------------------


def accuracy_sections(quality: Quality, seams: Sequence[Seam]) -> Iterator[Section]:
    """Yield how well cameras and places are known; `seams`: those that are stated."""
    uncertainty, maps = quality.uncertainty, quality.maps
    if uncertainty is None:
        yield Section(data={"uncertainty": None})
        return
    pairs, most_pairs = uncertainty.rig, 6  # all pairs of four cameras
    more = [f"{plural(len(pairs) - most_pairs, 'more pair')} in --json"] if len(pairs) > most_pairs else []
    yield Section("rig", [*map(_rig_line, pairs[:most_pairs]), *more])
    yield Section("located", [f"{name}: {_sd_at_heights(every)}" for name, every in maps.items()])
    yield _seams(seams)
    yield Section("widened", wrapped(uncertainty.widening or ""))
    yield from _unknown(uncertainty)
    known = {
        "numbers": [{**vars(one), "key": one.key._asdict()} for one in uncertainty.verdicts],
        "widening": uncertainty.widening,
        "rig": uncertainty.rig,
        "dependence": uncertainty.posterior.dependence,
        "unknown_placements": uncertainty.unknown_placements,
        "maps": {name: [_map_data(one) for one in every] for name, every in maps.items()},
    }
    yield Section(data={"uncertainty": known})


def _rig_line(pair: RigPair) -> str:
    """Baseline and angle of two stations, each with its standard deviation."""
    baseline = 1e3 * np.array([pair.baseline_m, pair.baseline_sd_m])
    turn = np.degrees([pair.angle_rad, pair.angle_sd_rad])
    apart, turned = (with_sd(value, sd) for value, sd in (baseline, turn))
    return f"{' - '.join(pair.stations)}: baseline {apart} mm, angle {turned} deg"


def _sd_at_heights(maps: Sequence[FieldMap]) -> str:
    parts = []
    for m in maps:
        x, y = m.worst_place_m
        mean = f"± {two_digits(m.mean_mm)} mm" if np.isfinite(m.mean_mm) else "unknown"
        worst = f" (worst {two_digits(m.worst_mm)} at {x:.1f}, {y:.1f} m)" if np.isfinite(m.worst_mm) else ""
        parts.append(f"{mean} {at_height(m.height_m)}{worst}")
    return ", ".join(parts)


def _map_data(m: FieldMap) -> dict[str, Any]:
    own = {name: getattr(m, name) for name in ("height_m", "worst_place_m", "x_m", "y_m", "sd_mm", "radius_95_mm")}
    return {**own, "mean_sd_mm": m.mean_mm, "worst_sd_mm": m.worst_mm}


def _seams(seams: Sequence[Seam]) -> Section:
    """Section on how much two cameras disagree where they overlap."""
    data, rows = [], []
    for stations, maps, measured in seams:
        rms, expected, count = measured.rms_mm, measured.expected_rms_mm, len(measured.what)
        found = {"found_mm": rms, "expected_mm": expected, "compared": count}
        data.append({"stations": stations, "predicted": [_map_data(one) for one in maps], **found})
        means = (f"± {mm(one.mean_mm)}" for one in maps)
        over = f" rms of {count}" if count else ""
        rows.append((f" {DASH} ".join(stations), *means, f"{mm(rms)}{over}", mm(expected)))
    head = ("stations", *map(at_height, HEIGHTS_M), "found", "expected")
    table = Table(head, tuple(rows), "Where two cameras overlap: by how much they disagree", stacked=True)
    shown = (table,) if rows else ()
    return Section("seam", [line for one in shown for line in one.lines()], {"uncertainty": {"seams": data}}, shown)


def _unknown(uncertainty: Uncertainty) -> Iterator[Section]:
    """Yield what the observations hardly determine."""
    weak = uncertainty.weak_directions
    lines = [one.words for one in weak[:_MOST_DIRECTIONS]]
    if len(weak) > _MOST_DIRECTIONS:
        lines.append(f"and {len(weak) - _MOST_DIRECTIONS} more (--json)")
    data = [
        {"words": one.words, "relative": one.relative, "shares": [[*key[:3], share] for key, share in one.shares]}
        for one in weak
    ]
    bullets = BulletList(tuple(("care", one.words) for one in weak))
    pieces = (Text("What the observations hardly determine, weakest first:"), bullets) if weak else ()
    yield Section("weak", lines, {"uncertainty": {"weak_directions": data}}, pieces)
    unknown = uncertainty.unknown_placements
    if unknown:
        name, quantities = next(iter(unknown.items()))
        rest = f", and of {len(unknown) - 1} more placements" if len(unknown) > 1 else ""
        yield Section("unknown", [f"{', '.join(quantities)} of placement {name!r}{rest}"])


# ---- on a page ------------------------------------------------------------------------------------------------------


def verdict_chapter(material: Material) -> Chapter:
    """Make the chapter of the verdict; its level is the colour of the page's first box."""
    judged = grounds.judge_quality(material)
    tiles = tuple(_tiles(material))
    if not grounds.promises(material):  # the verdict's colour instead of that of a number without a promise
        tiles = tuple(
            replace(tile, level=grounds.worst(judged.level, tile.level)) if tile.level else tile for tile in tiles
        )
    pieces: list[Piece] = [tiles, BulletList(judged.reasons)]
    if material.maps:
        pieces.append(Text(_MEANING, "note"))
    return Chapter("verdict", judged.headline, tuple(pieces), judged.level)


# ---- large numbers --------------------------------------------------------------------------------------------------


def _tiles(material: Material) -> Iterator[Tile]:
    several = len(material.maps) > 1
    for station, maps in material.maps.items():
        for one in maps:
            label = words.sentence(at_height(one.height_m)) + (f", {station}" if several else "")
            yield _map_tile(label, one, grounds.reach(one.height_m, [one], grounds.paint_over_usual(material)))
    if not material.maps:
        for verdict in grounds.focal(material):
            yield _focal_tile(verdict)
    fit, table = material.calibration.fit, material.diagnosis.table
    if material.diagnosis.new_data:
        distance = table.distance_px[table.inlier]
        title, size_px, count = "Residuals of new data", rms(distance), len(distance)
    else:
        title, size_px, count = "Residuals", fit.rms_px, fit.points + fit.curves
    yield Tile(title, short(size_px), "px rms", f"over {counted(count, 'observation')}")
    out = int(np.count_nonzero(table.outlier))
    share = 100.0 * out / max(len(table), 1)
    yield Tile("Taken out", short(share), "%", f"{counted(out, 'outlier')} of {counted(len(table), 'observation')}")


def _map_tile(label: str, one: FieldMap, known: grounds.Reach) -> Tile:
    level = known.level
    if np.isnan(known.worst_mm):
        return Tile(label, "unseen", "", "the image shows no place of the field", "no")
    if np.isinf(one.mean_mm):
        return Tile(
            label, "unknown", "", "not determined by the observations: add tilted boards or measure the height", level
        )
    note = f"mean of located points; at worst {mm(one.worst_mm)}, at {words.metres(one.worst_place_m)}"
    return Tile(label, f"± {short(one.mean_mm)}", "mm", note, level)


def _focal_tile(verdict: Verdict) -> Tile:
    known = np.isfinite(verdict.relative)
    value = f"± {short(100.0 * verdict.relative)}" if known else "unknown"
    note = f"{words.fixed(verdict.value, 1)} px, 95 %: {bounds(verdict)}"
    return Tile(f"phi of {verdict.key.owner}", value, "%" if known else "", note, grounds.level_of_verdict(verdict))


def numbers_chapter(quality: Quality, seams: Sequence[Seam]) -> Chapter:
    """Make the chapter of the numbers."""
    intro = (
        "Radial lenses use the paper's notation with a1 = 1. Known: to 1 % or better. Weak: to 30 %. In conflict: all "
        "other observations contradict the stated value."
    )
    every = (*number_sections(quality), *accuracy_sections(quality, seams))
    return Chapter("numbers", "The numbers", (Text(intro), *(piece for one in every for piece in one.pieces)))


# ---- as plain data --------------------------------------------------------------------------------------------------


def known_of(quality: Quality) -> dict[str, Any]:
    """Return verdict, numbers, maps, and residuals by frame."""
    maps = next(iter(quality.maps.values()), ())
    return {
        **_judged(quality),
        "numbers": list(_numbers(quality)),
        "maps": [_map(one) for one in maps],
        "paint": [np.round(line[:, :2], 3).tolist() for line in paint_of(quality.fields)],
        "residuals": {} if quality.diagnosis is None else strokes_of(quality.diagnosis.table),
    }


def _numbers(quality: Quality) -> Iterator[dict[str, str]]:
    """Yield phi and height, and estimated dimensions."""
    for (kind, owner, quantity), verdict in quality.verdicts.items():
        if kind == "dimension" or quantity == "phi" or (kind == "station" and quantity == "height"):
            name = quantity.removesuffix("_m").replace("_", " ") if kind == "dimension" else f"{quantity} of {owner}"
            _, value, sd, *_ = number_row(name, verdict.value, "px" if quantity == "phi" else "m", verdict)
            spread = f"± {sd}" if np.isfinite(verdict.sd) else sd
            yield {"name": name, "value": value, "sd": spread, "verdict": verdict.verdict}


def _map(one: FieldMap) -> dict[str, Any]:
    """Radii row by row, mm: None where nothing is seen, -1 where the radius is unknown."""
    values = np.where(np.isinf(one.radius_95_mm), -1.0, np.round(one.radius_95_mm, 3))
    ends = [float(one.x_m[0]), float(one.x_m[-1]), float(one.y_m[0]), float(one.y_m[-1])]
    return {"height_mm": round(1e3 * one.height_m), "ends": ends, "rows": values.tolist()}


def strokes_of(table: ResidualTable) -> dict[str, list[list[Any]]]:
    """By frame: x, y, residual in x and y (px), and whether the observation is an outlier."""
    frames: dict[str, list[list[Any]]] = {}
    for number in np.flatnonzero(np.isfinite(table.residual_px[:, 0])).tolist():
        x, y = table.pixel[number].round(2).tolist()
        across, down = table.residual_px[number].round(4).tolist()
        frame = str(table.views[table.view[number]]["frame"])
        frames.setdefault(frame, []).append([x, y, across, down, int(table.outlier[number])])
    return frames


# ---- what to add next -----------------------------------------------------------------------------------------------


def advice_of(calibration: Calibration) -> list[dict[str, Any]]:
    """Return the best measurement and the next one: what to do, the remaining uncertainty, and where it is in the
    picture.
    """
    from ceres_cal.diagnostics.advice import advise  # imports OpenCV, only for the page of `open`
    from ceres_cal.report.pictures.overlay import places_in_picture

    advice, _ = answer_or_reason(lambda: advise(calibration))
    if advice is None:  # the verdict says that the numbers are not known
        return []
    camera = calibration.station()
    return [
        {
            "words": promise.measurement.words,
            "steps": list(promise.measurement.steps),
            "kind": promise.measurement.kind,
            "leaves": f"reduces the worst error to {mm(promise.after.worst_mm)} from {mm(advice.before.worst_mm)}",
            "shapes": [
                {"label": label, "pixels": np.round(pixels, 1).tolist()}
                for label, pixels in places_in_picture(promise.measurement, calibration.targets, camera)
            ],
        }
        for promise in (advice.best, advice.then)
        if promise is not None
    ]
