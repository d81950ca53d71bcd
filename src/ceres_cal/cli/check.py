"""`ceres-cal check`: does a calibration still hold? Fit for cron: exit code 0 yes, 1 no."""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ceres_cal.base.errors import InputError
from ceres_cal.cli.command import Answer, Command, parse_number
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
    from ceres_cal.moves import Check, StationCheck
    from ceres_cal.photographs import KnownDetections


def _add_arguments(parser: ArgumentParser) -> None:
    add_inputs(parser)
    parser.add_argument(
        "--false-alarms",
        default="0.01",
        metavar="SHARE",
        help="how often unmoved cameras may be said to have moved, such as 0.01 or 1%%; default: 0.01",
    )


def _run(args: Namespace) -> Answer:
    level = _share(args.false_alarms)
    images = photographs_in(args)
    found, seen = _photographed(args, images, level) if images else (_observed(args, level), None)
    return Answer(_data(found) | photographs_data(seen), lambda: _text(found, seen), 0 if found.holds else 1)


def _observed(args: Namespace, level: float) -> Check:
    from ceres_cal.moves import check

    return check(read_calibration(args), read_observations(args), level)


def _photographed(args: Namespace, images: list[Path], level: float) -> tuple[Check, KnownDetections]:
    from ceres_cal.photographs import check_photographs

    with progress_bar(args) as bar:
        return check_photographs(
            read_calibration(args), images, args.station, level, not_painted=not_painted(args), progress=bar.update
        )


COMMANDS = (Command("check", "does a calibration still hold? exit code 0 yes, 1 no", _add_arguments, _run),)


def _share(text: str) -> float:
    where = f"--false-alarms {text!r}"
    value = parse_number(text.rstrip("%"), where) / (100.0 if text.endswith("%") else 1.0)
    if not 0.0 < value < 1.0:
        raise InputError(f"{where}: give a share between 0 and 1, such as 0.01")
    return value


def _data(found: Check) -> dict[str, Any]:
    stations = {name: _station_data(one) for name, one in found.stations.items()}
    return {"holds": found.holds, "false_alarms": found.false_alarms, "stations": stations}


def _station_data(found: StationCheck) -> dict[str, Any]:
    """The fields; null where nothing could be told."""
    plain = {name: value if _told(value) else None for name, value in vars(found).items() if name != "shift_mm"}
    maps = [
        {"height_m": height_m, "mean_mm": mean if _told(mean) else None, "worst_mm": worst if _told(worst) else None}
        for height_m, (mean, worst) in found.shift_mm.items()
    ]
    return {**plain, "shift_mm": maps}


def _told(value: object) -> bool:
    return not isinstance(value, float) or math.isfinite(value)


def _text(found: Check, seen: KnownDetections | None) -> str:
    lines = [f"{'check':10}{'yes' if found.holds else 'no'} ({100.0 * found.false_alarms:g} % false alarms)"]
    lines += photographs_text(seen)
    for name, one in found.stations.items():
        lines.append(f"{'station':10}{name} {one.words}")
        if not _told(one.statistic) and not one.degrees:
            continue
        lines.append(f"{'':10}{one.used} observations, {one.outliers} outliers, noise {one.noise:.2f} times as before")
        size = f"picture {one.shift_px:.3f} px rms, phi {100.0 * one.phi_change:+.3f} %"
        lines.append(f"{'':10}moved {one.moved_mm:.1f} mm, turned {one.turned_deg:.4f} deg, {size}")
        for height_m, (mean, worst) in one.shift_mm.items():
            lines.append(f"{'':10}map at {1e3 * height_m:.0f} mm: {mean:.2f} mm on average, {worst:.2f} mm at most")
    return "\n".join(lines)
