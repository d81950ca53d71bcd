"""Cost of a calibration in a script: whole processes, ours and OpenCV's in turns. Run benchmark.py --process.

Ours is `ceres-cal calibrate`, with all its output and the calibration written. OpenCV's is a Python process that reads
the same corners, calls calibrateCamera and ends. On the sample OpenCV has only the boards, since it takes no lines.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.peers import Corners
from benchmarks.problems import corner_observations, wide_lens
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import gather_sights

SAMPLE = Path(__file__).parents[2] / "data" / "ssl_field" / "observations.json"
FRAMES = (20, 100, 1000)
_ALWAYS_COMPILED, OURS_ALONE = "PYTHONDONTWRITEBYTECODE", "OPENBLAS_THREAD_TIMEOUT"
_OURS = "import sys; from ceres_cal.cli import main; sys.exit(main())"
_OPENCV = """
import sys, cv2, numpy as np
with np.load(sys.argv[1]) as archive:
    views, places, pixels, size = (archive[name] for name in ("views", "places", "pixels", "size"))
cuts = np.flatnonzero(np.diff(views)) + 1
objects, images = np.split(places, cuts), np.split(pixels, cuts)
cv2.calibrateCamera(objects, images, tuple(size.tolist()), None, None)
"""


@dataclass(frozen=True)
class Cost:
    """Elapsed seconds of one process, processor seconds of all its threads, and its exit code."""

    wall: float
    processor: float
    code: int = 0


def command_of(*arguments: str) -> list[str]:
    """The command line of `ceres-cal`."""
    return [sys.executable, "-c", _OURS, *arguments]


def spent(command: Sequence[str], codes: Sequence[int] = (0,)) -> Cost:
    """Cost of one run, which must end with one of the codes. Python stores its compiled modules, as for an installed
    package, and the other programs do not inherit the variables that our package sets for its own process.
    """
    variables = {key: value for key, value in os.environ.items() if key not in (_ALWAYS_COMPILED, OURS_ALONE)}
    before, start = os.times(), time.perf_counter()
    done = subprocess.run(command, env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, check=False)
    if done.returncode not in codes:
        raise subprocess.CalledProcessError(done.returncode, command, stderr=done.stderr)
    wall, after = time.perf_counter() - start, os.times()
    processor = after.children_user - before.children_user + after.children_system - before.children_system
    return Cost(wall, processor, done.returncode)


def process_rows(repeat: int) -> list[dict[str, Any]]:
    """The sample, then the wide lens with each number of frames: medians, and the median ratio within each turn."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name, ours, theirs in [_sample(Path(folder)), *(_wide(Path(folder), frames) for frames in FRAMES)]:
            for command in (ours, theirs):
                spent(command)  # so that files are cached
            turns = [(spent(ours), spent(theirs)) for _ in range(repeat)]
            row: dict[str, Any] = {"problem": name}
            for what in ("wall", "processor"):
                pairs = np.array([[getattr(one, what) for one in turn] for turn in turns])
                row[f"ours_{what}"], row[f"opencv_{what}"] = np.median(pairs, axis=0).tolist()
                row[f"times_{what}"] = median((pairs[:, 0] / pairs[:, 1]).tolist())
            rows.append(row)
    return rows


def _commands(path: Path, corners: Path, *options: str) -> tuple[list[str], list[str]]:
    calibrate = ["calibrate", str(path), "--quiet", "--output", str(path.with_suffix(".out.json")), *options]
    return command_of(*calibrate), [sys.executable, "-c", _OPENCV, str(corners)]


def _save(path: Path, views: Any, places: Any, pixels: Any, size: Any) -> None:
    arrays = {"views": views, "places": np.asarray(places, np.float32), "pixels": np.asarray(pixels, np.float32)}
    np.savez(path, size=np.asarray(size), **arrays)


def _sample(folder: Path) -> tuple[str, list[str], list[str]]:
    corners, sights = folder / "sample-corners.npz", gather_sights(Observations.load(SAMPLE))
    boards = [sights[i] for i in np.flatnonzero(np.diff(sights.curve_bounds) == 0).tolist()]
    views = np.repeat(np.arange(len(boards)), [len(board.points) for board in boards])
    places, pixels = (np.vstack([getattr(board, what) for board in boards]) for what in ("points", "pixels"))
    _save(corners, views, places, pixels, (1280, 960))
    path = folder / "sample.json"
    path.write_bytes(SAMPLE.read_bytes())
    return ("the sample", *_commands(path, corners))


def _wide(folder: Path, frames: int) -> tuple[str, list[str], list[str]]:
    found: Corners = wide_lens(frames).corners
    path, corners = folder / f"wide{frames}.npz", folder / f"wide{frames}-corners.npz"
    corner_observations(found).save(path)
    _save(corners, found.view, found.board[found.feature], found.pixels, found.image_size)
    return (f"{frames} frames", *_commands(path, corners, "--lens", "brown", "--free-aspect"))
