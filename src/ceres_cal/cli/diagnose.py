"""`ceres-cal diagnose`: what the residuals of a calibration say of it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from ceres_cal.base.errors import InputError
from ceres_cal.cli.album import album_of
from ceres_cal.cli.command import Answer, Command, add_output, add_report, finishing, parse_number, require_outputs


def _add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("calibration", metavar="CALIBRATION", type=Path, help="file that `ceres-cal calibrate` wrote")
    add("observations", nargs="+", metavar="OBS", help="the observations it was made from, in the same order")
    add_output(parser, "the residual of every observation (.csv, .json or .npz)", required=False)
    add_report(parser)
    add("--new-data", action="store_true", help="the observations are others than those it was made from")
    add(
        "--held-out",
        action="store_true",
        help="also calibrate with other powers or coefficients, on some frames to predict the others, and say which "
        "lens predicts best",
    )
    add("--folds", type=int, default=5, metavar="K", help="parts into which frames go for --held-out; default: 5")
    add(
        "--false-alarms",
        default="0.01",
        metavar="P",
        help="probability of any finding where nothing is wrong; default: 0.01",
    )


def _run(args: Namespace) -> Answer:
    require_outputs(args.output, args.report, [args.calibration, *args.observations])
    if args.output is not None and args.output.suffix not in (".csv", ".json", ".npz"):
        raise InputError(f"{args.output}: the table is written as .csv, .json or .npz: give one of these endings")
    rate = parse_number(args.false_alarms, "--false-alarms")
    if not 0.0 < rate < 1.0:
        raise InputError(f"--false-alarms must lie between 0 and 1, not {args.false_alarms}")
    if args.folds < 2:
        raise InputError(f"--folds must be at least 2, not {args.folds}")
    if args.held_out and args.new_data:
        raise InputError("--held-out calibrates the observations anew: leave out --new-data")
    from ceres_cal.base.files import write_bytes
    from ceres_cal.calibration import Calibration
    from ceres_cal.cli.diagnosis import diagnosis_data, diagnosis_text
    from ceres_cal.diagnostics import choose, diagnose
    from ceres_cal.observations import Observations, combine

    calibration = Calibration.load(args.calibration)
    observations = combine([Observations.load(path) for path in args.observations])
    album = album_of(args, observations)
    diagnosis = diagnose(calibration, observations, new_data=args.new_data, false_alarm_rate=rate)
    choice = choose(observations, calibration.options, args.folds) if args.held_out else None
    page = ""
    if args.report is not None:
        from ceres_cal.report import make_report

        page = make_report(calibration, observations, diagnosis, choice, album)
    with finishing():
        if args.output is not None:
            diagnosis.table.save(args.output)
        if args.report is not None:
            write_bytes(args.report, page.encode())
    return Answer(
        diagnosis_data(diagnosis, choice, args.output, args.report),
        lambda: diagnosis_text(diagnosis, choice, args.output, args.report),
        1 if diagnosis.findings else 0,
    )


COMMANDS = (Command("diagnose", "what the residuals say: faults by name, noise, outliers", _add_arguments, _run),)
