"""How often `audit` finds a planted fault in a foreign calibration, and how often it reports one in a sound one.

Each run calibrates a camera above a field, exports it to OpenCV, reads the file back, with a fault or without, and
audits it with a second set of as many observations. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from runner import Row, over, script, share_error
from scenery import field_scene, overhead_pose

from ceres_cal import CalibrationError, Camera, Options, audit, calibrate
from ceres_cal.base.transforms import Pose
from ceres_cal.formats import export, import_calibration
from ceres_cal.formats.format import calibration_of
from ceres_cal.moves.audits import resized
from ceres_cal.scene.lens import Brown
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, simulate

NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3, outliers=0.01)
FREE = Options(lens="brown", free_aspect=True)


def scene_of(camera: Camera) -> Scene:
    stations = {"overhead": Station("overhead", camera.cam_from_world)}
    return field_scene(ssl_field("B"), {"overhead": camera.at(Pose.identity())}, stations, spacing_m=0.15)


def drawn(seed: int) -> Camera:
    """A camera that sees a division B field, tilted by 8 to 16 degrees, with pixels that are not square."""
    draw = np.random.default_rng(seed)
    lens = Brown((draw.uniform(-0.16, -0.09), draw.uniform(0.02, 0.05), *draw.uniform(-5e-4, 5e-4, 2), -0.002))
    turn, height_m = draw.uniform(-1.0, 1.0, 2), draw.uniform(4.8, 5.4)
    tilt = draw.uniform(8.0, 16.0) * turn / np.linalg.norm(turn)
    place = np.tan(np.radians(tilt)) * height_m
    pose = overhead_pose(-place[1], place[0], height_m, float(tilt[0]), float(tilt[1]), draw.uniform(-5.0, 5.0))
    aspect = float(draw.choice([0.99, 1.01]))
    centre = (639.5 + draw.uniform(-15, 15), 479.5 + draw.uniform(-15, 15))
    return Camera((1280, 960), draw.uniform(800.0, 850.0), centre, lens, aspect, pose)


def knocked(camera: Camera, seed: int) -> Camera:
    """Turned by 0.1 to 0.5 degrees."""
    draw = np.random.default_rng(seed)
    turn = np.radians(draw.uniform(0.1, 0.5)) * (axis := draw.normal(size=3)) / np.linalg.norm(axis)
    return camera.at(Pose.exp((*turn, 0.0, 0.0, 0.0)) @ camera.cam_from_world)


FAULTS: dict[str, Callable[[Camera], Camera]] = {
    "another image size": lambda c: resized(c, 0.5, (640, 480)),
    "half a pixel": lambda c: replace(c, principal_point=(c.principal_point[0] + 0.5, c.principal_point[1] + 0.5)),
    "swapped focal lengths": lambda c: replace(c, phi=c.phi * c.aspect, aspect=1.0 / c.aspect),
    "another unit": lambda c: c.at(Pose(c.cam_from_world.rotation, 1e3 * c.cam_from_world.translation)),
    "another focal length": lambda c: replace(c, phi=1.002 * c.phi),
    "moved": lambda c: c,
    "too few coefficients": lambda c: c,
}


def one_run(seed: int, fault: str | None, folder: Path) -> str | None:
    """The cause that `audit` names; None where it finds none."""
    true = drawn(seed)
    scene = scene_of(true)
    few = dict.fromkeys(("k2", "p1", "p2", "k3"), 0.0) if fault == "too few coefficients" else {}
    options = replace(FREE, fixed=few)
    try:
        first = calibrate(simulate(scene, NOISE, seed=2 * seed).observations, options)
    except CalibrationError:  # for example a lens that folds: there is no calibration to plant a fault in
        return one_run(seed + 100_000, fault, folder)
    faulty = FAULTS[fault](first.station()) if fault else first.station()
    written = calibration_of("this script", {"overhead": faulty}, first.targets)
    path = folder / f"camera-{seed}.yml"
    export(written, "opencv", path)
    given = import_calibration(path)
    there = scene_of(knocked(true, seed)) if fault == "moved" else scene
    seen = simulate(there, NOISE, seed=2 * seed + 1).observations
    return audit(given, seen)["overhead"].cause


def _causes(first: int, runs: int, fault: str | None) -> list[str | None]:
    with tempfile.TemporaryDirectory() as name:
        return list(over(partial(one_run, fault=fault, folder=Path(name)), range(first, first + runs)))


def fault_rows(fault: str, runs: int) -> Iterator[Row]:
    """Share of the calibrations with this fault in which it is found, and in which it is named correctly."""
    causes = _causes(1000, runs, fault)
    yield Row(fault, "found, share", float(np.mean([cause is not None for cause in causes])), least=1.0)
    named = causes.count(fault) / runs
    yield Row(fault, "found by its name, share", named, share_error(named, runs), least=0.95)


def sound_rows(runs: int) -> Iterator[Row]:
    """False alarms in as many sound calibrations as there are faulty ones of all kinds."""
    runs *= len(FAULTS)
    alarms = sum(cause is not None for cause in _causes(5000, runs, None))
    yield Row("sound", "false alarms", alarms, np.sqrt(max(alarms, 1)), most=0.01 * runs, note=f"{runs} calibrations")


_cases = {fault: partial(fault_rows, fault) for fault in FAULTS}
main = script({**_cases, "sound": sound_rows}, __doc__, (20, "calibrations with each fault"))
