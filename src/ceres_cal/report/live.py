"""What is known of a calibration as plain data, for a page that draws it itself: verdict, numbers, maps, advice."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from ceres_cal.base.errors import answer_or_reason
from ceres_cal.base.words import at_precision, mm, two_digits
from ceres_cal.calibration import Calibration
from ceres_cal.diagnostics import ResidualTable
from ceres_cal.diagnostics.advice import advise
from ceres_cal.posterior.maps import FieldMap
from ceres_cal.posterior.uncertainty import Verdict
from ceres_cal.report.grounds import judge_quality
from ceres_cal.report.material import paint_of
from ceres_cal.report.pictures.overlay import places_in_picture
from ceres_cal.report.quality import Quality


def known_of(quality: Quality) -> dict[str, Any]:
    """Verdict, numbers, maps, and residuals by frame."""
    judged = judge_quality(quality)
    maps = next(iter(quality.maps.values()), ())
    return {
        "level": judged.level,
        "headline": judged.headline,
        "reasons": [{"level": level, "text": text} for level, text in judged.reasons],
        "numbers": list(_numbers(quality)),
        "maps": [_map(one) for one in maps],
        "paint": [np.round(line[:, :2], 3).tolist() for line in paint_of(quality.fields)],
        "residuals": {} if quality.diagnosis is None else strokes_of(quality.diagnosis.table),
    }


def _numbers(quality: Quality) -> Iterator[dict[str, str]]:
    """phi and height, and dimensions that were solved for."""
    for (kind, owner, quantity), verdict in quality.verdicts.items():
        if quantity == "phi" or (kind == "station" and quantity == "height"):
            unit, factor = ("px", 1.0) if quantity == "phi" else ("mm", 1e3)
            yield _number(f"{quantity} of {owner}", verdict, factor, unit)
        elif kind == "dimension":
            yield _number(quantity.removesuffix("_m").replace("_", " "), verdict, 1e3, "mm")


def _number(name: str, verdict: Verdict, factor: float, unit: str) -> dict[str, str]:
    value, sd = factor * verdict.value, factor * verdict.sd
    spread = f"± {two_digits(sd)} {unit}" if np.isfinite(sd) else "unknown"
    shown = at_precision(value, sd) if np.isfinite(sd) else f"{value:.4g}"
    return {"name": name, "value": f"{shown} {unit}", "sd": spread, "verdict": verdict.verdict}


def _map(one: FieldMap) -> dict[str, Any]:
    """Radii row by row, mm: None where nothing is seen, -1 where it is unknown."""
    values = np.where(np.isinf(one.radius_95_mm), -1.0, np.round(one.radius_95_mm, 3))
    ends = [float(one.x_m[0]), float(one.x_m[-1]), float(one.y_m[0]), float(one.y_m[-1])]
    return {"height_mm": round(1e3 * one.height_m), "ends": ends, "rows": values.tolist()}


def strokes_of(table: ResidualTable) -> dict[str, list[list[Any]]]:
    """By frame: x, y, by how much the model is beside it, px each, and whether it was taken out."""
    frames: dict[str, list[list[Any]]] = {}
    for number in np.flatnonzero(np.isfinite(table.residual_px[:, 0])).tolist():
        x, y = table.pixel[number].round(2).tolist()
        across, down = table.residual_px[number].round(4).tolist()
        frame = str(table.views[table.view[number]]["frame"])
        frames.setdefault(frame, []).append([x, y, across, down, int(table.outlier[number])])
    return frames


# ---- what to add next -----------------------------------------------------------------------------------------------


def advice_of(calibration: Calibration) -> list[dict[str, Any]]:
    """The best measurement, and the next: what to do, what it leaves, and where in the picture that is."""
    advice, _ = answer_or_reason(lambda: advise(calibration))
    if advice is None:  # the verdict says that the numbers are not known
        return []
    camera = calibration.station()
    return [
        {
            "words": promise.measurement.words,
            "steps": list(promise.measurement.steps),
            "kind": promise.measurement.kind,
            "leaves": f"leaves {mm(promise.after.worst_mm)} of {mm(advice.before.worst_mm)} at the worst place",
            "shapes": [
                {"label": label, "pixels": np.round(pixels, 1).tolist()}
                for label, pixels in places_in_picture(promise.measurement, calibration.targets, camera)
            ],
        }
        for promise in (advice.best, advice.then)
        if promise is not None
    ]
