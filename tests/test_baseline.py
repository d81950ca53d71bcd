"""The paper's four-point method: exact without noise; with noise the bundle adjustment is better."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import RADIAL, SCENES

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import DegenerateError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations, Prior, combine
from ceres_cal.problem.parameters import Options
from ceres_cal.simulate import built_in_scene, simulate

DATA = Path(__file__).parents[1] / "data" / "field_2004"


def places() -> Array:
    x, y = np.meshgrid(np.linspace(-2.4, 0.0, 13), np.linspace(-1.5, 1.5, 13))
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def test_exact_with_the_lens_given() -> None:
    scene = SCENES["radial-2-3/corners"]()
    (camera,) = scene.cameras.values()
    fixed = {"phi": camera.phi, "cx": camera.principal_point[0], "cy": camera.principal_point[1]}
    options = Options(lens="radial", fixed={**fixed, **camera.lens.coefficients}, closed_form_only=True)
    calibration = calibrate(simulate(scene).observations, options)
    assert calibration.station().position == pytest.approx(scene.camera_at("overhead").position, abs=1e-9)
    assert calibration.rounds == 0 and not calibration.converged


def test_bundle_beats_it_on_the_papers_own_camera() -> None:
    observations = combine([Observations.load(DATA / f"{name}.json") for name in ("rings", "field")])
    scene, _ = built_in_scene("field-2004")
    truth = scene.camera_at("overhead")
    pixels = truth.project(places())
    baseline = calibrate(
        observations, Options(lens="radial", fixed={"phi": truth.phi}, closed_form_only=True)
    ).station()
    height = Prior("station", "overhead", "height_m", (2.5,), (0.005,))
    bundle = calibrate(observations, Options(lens="radial", priors=(height,))).station()
    errors_mm = [
        1e3 * float(np.mean(np.linalg.norm(camera.locate(pixels) - places()[:, :2], axis=1)))
        for camera in (baseline, bundle)
    ]
    assert errors_mm[0] < 8.0  # 3.6
    assert errors_mm[1] < 0.5  # 0.3


def test_needs_four_points_of_the_floor() -> None:
    observations = simulate(SCENES["radial-2-3/lines"]()).observations
    with pytest.raises(DegenerateError, match="needs four points of the floor, not 0"):
        calibrate(observations, replace(RADIAL, closed_form_only=True))
