"""A calibration's numbers and how well each is known: sections of its answer, and the chapter of its report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import euler_from_rotation, rotation_exp
from ceres_cal.base.words import (
    DASH,
    at_precision,
    bounds_text,
    fixed,
    grouped,
    mm,
    plural,
    powered,
    sentence,
    short,
    two_digits,
)
from ceres_cal.calibration import Calibration, LensChoice
from ceres_cal.observations import Observations
from ceres_cal.posterior.uncertainty import Verdict
from ceres_cal.problem.parameters import anchored_stations
from ceres_cal.report.document import Piece, Section, Table, Text, wrapped
from ceres_cal.report.grounds import of_the_solve
from ceres_cal.report.quality import Quality
from ceres_cal.robust.as_built import words_of
from ceres_cal.scene.camera import Camera

_HEAD = ("", "value", "± sd", "by the model alone", "95 % bounds", "verdict")
_MOST_FEATURES, _MOST_OFFSETS = 6, 40
_ANGLES = ("alpha, the paper's", "beta, the paper's", "gamma, the paper's", "tilt from straight down")
_PHI_FROM = {
    "fixed": "held",
    "views": "started from the views",
    "prior": "started from its prior",
    "guess": "started from a guess",
    "posterior": "under what was known of it",
}
_ANCHORED = "defines the world: boards alone do not determine where it stands"
_Row = tuple[str, ...]


def number_sections(quality: Quality) -> Iterator[Section]:
    """The fit, the lens, and every number of cameras, stations and targets."""
    calibration = quality.calibration
    yield _fit(calibration)
    if calibration.lens_choice is not None:
        yield lens_choice(calibration.lens_choice)
    yield from (_camera(quality, name) for name in calibration.cameras)
    yield from (_station(quality, name) for name in calibration.stations)
    if calibration.estimate.structure.dimensions:
        yield _dimensions(quality)
    if calibration.estimate.structure.own:
        yield _as_built(quality)


# ---- the fit --------------------------------------------------------------------------------------------------------


def observed(observations: Observations) -> list[str]:
    """How many observations there are, and of what."""
    count = observations.counts
    owners = [plural(count[f"{word}s"], word) for word in ("view", "camera", "station", "placement")]
    return [
        ", ".join(owners),
        f"{plural(count['points'], 'point observation')}, {plural(count['curves'], 'curve observation')}",
    ]


def _fit(calibration: Calibration) -> Section:
    fit, lines, rows = calibration.fit, [], []
    for kind, used, rms, scale in (
        ("points", fit.points, fit.points_rms_px, fit.point_scale),
        ("curves", fit.curves, fit.curves_rms_px, fit.curve_scale),
    ):
        if used:
            lines.append(f"{kind}  rms {rms:.4f} px over {used}, noise {scale:.3f} times the stated sigmas")
            rows.append((kind, grouped(used), fixed(rms, 4), f"{scale:.3f} times the stated"))
    table = Table(("fit", "took part", "rms px", "noise"), tuple(rows), "Fit", stacked=True)
    return Section("fit", lines, {"rms_px": calibration.rms_px}, (table,))


def outliers(calibration: Calibration) -> Section:
    """What was taken out, by feature."""
    fit, total = calibration.fit, len(calibration.outliers)
    wholes = (entry.reason.partition(":")[0] for entry in calibration.outliers if entry.is_of_whole)
    single = (f"{entry.kind} {entry.feature}" for entry in calibration.outliers if not entry.is_of_whole)
    features = Counter(wholes) + Counter(single)
    most = features.most_common(_MOST_FEATURES)
    rule = f"taken out ({calibration.options.reject_sigma:g} sigma and more, or a whole line)" if total else ""
    lines = [f"{total or 'none'} of {fit.points + fit.curves + total} {rule}".rstrip()]
    lines += [f"{count:5}  {name}" for name, count in most]
    if len(features) > len(most):
        others = plural(len(features) - len(most), "other feature")
        lines.append(f"{total - sum(count for _, count in most):5}  on {others}")
    return Section("outliers", lines, {"outliers": dict(features.most_common())})


def stopped(calibration: Calibration) -> Section:
    """How the solve ended."""
    if not calibration.rounds:
        return Section("stopped", [calibration.termination])
    how = "converged" if calibration.converged else "did not converge"
    last = plural(max(len(calibration.history) - 1, 0), "iteration")
    solves = plural(calibration.rounds, "solve")
    return Section("stopped", [f"{how} after {solves}, the last of {last}", calibration.termination])


def warnings(calibration: Calibration) -> Iterator[str]:
    """What to know of it, and what may be wrong with the observations."""
    large_scale = 4.0  # from where on a warning is due
    yield from (*calibration.warnings, *calibration.remarks)
    yield from (text for _, text in of_the_solve(calibration))
    scale = max(calibration.fit.scales)
    if calibration.rounds and scale > large_scale:
        yield (
            f"the residuals are {scale:.0f} times the stated sigmas: the lens may not suit the camera, or labels and "
            "target dimensions may be wrong"
        )


def lens_choice(choice: LensChoice) -> Section:
    """What was chosen, over what, by how much."""
    rows = []
    for one in choice.tried:
        cells = (DASH, DASH, DASH, one.failed)
        if one.rms_px is not None and one.worse is not None:
            cells = (fixed(one.rms_px, 4), fixed(one.worse, 1, "+"), _percent(one.probability), "")
        rows.append((one.label, str(one.coefficients), *cells))
    head = ("lens", "coefficients", "held-out px", "worse, standard errors", "predicts best, probability", "")
    table = Table(head, tuple(rows), f"The lens that the data ask for: {choice.chosen}", stacked=True)
    return Section("lens", wrapped(choice.words), pieces=(table,))


def _percent(share: float | None) -> str:
    return DASH if share is None else f"{100.0 * share:.0f} %"


# ---- cameras and stations -------------------------------------------------------------------------------------------


def _camera(quality: Quality, name: str) -> Section:
    clearly = 3.0  # standard deviations from what is usual of cameras: nearer it is not listed among the first numbers
    camera, options = quality.calibration.cameras[name], quality.calibration.options
    (width, height), (cx, cy) = camera.image_size, camera.principal_point
    units = {"phi": "px", "cx": "px", "cy": "px"}
    plain = {"aspect": 1.0, "skew": 0.0}  # of most cameras
    values = {"phi": camera.phi, "cx": cx, "cy": cy, "aspect": camera.aspect, "skew": camera.skew, **camera.lens.listed}

    def known(quantity: str) -> Verdict | None:
        return quality.verdicts.get(("camera", name, quantity))

    def line(title: str, *quantities: str, held: bool = False) -> str:
        shown = (with_sd(values[one], units.get(one, ""), known(one)) for one in quantities)
        held = held or all(one in options.held for one in quantities)
        return f"{title:16}{', '.join(shown)}{' (held)' if held else ''}"

    def differs(one: str, usual: float) -> bool:
        verdict = known(one)
        return abs(values[one] - usual) > (clearly * verdict.sd if verdict else 0.0)

    started = quality.calibration.phi_from.get(name, "")
    freed = {"aspect": options.free_aspect, "skew": options.free_skew}
    lines = [
        f"{name}, {width} x {height} px",
        f"{'phi':16}{with_sd(camera.phi, 'px', known('phi'))} ({_PHI_FROM.get(started, started)})",
        *(line(one, one) for one, usual in plain.items() if freed[one] or differs(one, usual)),
        line("principal point", "cx", "cy", held=not options.free_principal_point),
        *(line(one, one) for one in camera.lens.listed),
    ]
    rows = tuple(
        _row(_named(camera, one), value, units.get(one, ""), known(one))
        for one, value in values.items()
        if value != plain.get(one) or known(one) is not None
    )
    table = Table(_HEAD, rows, f"Camera {name}: {camera.lens.kind} lens, {width} × {height} px", stacked=True)
    note = camera.lens.note
    lines += [note] if note else []
    return Section("camera", lines, pieces=(table, Text(f"{note}.")) if note else (table,))


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


def _station(quality: Quality, name: str) -> Section:
    camera = quality.calibration.stations[name]
    owner = quality.calibration.estimate.stations[name].camera
    title = name if owner == name else f"{name}, camera {owner}"
    caption, data = f"Station {title}", {"tilt_deg": {name: camera.tilt_deg}}
    if name in anchored_stations(quality.observations):
        table = Table(("", "value"), (("pose", _ANCHORED),), caption, stacked=True)
        return Section("station", [title, _ANCHORED], data, (table,))
    place = [
        (word, float(value), quality.verdicts.get(("station", name, word)))
        for word, value in zip(("x", "y", "height"), camera.position, strict=True)
    ]
    alpha, beta, gamma = np.degrees(euler_from_rotation(camera.cam_from_world.rotation))
    turns = [quality.verdicts.get(("station", name, f"turn_{axis}")) for axis in "xyz"]
    sds = [f"{np.degrees(turn.sd):.2g}" if np.isfinite(turn.sd) else "unknown" for turn in turns if turn is not None]
    shown = (f"{word} {with_sd(value, 'm', verdict)}" for word, value, verdict in place)
    lines = [
        title,
        f"{'position':16}{', '.join(shown)}",
        f"{'angles':16}alpha {alpha:.3f}, beta {beta:.3f}, gamma {gamma:.3f} deg (the paper's)",
        f"{'tilt':16}{camera.tilt_deg:.3f} deg from straight down",
        *([f"{'turns':16}± {', '.join(sds)} deg about the camera's x, y and z"] if sds else []),
    ]
    rows = [_row(word if word == "height" else f"position {word}", value, "m", known) for word, value, known in place]
    table = Table(_HEAD, (*rows, *_angles(quality, name, camera)), caption, stacked=True)
    return Section("station", lines, data, (table,))


def _angles(quality: Quality, name: str, camera: Camera) -> Iterator[_Row]:
    """The paper's angles and the tilt, with what turns about the camera's axes leave of them."""
    every = (quality.verdicts.get(("station", name, f"turn_{axis}")) for axis in "xyz")
    turns = [verdict for verdict in every if verdict is not None]
    rotation = camera.cam_from_world.rotation
    posterior = quality.calibration.posterior
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
    turn = 1e-6  # rad
    own = np.sqrt(np.diagonal(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / own[:, None] / own
    slopes = np.stack(
        [(_angles_deg(rotation_exp(turn * axis) @ rotation) - _angles_deg(rotation)) / turn for axis in np.eye(3)], 1
    )
    slopes = (slopes + 180.0 / turn) % (360.0 / turn) - 180.0 / turn  # a turn past 180 degrees is a small one
    with np.errstate(invalid="ignore"):  # of what is unknown; an angle that does not depend on it is unknown, too
        spread = np.stack([np.einsum("ai,ij,aj->a", slopes * s, correlation, slopes * s) for s in sd.T], 1)
    return np.where(np.isfinite(spread), np.sqrt(np.maximum(spread, 0.0)), np.inf)


def _angles_deg(rotation: Array) -> Array:
    """(4,) alpha, beta, gamma and the tilt."""
    tilt = np.arctan2(np.hypot(*rotation[2, :2]), -rotation[2, 2])
    return np.degrees([*euler_from_rotation(rotation), tilt])


# ---- targets --------------------------------------------------------------------------------------------------------


def _dimensions(quality: Quality) -> Section:
    lines, rows = [], []
    for name, length in quality.calibration.estimate.structure.dimensions.items():
        verdict = quality.verdicts.get(("dimension", *name.partition("/")[::2]))
        lines.append(f"{name:36}{with_sd(length, 'm', verdict)} (solved for)")
        rows.append(_row(name, length, "m", verdict))
    table = Table(_HEAD, tuple(rows), "Dimensions that were solved for", stacked=True)
    return Section("lengths", lines, pieces=(table,))


def _as_built(quality: Quality) -> Section:
    """What is off its drawing, the farthest first; a line of what was stated alone, the rest is in words."""
    structure, as_built = quality.calibration.estimate.structure, quality.calibration.as_built
    order = np.argsort(-np.abs(structure.values[: structure.own]), kind="stable").tolist()
    offset_mm = 1e3 * structure.values
    estimated = {one.target for one in as_built}
    stated = [i for i in order if structure.names[i].partition("/")[0] not in estimated]
    lines = wrapped(*words_of(as_built))
    lines += [f"{offset_mm[i]:8.2f} mm  {structure.names[i]}" for i in stated[:_MOST_FEATURES]]
    if rest := len(stated[_MOST_FEATURES:]):
        lines.append(f"and {plural(rest, 'smaller correction')}")
    rows = []
    for i in order[:_MOST_OFFSETS]:
        verdict = quality.verdicts.get(("structure", *structure.names[i].partition("/")[::2]))
        widths = (np.nan if verdict is None else verdict.sd, float(structure.sigma_m[i]))
        rows.append((structure.names[i], f"{offset_mm[i]:+.2f} mm", *(f"{short(1e3 * sd)} mm" for sd in widths)))
    pieces: list[Piece] = [Text(f"{sentence(words)}.") for words in words_of(as_built)]
    pieces.append(Table(("", "off its drawing", "± sd", "tolerance"), tuple(rows), "Targets as built", stacked=True))
    if rest := len(order[_MOST_OFFSETS:]):
        pieces.append(Text(f"And {grouped(rest)} smaller ones.", "note"))
    return Section("as built", lines, pieces=tuple(pieces))


# ---- how well it is known -------------------------------------------------------------------------------------------


def with_sd(value: float, unit: str, verdict: Verdict | None) -> str:
    """A number and how well it is known: "869.0 ± 1.4 px", "4.022 m ± 6.6 mm", "745 px, unknown: below 1209 px".

    Without a verdict it was held, or nothing was minimised. Coefficients have no unit.
    """
    places = 3 if unit == "m" else 0
    if verdict is None:
        return f"{value:.{places or 4}f} {unit}" if unit else f"{value:.8g}"
    if not unit:
        shown = at_precision(value, verdict.sd)
        return f"{shown} ± {verdict.sd:.2g}" if np.isfinite(verdict.sd) else f"{shown}, unknown"
    word = "" if verdict.verdict == "known" else f", {verdict.verdict}"
    if verdict.by_profile and word:
        return f"{value:.{places}f} {unit}{word}: {bounds_text(verdict.low, verdict.high, unit)}"
    if not np.isfinite(verdict.sd):
        return f"{value:.{places}f} {unit}{word}"
    if unit == "m":
        return f"{value:.3f} m ± {two_digits(1e3 * verdict.sd)} mm{word}"
    return f"{at_precision(value, verdict.sd)} ± {two_digits(verdict.sd)} {unit}{word}"
