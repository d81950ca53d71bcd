"""The chapter of numbers: cameras, stations, targets, fit, in the paper's units, with how well each is known."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import euler_from_rotation, rotation_exp
from ceres_cal.base.words import DASH, at_precision, bounds_text, fixed, grouped, mm, powered, sentence, short
from ceres_cal.calibration import LensChoice
from ceres_cal.model.parameters import anchored_stations
from ceres_cal.report.material import Material
from ceres_cal.report.page import BulletList, Chapter, Piece, Table, Text
from ceres_cal.report.quality import Seam
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.heights import HEIGHTS_M, at_height
from ceres_cal.solve import words_of
from ceres_cal.uncertainty import Verdict

_HEAD = ("", "value", "± sd", "by the model alone", "95 % bounds", "verdict")
_MOST_OFFSETS = 40
_ANGLES = ("alpha, the paper's", "beta, the paper's", "gamma, the paper's", "tilt from straight down")
_TURN = 1e-6  # rad
_Row = tuple[str, ...]


def numbers(material: Material) -> Chapter:
    """The chapter."""
    pieces: list[Piece] = [
        Text(
            "In the paper's units; coefficients with its a1 = 1 (another a1 goes with a1 a2, a1 a3 and a1 phi). Known "
            "means to 1 % or better, weak to 30 %."
        )
    ]
    pieces += _lens_choice(material.calibration.lens_choice)
    for name in material.observations.cameras:
        note = material.calibration.cameras[name].lens.note
        pieces += [_camera(material, name), *([Text(f"{note}.")] if note else [])]
    pieces += [_station(material, name) for name in material.observations.stations]
    pieces += [*_as_built(material), *_weak(material), *_seams(material), _fit(material)]
    return Chapter("numbers", "The numbers", tuple(pieces))


def _lens_choice(choice: LensChoice | None) -> Iterator[Piece]:
    """What was chosen, over what, by how much."""
    if choice is None:
        return
    rows = tuple(
        (
            one.label,
            str(one.coefficients),
            fixed(one.rms_px, 4),
            fixed(one.worse, 1, "+"),
            _percent(one.probability),
            "",
        )
        if one.rms_px is not None and one.worse is not None
        else (one.label, str(one.coefficients), DASH, DASH, DASH, one.failed)
        for one in choice.tried
    )
    head = ("lens", "coefficients", "held-out px", "worse, standard errors", "predicts best, probability", "")
    yield Table(head, rows, f"The lens that the data ask for: {choice.chosen}", stacked=True)


def _percent(share: float | None) -> str:
    return DASH if share is None else f"{100.0 * share:.0f} %"


def _camera(material: Material, name: str) -> Table:
    camera = material.calibration.cameras[name]
    width, height = camera.image_size
    cx, cy = camera.principal_point
    values = {"phi": (camera.phi, "px"), "cx": (cx, "px"), "cy": (cy, "px"), "aspect": (camera.aspect, "")}
    values["skew"] = (camera.skew, "")
    values |= {key: (value, "") for key, value in camera.lens.listed.items()}
    rows = tuple(
        _row(_named(camera, key), value, unit, material.verdicts.get(("camera", name, key)))
        for key, (value, unit) in values.items()
        if value != {"aspect": 1.0, "skew": 0.0}.get(key) or ("camera", name, key) in material.verdicts
    )
    return Table(_HEAD, rows, f"Camera {name}: {camera.lens.kind} lens, {width} × {height} px", stacked=True)


def _named(camera: Camera, quantity: str) -> str:
    words = {"cx": "principal point x", "cy": "principal point y", "aspect": "aspect fy / fx"}
    unit = dict(zip(camera.lens.names, camera.lens.units, strict=True)).get(quantity, "1")
    if unit != "1":
        return f"{quantity}, {powered(unit)}"
    return words.get(quantity, quantity)


def _row(name: str, value: float, unit: str, verdict: Verdict | None) -> _Row:
    """A number; without a verdict it was held, or nothing was minimised."""
    space = f" {unit}" if unit else ""
    if verdict is None:
        return name, f"{value:.10g}{space}", "", "", "", "not free"
    plain = verdict.key.kind == "camera" and not unit
    shown = f"{at_precision(value, verdict.sd)}{space}"
    sds = (_width(sd, unit, plain) for sd in (verdict.sd, verdict.sd / verdict.factor))
    by = " (by its profile)" if verdict.by_profile and verdict.verdict != "known" else ""
    return name, shown, *sds, bounds(verdict, unit), verdict.verdict + by


def _width(sd: float, unit: str, plain: bool) -> str:
    """A standard deviation; `plain`: of a coefficient."""
    if unit == "m":
        return mm(1e3 * sd)
    if not np.isfinite(sd):
        return "unknown"
    return f"{sd:.2g}" if plain else short(sd) + (f" {unit}" if unit else "")


def bounds(verdict: Verdict, unit: str = "") -> str:
    """What 95 % bounds leave, as finely as the value is given."""
    if np.isfinite([verdict.low, verdict.high, verdict.sd]).all() and verdict.low != 0.0:
        low, high = (at_precision(bound, verdict.sd) for bound in (verdict.low, verdict.high))
        if ("e" in low) != ("e" in high):  # as many places, without powers
            places = 1 - int(np.floor(np.log10(verdict.sd)))
            low, high = (f"{bound:.{places}f}" for bound in (verdict.low, verdict.high))
        return f"{low} to {high}{f' {unit}' if unit else ''}"
    return bounds_text(verdict.low, verdict.high, unit, ".4g")


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
    rows += _angles(material, name, camera)
    return Table(_HEAD, tuple(rows), caption, stacked=True)


def _angles(material: Material, name: str, camera: Camera) -> Iterator[_Row]:
    """The paper's angles and the tilt, with what turns about the camera's axes leave of them."""
    every = (material.verdicts.get(("station", name, f"turn_{axis}")) for axis in "xyz")
    turns = [verdict for verdict in every if verdict is not None]
    rotation = camera.cam_from_world.rotation
    posterior = material.calibration.posterior
    if len(turns) == 3 and posterior is not None:
        at = [posterior.column("station", name, f"turn_{axis}") for axis in "xyz"]
        sd = np.array([(turn.sd, turn.sd / turn.factor) for turn in turns])
        widths = _angle_sds(rotation, posterior.covariance[np.ix_(at, at)], sd)
    else:
        widths = np.full((len(_ANGLES), 2), np.nan)
    reach = 0.0 if posterior is None else posterior.half_width
    for word, angle, (width, alone) in zip(_ANGLES, _angles_deg(rotation), widths.tolist(), strict=True):
        shown = f"{at_precision(float(angle), width)}°"
        if np.isfinite(width):
            yield word, shown, f"{short(width)}°", f"{short(alone)}°", f"± {short(reach * width)}°", ""
        else:
            yield word, shown, *(("", "", "", "not free") if np.isnan(width) else ("unknown", "", "", ""))


def _angle_sds(rotation: Array, covariance: Array, sd: Array) -> Array:
    """(4, n) degrees: of the angles, by the correlation of the three turns and each column of their sd (3, n) rad."""
    own = np.sqrt(np.diagonal(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / own[:, None] / own
    slopes = np.stack(
        [(_angles_deg(rotation_exp(_TURN * axis) @ rotation) - _angles_deg(rotation)) / _TURN for axis in np.eye(3)], 1
    )
    slopes = (slopes + 180.0 / _TURN) % (360.0 / _TURN) - 180.0 / _TURN  # a turn past 180 degrees is a small one
    spread = np.stack([np.einsum("ai,ij,aj->a", slopes * s, correlation, slopes * s) for s in sd.T], 1)
    return np.where(np.isfinite(spread), np.sqrt(np.maximum(spread, 0.0)), np.inf)


def _angles_deg(rotation: Array) -> Array:
    """(4,) alpha, beta, gamma and the tilt."""
    tilt = np.arctan2(np.hypot(*rotation[2, :2]), -rotation[2, 2])
    return np.degrees([*euler_from_rotation(rotation), tilt])


def _as_built(material: Material) -> Iterator[Piece]:
    structure = material.calibration.estimate.structure
    lengths = [(name, *name.partition("/")[::2], length) for name, length in structure.dimensions.items()]
    solved = tuple(
        _row(name, length, "m", material.verdicts.get(("dimension", target, one)))
        for name, target, one, length in lengths
    )
    if solved:
        yield Table(_HEAD, solved, "Dimensions that were solved for", stacked=True)
    if not structure.own:
        return
    order = np.argsort(-np.abs(structure.values[: structure.own]), kind="stable")[:_MOST_OFFSETS]
    rows = []
    for i in order:
        target, _, feature = structure.names[i].partition("/")
        verdict = material.verdicts.get(("structure", target, feature))
        sd = 1e3 * verdict.sd if verdict is not None else np.nan
        rows.append((structure.names[i], f"{1e3 * structure.values[i]:+.2f} mm", f"{short(sd)} mm",
                     f"{short(1e3 * float(structure.sigma_m[i]))} mm"))  # fmt: skip
    rest = structure.own - len(order)
    yield from (Text(f"{sentence(words)}.") for words in words_of(material.calibration.as_built))
    yield Table(("", "off its drawing", "± sd", "tolerance"), tuple(rows), "Targets as built", stacked=True)
    if rest:
        yield Text(f"And {grouped(rest)} smaller ones.", "note")


def _weak(material: Material) -> Iterator[Piece]:
    if material.uncertainty is None or not material.uncertainty.weak_directions:
        return
    yield Text("What the observations hardly tell, weakest first:")
    yield BulletList(tuple(("care", direction.words) for direction in material.uncertainty.weak_directions))


def _seams(material: Material) -> Iterator[Piece]:
    if material.seams:
        rows = tuple(_seam_row(seam) for seam in material.seams)
        head = ("stations", *map(at_height, HEIGHTS_M), "found", "expected")
        yield Table(head, rows, "Where two cameras see the same: by how much they disagree", stacked=True)


def _seam_row(seam: Seam) -> tuple[str, ...]:
    measured = seam.measured
    over = f" rms of {len(measured.what)}" if len(measured.what) else ""
    return (
        f" {DASH} ".join(seam.stations),
        *(f"± {mm(one.mean_mm)}" for one in seam.predicted),
        f"{mm(measured.rms_mm)}{over}",
        mm(measured.expected_rms_mm),
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
