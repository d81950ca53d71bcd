"""`ceres-cal refit`: after a move, the poses anew from few observations and all that was known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from ceres_cal.cli.arguments import PriorNames, Reporting, output_option, parse_names, parse_prior, prior_option
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.inputs import read_calibration, read_observations
from ceres_cal.cli.options import option, switch
from ceres_cal.cli.outputs import report_page, report_photographs, require_outputs, section, write_results
from ceres_cal.cli.photographs import Seen, photographs_data, photographs_in, photographs_text
from ceres_cal.cli.progress import progress_bar

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.photographs import KnownDetections
    from ceres_cal.report.quality import Quality


@dataclass(frozen=True, kw_only=True)
class RefitArguments(Seen, Reporting):
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


def _run(args: RefitArguments) -> Answer:
    images = photographs_in(args)
    # To replace the old calibration is what many want.
    require_outputs(args, images or args.inputs)
    calibration = read_calibration(args.calibration)
    detections = _photographed(args, calibration, images) if images else None
    observations = read_observations(args.inputs) if detections is None else detections.require()
    from ceres_cal.moves import RefitOptions, refit
    from ceres_cal.report.quality import quality_of

    photographs = report_photographs(args, observations, calibration, images)
    priors = tuple(parse_prior(spec, observations, PriorNames(("height_m",))) for spec in args.prior)
    result = refit(
        calibration,
        observations,
        args.what,
        moved=args.moved or None,
        options=RefitOptions(args.hold_others, args.labels, priors),
    )
    write_results(args, result.save, report_page(args, result, observations, photographs))
    quality = quality_of(result, observations)
    data = _data(quality, calibration, args) | photographs_data(detections)
    return Answer(data, lambda: _text(quality, detections, args))


def _photographed(args: RefitArguments, calibration: Calibration, images: list[Path]) -> KnownDetections:
    from ceres_cal.photographs import detect_known

    not_painted = parse_names(args.not_painted)
    with progress_bar(args) as bar:
        return detect_known(calibration, images, args.station, not_painted=not_painted, progress=bar.update)


COMMANDS = (
    Command(
        "refit",
        "after a move: poses anew, everything else under what was known",
        RefitArguments,
        _run,
        (
            "calibration.json now.png -o calibration.json",
            "calibration.json new.json --what zoom -o calibration.json --report report.html",
        ),
    ),
)


def _data(quality: Quality, before: Calibration, args: RefitArguments) -> dict[str, Any]:
    from ceres_cal.cli.summary import calibration_data
    from ceres_cal.moves import movements

    result = quality.calibration
    moves = {name: {"mm": 1e3 * shift_m, "deg": deg} for name, (shift_m, deg) in movements(before, result).items()}
    refitted = result.refitted
    assert refitted is not None
    summary = calibration_data(quality, args.inputs, args)
    return {**summary, "what": refitted.what, "explanation": refitted.explanation, "moved": moves}


def _text(quality: Quality, detections: KnownDetections | None, args: RefitArguments) -> str:
    from ceres_cal.cli.summary import calibration_text

    refitted = quality.calibration.refitted
    assert refitted is not None
    explanation = section("refit", refitted.explanation.split("; "))
    summary = calibration_text(quality, args.inputs, args)
    return "\n".join([explanation, *photographs_text(detections), summary])
