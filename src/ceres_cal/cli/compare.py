"""`ceres-cal compare`: where on the field two calibrations differ, in mm."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import add_height, add_station, height_m
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.outputs import finishing, require_output, section

if TYPE_CHECKING:
    from ceres_cal.moves import StationComparison

_COLUMNS, _ROWS = 9, 7


def _add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("a", metavar="A", type=Path, help="one calibration")
    add("b", metavar="B", type=Path, help="the other")
    add_height(parser, "of the map above the floor; default: 0")
    add_station(parser, "only this one; default: all that both have")
    add("--picture", metavar="SVG", type=Path, help="draw the map there (of one station)")


def _run(args: Namespace) -> Answer:
    require_output(args.picture, [args.a, args.b])
    height = height_m(args)
    from ceres_cal.base.files import write_bytes
    from ceres_cal.calibration import Calibration
    from ceres_cal.moves import compare

    first = Calibration.load(args.a)
    comparisons = compare(first, Calibration.load(args.b), height, args.station)
    if args.picture is not None:
        if len(comparisons) > 1:
            names = " or ".join(one.station for one in comparisons)
            raise InputError(f"--picture shows one station: name it with --station {names}")
        from ceres_cal.report.maps import comparison_svg

        svg = comparison_svg(comparisons[0], first)
        with finishing():
            write_bytes(args.picture, svg.encode())
    data = {"stations": {one.station: _data(one) for one in comparisons}}
    return Answer(data, lambda: "\n".join(map(_text, comparisons)))


COMMANDS = (
    Command(
        "compare",
        "where on the field two calibrations differ, in mm",
        _add_arguments,
        _run,
        ("old.json new.json --height-mm 150", "old.json new.json --picture moved.svg"),
    ),
)


def _data(one: StationComparison) -> dict[str, Any]:
    """Everything; the map's places that are not shown are null."""
    return {
        "moved_mm": one.moved_mm,
        "turned_deg": one.turned_deg,
        "phi_px": one.phi_px,
        "height_m": one.height_m,
        "mean_mm": one.mean_mm,
        "worst_mm": one.worst_mm,
        "explained_by_uncertainty": one.explained,
        "probability": one.probability,
        "x_m": one.x_m,
        "y_m": one.y_m,
        "difference_mm": one.difference_mm,
        "expected_mm": one.expected_mm,
    }


def _text(one: StationComparison) -> str:
    answer = {
        True: f"explained by their uncertainties (probability {one.probability or 0.0:.2g})",
        False: f"more than their uncertainties explain (probability {one.probability or 0.0:.1g})",
        None: "nothing can be said of uncertainty: it is not told of both",
    }[one.explained]
    phi = f"phi {one.phi_px[0]:.3f} -> {one.phi_px[1]:.3f} px"
    size = f"{one.mean_mm:.2f} mm on average, {one.worst_mm:.2f} mm at most"
    lines = [
        section("station", [one.station]),
        section("camera", [f"moved {one.moved_mm:.2f} mm, turned {one.turned_deg:.4f} deg, {phi}"]),
        section("map", [f"{size}, {1e3 * one.height_m:.0f} mm above the floor", answer]),
    ]
    return "\n".join([*lines, *_table(one)])


def _table(one: StationComparison) -> list[str]:
    import numpy as np

    from ceres_cal.report.maps import evenly

    columns, rows = evenly(len(one.x_m), _COLUMNS), evenly(len(one.y_m), _ROWS)[::-1]
    lines = [f"{'mm':>10}" + "".join(f"{one.x_m[c]:8.2f}" for c in columns) + "  x, m"]
    for row in rows:
        values = one.errors_mm[row, columns]
        cells = "".join(f"{value:8.2f}" if np.isfinite(value) else f"{'.':>8}" for value in values)
        lines.append(f"{one.y_m[row]:10.2f}{cells}")
    return lines
