"""Whether a camera is still as calibrated: `ceres-cal check`, `score`, `audit` and `compare` compare it with new
observations or another calibration; the exit code is 0 for yes and 1 for no, for use in cron. After a move `refit`
estimates new poses from few observations and all prior knowledge.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ceres_cal import base, detect, formats, moves, report, scene
from ceres_cal.base import HEIGHTS_M, InputError, at_height, fixed, plural, replace, short
from ceres_cal.cli import arguments, files
from ceres_cal.cli.command import REQUIRED, argument, command, option, switch, whole
from ceres_cal.cli.foreign import from_option, import_options, typed_options
from ceres_cal.cli.photographs import InputArguments, photographs_in, shown
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Document, Section, wrapped

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations, Prior


@command(
    "check",
    "does a calibration still hold? exit code 0 yes, 1 no",
    "calibration.json now.png",
    "calibration.json incoming/ --checks 720 --json",
)
def _check(
    args: InputArguments,
    false_alarms: float = arguments.false_alarms_option("probability of reporting a move if no camera moved"),
    checks: int = option(
        "this probability is for N checks of this calibration together: 720 for an hourly check over a month",
        "N",
        1,
        read=whole(1),
    ),
) -> Document:
    images, detections = photographs_in(args), None
    calibration, names = files.read_calibration(args.calibration), arguments.parse_names(args.not_painted)
    if not images:
        answer = moves.check(calibration, files.read_observations(args.inputs), false_alarms, checks)
    else:
        with ProgressBar(args.silent) as bar:
            answer, detections = detect.check_photographs(
                calibration, images, args.station, false_alarms, checks=checks, not_painted=names, progress=bar.update
            )
    often = "" if answer.checks == 1 else f", any in {answer.checks} checks"
    rate = f"({100.0 * false_alarms:g} % false alarms{often})"
    holds = f"{'yes' if answer.holds else 'no'} {rate}"
    headline = f"The calibration {'holds' if answer.holds else 'no longer holds'} {rate}."
    stated = {name: getattr(answer, name) for name in ("holds", "false_alarms", "checks")}
    stations = map(_checked_station, answer.values())
    return Document((Section("check", [holds], stated), shown(detections), *stations), answer.exit_code, headline)


def _checked_station(one: moves.Agreement) -> Section:
    lines, change, misfit = [f"{one.name} {one.words}"], one.change, one.misfit
    used, noise = misfit.points + misfit.curves, misfit.noise[0]
    data = {name: getattr(one, name) for name in ("holds", "cause", "probability", "statistic", "degrees", "words")}
    data |= {"station": one.name, "used": used, "outliers": misfit.outliers, "noise": noise}
    sizes: dict[str, float | None] = dict.fromkeys(("moved_mm", "turned_deg", "phi_change", "shift_px"))
    maps = [(height_m, math.nan, math.nan) for height_m in HEIGHTS_M]
    if change is not None:
        phi_change = change.phi_px[1] / change.phi_px[0] - 1.0
        sizes |= {"moved_mm": change.moved_mm, "turned_deg": change.turned_deg}
        sizes |= {"phi_change": phi_change, "shift_px": change.shift_px}
        picture = f"picture {short(change.shift_px, 3)} px rms, " if math.isfinite(change.shift_px) else ""
        size = f"{picture}phi {100.0 * phi_change:+.3f} %"
        maps = [(over.height_m, over.mean_mm, over.worst_mm) for over in change.maps]
        lines += [
            f"{plural(used, 'observation')}, {plural(misfit.outliers, 'outlier')}, noise {noise:.2f} times as before",
            f"{moves.moved_words(1e-3 * change.moved_mm, change.turned_deg)}, {size}",
            *(
                f"map {at_height(h)}: {short(mean, 3)} mm on average, {short(worst, 3)} mm at most"
                for h, mean, worst in maps
                if mean == mean
            ),
        ]
    shifts = [{"height_m": h, "mean_mm": mean, "worst_mm": worst} for h, mean, worst in maps]
    return Section("station", lines, {"stations": {one.name: {**data, **sizes, "shift_mm": shifts}}})


# ---- how well new boards or fields are predicted, poses alone at their best ------------------------------------------


@command(
    "score",
    "how well a calibration predicts new boards or fields: intrinsics held",
    "calibration.json new.json",
    "rig.json boards.json --hold-stations --loss trivial --reject-sigma inf",
)
def _score(
    calibration: Path = arguments.calibration_argument(),
    observations: tuple[str, ...] = argument("OBS", "files of new observations (.json or .npz), taken together"),
    hold_stations: bool = switch(
        "hold the calibrated poses of stations and solve for those of boards only: tests the poses of a rig, too"
    ),
    loss: arguments.Loss | None = option("default: the calibration's"),
    reject_sigma: float | None = option(
        "observations with larger residuals are rejected; default: the calibration's. inf keeps all, and with --loss "
        "trivial the rms compares with that of other programs",
        "SIGMA",
        read=float,
    ),
) -> Document:
    files.require_different(observations)

    before = files.read_calibration(calibration)
    asked = {name: value for name, value in (("loss", loss), ("reject_sigma", reject_sigma)) if value is not None}
    options = replace(before.options, **asked)
    return _scored(
        moves.score(before, files.read_observations(observations), options=options, hold_stations=hold_stations), before
    )


def _scored(answer: moves.Agreements, before: Calibration) -> Document:
    most_views = 3  # number of views that are shown
    cameras = list(answer.values())
    views = sorted((view for one in cameras for view in one.views), key=lambda view: -view.misfit.all_rms_px)
    posed = cameras[0].solution
    assert posed is not None
    ratios = dict(zip(("points", "curves"), cameras[0].misfit.noise, strict=True))
    known = [f"noise of {kind} {ratio:.2f} times the calibration's" for kind, ratio in ratios.items() if ratio == ratio]
    numbers = {
        "holds": answer.holds,
        "fit": posed.fit,
        "rms_px": posed.fit.rms_px,
        "calibration_rms_px": before.fit.rms_px,
        "noise_ratios": ratios,
    }
    parts = {"cameras": list(map(_misfit_data, cameras)), "views": list(map(_misfit_data, views))}
    first = Section("score", [*(f"{one.name} {one.words}" for one in cameras), *known], numbers)
    worst = Section("worst", list(map(_left, views[:most_views])), parts)
    return Document((first, *(Section("camera", [_left(one)]) for one in cameras), worst))


def _misfit_data(one: moves.Agreement) -> dict[str, Any]:
    said = {name: value for name, value in vars(one.misfit).items() if name != "noise"}
    return {"name": one.name, **said, **({"holds": one.holds, "words": one.words} if one.words else {})}


def _left(one: moves.Agreement) -> str:
    left = one.misfit
    kinds = [
        f"rms {rms:.4f} px over {count} {kind}"
        for kind, count, rms in (
            ("points", left.points, left.points_rms_px),
            ("curve observations", left.curves, left.curves_rms_px),
        )
        if count
    ]
    out = f"; {left.outliers} taken out, {left.all_rms_px:.4f} px with them" if left.outliers else ""
    return f"{one.name}: {', '.join(kinds or ['nothing took part'])}{out}"


# ---- may the calibration of another program be trusted ---------------------------------------------------------------


@command(
    "audit",
    "may another program's calibration be trusted? exit code 0 yes, 1 no",
    "opencv.yml --observations field.json",
    "geometry.yml --observations field.json --observations more.json",
)
def _audit(
    file: Path = argument("FILE", "a calibration of ours or of another program"),
    form: str | None = from_option(),
    observations: tuple[str, ...] = option("of its stations", "FILE", REQUIRED, repeatable=True),
    options: Mapping[str, str] = import_options(),
) -> Document:
    from ceres_cal.calibration import Calibration

    ours = form is None and file.suffix == ".json" and b"ceres-cal/calibration" in base.read_bytes(file)[:4096]
    given = Calibration.load(file) if ours else formats.import_calibration(file, form, **typed_options(options, form))
    stations = moves.audit(given, files.read_observations(observations))
    stated = {"trusted": stations.holds, "warnings": list(given.warnings)}
    first = Section("audit", ["yes" if stations.holds else "no"], stated)
    warnings = (Section("warning", wrapped(text)) for text in given.warnings)
    return Document((first, *map(_audited_station, stations.values()), *warnings), stations.exit_code)


def _audited_station(one: moves.Agreement) -> Section:
    assert one.solution is not None and one.change is not None
    camera, maps = one.solution.station(), one.change.maps
    off_px, noise_px = moves.excess_px(one)
    known_mm = {} if one.solution.posterior is None else {over.height_m: over.known_mm for over in maps}
    known = (
        f"{f'± {short(sd)} mm' if math.isfinite(sd) else 'unknown'} at {1e3 * h:.0f} mm" for h, sd in known_mm.items()
    )
    ours = ", ".join((f"ours: {camera!r}", *known))
    off = f"its picture is off by {off_px:.3f} px rms beyond the noise of {noise_px:.3f} px"
    data: dict[str, Any] = {"trusted": one.holds, "cause": one.cause, "words": one.words}
    data |= {"off_px": off_px, "noise_px": noise_px, "posed": not one.pose_free}
    data["off_mm"] = [{"height_m": over.height_m, "rms_mm": over.rms_mm, "worst_mm": over.most_mm} for over in maps]
    data["known_mm"] = [{"height_m": h, "sd_mm": sd} for h, sd in known_mm.items()]
    data["ours"] = {"phi_px": camera.phi, "lens": camera.lens.kind, "rms_px": one.solution.rms_px}
    return Section("station", wrapped(f"{one.name} {one.words}", off, ours), {"stations": {one.name: data}})


# ---- where two calibrations differ, on the field in mm or over the image in px ---------------------------------------


@command(
    "compare",
    "where two calibrations differ, on the field in mm or over the image in px",
    "old.json new.json --height-mm 150",
    "old.json new.json --over-image --without-turn",
)
def _compare(
    a: Path = argument("A", "one calibration"),
    b: Path = argument("B", "the other"),
    height_mm: float | None = arguments.height_option("of the map above the floor; default: 0"),
    station: str | None = arguments.station_option(
        "only this one; default: all that both have, or the only one of each"
    ),
    picture: Path | None = option("draw the map there (of one station)", "SVG"),
    over_image: bool = switch("intrinsics, over the image in px; default where there is no field"),
    without_turn: bool = switch(
        "likewise, after the rotation that aligns both best: another principal point looks much like a rotation"
    ),
) -> Document:
    files.require_output(picture, [a, b], "pictures are", ".svg")
    first, second = files.read_calibration(a), files.read_calibration(b)
    if scene.still(first.targets) and not (over_image or without_turn):
        compared, shown_as = moves.compare(first, second, arguments.metres(height_mm), station), _compared_station
    elif picture is not None or station is not None:
        raise InputError("--picture and --station are for maps of a field: leave them out where images are compared")
    else:
        compared, shown_as = moves.compare_cameras(first, second, without_turn=without_turn), _compared_camera
    if picture is not None:
        if len(compared) > 1:
            raise InputError(f"--picture shows one station: name it with --station {' or '.join(compared)}")
        files.save(picture, report.comparison_svg(next(iter(compared.values())), first).encode())
    return Document(tuple(section for one in compared.values() for section in shown_as(one)))


def _compared_station(one: moves.Agreement) -> Iterator[Section]:
    assert one.change is not None
    change, (over,) = one.change, one.change.maps
    before, after = change.phi_px
    size = f"{over.mean_mm:.2f} mm on average, {over.worst_mm:.2f} mm at most"
    data = {name: getattr(over, name) for name in ("height_m", "x_m", "y_m", "difference_mm", "expected_mm")}
    data |= {name: getattr(change, name) for name in ("moved_mm", "turned_deg", "phi_px")}
    data |= {"mean_mm": over.mean_mm, "worst_mm": over.worst_mm, **_tested(one)}
    moved = f"moved {change.moved_mm:.2f} mm, turned {change.turned_deg:.4f} deg"
    yield Section("station", [one.name], {"stations": {one.name: data}})
    yield Section("camera", [f"{moved}, phi {before:.3f} -> {after:.3f} px"])
    yield Section("map", [f"{size}, {1e3 * over.height_m:.0f} mm above the floor", _explained(one)])
    yield _table("mm at y \\ x", over.errors_mm[::-1], over.x_m, over.y_m[::-1], "{:.2f} m")


def _compared_camera(one: moves.Agreement) -> Iterator[Section]:
    import numpy as np

    assert one.image is not None
    over = one.image
    pixels, angles = over.errors_px[np.isfinite(over.errors_px)], over.angles_deg[np.isfinite(over.angles_deg)]
    turned = f", {over.turn_deg:.4f} deg of turn taken out" if over.turn_deg else ""
    title = f"{one.name}, phi {over.phi_px[0]:.3f} -> {over.phi_px[1]:.3f} px{turned}"
    yield Section("camera", [title], {"cameras": {one.name: {**vars(over), **_tested(one)}}})
    lines = [
        f"{np.mean(pixels):.3f} px on average, {np.max(pixels):.3f} px at most",
        f"{np.mean(angles):.4f} deg on average, {np.max(angles):.4f} deg at most, between directions",
        _explained(one),
    ]
    yield Section("image", lines)
    yield _table("px at y \\ x", over.errors_px, over.x_px, over.y_px, "{:.0f} px")


def _table(head: str, values: base.Array, x: base.Array, y: base.Array, place: str) -> Section:
    table_size = 9, 7

    table = report.grid_table(head, values, x, y, place, table_size, partial(fixed, places=2))
    return Section("", table.lines(), pieces=(table,))


def _tested(one: moves.Agreement) -> dict[str, Any]:
    return {"probability": one.probability, "explained_by_uncertainty": one.holds}


def _explained(one: moves.Agreement) -> str:
    return {
        True: f"explained by their uncertainties (probability {one.probability:.2g})",
        False: f"more than their uncertainties explain (probability {one.probability:.1g})",
        None: "not tested: their lenses have different coefficients, or one calibration has no uncertainty",
    }[one.holds]


# ---- after a move: poses anew ---------------------------------------------------------------------------------------


class RefitArguments(InputArguments, arguments.ReportArguments):
    """Arguments of `refit`: the observations after a move, and what may have changed."""

    output: Path | None = arguments.output_option("the new calibration", None)
    what: Literal["auto", "pose", "pose-only", "zoom", "iris", "everything"] = option(
        "what has changed and is solved for. pose: the poses; the intrinsics stay within what is known of them, and "
        "where anything else has changed it is refused. pose-only: the poses; the intrinsics are held. zoom: also phi, "
        "the focal length. iris: also the coefficients of the lens. everything: all intrinsics. auto (default): as "
        "pose, or as zoom or iris where the observations say so",
        default="auto",
    )
    moved: tuple[str, ...] = option(
        "only this station moved (repeatable); default: all that were observed", "STATION", repeatable=True
    )
    hold_others: bool = switch("hold stations that did not move, and their cameras, exactly")
    labels: Literal["check", "as-given", "turned"] = option(
        "refuse labels that look turned by 180 degrees (default), believe them, or turn them", default="check"
    )
    prior: tuple[str, ...] = arguments.prior_option("STATION.height_m=VALUE:SIGMA", "a height measured after the move")


@command(
    "refit",
    "after a move: poses anew, everything else under what was known",
    "calibration.json now.png -o calibration.json",
    "calibration.json new.json --what zoom -o calibration.json --report report.html",
)
def _refit(args: RefitArguments) -> Document:
    images = photographs_in(args)
    # The output may replace the old calibration, as many users want.
    files.require_outputs(args, images or args.inputs)
    files.require_frames_apart(images if args.report else ())
    calibration = files.read_calibration(args.calibration)
    observed = None if images else files.read_observations(args.inputs)
    priors = _priors(args, calibration if observed is None else observed)
    detections = _detected(args, calibration, images) if observed is None else None
    observations = detections.require() if detections is not None else observed
    assert observations is not None

    photographs = files.report_photographs(args, observations, calibration, images)
    options = moves.RefitOptions(args.hold_others, args.labels, priors)
    result = moves.refit(calibration, observations, args.what, moved=args.moved or None, options=options)
    about = result.refitted
    assert about is not None
    every = moves.movements(calibration, result, about.what).items()
    moved = {name: {"mm": 1e3 * shift_m, "deg": deg} for name, (shift_m, deg) in every}
    explained = {"what": about.what, "explanation": about.explanation, "moved": moved}
    first = Section("refit", about.explanation.split("; "), explained)
    before = first, shown(detections)
    return files.calibrated(
        args, result, observations, photographs, args.inputs, *before, is_observed_now=detections is not None
    )


def _priors(args: RefitArguments, known: Calibration | Observations) -> tuple[Prior, ...]:
    owners = {"station": known.stations, "camera": known.cameras}
    return tuple(arguments.parse_prior(spec, owners, {"station": ("height_m",)}) for spec in args.prior)


def _detected(args: RefitArguments, calibration: Calibration, images: list[Path]) -> detect.KnownDetections:
    moves.require_posterior(calibration)
    station = files.station_of(args.calibration, args.station, calibration)
    if strange := set(args.moved) - {station}:
        raise InputError(
            f"--moved {sorted(strange)[0]}: the photographs are of station {station!r}: name that, or none"
        )
    not_painted = arguments.parse_names(args.not_painted)
    with ProgressBar(args.silent) as bar:
        return detect.detect_known(calibration, images, args.station, not_painted=not_painted, progress=bar.update)
