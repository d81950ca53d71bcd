"""A week of watching, accelerated: python scripts/run.py week [--help]

`refit_after_move.py --watch` runs as users run it. Files of observations appear in its folder, one in ten of them
damaged or truncated. After every thousand files the camera has moved. Sometimes the folder is renamed for a while, or
no file can grow, as on a full disk. Processed files are removed. "yes": the limit is kept. "no": it is missed. Exits
with 1 when a figure is missed.
"""

from __future__ import annotations

import json
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from accuracy.moves import DAY, HOME, MOVED, calibrated, seen
from runner import Row, script

from ceres_cal.calibration import Calibration
from ceres_cal.moves.checks import check

SCRIPT = Path(__file__).parents[1] / "refit_after_move.py"
PLACES = {"home": HOME, "moved": MOVED}
KINDS = 20  # files of each place, from which all files are drawn
HEAP = 50  # files that appear at once
MOVE_EVERY, AWAY_EVERY, FULL_EVERY = 1000, 1700, 2300
DAMAGED = 0.1
LONGEST_S = 300.0
FLAT = 1.05  # times the memory of the first tenth


@dataclass(frozen=True)
class DroppedFile:
    """A file that appeared: its name, whether it can be read, and the place of the camera at that time."""

    name: str
    good: bool
    place: str


class Watch:
    """The running script, its folder and its log."""

    def __init__(self, folder: Path) -> None:
        self.calibration, self.log = folder / "calibration.json", folder / "events.jsonl"
        self.incoming, self._away, self._staging = folder / "incoming", folder / "away", folder / "staging"
        for path in (self.incoming, self._staging):
            path.mkdir()
        calibrated(0).save(self.calibration)
        arguments = [str(self.calibration), "--watch", str(self.incoming), "--log", str(self.log), "--every-s", "0.05"]
        self._process = subprocess.Popen([sys.executable, str(SCRIPT), *arguments], cwd=folder)
        time.sleep(3.0)  # files that exist when the watch begins are not new
        self._read = 0
        self.events: list[dict[str, object]] = []

    def drop(self, name: str, content: bytes) -> None:
        """A complete file appears, even while the folder is renamed."""
        (self._staging / name).write_bytes(content)
        folder = self.incoming if self.incoming.exists() else self._away
        (self._staging / name).rename(folder / name)

    def rename(self, *, away: bool) -> None:
        one, other = (self.incoming, self._away) if away else (self._away, self.incoming)
        one.rename(other)

    def full(self, *, full: bool) -> None:
        """Prevents all files of the process from growing, or allows it again."""
        limit = 0 if full else resource.RLIM_INFINITY
        resource.prlimit(self._process.pid, resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))

    def wait_for(self, names: Sequence[str]) -> set[str]:
        """Wait until the log has all of these files; returns those that are missing at the end."""
        end, missing = time.monotonic() + LONGEST_S, set(names)
        while missing and time.monotonic() < end:
            for event in self._new_events():
                missing.discard(Path(str(event.get("file", ""))).name)
            time.sleep(0.02)
        return missing

    def _new_events(self) -> Iterator[dict[str, object]]:
        if self.log.exists():
            with self.log.open("rb") as log:
                log.seek(self._read)
                for line in log:
                    if line.endswith(b"\n"):
                        self._read += len(line)
                        self.events.append(json.loads(line))
                        yield self.events[-1]

    def memory_mb(self) -> float:
        for line in Path(f"/proc/{self._process.pid}/status").read_text().splitlines():
            if line.startswith("VmRSS"):
                return float(line.split()[1]) / 1024.0
        return float("nan")  # the process has ended

    def end(self) -> int:
        self._process.send_signal(signal.SIGTERM)
        return self._process.wait(60)


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """Content that no reader accepts as observations: truncated, or with bytes that are no text."""
    at = int(rng.integers(0, len(content) // 2))
    return content[:at] if rng.random() < 0.5 else content[:at] + b"\xff\x00{" + content[at + 9 :]


def contents(folder: Path) -> dict[str, list[bytes]]:
    """Files of observations for each place of the camera."""
    files: dict[str, list[bytes]] = {}
    for place, pose in PLACES.items():
        files[place] = []
        for seed in range(KINDS):
            seen(pose, DAY, 5000 + seed).observations.save(folder / "one.json")
            files[place].append((folder / "one.json").read_bytes())
    return files


def week(folder: Path, files: int) -> Iterator[tuple[str, float, float]]:
    """Each figure with its upper limit."""
    rng, given = np.random.default_rng(1), contents(folder)
    watch = Watch(folder)
    dropped: list[DroppedFile] = []
    memory, lost, places, full = [], set(), list(PLACES), False
    for first in range(0, files, HEAP):
        place = places[first // MOVE_EVERY % len(places)]
        heap = [DroppedFile(f"{first + n:07d}.json", bool(rng.random() >= DAMAGED), place) for n in range(HEAP)]
        away, full = passes(first, AWAY_EVERY), passes(first, FULL_EVERY)
        if away:
            watch.rename(away=True)
        watch.full(full=full)
        for one in heap:
            content = given[place][int(rng.integers(0, KINDS))]
            watch.drop(one.name, content if one.good else damaged(content, rng))
        if away or full:
            time.sleep(0.5)
        if away:
            watch.rename(away=False)
        if full:
            watch.full(full=False)
        lost |= watch.wait_for([one.name for one in heap])
        for one in heap:
            (watch.incoming / one.name).unlink()
        dropped += heap
        memory.append(watch.memory_mb())
    code = watch.end()
    yield "files that were lost", len(lost), 0
    yield from figures(watch, dropped)
    tenth = max(1, len(memory) // 10)
    yield "memory at the end over that of the first tenth", max(memory[-tenth:]) / max(memory[:tenth]), FLAT
    yield "exit code after SIGTERM", code, 0
    last = check(Calibration.load(watch.calibration), seen(PLACES[dropped[-1].place], DAY, 9).observations)
    yield "the calibration does not hold at the end", not last.holds, 0


def passes(first: int, every: int) -> bool:
    """Whether this heap contains a multiple of `every`."""
    return first > 0 and first // every != (first - HEAP) // every


def figures(watch: Watch, dropped: Sequence[DroppedFile]) -> Iterator[tuple[str, float, float]]:
    """Figures of the files from the log."""
    of_files = [event for event in watch.events if "file" in event]
    times = Counter(Path(str(event["file"])).name for event in of_files)
    kinds = {Path(str(event["file"])).name: str(event["event"]) for event in of_files}
    yield "files handled more than once", sum(count > 1 for count in times.values()), 0
    yield "good files taken for unreadable", sum(one.good and kinds.get(one.name) == "unreadable" for one in dropped), 0
    wrong = sum(not one.good and kinds.get(one.name, "unreadable") != "unreadable" for one in dropped)
    yield "damaged files that were used", wrong, 0
    yield "events that nobody expects", sum("unexpected" in str(event.get("reason", "")) for event in of_files), 0
    moves = sum(a.place != b.place for a, b in pairwise(dropped))
    refits = Counter(kinds.values())["refitted"]
    yield f"refits that are not one of {moves} moves", abs(refits - moves), max(1.0, 0.01 * len(dropped) / 720)


def rows(runs: int) -> Iterator[Row]:
    """The figures for so many files."""
    with tempfile.TemporaryDirectory() as folder:
        for what, value, most in week(Path(folder), runs):
            yield Row("week", what, float(value), most=most)


main = script({"week": rows}, __doc__, (20_000, "files"))
