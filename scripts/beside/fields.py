"""Fields with lines: the small-size league's with ssl-vision's method, and SoccerNet's with published answers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from accuracy.accuracy import map_errors_mm
from accuracy.bound import make_trial
from accuracy.scenes import SSL_NOISE, SSL_PROBLEMS, SSL_VISION_MM, field_places
from accuracy.soccernet import Pitch, answer, rows
from photos.real_data import real_place
from runner import over

from beside.ssl_vision import SslCamera, calibrated
from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.words import HEIGHTS_M
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.problem.parameters import Options

NOISES = {"noise alone": SSL_NOISE, "5 % of line points far off": replace(SSL_NOISE, outliers=0.05)}
PUBLISHED: Mapping[str, tuple[float, float, float]] = {
    "PnLCalib, from the pictures": (0.970, 0.800, 0.946),
    "No Bells Just Whistles, from the pictures": (0.978, 0.757, 0.930),
}
"""Completeness, JaC@5 and JaC@20 of answers that github.com/mguti97/PnLCalib stores for the same 400 frames."""
_PINHOLE = Options(lens="brown", fixed=dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0), free_principal_point=False)


# ---- the small-size league ------------------------------------------------------------------------------------------


def ssl_rows(runs: int) -> list[dict[str, Any]]:
    """Mean error over the field at each height, median over the seeds, for each scene, noise and method."""
    found = []
    for scene in SSL_PROBLEMS:
        for noise in NOISES:
            every = list(over(_trial, [scene] * runs, [noise] * runs, range(runs)))
            for method in every[0]:
                some = np.array([one[method] for one in every])
                row: dict[str, Any] = {"scene": scene, "noise": noise, "method": method, "runs": runs}
                row["failed"] = int(np.sum(~np.isfinite(some[:, 0])))
                for name, values in zip(("floor_mm", "robot_mm"), np.nanmedian(some, axis=0).tolist(), strict=True):
                    row[name] = values
                found.append(row)
    return [*found, *program_rows()]


def program_rows() -> list[dict[str, Any]]:
    """Errors of ssl-vision's own program, measured earlier and elsewhere (`accuracy.scenes`)."""
    method = "ssl-vision's program, measured earlier"
    noise = next(iter(NOISES))
    return [
        {"scene": scene, "noise": noise, "method": method, "runs": 20, "floor_mm": floor[0], "robot_mm": robot[0]}
        for scene, (floor, robot) in SSL_VISION_MM.items()
    ]


def _trial(scene: str, noise: str, seed: int) -> dict[str, list[float]]:
    problem = SSL_PROBLEMS[scene]()
    trial = make_trial(problem, NOISES[noise], seed)
    (name,) = trial.truth.stations
    truth = trial.truth.camera_at(name)
    places = field_places(half=scene.startswith("half"))
    found: dict[str, list[float]] = {}
    for method, options in (("ceres-cal, by defaults", Options()), ("ceres-cal, the lens named", problem.options)):
        try:
            camera = calibrate(trial.observations, options).station()
            found[method] = [float(np.mean(map_errors_mm(truth, camera, places, h))) for h in HEIGHTS_M]
        except CalibrationError:
            found[method] = [float("nan")] * len(HEIGHTS_M)
    for method, held in (("ssl-vision, height entered as tz", False), ("ssl-vision, the true tz", True)):
        found[method] = _ssl_vision(trial, truth, places, true_tz=held)
    return found


def _ssl_vision(trial: Any, truth: Any, places: Array, *, true_tz: bool) -> list[float]:
    seen, (field,) = trial.observations, trial.observations.targets.values()
    pose = truth.cam_from_world
    (height,) = (prior.value[0] for prior in seen.priors)
    size = np.array(truth.image_size)
    shift = np.array(pose.translation, dtype=float)
    shift[2] = shift[2] if true_tz else height
    start = SslCamera(np.array([truth.phi, *(0.5 * (size - 1.0)), 0.1]), np.array(pose.rotation), shift)
    points, curves = seen.points, seen.curves
    camera = calibrated(start, field, (points.feature, points.pixels), (curves.feature, curves.pixels))
    return [float(np.mean(_errors_mm(truth, camera, places, h))) for h in HEIGHTS_M]


def _errors_mm(truth: Any, camera: SslCamera, places: Array, height_m: float) -> Array:
    pixels = truth.project(np.column_stack([places, np.full(len(places), height_m)]))
    shown = np.all((pixels >= -0.5) & (pixels <= np.array(truth.image_size) - 0.5), axis=1)
    return np.asarray(1e3 * np.linalg.norm(camera.locate(pixels[shown], height_m) - places[shown], axis=1))


# ---- broadcast ------------------------------------------------------------------------------------------------------


def soccernet_rows(runs: int, folder: Path | None = None) -> list[dict[str, Any]]:
    """Ours from the annotated points, with a pinhole and by defaults, and published answers from the pictures."""
    folder = folder or real_place() / "soccernet_lines"
    if not folder.is_dir():
        return []
    pitch = Pitch.load(folder / "pitch.json")
    frames = json.loads((folder / "frames.json").read_text(encoding="utf-8"))
    some = list(frames.items())[:runs]
    found = []
    for name, options in (("a pinhole", _PINHOLE), ("by defaults", Options())):
        answers = list(over(answer, *zip(*some, strict=True), [pitch] * len(some), [options] * len(some)))
        figures = {row.what: row.value for row in rows(answers)}
        found.append(
            {"method": f"ceres-cal, {name}, from the annotated points", "frames": len(some),
             "completeness": figures["completeness"], "jac5": figures["JaC@5 of those answered"],
             "jac20": figures["JaC@20 of those answered"], "final": figures["final score"]}
        )  # fmt: skip
    for name, (completeness, jac5, jac20) in PUBLISHED.items():
        found.append(
            {"method": name, "frames": 400, "completeness": completeness, "jac5": jac5, "jac20": jac20,
             "final": completeness * jac5}
        )  # fmt: skip
    return found
