"""The noise scale describes the rows that are kept, also where the noise has tails; outliers do not widen it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from accuracy.diagnostic_scenes import held_boards
from scenes import RADIAL

from ceres_cal.base.arrays import Array
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations
from ceres_cal.scene.lens import Radial
from ceres_cal.simulate import Disturbance, simulate

UNKNOWNS = 5 + 6 * 13


@cache
def exact() -> Observations:
    return simulate(held_boards(Radial((-5.2e-5, 6.1e-7), (2, 3)), count=13), Disturbance(), 0).observations


def calibrated(noise_px: Array) -> Calibration:
    points = exact().points
    pixels = np.clip(points.pixels + noise_px, 0.0, (1279.0, 959.0))
    return calibrate(replace(exact(), points=replace(points, pixels=pixels)), RADIAL)


@pytest.mark.parametrize("degrees", [np.inf, 5.0, 3.0, 2.0])
def test_scale_is_that_of_the_rows_kept(degrees: float) -> None:
    """Student's t: with two degrees of freedom 3 % of the rows are taken out, and the others were 6 % above it."""
    for seed in range(3):
        rng, shape = np.random.default_rng(seed), exact().points.pixels.shape
        noise = rng.standard_normal(shape) if np.isinf(degrees) else rng.standard_t(degrees, shape)
        fit = calibrated(0.3 * noise).fit
        spare = 1.0 - UNKNOWNS / (2.0 * fit.points)
        kept = fit.points_rms_px / np.sqrt(2.0 * spare)
        assert fit.point_scale == pytest.approx(kept, rel=0.01)  # 0.004 measured; 0.06 by the first scale alone


def test_scale_is_not_that_of_outliers() -> None:
    rng, shape = np.random.default_rng(5), exact().points.pixels.shape
    noise = 0.3 * rng.standard_normal(shape)
    gross = rng.random(len(noise)) < 0.2
    noise[gross] += 20.0 * rng.standard_normal((np.count_nonzero(gross), 2))
    fit = calibrated(noise).fit
    assert fit.point_scale == pytest.approx(0.3, rel=0.08)  # 0.31 measured
