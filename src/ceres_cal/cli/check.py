"""`ceres-cal check`: does a calibration still hold? Fit for cron: exit code 0 yes, 1 no."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import HEIGHTS_M, at_height
from ceres_cal.cli.arguments import parse_names, parse_number, whole
from ceres_cal.cli.command import command, option
from ceres_cal.cli.files import read_calibration, read_observations
from ceres_cal.cli.photographs import InputArguments, photographs_in, shown
from ceres_cal.cli.terminal import progress_bar
from ceres_cal.report.document import Document, Section

if TYPE_CHECKING:
    from ceres_cal.detect.photographs import KnownDetections
    from ceres_cal.moves.agreement import Agreement, Agreements


def _share(text: str) -> float:
    where = f"--false-alarms {text!r}"
    value = parse_number(text.rstrip("%"), where) / (100.0 if text.endswith("%") else 1.0)
    if not 0.0 < value < 1.0:
        raise InputError(f"{where}: give a share between 0 and 1, such as 0.01")
    return value


class CheckArguments(InputArguments):
    """What is held against a calibration, and how sure the answer is to be."""

    false_alarms: float = option(
        "how often unmoved cameras may be said to have moved, such as 0.01 or 1%", "SHARE", 0.01, read=_share
    )
    checks: int = option(
        "that is at least once in N checks of this calibration: 720 for an hourly check over a month",
        "N",
        1,
        read=whole(1),
    )


@command(
    "check",
    "does a calibration still hold? exit code 0 yes, 1 no",
    "calibration.json now.png",
    "calibration.json incoming/ --checks 720 --json",
)
def _run(args: CheckArguments) -> Document:
    images = photographs_in(args)
    detections = None
    if images:
        answer, detections = _photographed(args, images)
    else:
        from ceres_cal.moves.checks import check

        answer = check(
            read_calibration(args.calibration), read_observations(args.inputs), args.false_alarms, args.checks
        )
    often = "" if answer.checks == 1 else f", any in {answer.checks} checks"
    rate = f"({100.0 * args.false_alarms:g} % false alarms{often})"
    holds = f"{'yes' if answer.holds else 'no'} {rate}"
    headline = f"The calibration {'holds' if answer.holds else 'no longer holds'} {rate}."
    stated = {name: getattr(answer, name) for name in ("holds", "false_alarms", "checks")}
    stations = map(_station, answer.values())
    return Document((Section("check", [holds], stated), shown(detections), *stations), answer.exit_code, headline)


def _photographed(args: CheckArguments, images: list[Path]) -> tuple[Agreements, KnownDetections]:
    from ceres_cal.detect.photographs import check_photographs

    calibration, not_painted = read_calibration(args.calibration), parse_names(args.not_painted)
    with progress_bar(args) as bar:
        return check_photographs(
            calibration,
            images,
            args.station,
            args.false_alarms,
            checks=args.checks,
            not_painted=not_painted,
            progress=bar.update,
        )


def _station(one: Agreement) -> Section:
    lines, change, misfit = [f"{one.name} {one.words}"], one.change, one.misfit
    used, noise = misfit.points + misfit.curves, misfit.noise[0]
    data = {name: getattr(one, name) for name in ("holds", "probability", "statistic", "degrees", "words")}
    data |= {"station": one.name, "used": used, "outliers": misfit.outliers, "noise": noise}
    sizes: dict[str, float | None] = dict.fromkeys(("moved_mm", "turned_deg", "phi_change", "shift_px"))
    maps: list[tuple[float, float | None, float | None]] = [(height_m, None, None) for height_m in HEIGHTS_M]
    if change is not None:
        phi_change = change.phi_px[1] / change.phi_px[0] - 1.0
        sizes |= {"moved_mm": change.moved_mm, "turned_deg": change.turned_deg}
        sizes |= {"phi_change": phi_change, "shift_px": change.shift_px}
        picture = f"picture {change.shift_px:.3g} px rms, " if math.isfinite(change.shift_px) else ""
        size = f"{picture}phi {100.0 * phi_change:+.3f} %"
        maps = [(over.height_m, over.mean_mm, over.worst_mm) for over in change.maps]
        lines += [
            f"{used} observations, {misfit.outliers} outliers, noise {noise:.2f} times as before",
            f"moved {change.moved_mm:.3g} mm, turned {change.turned_deg:.3g} deg, {size}",
            *(
                f"map {at_height(h)}: {mean:.3g} mm on average, {worst:.3g} mm at most"
                for h, mean, worst in maps
                if mean == mean
            ),
        ]
    shifts = [{"height_m": h, "mean_mm": mean, "worst_mm": worst} for h, mean, worst in maps]
    return Section("station", lines, {"stations": {one.name: {**data, **sizes, "shift_mm": shifts}}})
