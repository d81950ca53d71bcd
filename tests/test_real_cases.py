"""Inputs that once ended badly: its README says what is right of each file of `cases` in the folder of real data."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ceres_cal.calibrating import calibrate
from ceres_cal.model.parameters import Options
from ceres_cal.model.structure import Tolerance
from ceres_cal.moves import score
from ceres_cal.observations import Observations, Prior


@pytest.fixture(scope="session")
def case(real_data: Path) -> Callable[[str], Path]:
    """Where a case lies, by the name of its file."""

    def place(name: str) -> Path:
        path = real_data / "cases" / name
        if not path.is_file():
            pytest.skip(f"{path} is not there")
        return path

    return place


def test_two_cameras_above_know_neither_phi_nor_height(case: Callable[[str], Path]) -> None:
    calibration = calibrate(Observations.load(case("two_cameras_above.json")))
    known = calibration.uncertainty
    for name in calibration.stations:
        camera = calibration.estimate.stations[name].camera
        assert known.verdict("camera", camera, "phi").verdict != "known"
        assert known.verdict("station", name, "height").verdict != "known"
        assert known.map_sd_mm(name).mean_mm < 5.0  # 3 measured


def test_lens_none_field_keeps_its_stated_height(case: Callable[[str], Path]) -> None:
    prior = Prior("station", "camera", "height_m", (5.0,), (0.02,))
    calibration = calibrate(Observations.load(case("lens_none_field.json")), Options(lens="radial", priors=(prior,)))
    assert calibration.uncertainty.verdict("station", "camera", "height").sd <= 0.02 * (1.0 + 1e-9)  # 1.049 before
    assert 0.1 < calibration.uncertainty.map_sd_mm().mean_mm < 0.5  # 0.18 measured, 97 before; 0.25 off


def test_stereo_left_is_solved_as_built(case: Callable[[str], Path]) -> None:
    calibration = calibrate(Observations.load(case("stereo_left.json")), Options(as_built="estimate"))
    assert calibration.as_built and calibration.fit.points_rms_px < 0.09  # 0.076 measured
    assert np.all(np.isfinite(calibration.uncertainty.posterior.sd))


def test_stereo_left_b_is_scored_by_a_warped_board(case: Callable[[str], Path]) -> None:
    options = Options(tolerances={"board": Tolerance(warp_m=0.002)})
    calibration = calibrate(Observations.load(case("stereo_left_a.json")), options)
    scored = score(calibration, Observations.load(case("stereo_left_b.json")))
    assert scored.fit.points_rms_px < 0.14  # 0.125 measured; 0.113 of the other half
    assert scored.noise_ratios[0] == pytest.approx(1.0, abs=0.2)  # 1.10 measured
