"""A refit is diagnosed with the priors with which it was solved."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from accuracy.moves import CAMERA, DAY, MOVED, NOISE, seen
from accuracy.moves import calibrated as calibrated_at_home
from accuracy.scenes import FIELD
from scenery import field_scene
from scenes import side_by_side

from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics import Diagnosis, diagnose
from ceres_cal.moves.refits import refit
from ceres_cal.observations import Observations, taken
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.structure import Tolerance
from ceres_cal.robust.noise import USUAL_EQUATIONS
from ceres_cal.simulate import simulate


def rows_of(observations: Observations, points: np.ndarray, curves: np.ndarray) -> Observations:
    chosen = [
        np.isin(np.arange(len(c)), rows) for c, rows in ((observations.points, points), (observations.curves, curves))
    ]
    return replace(
        observations,
        points=taken(observations.points, chosen[0]),
        curves=taken(observations.curves, chosen[1]),
    )


def four_corners() -> tuple[Calibration, Observations]:
    moved = seen(MOVED, DAY, 1).observations
    spread = np.argsort(np.linalg.norm(moved.points.pixels - moved.points.pixels.mean(axis=0), axis=1))[-4:]
    observed = rows_of(moved, spread, np.empty(0))
    return refit(calibrated_at_home(0), observed), observed


def lines() -> tuple[Calibration, Observations]:
    moved = seen(MOVED, DAY, 1).observations
    observed = rows_of(moved, np.empty(0), np.arange(len(moved.curves)))
    return refit(calibrated_at_home(0), observed), observed


def stations() -> tuple[Calibration, Observations]:
    cameras, there = side_by_side(CAMERA)
    scene = field_scene(FIELD, cameras, there, frames=2, spacing_m=0.15)
    before = calibrate(
        simulate(scene, NOISE, 0).observations, Options(lens="radial", tolerances={"field": Tolerance(lines_m=0.005)})
    )
    observed = simulate(field_scene(FIELD, cameras, there, spacing_m=0.3), NOISE, 5).observations
    return refit(before, observed, moved=["right"]), observed


@pytest.mark.parametrize("scene", [four_corners, lines, stations])
def test_the_diagnosis_of_a_refit_gives_the_fit_s_own_noise(
    scene: Callable[[], tuple[Calibration, Observations]],
) -> None:
    calibration, observations = scene()
    diagnosis = diagnose(calibration, observations)
    assert calibration.posterior is not None
    assert not diagnosis.findings
    scales = {"points": calibration.fit.point_scale, "curves": calibration.fit.curve_scale}
    for noise in diagnosis.noise:
        assert noise.scale == pytest.approx(scales[noise.kind], rel=1e-9)
    assert diagnosis.degrees_of_freedom == pytest.approx(calibration.posterior.degrees_of_freedom, rel=1e-9)
    # Recomputed, observation by observation: the part that the fit absorbed.
    assert redundancy(diagnosis) + USUAL_EQUATIONS == pytest.approx(diagnosis.degrees_of_freedom, rel=0.01)  # 0.003
    leverage = diagnosis.table.leverage[diagnosis.table.inlier]
    assert np.max(leverage) < 0.95


def redundancy(diagnosis: Diagnosis) -> float:
    table = diagnosis.table
    equations = np.where(table.is_curve, 1.0, 2.0)
    return float(np.sum((equations * (1.0 - table.leverage))[table.inlier]))
