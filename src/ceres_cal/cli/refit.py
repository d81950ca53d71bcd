"""`ceres-cal refit`: after a move, the poses anew from few observations and all that was known."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.album import album_of
from ceres_cal.cli.command import Answer, Command, add_output, add_report, finishing, parse_numbers, require_outputs
from ceres_cal.cli.moved import (
    add_inputs,
    not_painted,
    photographs_data,
    photographs_in,
    photographs_text,
    progress_bar,
    read_calibration,
    read_observations,
)

if TYPE_CHECKING:
    from ceres_cal.calibration import Calibration
    from ceres_cal.observations import Observations, Prior
    from ceres_cal.photographs import KnownDetections

_HELP = {
    "pose": "poses, the intrinsics under what is known of them (default)",
    "pose-only": "poses, the intrinsics held",
    "zoom": "phi, too: nothing is known of it any more",
    "iris": "the lens's coefficients, too",
    "everything": "all intrinsics, too",
}


def _add_arguments(parser: ArgumentParser) -> None:
    add_inputs(parser)
    add_output(parser, "the new calibration", required=False)
    add_report(parser)
    add = parser.add_argument
    what = "; ".join(f"{name}: {text}" for name, text in _HELP.items())
    add("--what", choices=tuple(_HELP), default="pose", help=f"what is free: {what}")
    add("--moved", metavar="STATION", action="append", help="only this one moved (repeatable); default: all observed")
    add("--hold-others", action="store_true", help="hold stations that did not move, and their cameras, exactly")
    add(
        "--labels",
        choices=("check", "as-given", "turned"),
        default="check",
        help="refuse labels that look turned by 180 degrees (default), believe them, or turn them",
    )
    add(
        "--prior",
        action="append",
        default=[],
        metavar="STATION.height_m=VALUE:SIGMA",
        help="a height measured after the move; repeatable",
    )


def _run(args: Namespace) -> Answer:
    images = photographs_in(args)
    # To replace the old calibration is what many want.
    require_outputs(args.output, args.report, images or args.inputs)
    calibration = read_calibration(args)
    found = _photographed(args, calibration, images) if images else None
    observations = read_observations(args) if found is None else found.require()
    from ceres_cal.base.files import write_bytes
    from ceres_cal.moves import refit

    album = album_of(args, observations, calibration, images)
    priors = tuple(_height(spec, observations) for spec in args.prior)
    result = refit(
        calibration,
        observations,
        args.what,
        moved=args.moved,
        hold_others=args.hold_others,
        labels=args.labels,
        priors=priors,
    )
    page = ""
    if args.report is not None:
        from ceres_cal.report import make_report

        page = make_report(result, observations, album=album)
    with finishing():
        if args.output is not None:
            result.save(args.output)
        if args.report is not None:
            write_bytes(args.report, page.encode())
    data = _data(result, calibration, observations, args) | photographs_data(found)
    return Answer(data, lambda: _text(result, observations, found, args))


def _photographed(args: Namespace, calibration: Calibration, images: list[Path]) -> KnownDetections:
    from ceres_cal.photographs import detect_known

    with progress_bar(args) as bar:
        return detect_known(calibration, images, args.station, not_painted=not_painted(args), progress=bar.update)


COMMANDS = (Command("refit", "after a move: poses anew, everything else under what was known", _add_arguments, _run),)


def _height(spec: str, observations: Observations) -> Prior:
    """The prior of `--prior [STATION.]height_m=VALUE:SIGMA`."""
    from ceres_cal.observations import prior_from_json

    where = f"--prior {spec!r}"
    left, equals, right = spec.rpartition("=")
    value, colon, sigma = right.partition(":")
    owner, _, quantity = left.strip().rpartition(".")
    stations = tuple(observations.stations)
    if not (equals and colon) or quantity != "height_m":
        raise InputError(f"{where}: write STATION.height_m=VALUE:SIGMA, such as overhead.height_m=4.02:0.01")
    if not owner and len(stations) == 1:
        owner = stations[0]
    if owner not in stations:
        raise InputError(f"{where}: name one station before the dot: {', '.join(stations)}")
    numbers = (*parse_numbers(value, where), *parse_numbers(sigma, f"{where}: sigma"))
    if len(numbers) != 2 or numbers[1] <= 0.0:
        raise InputError(f"{where}: give one height and one sigma above 0")
    return prior_from_json({"station": owner, "height_m": numbers[0], "sigma_m": numbers[1]}, where)


def _data(result: Calibration, before: Calibration, observations: Observations, args: Namespace) -> dict[str, Any]:
    from ceres_cal.cli.summary import calibration_data
    from ceres_cal.moves import movements

    found = calibration_data(result, observations, args.inputs, args.output, args.report)
    moves = {
        name: {"mm": 1e3 * shift_m, "deg": turn_deg} for name, (shift_m, turn_deg) in movements(before, result).items()
    }
    refitted = result.refitted
    assert refitted is not None
    return {**found, "what": refitted.what, "explanation": refitted.explanation, "moved": moves}


def _text(result: Calibration, observations: Observations, found: KnownDetections | None, args: Namespace) -> str:
    from ceres_cal.cli.summary import calibration_text

    refitted = result.refitted
    assert refitted is not None
    told = "\n".join(f"{'' if i else 'refit':10}{line}" for i, line in enumerate(refitted.explanation.split("; ")))
    summary = calibration_text(result, observations, args.inputs, args.output, args.report)
    return "\n".join([told, *photographs_text(found), summary])
