"""Writers that are killed, and disks that are full: python scripts/faults.py [--kills N] [--full N]

A process that saves one of two calibrations in turn is killed at a random moment, or may write so many bytes only.
Counted: a file that is neither of the two, and what is left beside it after the next save. Exits with 1 when there is.
"""

from __future__ import annotations

import argparse
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

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
    """Start the writer; end it in one way or the other."""
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
    """Whether the file is half, and how many are left beside it when it has been saved once more."""
    from ceres_cal.base.files import write_bytes

    whole = [(folder / name).read_bytes() for name in ("a.json", "b.json")]
    place = folder / "out" / "calibration.json"
    fault(folder, rng, full)
    half = place.exists() and place.read_bytes() not in whole
    write_bytes(place, whole[0])
    return int(half), len(list(place.parent.iterdir())) - 1


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--full", type=int, default=200)
    given, rng = parser.parse_args(arguments), random.Random(0)
    total = 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "out").mkdir()
        for number, letter in enumerate("ab"):
            (folder / f"{letter}.json").write_bytes(rng.randbytes(200_000 + 100_000 * number))
        for what, count, full in (("kills", given.kills, False), ("full disks", given.full, True)):
            half, stale = (
                sum(parts) for parts in zip(*(bad_after(folder, rng, full) for _ in range(count)), strict=True)
            )
            print(f"{count} {what}: {half} half files, {stale} stale files after the next save", flush=True)
            total += half + stale
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
