"""`ceres-cal compare`: where on the field two calibrations differ, in mm."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.command import Answer, Command, finishing, parse_number, require_output

if TYPE_CHECKING:
    from ceres_cal.moves import StationComparison

_COLUMNS, _ROWS = 9, 7


def _add_arguments(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("a", metavar="A", type=Path, help="one calibration")
    add("b", metavar="B", type=Path, help="the other")
    add("--height-mm", default="0", metavar="MM", help="of the map above the floor; default: 0")
    add("--station", help="only this one; default: all that both have")
    add("--picture", metavar="SVG", type=Path, help="draw the map there (of one station)")


def _run(args: Namespace) -> Answer:
    require_output(args.picture, [args.a, args.b])
    height_m = parse_number(args.height_mm, "--height-mm") / 1000.0
    from ceres_cal.base.files import write_bytes
    from ceres_cal.calibration import Calibration
    from ceres_cal.moves import compare, picture

    first = Calibration.load(args.a)
    found = compare(first, Calibration.load(args.b), height_m, args.station)
    if args.picture is not None:
        if len(found) > 1:
            names = " or ".join(one.station for one in found)
            raise InputError(f"--picture shows one station: name it with --station {names}")
        with finishing():
            write_bytes(args.picture, picture(found[0], first.targets).encode())
    return Answer({"stations": {one.station: _data(one) for one in found}}, lambda: "\n".join(map(_text, found)))


COMMANDS = (Command("compare", "where on the field two calibrations differ, in mm", _add_arguments, _run),)


def _data(found: StationComparison) -> dict[str, Any]:
    """Everything; the map's places that are not shown are null."""

    def plain(values: Any) -> Any:
        if isinstance(values, list):
            return [plain(value) for value in values]
        return values if values == values and abs(values) != float("inf") else None

    return {
        "moved_mm": found.moved_mm,
        "turned_deg": found.turned_deg,
        "phi_px": list(found.phi_px),
        "height_m": found.height_m,
        "mean_mm": plain(found.mean_mm),
        "worst_mm": plain(found.worst_mm),
        "explained_by_uncertainty": found.explained,
        "probability": found.probability,
        "x_m": found.x_m.tolist(),
        "y_m": found.y_m.tolist(),
        "difference_mm": plain(found.difference_mm.tolist()),
        "expected_mm": plain(found.expected_mm.tolist()),
    }


def _text(found: StationComparison) -> str:
    import numpy as np

    answer = {
        True: f"explained by their uncertainties (probability {found.probability or 0.0:.2g})",
        False: f"more than their uncertainties explain (probability {found.probability or 0.0:.1g})",
        None: "nothing can be said of uncertainty: it is not told of both",
    }[found.explained]
    lines = [
        f"{'station':10}{found.station}",
        f"{'camera':10}moved {found.moved_mm:.2f} mm, turned {found.turned_deg:.4f} deg, "
        f"phi {found.phi_px[0]:.3f} -> {found.phi_px[1]:.3f} px",
        f"{'map':10}{found.mean_mm:.2f} mm on average, {found.worst_mm:.2f} mm at most, "
        f"{1e3 * found.height_m:.0f} mm above the floor",
        f"{'':10}{answer}",
        f"{'mm':>10}" + "".join(f"{found.x_m[c]:8.2f}" for c in _some(len(found.x_m), _COLUMNS)) + "  x, m",
    ]
    for row in _some(len(found.y_m), _ROWS)[::-1]:
        cells = [found.length_mm[row, c] for c in _some(len(found.x_m), _COLUMNS)]
        shown = "".join(f"{value:8.2f}" if np.isfinite(value) else f"{'.':>8}" for value in cells)
        lines.append(f"{found.y_m[row]:10.2f}{shown}")
    return "\n".join(lines)


def _some(count: int, most: int) -> list[int]:
    """Places that lie evenly, both ends among them."""
    return sorted({round(i * (count - 1) / (most - 1)) for i in range(most)})
