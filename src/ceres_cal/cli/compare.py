"""`ceres-cal compare`: where two calibrations differ, on the field in mm or over the image in px."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import fixed
from ceres_cal.cli.arguments import height_option, metres, station_option
from ceres_cal.cli.command import Arguments, argument, command, option, switch
from ceres_cal.cli.files import read_calibration, require_ending, require_output, save
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.base.arrays import Array
    from ceres_cal.calibration import Calibration
    from ceres_cal.moves.agreement import Agreement


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
    require_ending(args.picture, "pictures are", ".svg")
    first, second = read_calibration(args.a), read_calibration(args.b)
    if args.over_image or args.without_turn or all(target.movable for target in first.targets.values()):
        return _over_image(args, first, second)
    return _over_field(args, first, second)


def _over_image(args: CompareArguments, first: Calibration, second: Calibration) -> Document:
    if args.picture is not None or args.station is not None:
        raise InputError("--picture and --station are for maps of a field: leave them out where images are compared")
    from ceres_cal.moves.comparisons import compare_cameras

    comparisons = compare_cameras(first, second, without_turn=args.without_turn)
    return Document(tuple(section for one in comparisons.values() for section in _camera(one)))


def _over_field(args: CompareArguments, first: Calibration, second: Calibration) -> Document:
    from ceres_cal.moves.comparisons import compare

    comparisons = compare(first, second, metres(args.height_mm), args.station)
    if args.picture is not None:
        if len(comparisons) > 1:
            names = " or ".join(comparisons)
            raise InputError(f"--picture shows one station: name it with --station {names}")
        from ceres_cal.report.maps import comparison_svg

        save(args.picture, comparison_svg(next(iter(comparisons.values())), first).encode())
    return Document(tuple(section for one in comparisons.values() for section in _station(one)))


def _station(one: Agreement) -> Iterator[Section]:
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


def _camera(one: Agreement) -> Iterator[Section]:
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


def _table(head: str, values: Array, x: Array, y: Array, place: str) -> Section:
    table_size = 9, 7
    from ceres_cal.report.maps import grid_table

    table = grid_table(head, values, x, y, place, table_size, partial(fixed, places=2))
    return Section("", table.lines(), pieces=(table,))


def _tested(one: Agreement) -> dict[str, Any]:
    return {"probability": one.probability, "explained_by_uncertainty": one.holds}


def _explained(one: Agreement) -> str:
    return {
        True: f"explained by their uncertainties (probability {one.probability:.2g})",
        False: f"more than their uncertainties explain (probability {one.probability:.1g})",
        None: "no statement on uncertainty: one of the calibrations does not have it",
    }[one.holds]
