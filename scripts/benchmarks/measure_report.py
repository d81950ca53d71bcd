"""Size of the report for 100 000 observations, and time of `calibrate --report` as a whole process.

Run: python scripts/run.py measure_report [--help]. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from runner import Row, script
from scenery import board_scene, field_scene, overhead_pose

from ceres_cal import Camera, Observations, Pose
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, Station, simulate

MOST_SECONDS, MOST_MB = 15.0, 3.0
_CAMERA = Camera((1280, 960), 868.0, (651.3, 468.9), Radial((-5.2e-5, 6.1e-7)))
_NOISE = Disturbance(0.5, 0.3, outliers=0.05, wrong_labels=0.01)


def of_a_field() -> Observations:
    """Lines and arcs of a field, seen by one tilted camera."""
    stations = {"overhead": Station("overhead", overhead_pose(-0.5, -1.2, 5.2, tilt_x_deg=-14.0, tilt_y_deg=-11.5))}
    scene = field_scene(ssl_field("B"), {"overhead": _CAMERA}, stations, frames=90, spacing_m=0.04)
    return simulate(scene, _NOISE, 1).observations


def of_boards() -> Observations:
    """A thousand boards with a hundred corners each."""
    stations = {"camera": Station("camera", Pose.identity())}
    scene = board_scene(checkerboard(10, 10, 0.05), {"camera": _CAMERA}, stations, count=1000, seed=3)
    return simulate(scene, _NOISE, 1).observations


SETS: dict[str, Callable[[], Observations]] = {"field": of_a_field, "boards": of_boards}


def measured(observations: Observations, runs: int) -> tuple[float, float]:
    """MB of the page, and the shortest time of some runs in seconds."""
    with tempfile.TemporaryDirectory() as folder:
        source, page = Path(folder) / "observations.npz", Path(folder) / "page.html"
        observations.save(source)
        code = "from ceres_cal.cli import main; raise SystemExit(main())"
        command = [sys.executable, "-c", code, "calibrate", str(source), "--report", str(page), "--quiet"]
        taken = []
        for _ in range(runs):
            start = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            taken.append(time.perf_counter() - start)
        return page.stat().st_size / 1e6, min(taken)


def rows(name: str, runs: int) -> Iterator[Row]:
    """The figures for one set of observations."""
    observations = SETS[name]()
    size_mb, seconds = measured(observations, runs)
    count = len(observations.points) + len(observations.curves)
    yield Row(name, "calibrate --report, whole process, s", seconds, most=MOST_SECONDS, note=f"{count} observations")
    yield Row(name, "its page, MB", size_mb, most=MOST_MB)


main = script({name: partial(rows, name) for name in SETS}, __doc__, (3, "runs, of which the fastest counts"))
