"""Keeps a calibration up to date: checks it against new observations, and refits it after a move. Copy this file.

    python scripts/refit_after_move.py calibration.json new.json photograph.jpg   # these files, once
    python scripts/refit_after_move.py calibration.json --watch incoming/         # every file that appears there

A file contains observations, or is a photograph in which the field is searched near its calibrated place. Two files
must agree before anything changes: if a file shows that a camera has moved, the calibration is "suspected"; if the next
file shows it, too, the calibration is refitted from that file. In --checks checks (720: hourly for a month) an unmoved
camera is refitted with a probability of at most --false-alarms, if errors of different files are independent.
Every event is one line of JSON on standard output, or in --log: "holds", "suspected", "refitted", "refused" (nothing
was changed; the reason says what to do), "unreadable", or "folder" (the watched folder is gone, or is back). With --log
a suspicion is remembered from one run to the next. Ctrl-C and SIGTERM end the watch after the current file. The
calibration is replaced in one step, and the previous one is kept in previous/ beside it. Exits with 0 when the
calibration holds at the end, 3 when the last file raised a suspicion, was refused or could not be read.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from watching import Folder, Journal

import ceres_cal as cc
from ceres_cal.base.files import make_folder, read_bytes, write_bytes
from ceres_cal.base.images import IMAGE_ENDINGS
from ceres_cal.base.words import ROBOT_TOP_M
from ceres_cal.detect.images import read_grey
from ceres_cal.detect.photographs import check_photographs
from ceres_cal.moves.agreement import FALSE_ALARMS, Agreements
from ceres_cal.moves.refit_plan import WHAT
from ceres_cal.moves.refits import movements

SUSPICIOUS = ("suspected", "refused")  # events of a checked file


def handle(place: Path, source: Path, given: argparse.Namespace, suspected: bool) -> dict[str, Any]:
    """Check the calibration at `place` against a file, and refit it where it fails and was suspected; returns the
    event.
    """
    begin = time.perf_counter()
    event: dict[str, Any] = {"time": now(), "file": str(source)}
    try:
        content = read(source)
    except cc.InputError as error:
        return {**event, "event": "unreadable", "reason": str(error)}
    try:
        old = cc.Calibration.load(place)
        found, observations = checked(old, source, content, given)
        event["check"] = told(found)
        event["false_alarms"] = {"of_this_check": found.false_alarms, "refits": given.false_alarms, "in": given.checks}
        if found.holds:
            return {**event, "event": "holds", "seconds": round(time.perf_counter() - begin, 3)}
        if not suspected:
            reason = "; ".join(told(found).values())
            return {**event, "event": "suspected", "reason": f"{reason}; asked again with the next file"}
        if observations is None:
            return {**event, "event": "refused", "reason": "; ".join(told(found).values())}
        new = cc.refit(old, observations, given.what)
        worst = {name: new.uncertainty.map_sd_mm(name, ROBOT_TOP_M).worst_mm for name in observations.stations}
        event["sd_mm_at_robot_height"] = worst
        if not all(value <= given.limit_mm for value in worst.values()):
            reason = f"known to {max(worst.values()):.1f} mm at robot height only, asked for are {given.limit_mm:g} mm"
            return {**event, "event": "refused", "reason": f"{reason}: observe more lines and corners"}
        event["kept"] = str(keep(place))
        new.save(place)
    except cc.CalibrationError as error:
        return {**event, "event": "refused", "reason": str(error)}
    explanation = new.refitted.explanation if new.refitted else ""
    moves = {
        name: {"mm": None if math.isnan(shift_m) else 1e3 * shift_m, "deg": deg}  # NaN is no JSON
        for name, (shift_m, deg) in movements(old, new, new.refitted.what if new.refitted else "pose").items()
    }
    event |= {"explanation": explanation, "moved": moves, "warnings": list(new.warnings), "rms_px": new.rms_px}
    return {**event, "event": "refitted", "seconds": round(time.perf_counter() - begin, 3)}


def read(source: Path) -> cc.Observations | None:
    """The observations in a file, or None for a photograph; InputError where it is neither."""
    if source.suffix.lower() not in IMAGE_ENDINGS:
        return cc.Observations.load(source)
    read_grey(source)
    return None


def checked(
    old: cc.Calibration, source: Path, content: cc.Observations | None, given: argparse.Namespace
) -> tuple[Agreements, cc.Observations | None]:
    """The answer to a file, and its observations; None where a photograph shows no field."""
    if content is not None:
        return cc.check(old, content, level(given)), content
    found, seen = check_photographs(old, [source], given.station, level(given))
    return found, seen.observations


def level(given: argparse.Namespace) -> float:
    """False alarm probability of one check; two in a row are then as rare as required over all checks."""
    return math.sqrt(float(given.false_alarms) / int(given.checks))


def told(found: Agreements) -> dict[str, str]:
    """The answer for each station, in words."""
    return {name: station.words for name, station in found.items()}


def keep(place: Path) -> Path:
    """Copies the calibration to previous/, with the time in its name."""
    folder = make_folder(place.parent / "previous")
    copy = folder / f"{place.stem}-{datetime.now(UTC):%Y%m%dT%H%M%S%f}{place.suffix}"
    write_bytes(copy, read_bytes(place))
    return copy


def is_suspected(log: Path | None) -> bool:
    """Whether the log says that the last checked file disagreed with the calibration."""
    lines = log.read_text(encoding="utf-8", errors="replace").splitlines() if log is not None and log.is_file() else []
    for line in reversed(lines):
        with suppress(ValueError):  # an incomplete line of a run that was killed
            event = json.loads(line)
            if isinstance(event, dict) and "check" in event:
                return event.get("event") in SUSPICIOUS
    return False


def events(given: argparse.Namespace) -> Iterator[dict[str, Any]]:
    suspected = is_suspected(given.log)

    def answer(source: Path) -> dict[str, Any]:
        nonlocal suspected
        try:
            event = handle(given.calibration, source, given, suspected)
        except Exception as error:  # one odd file must not end a week of watching
            reason = f"unexpected {error!r}: please report it"
            return {"time": now(), "file": str(source), "event": "refused", "reason": reason}
        if "check" in event:
            suspected = event["event"] in SUSPICIOUS
        return event

    yield from map(answer, given.files)
    if given.watch is not None:
        yield from watched(given, answer)


def watched(given: argparse.Namespace, answer: Callable[[Path], dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Events of files that appear in the folder, until Ctrl-C or SIGTERM; the current file is finished first."""
    stopped = threading.Event()

    def stop(*_: object) -> None:
        if stopped.is_set():
            raise KeyboardInterrupt  # a second signal ends at once
        stopped.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    folder, was_there = Folder(given.watch, {".json", ".npz", *IMAGE_ENDINGS}), True
    while not stopped.wait(given.every_s):
        ready = folder.look()
        if folder.is_there != was_there:
            was_there = folder.is_there
            yield {"time": now(), "event": "folder", "reason": f"{given.watch} is {'back' if was_there else 'gone'}"}
        for source in ready:
            if stopped.is_set():
                return
            event = answer(source)
            if event["event"] != "unreadable" or not folder.again(source):
                yield event


