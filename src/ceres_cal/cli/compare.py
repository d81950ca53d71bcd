"""`ceres-cal compare`: where two calibrations differ, on the field in mm or over the image in px."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import fixed
from ceres_cal.cli.arguments import height_option, metres, station_option
from ceres_cal.cli.command import command
from ceres_cal.cli.files import finishing, require_output
from ceres_cal.cli.options import Arguments, argument, option, switch
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.base.arrays import Array
    from ceres_cal.calibration import Calibration
    from ceres_cal.moves import CameraComparison, StationComparison

_TABLE_SIZE = 9, 7


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


@command(
    "compare",
    "where two calibrations differ, on the field in mm or over the image in px",
    "old.json new.json --height-mm 150",
    "old.json new.json --over-image --without-turn",
)
def _run(args: CompareArguments) -> Document:
    require_output(args.picture, [args.a, args.b])
    from ceres_cal.calibration import Calibration

    first, second = Calibration.load(args.a), Calibration.load(args.b)
    if args.over_image or args.without_turn or all(target.movable for target in first.targets.values()):
        return _over_image(args, first, second)
    return _over_field(args, first, second)


def _over_image(args: CompareArguments, first: Calibration, second: Calibration) -> Document:
    if args.picture is not None or args.station is not None:
        raise InputError("--picture and --station are for maps of a field: leave them out where images are compared")
    from ceres_cal.moves import compare_cameras

    comparisons = compare_cameras(first, second, without_turn=args.without_turn)
    return Document(tuple(section for one in comparisons for section in _camera(one)))


def _over_field(args: CompareArguments, first: Calibration, second: Calibration) -> Document:
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
    return Document(tuple(section for one in comparisons for section in _station(one)))


def _station(one: StationComparison) -> Iterator[Section]:
    phi = f"phi {one.phi_px[0]:.3f} -> {one.phi_px[1]:.3f} px"
    size = f"{one.mean_mm:.2f} mm on average, {one.worst_mm:.2f} mm at most"
    data = _data(one, mean_mm=one.mean_mm, worst_mm=one.worst_mm)
    yield Section("station", [one.station], {"stations": {one.station: data}})
    yield Section("camera", [f"moved {one.moved_mm:.2f} mm, turned {one.turned_deg:.4f} deg, {phi}"])
    yield Section("map", [f"{size}, {1e3 * one.height_m:.0f} mm above the floor", _explained(one)])
    yield _table("mm at y \\ x", one.errors_mm[::-1], one.x_m, one.y_m[::-1], "{:.2f} m")


def _camera(one: CameraComparison) -> Iterator[Section]:
    import numpy as np

    pixels, angles = one.errors_px[np.isfinite(one.errors_px)], one.angles_deg[np.isfinite(one.angles_deg)]
    turned = f", {one.turn_deg:.4f} deg of turn taken out" if one.turn_deg else ""
    title = f"{one.camera}, phi {one.phi_px[0]:.3f} -> {one.phi_px[1]:.3f} px{turned}"
    yield Section("camera", [title], {"cameras": {one.camera: _data(one)}})
    lines = [
        f"{np.mean(pixels):.3f} px on average, {np.max(pixels):.3f} px at most",
        f"{np.mean(angles):.4f} deg on average, {np.max(angles):.4f} deg at most, between directions",
        _explained(one),
    ]
    yield Section("image", lines)
    yield _table("px at y \\ x", one.errors_px, one.x_px, one.y_px, "{:.0f} px")


def _table(head: str, values: Array, x: Array, y: Array, place: str) -> Section:
    from ceres_cal.report.maps import grid_table

    table = grid_table(head, values, x, y, place, _TABLE_SIZE, partial(fixed, places=2))
    return Section("", table.lines(), pieces=(table,))


def _data(one: StationComparison | CameraComparison, **more: float) -> dict[str, Any]:
    """Everything; places of a map that are not shown are null."""
    own = {name: value for name, value in vars(one).items() if name not in ("station", "camera")}
    return {**own, **more, "explained_by_uncertainty": one.explained}


def _explained(one: StationComparison | CameraComparison) -> str:
    return {
        True: f"explained by their uncertainties (probability {one.probability or 0.0:.2g})",
        False: f"more than their uncertainties explain (probability {one.probability or 0.0:.1g})",
        None: "nothing can be said of uncertainty: it is not told of both",
    }[one.explained]
