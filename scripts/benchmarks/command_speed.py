"""Time of every command on the sample, as a whole process: python scripts/run.py command_speed [--help]

Processor time of all threads, imports included, median of --runs. Elapsed time is shorter where two cores are used, and
longer where other processes use them. Printed as the table of docs/speed.md. Exits with 1 where a command fails.
"""

from __future__ import annotations

import argparse
import resource
import shlex
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from statistics import median

from data.documents import prepare

HOME, MOVED = "data/ssl_field", "data/ssl_field_moved"
FACING = "--target ssl-b --auto --facing LeftGoalLine=top"
COMMANDS = (
    "--help",
    f"calibrate {HOME}/observations.json -o calibration.json",
    f"calibrate {HOME}/observations.json --report report.html",
    f"diagnose calibration.json {HOME}/observations.json",
    "advise calibration.json",
    "locate calibration.json 640,480",
    "export calibration.json --to vision-processor -o geometry.yml",
    "export calibration.json --to table -o table.npz",
    f"detect board {HOME}/photographs/board_*.jpg --columns 9 --rows 6 --square 0.1 -o board.json",
    f"detect field {HOME}/photographs/000*.jpg {FACING} -o field.json",
    "calibrate field.json board.json -o camera.json --lens auto",
    f"check camera.json {MOVED}/photographs/0001.jpg || true",
    f"refit camera.json {MOVED}/photographs/0001.jpg -o moved.json",
    "compare camera.json moved.json --picture moved.svg",
    f"undistort camera.json {HOME}/photographs/0001.jpg -o straight",
    f"undistort camera.json {HOME}/photographs/0001.jpg -o top --top-view",
    "simulate ssl-field -o try",
)


def processor_s(command: str, folder: Path) -> float:
    """Processor time of one run, s."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    line = f"source .venv/bin/activate; ceres-cal {command}"
    done = subprocess.run(["bash", "-c", line], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"ceres-cal {command}: {done.stderr.strip()}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--runs", type=int, default=5, help="of each command; default: 5")
    runs = max(parser.parse_args(arguments).runs, 1)
    print("| `ceres-cal ...` | s of processor |\n|---|---|")
    with tempfile.TemporaryDirectory() as name:
        folder = prepare(Path(name))
        for command in COMMANDS:
            shown = shlex.join(part for part in shlex.split(command.partition(" ||")[0]))
            times = [processor_s(command, folder) for _ in range(runs)]
            print(f"| `{shown.replace(chr(39), '')}` | {median(times):.2g} |", flush=True)
    return 0
