"""How well a calibration knows places: sections of its answer, with what they say on a page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from ceres_cal.base.words import DASH, at_precision, mm, two_digits
from ceres_cal.report.document import BulletList, Section, Table, Text
from ceres_cal.report.quality import Quality, Seam
from ceres_cal.scene.heights import HEIGHTS_M, at_height
from ceres_cal.uncertainty import FieldMap, Uncertainty
from ceres_cal.uncertainty.rig import RigPair

_MOST_DIRECTIONS = 4


def accuracy_sections(quality: Quality, seams: Sequence[Seam]) -> Iterator[Section]:
    """How well cameras and places are known; `seams`: those that are said."""
    uncertainty, maps = quality.uncertainty, quality.maps
    if uncertainty is None:
        yield Section(data={"uncertainty": None})
        return
    yield Section("rig", [_rig_line(pair) for pair in uncertainty.rig])
    yield Section("located", [f"{name}: {_sd_at_heights(every)}" for name, every in maps.items()])
    yield _seams(seams)
    yield Section("widened", [uncertainty.widening] if uncertainty.widening else [])
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
    apart, turned = (
        f"{at_precision(value, sd)} ± {two_digits(sd) if np.isfinite(sd) else 'unknown'}"
        for value, sd in (baseline, turn)
    )
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
    """By how much two cameras disagree about what both see."""
    lines, data, rows = [], [], []
    for seam in seams:
        rms, expected, count = seam.measured.rms_mm, seam.measured.expected_rms_mm, len(seam.measured.what)
        lines.append(f"{' - '.join(seam.stations)}: {_sd_at_heights(seam.predicted)}")
        if count:
            found = f"found {two_digits(rms)} mm where {two_digits(expected)} were expected"
            lines.append(f"{found} (rms of {count} points and stretches that both observed)")
        measured = {"found_mm": rms, "expected_mm": expected, "compared": count}
        predicted = [_map_data(one) for one in seam.predicted]
        data.append({"stations": seam.stations, "predicted": predicted, **measured})
        means = (f"± {mm(one.mean_mm)}" for one in seam.predicted)
        over = f" rms of {count}" if count else ""
        rows.append((f" {DASH} ".join(seam.stations), *means, f"{mm(rms)}{over}", mm(expected)))
    head = ("stations", *map(at_height, HEIGHTS_M), "found", "expected")
    table = Table(head, tuple(rows), "Where two cameras see the same: by how much they disagree", stacked=True)
    return Section("seam", lines, {"uncertainty": {"seams": data}}, (table,) if rows else ())


def _unknown(uncertainty: Uncertainty) -> Iterator[Section]:
    """What the observations hardly tell."""
    weak = uncertainty.weak_directions
    lines = [one.words for one in weak[:_MOST_DIRECTIONS]]
    if len(weak) > _MOST_DIRECTIONS:
        lines.append(f"and {len(weak) - _MOST_DIRECTIONS} more (--json)")
    data = [
        {"words": one.words, "relative": one.relative, "shares": [[*key[:3], share] for key, share in one.shares]}
        for one in weak
    ]
    bullets = BulletList(tuple(("care", one.words) for one in weak))
    pieces = (Text("What the observations hardly tell, weakest first:"), bullets) if weak else ()
    yield Section("weak", lines, {"uncertainty": {"weak_directions": data}}, pieces)
    unknown = uncertainty.unknown_placements
    if unknown:
        name, quantities = next(iter(unknown.items()))
        rest = f", and of {len(unknown) - 1} more placements" if len(unknown) > 1 else ""
        yield Section("unknown", [f"{', '.join(quantities)} of placement {name!r}{rest}"])
