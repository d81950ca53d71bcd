"""ceres-cal, called as in docs/python.md: Observations of the corners, and calibrate with defaults or with a lens."""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from benchmarks.peers import Array, Corners

from beside.peer_fit import PeerFit
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main as run
from ceres_cal.moves.scores import sights_as_built
from ceres_cal.observations import NO_CURVES, Observations, Points, View
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.quantities import camera_moved, values_of
from ceres_cal.scene.targets import checkerboard


def observations_of(corners: Corners) -> Observations:
    """The corners as our observations; no sigma is stated, as for the other peers."""
    columns, rows = corners.grid.tolist()
    width, height = corners.image_size.tolist()
    views = tuple(View(f"{n:05d}", "camera", "camera", "board", f"{n:05d}") for n in range(corners.frames))
    points = Points(corners.view, corners.feature, corners.pixels, np.ones(len(corners.view)))
    board = {"board": checkerboard(columns, rows, float(corners.square_m))}
    return Observations(board, {"camera": (width, height)}, views, points, NO_CURVES)


def _fit(options: Options, corners: Corners) -> PeerFit:
    observations = observations_of(corners)
    start = time.perf_counter()
    calibration = calibrate(observations, options)
    return fitted_of(calibration, corners, time.perf_counter() - start)


def fitted_of(calibration: Calibration, corners: Corners, seconds: float) -> PeerFit:
    posterior = calibration.uncertainty.posterior
    keys = [key for key in posterior.keys if key.kind == "camera"]
    at = [posterior.keys.index(key) for key in keys]
    quantities = [key.quantity for key in keys]
    camera = calibration.estimate.cameras["camera"]
    start = np.asarray(values_of(calibration.estimate, keys), dtype=float)
    covariance = np.asarray(posterior.covariance[np.ix_(at, at)])

    def project(places: Array, values: Array) -> Array:
        moved = camera_moved(camera, quantities, values - start) if np.any(values != start) else camera
        return np.asarray(moved.at(Pose.identity()).project(places))

    return PeerFit(
        tuple(quantities), start, project, _board(calibration, corners), calibration.fit.point_scale,
        np.sqrt(np.diag(covariance)), covariance, taken_out=len(calibration.rejected), seconds=seconds,
    )  # fmt: skip


def _board(calibration: Calibration, corners: Corners) -> Array:
    """Places of the corners on the board as built."""
    count = len(corners.board)
    one = Corners(
        corners.image_size, corners.grid, corners.square_m, np.zeros(count, np.int32), np.arange(count, dtype=np.int32),
        np.zeros((count, 2)),
    )  # fmt: skip
    return np.asarray(sights_as_built(observations_of(one), calibration).points)


def _audited(corners: Corners) -> PeerFit:
    """The two commands `calibrate` and `diagnose`, with their output."""
    with tempfile.TemporaryDirectory() as name:
        given, found = Path(name) / "observations.json", Path(name) / "calibration.json"
        observations_of(corners).save(given)
        printed = io.StringIO()
        start = time.perf_counter()
        with redirect_stdout(printed), redirect_stderr(printed):
            code = run(["calibrate", str(given), "-o", str(found)])
        if not found.exists():
            raise RuntimeError(printed.getvalue().strip()[-400:] or f"exit code {code}")
        seconds = time.perf_counter() - start
        with redirect_stdout(printed), redirect_stderr(printed):
            run(["diagnose", str(found), str(given)])
        fitted = fitted_of(Calibration.load(found), corners, seconds)
    return replace(fitted, said=tuple(_sentences(printed.getvalue())))


def _sentences(printed: str) -> Iterator[str]:
    """The sentences of the output that report a problem, each on one line."""
    lines: list[str] = []
    for line in printed.splitlines():
        if line.startswith(" ") and lines:
            lines[-1] += " " + line.strip()
        else:
            lines.append(line)
    quiet = ("read", "fit", "lens", "camera", "station", "stopped", "written", "noise", "frames", "features", "radius",
             "regions", "leverage", "outliers", "located")  # fmt: skip
    yield from (line for line in lines if line and not line.startswith(quiet))


SETTINGS: dict[str, Callable[[Corners], PeerFit]] = {
    "default": partial(_fit, Options()),
    "as drawn": partial(_fit, Options(as_built="as drawn")),
    "radial 2,3": partial(_fit, Options(lens="radial")),
    "brown": partial(_fit, Options(lens="brown")),
    "kannala-brandt": partial(_fit, Options(lens="kannala-brandt")),
    "spline": partial(_fit, Options(lens="spline")),
    "brown, free aspect": partial(_fit, Options(lens="brown", free_aspect=True)),
    "audit": _audited,
}
