"""The chapter of numbers: cameras, stations, targets, fit, in the paper's units, with how well each is known."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.base.transforms import euler_from_rotation
from ceres_cal.model.parameters import anchored_stations
from ceres_cal.report.material import Material, Seam
from ceres_cal.report.page import Chapter, Piece, Points, Table, Text
from ceres_cal.report.words import DASH, at_precision, bounds, fixed, grouped, mm, powered, short
from ceres_cal.scene.camera import Camera
from ceres_cal.uncertainty import Verdict

_HEAD = ("", "value", "± sd", "95 % bounds", "verdict")
_MOST_OFFSETS = 40
_Row = tuple[str, str, str, str, str]


def numbers(material: Material) -> Chapter:
    """The chapter."""
    pieces: list[Piece] = [
        Text(
            "In the paper's units; coefficients with its a1 = 1 (another a1 goes with a1 a2, a1 a3 and a1 phi). Known "
            "means to 1 % or better, weak to 30 %."
        )
    ]
    pieces += [_camera(material, name) for name in material.observations.cameras]
    pieces += [_station(material, name) for name in material.observations.stations]
    pieces += [*_as_built(material), *_weak(material), *_seams(material), _fit(material)]
    return Chapter("numbers", "The numbers", tuple(pieces))


def _camera(material: Material, name: str) -> Table:
    camera = material.calibration.cameras[name]
    width, height = camera.image_size
    cx, cy = camera.principal_point
    values = {"phi": (camera.phi, "px"), "cx": (cx, "px"), "cy": (cy, "px"), "aspect": (camera.aspect, "")}
    values |= {key: (value, "") for key, value in camera.lens.coefficients.items()}
    rows = tuple(
        _row(_named(camera, key), value, unit, material.verdicts.get(("camera", name, key)))
        for key, (value, unit) in values.items()
        if key != "aspect" or value != 1.0 or ("camera", name, key) in material.verdicts
    )
    return Table(_HEAD, rows, f"Camera {name}: {camera.lens.kind} lens, {width} × {height} px", stacked=True)


def _named(camera: Camera, quantity: str) -> str:
    words = {"cx": "principal point x", "cy": "principal point y", "aspect": "aspect fy / fx"}
    unit = dict(zip(camera.lens.names, camera.lens.units, strict=True)).get(quantity, "1")
    if unit != "1":
        return f"{quantity}, {powered(unit)}"
    return words.get(quantity, quantity)


def _row(name: str, value: float, unit: str, found: Verdict | None) -> _Row:
    """A number; without a verdict it was held, or nothing was minimised."""
    space = f" {unit}" if unit else ""
    if found is None:
        return name, f"{value:.10g}{space}", "", "", "not free"
    if found.key.kind == "camera" and not unit:
        shown, width = repr(value), f"{found.sd:.2g}" if np.isfinite(found.sd) else "unknown"
    elif unit == "m":
        shown, width = f"{at_precision(value, found.sd, unit)} m", mm(1e3 * found.sd)
    else:
        shown = f"{at_precision(value, found.sd, unit)}{space}"
        width = f"{short(found.sd)}{space}" if np.isfinite(found.sd) else "unknown"
    by = " (by its profile)" if found.by_profile and found.verdict != "known" else ""
    return name, shown, width, f"{bounds(found)}{space}", found.verdict + by


def _station(material: Material, name: str) -> Table:
    camera = material.calibration.estimate.camera_at(name)
    owner = material.observations.stations[name]
    caption = f"Station {name}" + ("" if owner == name else f", camera {owner}")
    if name in anchored_stations(material.observations):
        held = "held as the world: boards alone do not tell where it stands"
        return Table(("", "value"), (("pose", held),), caption, stacked=True)
    rows = [
        _row(f"position {quantity}" if quantity != "height" else "height", float(value), "m",
             material.verdicts.get(("station", name, quantity)))
        for quantity, value in zip(("x", "y", "height"), camera.position, strict=True)
    ]  # fmt: skip
    angles = np.degrees(euler_from_rotation(camera.cam_from_world.rotation))
    for word, angle in zip(("alpha", "beta", "gamma"), angles.tolist(), strict=True):
        rows.append((f"{word}, the paper's", f"{angle:.4f}°", "", "", ""))
    down = camera.cam_from_world.rotation[2]
    tilt = float(np.degrees(np.arctan2(np.hypot(down[0], down[1]), -down[2])))
    rows.append(("tilt from straight down", f"{tilt:.3f}°", "", "", ""))
    for axis in "xyz":
        found = material.verdicts.get(("station", name, f"turn_{axis}"))
        if found is not None:
            sd = float(np.degrees(found.sd))
            limits = f"± {short(0.5 * float(np.degrees(found.high - found.low)))}°"
            width = f"{short(sd)}°" if np.isfinite(sd) else "unknown"
            rows.append((f"turn about the camera's {axis}", "", width, limits, found.verdict))
    return Table(_HEAD, tuple(rows), caption, stacked=True)


def _as_built(material: Material) -> Iterator[Piece]:
    structure = material.calibration.estimate.structure
    if not len(structure.names):
        return
    order = np.argsort(-np.abs(structure.values), kind="stable")[:_MOST_OFFSETS]
    rows = []
    for i in order:
        target, _, feature = structure.names[i].partition("/")
        found = material.verdicts.get(("structure", target, feature))
        sd = 1e3 * found.sd if found is not None else np.nan
        rows.append((structure.names[i], f"{1e3 * structure.values[i]:+.2f} mm", f"{short(sd)} mm",
                     f"{short(1e3 * float(structure.sigma_m[i]))} mm"))  # fmt: skip
    rest = len(structure.names) - len(order)
    yield Table(("", "off its drawing", "± sd", "tolerance"), tuple(rows), "Targets as built", stacked=True)
    if rest:
        yield Text(f"And {grouped(rest)} smaller ones.", "note")


def _weak(material: Material) -> Iterator[Piece]:
    if material.known is None or not material.known.weak_directions:
        return
    yield Text("What the observations hardly tell, weakest first:")
    yield Points(tuple(("care", direction.words) for direction in material.known.weak_directions))


def _seams(material: Material) -> Iterator[Piece]:
    if material.seams:
        rows = tuple(_seam_row(seam) for seam in material.seams)
        head = ("stations", "on the floor", "at 150 mm", "found", "expected")
        yield Table(head, rows, "Where two cameras see the same: by how much they disagree", stacked=True)


def _seam_row(seam: Seam) -> tuple[str, ...]:
    found = seam.found
    over = f" rms of {len(found.what)}" if len(found.what) else ""
    return (
        f"{seam.first} {DASH} {seam.second}",
        *(f"± {mm(one.mean_mm)}" for one in seam.maps),
        f"{mm(found.rms_mm)}{over}",
        mm(found.expected_rms_mm),
    )


def _fit(material: Material) -> Table:
    fit = material.calibration.fit
    rows = tuple(
        (kind, grouped(used), fixed(rms, 4), f"{scale:.3f} times the stated")
        for kind, used, rms, scale in (
            ("points", fit.points, fit.points_rms_px, fit.point_scale),
            ("curves", fit.curves, fit.curves_rms_px, fit.curve_scale),
        )
        if used
    )
    return Table(("fit", "took part", "rms px", "noise"), rows, "Fit", stacked=True)
