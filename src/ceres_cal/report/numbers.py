"""Numbers of a calibration and their accuracy: sections of a command's answer, and the chapter of its report."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from ceres_cal.base import Array, euler_from_rotation, replace, rotation_exp
from ceres_cal.base.words import DASH, at_precision, bounds_text, fixed, grouped, mm, plural, powered, sentence, short
from ceres_cal.calibration import Calibration, LensChoice
from ceres_cal.observations import Observations
from ceres_cal.posterior.uncertainty import Verdict
from ceres_cal.problem.parameters import anchored_stations
from ceres_cal.report.document import Piece, Section, Table, Text, wrapped
from ceres_cal.report.grounds import of_the_solve
from ceres_cal.report.quality import Quality
from ceres_cal.robust.as_built import words_of
from ceres_cal.scene.camera import Camera

_HEAD = ("", "value", "± sd", "by the model alone", "95 % bounds", "how well")
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
    """Yield the fit, the lens, and every number of cameras, stations and targets."""
    calibration = quality.calibration
    yield _fit(calibration)
    several = len(calibration.lens_choices) > 1
    for name, choice in calibration.lens_choices.items():
        yield lens_choice(f"camera {name!r}: " if several else "", choice)
    yield from (_camera(quality, name) for name in calibration.cameras)
    yield from (_station(quality, name) for name in calibration.stations)
    if calibration.estimate.structure.dimensions:
        yield _dimensions(quality)
    if calibration.estimate.structure.own:
        yield _as_built(quality)


# ---- the fit --------------------------------------------------------------------------------------------------------


def observed(observations: Observations) -> list[str]:
    """Return lines on the number of observations, and what they are of."""
    count = observations.counts
    owners = [plural(count[f"{word}s"], word) for word in ("view", "camera", "station", "placement")]
    return [
        ", ".join(owners),
        f"{plural(count['points'], 'point observation')}, {plural(count['curves'], 'curve observation')}",
    ]


def _fit(calibration: Calibration) -> Section:
    fit = calibration.fit
    kinds = (
        ("points", fit.points, fit.points_rms_px, fit.point_scale),
        ("curves", fit.curves, fit.curves_rms_px, fit.curve_scale),
    )
    rows = [
        (kind, grouped(used), fixed(rms, 4), f"{scale:.3f} times the stated sigmas")
        for kind, used, rms, scale in kinds
        if used
    ]
    table = Table(("", "took part", "rms px", "noise"), tuple(rows), "Fit", stacked=True)
    return Section("fit", table.lines(), {"rms_px": calibration.rms_px}, (table,))


def outliers(calibration: Calibration) -> Section:
    """Section on the outliers, by feature."""
    fit, total = calibration.fit, len(calibration.outliers)
    groups = (entry.reason.partition(":")[0] for entry in calibration.outliers if entry.is_of_whole)
    single = (f"{entry.kind} {entry.feature}" for entry in calibration.outliers if not entry.is_of_whole)
    features = Counter(groups) + Counter(single)
    most = features.most_common(_MOST_FEATURES)
    rule = f"taken out ({calibration.options.reject_sigma:g} sigma and more, or a whole line)" if total else ""
    lines = [f"{total or 'none'} of {fit.points + fit.curves + total} {rule}".rstrip()]
    lines += [f"{count:5}  {name}" for name, count in most]
    if len(features) > len(most):
        others = plural(len(features) - len(most), "other feature")
        lines.append(f"{total - sum(count for _, count in most):5}  on {others}")
    return Section("outliers", lines, {"outliers": dict(features.most_common())})


def stopped(calibration: Calibration) -> Section:
    """Section on how the solve ended."""
    if not calibration.rounds:
        return Section("stopped", [calibration.termination])
    how = "converged" if calibration.converged else "did not converge"
    last = plural(max(len(calibration.history) - 1, 0), "iteration")
    solves = plural(calibration.rounds, "solve")
    return Section("stopped", [f"{how} after {solves}, the last of {last}", calibration.termination])


def warnings(calibration: Calibration) -> Iterator[str]:
    """Yield what to know about the calibration, and what may be wrong with the observations."""
    large_scale = 4.0  # ratio of the noise to the stated sigmas above which a warning is given
    yield from (*calibration.warnings, *calibration.remarks)
    yield from (text for _, text in of_the_solve(calibration))
    scale = max(calibration.fit.scales)
    if calibration.rounds and scale > large_scale:
        yield (
            f"the residuals are {scale:.0f} times the stated sigmas: the lens may not suit the camera, or labels and "
            "target dimensions may be wrong"
        )


def lens_choice(camera: str, choice: LensChoice) -> Section:
    """Section on the chosen lens, the alternatives, and the differences; `camera` is given where there are several."""
    rows = []
    for one in choice.tried:
        cells = (DASH, DASH, DASH, one.failed)
        if one.rms_px is not None and one.worse is not None:
            share = DASH if one.probability is None else f"{100.0 * one.probability:.0f} %"
            cells = (fixed(one.rms_px, 4), fixed(one.worse, 1, "+"), share, "")
        rows.append((one.label, str(one.coefficients), *cells))
    head = ("lens", "coefficients", "held-out px", "worse, standard errors", "predicts best, probability", "")
    table = Table(head, tuple(rows), sentence(f"{camera}the lens that the data ask for: {choice.chosen}"), stacked=True)
    return Section("lens", wrapped(camera + choice.words), pieces=(table,))


# ---- cameras and stations -------------------------------------------------------------------------------------------


def _camera(quality: Quality, name: str) -> Section:
    camera = quality.calibration.cameras[name]
    (width, height), (cx, cy) = camera.image_size, camera.principal_point
    units = {"phi": "px", "cx": "px", "cy": "px"}
    plain = {"aspect": 1.0, "skew": 0.0}  # values for most cameras
    values = {"phi": camera.phi, "cx": cx, "cy": cy, "aspect": camera.aspect, "skew": camera.skew, **camera.lens.listed}
    known, alone = (
        {one: every.get(("camera", name, one)) for one in values} for every in (quality.verdicts, quality.undisputed)
    )
    rows = tuple(
        number_row(_named(camera, one), value, units.get(one, ""), known[one], alone[one])
        for one, value in values.items()
        if value != plain.get(one) or known[one] is not None
    )
    started = quality.calibration.phi_from.get(name, "")
    notes = [f"phi: {_PHI_FROM.get(started, started)}", *([camera.lens.note] if camera.lens.note else [])]
    about = f"{name}: {camera.lens.kind} lens, {width} × {height} px"
    return _listed("camera", about, rows, [*notes, *_disputed(quality)])


def _disputed(quality: Quality, of: str = "") -> Iterator[str]:
    if quality.uncertainty and quality.uncertainty.undisputed is not quality.uncertainty:
        yield f"± sd{of}: without the contradicted statements; the 95 % bounds include the solution with them"


def _listed(title: str, about: str, rows: Iterable[_Row], notes: Sequence[str] = ()) -> Section:
    """Section of numbers, how well each is known, and notes below them."""
    narrow = (0, 1, 2, 4, 5)  # without the column of the model alone, for which only the page has room
    table = Table(_HEAD, tuple(rows), f"{sentence(title)} {about}", stacked=True, printed=narrow)
    return Section(title, [about, *table.lines(), *notes], pieces=(table, *(Text(f"{note}.") for note in notes)))


def _named(camera: Camera, quantity: str) -> str:
    words = {"cx": "principal point x", "cy": "principal point y", "aspect": "aspect fy / fx"}
    unit = dict(zip(camera.lens.names, camera.lens.units, strict=True)).get(quantity, "1")
    if unit != "1":
        return f"{quantity}, {powered(unit)}"
    return words.get(quantity, quantity)


def number_row(name: str, value: float, unit: str, verdict: Verdict | None, undisputed: Verdict | None = None) -> _Row:
    """Row of a number; without a verdict it was held, or nothing was minimised. `undisputed`: the verdict without what
    is contradicted.
    """
    space = f" {unit}" if unit else ""
    if verdict is None:
        return name, f"{value:.10g}{space}", "", "", "", "not free"
    plain = verdict.key.kind == "camera" and not unit
    own_sd = (undisputed or verdict).sd
    shown = f"{at_precision(value, own_sd)}{space}"
    sds = (_width(sd, unit, plain) for sd in (own_sd, verdict.sd / verdict.factor))
    by = " (by its profile)" if verdict.by_profile and verdict.verdict != "known" else ""
    return name, shown, *sds, bounds(verdict, unit), verdict.verdict + by


def _width(sd: float, unit: str, plain: bool) -> str:
    """Format a standard deviation; `plain`: of a coefficient."""
    if unit == "m":
        return mm(1e3 * sd)
    if not np.isfinite(sd):
        return "unknown"
    return f"{sd:.2g}" if plain else short(sd) + (f" {unit}" if unit else "")


def bounds(verdict: Verdict, unit: str = "") -> str:
    """Format 95 % bounds with as many digits as the value."""
    if np.isfinite([verdict.low, verdict.high, verdict.sd]).all() and verdict.low != 0.0:
        low, high = (at_precision(bound, verdict.sd) for bound in (verdict.low, verdict.high))
        if ("e" in low) != ("e" in high):  # the same number of decimals, without powers
            places = 1 - int(np.floor(np.log10(verdict.sd)))
            low, high = (f"{bound:.{places}f}" for bound in (verdict.low, verdict.high))
        return f"{low} to {high}{f' {unit}' if unit else ''}"
    return bounds_text(verdict.low, verdict.high, unit, ".4g")


def _station(quality: Quality, name: str) -> Section:
    camera = quality.calibration.stations[name]
    owner = quality.calibration.estimate.stations[name].camera
    title = name if owner == name else f"{name}, camera {owner}"
    data = {"tilt_deg": {name: camera.tilt_deg}}
    if name in anchored_stations(quality.observations):
        table = Table(("", "value"), (("pose", _ANCHORED),), f"Station {title}", stacked=True)
        return Section("station", [title, _ANCHORED], data, (table,))
    keys = [("station", name, word) for word in ("x", "y", "height")]
    places = zip(("position x", "position y", "height"), camera.position.tolist(), keys, strict=True)
    every, alone = quality.verdicts, quality.undisputed
    rows = [number_row(word, value, "m", every.get(key), alone.get(key)) for word, value, key in places]
    angles = _angles(quality, name, camera)
    return replace(_listed("station", title, [*rows, *angles], [*_disputed(quality, " of the position")]), data=data)


def _angles(quality: Quality, name: str, camera: Camera) -> Iterator[_Row]:
    """Yield the paper's angles and the tilt, with standard deviations from those of turns about the camera's axes."""
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
    """(4, n) degrees, standard deviations of the angles, given the correlation of the three turns and each column of
    their sd (3, n) rad.
    """
    turn = 1e-6  # rad
    own = np.sqrt(np.diagonal(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / own[:, None] / own
    slopes = np.stack(
        [(_angles_deg(rotation_exp(turn * axis) @ rotation) - _angles_deg(rotation)) / turn for axis in np.eye(3)], 1
    )
    slopes = (slopes + 180.0 / turn) % (360.0 / turn) - 180.0 / turn  # a turn past 180 degrees is a small one
    # Unknown turns give NaN; an angle that does not depend on one counts as unknown, too.
    with np.errstate(invalid="ignore"):
        spread = np.stack([np.einsum("ai,ij,aj->a", slopes * s, correlation, slopes * s) for s in sd.T], 1)
    return np.where(np.isfinite(spread), np.sqrt(np.maximum(spread, 0.0)), np.inf)


def _angles_deg(rotation: Array) -> Array:
    """(4,) alpha, beta, gamma and the tilt, degrees."""
    tilt = np.arctan2(np.hypot(*rotation[2, :2]), -rotation[2, 2])
    return np.degrees([*euler_from_rotation(rotation), tilt])


# ---- targets --------------------------------------------------------------------------------------------------------


def _dimensions(quality: Quality) -> Section:
    lengths = quality.calibration.estimate.structure.dimensions.items()
    known = {name: quality.verdicts.get(("dimension", *name.partition("/")[::2])) for name, _ in lengths}
    return _listed(
        "lengths", "that were solved for", [number_row(name, one, "m", known[name]) for name, one in lengths]
    )


def _as_built(quality: Quality) -> Section:
    """Section on what is off its nominal position, the farthest first."""
    structure, as_built = quality.calibration.estimate.structure, quality.calibration.as_built
    order = np.argsort(-np.abs(structure.values[: structure.own]), kind="stable").tolist()
    rows = []
    for i in order[:_MOST_OFFSETS]:
        verdict = quality.verdicts.get(("structure", *structure.names[i].partition("/")[::2]))
        widths = (np.nan if verdict is None else verdict.sd, float(structure.sigma_m[i]))
        shown = f"{1e3 * structure.values[i]:+.2f} mm"
        rows.append((structure.names[i], shown, *(f"{short(1e3 * sd)} mm" for sd in widths)))
    table = Table(("", "off its drawing", "± sd", "tolerance"), tuple(rows), "Targets as built", stacked=True)
    words = [f"{sentence(one)}." for one in words_of(as_built)]
    lines = [*wrapped(*words), *replace(table, rows=table.rows[:_MOST_FEATURES]).lines()]
    if rest := len(order[_MOST_FEATURES:]):
        lines.append(f"and {plural(rest, 'smaller correction')}")
    pieces: list[Piece] = [*map(Text, words), table]
    if rest := len(order[_MOST_OFFSETS:]):
        pieces.append(Text(f"And {grouped(rest)} smaller ones.", "note"))
    return Section("as built", lines, pieces=tuple(pieces))
