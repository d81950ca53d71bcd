"""`ceres-cal compare`: where two calibrations differ, on the field in mm or over the image in px."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.arguments import height_option, metres, station_option
from ceres_cal.cli.command import Answer, Command
from ceres_cal.cli.options import Arguments, argument, option, switch
from ceres_cal.cli.outputs import finishing, require_output, section

if TYPE_CHECKING:
    from ceres_cal.base.arrays import Array
    from ceres_cal.calibration import Calibration
    from ceres_cal.moves import CameraComparison, StationComparison

_COLUMNS, _ROWS = 9, 7


@dataclass(frozen=True, kw_only=True)
class CompareArguments(Arguments):
    """Two calibrations, and where to compare them."""

    a: Path = argument("A", "one calibration")
    b: Path = argument("B", "the other")
    height_mm: float | None = height_option("of the map above the floor; default: 0")
    station: str | None = station_option("only this one; default: all that both have")
    picture: Path | None = option("draw the map there (of one station)", "SVG")
    over_image: bool = switch("intrinsics, over the image in px; default where there is no field")
    without_turn: bool = switch("the same without the turn that brings them nearest to each other")


def _run(args: CompareArguments) -> Answer:
    require_output(args.picture, [args.a, args.b])
    from ceres_cal.calibration import Calibration

    first, second = Calibration.load(args.a), Calibration.load(args.b)
    if args.over_image or args.without_turn or all(target.movable for target in first.targets.values()):
        return _over_image(args, first, second)
    return _over_field(args, first, second)


def _over_image(args: CompareArguments, first: Calibration, second: Calibration) -> Answer:
    if args.picture is not None or args.station is not None:
        raise InputError("--picture and --station are for maps of a field: leave them out where images are compared")
    from ceres_cal.moves import compare_cameras

    comparisons = compare_cameras(first, second, without_turn=args.without_turn)
    data = {"cameras": {one.camera: _camera_data(one) for one in comparisons}}
    return Answer(data, lambda: "\n".join(map(_camera_text, comparisons)))


def _over_field(args: CompareArguments, first: Calibration, second: Calibration) -> Answer:
    from ceres_cal.base.files import write_bytes
    from ceres_cal.moves import compare

    comparisons = compare(first, second, metres(args.height_mm), args.station)
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
        "where two calibrations differ, on the field in mm or over the image in px",
        CompareArguments,
        _run,
        ("old.json new.json --height-mm 150", "old.json new.json --over-image --without-turn"),
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


def _explained(one: StationComparison | CameraComparison) -> str:
    return {
        True: f"explained by their uncertainties (probability {one.probability or 0.0:.2g})",
        False: f"more than their uncertainties explain (probability {one.probability or 0.0:.1g})",
        None: "nothing can be said of uncertainty: it is not told of both",
    }[one.explained]


def _text(one: StationComparison) -> str:
    phi = f"phi {one.phi_px[0]:.3f} -> {one.phi_px[1]:.3f} px"
    size = f"{one.mean_mm:.2f} mm on average, {one.worst_mm:.2f} mm at most"
    lines = [
        section("station", [one.station]),
        section("camera", [f"moved {one.moved_mm:.2f} mm, turned {one.turned_deg:.4f} deg, {phi}"]),
        section("map", [f"{size}, {1e3 * one.height_m:.0f} mm above the floor", _explained(one)]),
    ]
    return "\n".join([*lines, *_table(one)])


def _table(one: StationComparison) -> list[str]:
    return _grid_table(one.errors_mm[::-1], one.x_m, one.y_m[::-1], ("mm", "x, m"))


def _grid_table(values: Array, x: Array, y: Array, units: tuple[str, str]) -> list[str]:
    """Some of the values (Y, X), the first row at the top."""
    import numpy as np

    from ceres_cal.report.maps import evenly

    columns, rows = evenly(len(x), _COLUMNS), evenly(len(y), _ROWS)
    places = 2 if units[0] == "mm" else 0
    lines = [f"{units[0]:>10}" + "".join(f"{x[c]:8.{places}f}" for c in columns) + f"  {units[1]}"]
    for row in rows:
        cells = "".join(f"{v:8.2f}" if np.isfinite(v) else f"{'.':>8}" for v in values[row, columns])
        lines.append(f"{y[row]:10.{places}f}{cells}")
    return lines


def _camera_data(one: CameraComparison) -> dict[str, Any]:
    """Everything; pixels without an answer are null."""
    return {
        "phi_px": one.phi_px,
        "turn_deg": one.turn_deg,
        "explained_by_uncertainty": one.explained,
        "probability": one.probability,
        "x_px": one.x_px,
        "y_px": one.y_px,
        "difference_px": one.difference_px,
        "angles_deg": one.angles_deg,
    }


def _camera_text(one: CameraComparison) -> str:
    import numpy as np

    pixels, angles = one.errors_px[np.isfinite(one.errors_px)], one.angles_deg[np.isfinite(one.angles_deg)]
    turned = f", {one.turn_deg:.4f} deg of turn taken out" if one.turn_deg else ""
    lines = [
        section("camera", [f"{one.camera}, phi {one.phi_px[0]:.3f} -> {one.phi_px[1]:.3f} px{turned}"]),
        section(
            "image",
            [
                f"{np.mean(pixels):.3f} px on average, {np.max(pixels):.3f} px at most",
                f"{np.mean(angles):.4f} deg on average, {np.max(angles):.4f} deg at most, between directions",
                _explained(one),
            ],
        ),
    ]
    return "\n".join([*lines, *_grid_table(one.errors_px, one.x_px, one.y_px, ("px", "x, px"))])
