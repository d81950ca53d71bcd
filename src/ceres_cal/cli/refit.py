"""`ceres-cal refit`: after a move, the poses anew from few observations and all that was known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ceres_cal import detect, moves
from ceres_cal.base.errors import InputError
from ceres_cal.cli import files
from ceres_cal.cli.arguments import ReportArguments, output_option, parse_names, parse_prior, prior_option
from ceres_cal.cli.command import command, option, switch
from ceres_cal.cli.photographs import InputArguments, photographs_in, shown
from ceres_cal.cli.terminal import progress_bar
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations, Prior


class RefitArguments(InputArguments, ReportArguments):
    """What was seen after a move, and what may have changed."""

    output: Path | None = output_option("the new calibration", None)
    what: Literal["pose", "pose-only", "zoom", "iris", "everything"] = option(
        "what is free: pose: poses, the intrinsics under what is known of them (default); pose-only: poses, the "
        "intrinsics held; zoom: phi, too: nothing is known of it any more; iris: the lens's coefficients, too; "
        "everything: all intrinsics, too",
        default="pose",
    )
    moved: tuple[str, ...] = option(
        "only this one moved (repeatable); default: all observed", "STATION", repeatable=True
    )
    hold_others: bool = switch("hold stations that did not move, and their cameras, exactly")
    labels: Literal["check", "as-given", "turned"] = option(
        "refuse labels that look turned by 180 degrees (default), believe them, or turn them", default="check"
    )
    prior: tuple[str, ...] = prior_option("STATION.height_m=VALUE:SIGMA", "a height measured after the move")


@command(
    "refit",
    "after a move: poses anew, everything else under what was known",
    "calibration.json now.png -o calibration.json",
    "calibration.json new.json --what zoom -o calibration.json --report report.html",
)
def _run(args: RefitArguments) -> Document:
    images = photographs_in(args)
    # To replace the old calibration is what many want.
    files.require_outputs(args, images or args.inputs)
    calibration = files.read_calibration(args.calibration)
    observed = None if images else files.read_observations(args.inputs)
    priors = _priors(args, calibration if observed is None else observed)
    detections = _photographed(args, calibration, images) if observed is None else None
    observations = detections.require() if detections is not None else observed
    assert observations is not None

    photographs = files.report_photographs(args, observations, calibration, images)
    result = moves.refit(
        calibration,
        observations,
        args.what,
        moved=args.moved or None,
        options=moves.RefitOptions(args.hold_others, args.labels, priors),
    )
    about = result.refitted
    assert about is not None
    every = moves.movements(calibration, result, about.what).items()
    moved = {name: {"mm": 1e3 * shift_m, "deg": deg} for name, (shift_m, deg) in every}
    explained = {"what": about.what, "explanation": about.explanation, "moved": moved}
    first = Section("refit", about.explanation.split("; "), explained)
    return files.calibrated(args, result, observations, photographs, args.inputs, first, shown(detections))


def _priors(args: RefitArguments, known: Calibration | Observations) -> tuple[Prior, ...]:
    owners = {"station": known.stations, "camera": known.cameras}
    return tuple(parse_prior(spec, owners, {"station": ("height_m",)}) for spec in args.prior)


def _photographed(args: RefitArguments, calibration: Calibration, images: list[Path]) -> detect.KnownDetections:
    moves.require_posterior(calibration)
    station = files.station_of(args.calibration, args.station, calibration)
    if strange := set(args.moved) - {station}:
        raise InputError(
            f"--moved {sorted(strange)[0]}: the photographs are of station {station!r}: name that, or none"
        )
    not_painted = parse_names(args.not_painted)
    with progress_bar(args.silent) as bar:
        return detect.detect_known(calibration, images, args.station, not_painted=not_painted, progress=bar.update)
