"""`ceres-cal advise`: what to measure next, and what it would bring in mm."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ceres_cal import diagnostics, observations, scene
from ceres_cal.base import InputError, naming, short
from ceres_cal.cli import arguments
from ceres_cal.cli.command import QuietArguments, command, option
from ceres_cal.cli.files import read_calibration, station_of
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.report.document import Document, Section, wrapped


@command(
    "advise",
    "what to measure next, and what it would bring in mm",
    "calibration.json --good-enough-mm 2",
    "calibration.json --board 9x6x50mm --height-mm 150",
)
def _run(
    args: QuietArguments,
    calibration: Path = arguments.calibration_argument(),
    height_mm: float = arguments.height_option("height of what is to be located; default: 150, a robot's top", 150.0),
    station: str | None = arguments.station_option("whose map; may be left out where there is only one"),
    good_enough_mm: float | None = option(
        "largest acceptable error; no advice is given if the calibration reaches it", "MM", read=arguments.length("mm")
    ),
    board: tuple[int, int, float] | None = arguments.board_option(
        "the board that could be shown: inner corners and size of a square, such as 9x6x100; default: the "
        "calibration's own, or that one",
        read=arguments.parse_board,
    ),
) -> Document:
    enough = good_enough_mm
    if enough is not None and not enough > 0.0:
        raise InputError(f"--good-enough-mm {enough:g}: give a number of millimetres above 0")

    known = read_calibration(calibration)
    name = station_of(calibration, station, known)
    with naming(calibration), ProgressBar(args.silent) as bar:
        shown = None if board is None else scene.checkerboard(*board)
        advice = diagnostics.advise(known, name, arguments.metres(height_mm), enough, shown, bar.update)
    weak = [direction.words for direction in known.uncertainty.weak_directions]
    return Document(tuple(_sections(advice, weak)))


# ---- what is said ---------------------------------------------------------------------------------------------------


def _sections(advice: diagnostics.Advice, weak: list[str]) -> Iterator[Section]:
    x, y = advice.worst_place_m
    before, height, verdict = advice.before, f"{1e3 * advice.height_m:.0f} mm", list(_verdict(advice))
    where = f" at ({x:.1f}, {y:.1f} m)" if before.worst_mm < float("inf") else ""
    today = f"station {advice.station!r} at {height}: worst {_mm(before.worst_mm)}{where}, mean {_mm(before.mean_mm)}"
    asked = {name: getattr(advice, name) for name in ("station", "height_m", "good_enough_mm")}
    yield Section("advice", verdict, {**asked, "verdict": verdict})
    known = {**vars(before), "worst_place_m": list(advice.worst_place_m), "weak_directions": weak}
    yield Section("today", wrapped(today, *weak[:1]), {"today": known})
    lines = ["", f"{'worst':>9}  {'mean':>9}  would be left at {height} if you"]
    for promise in advice.promises:
        after, words = promise.after, f"{promise.measurement.words}{_range(promise)}"
        lines.append(f"{_mm(after.worst_mm):>9}  {_mm(after.mean_mm):>9}  {words}")
        lines += [f"{'':24}{step}" for step in promise.measurement.steps]
    data = {
        "best": None if advice.best is None else advice.promises.index(advice.best),
        "then": None if advice.then is None else _promise_data(advice.then),
        "promises": [_promise_data(promise) for promise in advice.promises],
    }
    yield Section("", lines, data)


def _verdict(advice: diagnostics.Advice) -> Iterator[str]:
    before, best, enough = advice.before, advice.best, advice.good_enough_mm
    worst = f"the worst error at {1e3 * advice.height_m:.0f} mm"
    if best is None:
        if enough is not None and before.worst_mm <= enough:
            yield f"nothing needs to be measured: {worst} is {_mm(before.worst_mm)}, and {enough:g} mm are good enough"
        else:
            left = _mm(advice.promises[0].after.worst_mm)
            yield f"no measurement is worthwhile: {worst} is {_mm(before.worst_mm)}, and {left} at best afterwards"
        return
    fall = f"{short(before.worst_mm)} to {_mm(best.after.worst_mm)}"
    yield f"{best.measurement.words}: {worst} falls from {fall}{_range(best)}"
    yield from (f"  {step}" for step in best.measurement.steps)
    if advice.then is not None:
        yield f"and then {advice.then.measurement.words}: it falls to {_mm(advice.then.after.worst_mm)}"
        yield from (f"  {step}" for step in advice.then.measurement.steps)
    last = advice.then or best
    if enough is not None and last.after.worst_mm > enough:
        yield f"that is still more than the {enough:g} mm asked for: do more than one of these"


def _range(promise: diagnostics.Promise) -> str:
    """Words on the range of a promise that depends on phi; "" where it hardly does."""
    if promise.rough:
        return " (roughly: phi is not determined)"
    low, high = promise.worst_range_mm
    return f" ({_mm(low)} to {_mm(high)} over the possible phi)" if high > 1.1 * low else ""


def _mm(value: float) -> str:
    return f"{short(value)} mm" if value < float("inf") else short(value)


def _promise_data(promise: diagnostics.Promise) -> dict[str, Any]:
    """Return a promise, with its measurement in the form of files of observations."""
    measurement = promise.measurement
    as_in_files = {
        "priors": [observations.prior_to_json(prior) for prior in measurement.priors],
        "targets": {name: target.spec for name, target in measurement.targets.items()},
        "placements": {name: scene.PoseFile.of(pose) for name, pose in measurement.placements.items()},
    }
    over_phi = [{"phi_px": phi, **vars(errors)} for phi, errors in promise.valley]
    reach = {"worst_range_mm": promise.worst_range_mm, "rough": promise.rough, "over_phi": over_phi}
    return {**vars(measurement), **as_in_files, **vars(promise.after), **reach}
