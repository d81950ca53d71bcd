"""Writers that are killed, and disks that are full: python scripts/run.py faults [--help]

A process that saves two calibrations in turns is killed at a random moment, or may write only so many bytes. Counted
are files that are neither of the two, and files that are left beside it after the next save. Exits with 1 where there
is one.
"""

from __future__ import annotations

import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from runner import Row, script

WRITER = """
import sys
from pathlib import Path
from ceres_cal.base.files import write_bytes
contents = [Path(name).read_bytes() for name in sys.argv[1:3]]
print("ready", flush=True)
while True:
    for content in contents:
        write_bytes(sys.argv[3], content)
"""


def fault(folder: Path, rng: random.Random, full: bool) -> None:
    """Start the writer, and end it in one of the two ways."""
    largest = rng.randrange(0, 400_000)

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)  # then writing fails like on a full disk
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

    names = [str(folder / name) for name in ("a.json", "b.json")]
    command = [sys.executable, "-c", WRITER, *names, str(folder / "out" / "calibration.json")]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, preexec_fn=limit if full else None
    )
    assert process.stdout is not None
    process.stdout.readline()
    time.sleep(rng.uniform(0.0, 0.05))
    process.kill()
    process.communicate()


def bad_after(folder: Path, rng: random.Random, full: bool) -> tuple[int, int]:
    """Whether the file is incomplete, and the number of files left beside it after one more save."""
    from ceres_cal.base.files import write_bytes

    whole = [(folder / name).read_bytes() for name in ("a.json", "b.json")]
    place = folder / "out" / "calibration.json"
    fault(folder, rng, full)
    half = place.exists() and place.read_bytes() not in whole
    write_bytes(place, whole[0])
    return int(half), len(list(place.parent.iterdir())) - 1


def rows(what: str, full: bool, runs: int) -> Iterator[Row]:
    """The figures of so many faults of one kind."""
    rng = random.Random(0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "out").mkdir()
        for number, letter in enumerate("ab"):
            (folder / f"{letter}.json").write_bytes(rng.randbytes(200_000 + 100_000 * number))
        half, stale = (sum(parts) for parts in zip(*(bad_after(folder, rng, full) for _ in range(runs)), strict=True))
    yield Row(what, "half files", half, most=0.0, note=f"{runs} {what}")
    yield Row(what, "stale files after the next save", stale, most=0.0)


_cases = {what: partial(rows, what, full) for what, full in (("kills", False), ("full disks", True))}
main = script(_cases, __doc__, (200, "of each kind"))
