"""The whole calibration: truth from noise-free scenes, robustness, what must not matter, priors, failures."""

from __future__ import annotations

import signal
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import SCENES
from scipy.optimize import least_squares

from ceres_cal.bundle import Progress
from ceres_cal.calibrate import calibrate
from ceres_cal.calibration import Calibration
from ceres_cal.camera import Camera
from ceres_cal.errors import CalibrationError, DegenerateError, InputError, SolutionError
from ceres_cal.lens import Radial
from ceres_cal.observations import Curves, Observations, Points, Prior, View, combine
from ceres_cal.parameters import Options, intrinsic_names, intrinsics_scales, intrinsics_vector, with_intrinsics
from ceres_cal.simulate import (
    CLEAN,
    Disturbance,
    Scene,
    Simulation,
    Station,
    board_scene,
    built_in_scene,
    field_scene,
    overhead_pose,
    simulate,
)
from ceres_cal.targets import Arc, Segment, Target, along_track, checkerboard, custom, ssl_field
from ceres_cal.transforms import Array, Pose, rotation_exp, rotation_log

ROOT = Path(__file__).resolve().parents[1]
NOISE = Disturbance(points_sigma_px=0.3, curves_sigma_px=0.3)
WORKDAY = replace(NOISE, outliers=0.05, wrong_labels=0.03)
PLAIN: dict[str, Any] = {"loss": "trivial", "noise_scale": "stated", "reject_sigma": 1e9}
"""Least squares and nothing else."""


def options_for(scene: Scene, **more: Any) -> Options:
    lens = next(iter(scene.cameras.values())).lens
    return Options(lens=lens.kind, powers=getattr(lens, "powers", (2, 3)), **more)


@cache
def observed(name: str, disturbance: Disturbance = NOISE, seed: int = 0) -> Simulation:
    return simulate(SCENES[name](), disturbance, seed)


def error_of(found: Camera, truth: Camera) -> float:
    """Largest relative error of the intrinsics: principal point relative to phi, coefficients to their own size."""
    numbers = np.subtract((found.phi, found.aspect * truth.phi, *found.principal_point), 0.0)
    truths = np.array([truth.phi, truth.aspect * truth.phi, *truth.principal_point])
    lens = np.divide(found.lens.values, truth.lens.values) - 1.0
    return float(max(np.max(np.abs(numbers - truths)) / truth.phi, np.max(np.abs(lens))))


def error_of_pose(found: Pose, truth: Pose) -> float:
    """The larger of the angle between two poses (rad) and the distance of their positions, relative to its size."""
    away = np.linalg.norm(found.position - truth.position) / max(1.0, float(np.linalg.norm(truth.position)))
    return float(max(away, np.linalg.norm(rotation_log(found.rotation @ truth.rotation.T))))


# ---- noise-free scenes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_noise_free_scenes_return_the_truth(name: str) -> None:
    """From a cold start, to 1e-6 relative; boards alone are placed before their camera, whose frame is the world."""
    scene = SCENES[name]()
    simulation = observed(name, Disturbance())
    calibration = calibrate(simulation.observations, options_for(scene))
    for camera, truth in scene.cameras.items():
        assert error_of(calibration.cameras[camera], truth) < 1e-6  # 5e-8 measured (a coefficient), phi 1e-10
    for station, place in scene.stations.items():
        assert error_of_pose(calibration.stations[station].cam_from_world, place.cam_from_world) < 1e-6  # 2e-11
    for placement, world_from_target in scene.placements.items():
        found = calibration.placements[placement]
        if placement == "rings":  # nothing tells how far a sheet of circles is turned about its middle
            assert np.max(np.abs(found.translation - world_from_target.translation)) < 1e-6  # 4e-12 measured
            assert np.max(np.abs(found.rotation[:, 2] - world_from_target.rotation[:, 2])) < 1e-6
        else:
            assert error_of_pose(found.inverse, world_from_target.inverse) < 1e-6  # 4e-12 measured
    assert calibration.rejected == ()
    assert calibration.rms_px < 1e-6  # 4e-10 measured
    assert calibration.warnings == ()


# ---- robustness -----------------------------------------------------------------------------------------------------


def camera_before(simulation: Simulation, view: View) -> Camera:
    """The true camera of a view, in the frame of its target."""
    scene = simulation.scene
    pose = scene.stations[view.station].cam_from_world
    return scene.cameras[view.camera].at(pose if view.placement is None else pose @ scene.placements[view.placement])


def deviations_px(simulation: Simulation) -> tuple[Array, Array]:
    """How far each point and curve observation lies from what it is named, as the true camera sees it.

    Curves by a dense walk along the projected line or circle: good to 0.1 px.
    """
    observations = simulation.observations
    points, curves = np.empty(len(observations.points)), np.empty(len(observations.curves))
    for number, view in enumerate(observations.views):
        camera, target = camera_before(simulation, view), observations.targets[view.target]
        rows = np.flatnonzero(observations.points.view == number)
        seen = camera.project(target.point_array[observations.points.feature[rows]])
        points[rows] = np.nan_to_num(np.linalg.norm(seen - observations.points.pixels[rows], axis=1), nan=np.inf)
        for row in np.flatnonzero(observations.curves.view == number):
            feature, side = observations.curves.feature[row], observations.curves.side[row]
            seen = _walk(camera, target, int(feature), int(side))
            curves[row] = np.min(np.linalg.norm(seen - observations.curves.pixels[row], axis=1))
    return points, curves


_WALKS: dict[Any, Array] = {}


def _walk(camera: Camera, target: Target, feature: int, side: int) -> Array:
    key = (id(camera.cam_from_world), id(target), feature, side)
    if key not in _WALKS:
        is_arc = bool(target.is_arc[feature])
        low, high = list(target.curves.values())[feature].parameter_range
        beyond = 0.0 if is_arc else 0.3 * (high - low)
        s = np.linspace(low - beyond, high + beyond, 3000)
        seen = camera.project(along_track(target.tracks[side, feature], is_arc, s))
        _WALKS[key] = seen[np.isfinite(seen[:, 0])]
    return _WALKS[key]