def now() -> str:
    return datetime.now(UTC).isoformat()


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0], allow_abbrev=False)
    parser.add_argument("calibration", type=Path, help="is checked, and replaced where a camera has moved")
    parser.add_argument("files", type=Path, nargs="*", help="new observations or photographs, one after the other")
    parser.add_argument("--watch", type=Path, metavar="FOLDER", help="then wait for files that appear there")
    parser.add_argument("--every-s", type=float, default=0.5, help="how often to look (default 0.5 s)")
    parser.add_argument(
        "--what", default="auto", choices=WHAT, help="what is free in a refit, see `ceres-cal refit --help`"
    )
    parser.add_argument("--false-alarms", type=float, default=FALSE_ALARMS, help="refits of nothing (default 0.01)")
    parser.add_argument("--checks", type=int, default=720, help="in so many checks (default 720, hourly for a month)")
    parser.add_argument("--limit-mm", type=float, default=20.0, help="worst sigma at 150 mm still used (default 20)")
    parser.add_argument("--station", help="station that takes the photographs (default: the only one)")
    parser.add_argument("--log", type=Path, help="add the events to this file instead of printing them")
    given = parser.parse_args(arguments)
    if not given.calibration.is_file():
        parser.error(f"{given.calibration}: no such file")
    if given.watch is not None and not given.watch.is_dir():
        parser.error(f"{given.watch}: no such folder")
    if not (0.0 < given.false_alarms < 1.0 and given.checks >= 1):
        parser.error("--false-alarms must lie between 0 and 1, --checks must be 1 or more")
    if not given.files and given.watch is None:
        parser.error("name files of observations or photographs, or a folder to --watch")
    if not given.every_s > 0.0:
        parser.error("--every-s must be above 0")
    if given.log is not None and not os.access(given.log if given.log.exists() else given.log.parent, os.W_OK):
        parser.error(f"{given.log}: cannot be written")
    journal, last = Journal(given.log), 0
    try:
        for event in events(given):
            last = 0 if event["event"] in ("holds", "refitted") else 3
            journal.write(event)
    except KeyboardInterrupt:
        return 130
    return last if given.watch is None else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
