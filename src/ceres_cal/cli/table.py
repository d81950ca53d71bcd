"""`ceres-cal export-table`: a look-up table from pixels to the field, for tracking at many frames a second."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import add_calibration, add_output, add_station, parse_number
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.inputs import read_calibration, station_of
from ceres_cal.cli.outputs import finishing, require_output


def _add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add_calibration(parser)
    add_output(parser, "the table (.npz)", required=True)
    add_station(parser)
    add("--error-mm", default="0.1", metavar="MM", help="largest interpolation error on the field; default: 0.1")
    add("--step-px", type=int, metavar="PX", help="distance of the nodes; default: the widest that keeps to the error")


def _run(args: Namespace) -> Answer:
    require_output(args.output, [args.calibration])
    error_mm = parse_number(args.error_mm, "--error-mm")
    if error_mm <= 0.0:
        raise InputError(f"--error-mm must be above 0, not {error_mm:g}")
    from ceres_cal.scene.lookup import make_table
    from ceres_cal.uncertainty.uncertainty import field_grid

    calibration = read_calibration(args)
    name = station_of(args, calibration)
    table = make_table(calibration.stations[name], name, *field_grid(calibration.targets), error_mm, args.step_px)
    with finishing():
        table.save(args.output)
    errors = [{"height_m": h, "rms_mm": rms, "worst_mm": worst} for h, (rms, worst) in table.error_mm.items()]
    size = (len(table.x_px), len(table.y_px))
    data = {"station": name, "output": str(args.output), "step_px": table.step_px, "nodes": size, "errors": errors}
    lines = [f"{'table':10}{size[0]} x {size[1]} nodes every {table.step_px} px, written to {args.output}"]
    for height_m, (rms, worst) in table.error_mm.items():
        lines.append(f"{'error':10}{rms:.4f} mm rms, {worst:.4f} mm at most, {1e3 * height_m:.0f} mm above the floor")
    return Answer(data, lambda: "\n".join(lines))


COMMANDS = (Command("export-table", "a look-up table from pixels to the field (NPZ)", _add_arguments, _run),)
