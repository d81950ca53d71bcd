"""Inputs that once failed: the README in the folder of real data says what is right for each file of `cases`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.moves.scores import score
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.structure import Tolerance
from ceres_cal.report.grounds import judge_quality
from ceres_cal.report.quality import quality_of

HELD = ("--lens", "brown", *(part for name in ("k1", "k2", "k3", "p1", "p2") for part in ("--fix", f"{name}=0")))


@pytest.fixture(scope="session")
def case(real_data: Path) -> Callable[[str], Path]:
    """Path of a case, by the name of its file."""

    def place(name: str) -> Path:
        path = real_data / "cases" / name
        if not path.is_file():
            pytest.skip(f"no such case here: {path} (set CERES_CAL_REAL to a folder that has it)")
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
    assert 0.1 < calibration.uncertainty.map_sd_mm().mean_mm < 1.0  # 0.73 measured, 97 before; 0.25 off


def test_a_wrong_height_is_set_aside(case: Callable[[str], Path]) -> None:
    """It was named, but phi was still reported as 654.8 ± 2.5 px."""
    calibration = calibrate(Observations.load(case("height_wrong.json")))
    assert [one.quantity for one in calibration.conflicts] == ["height"]
    phi, height = (
        calibration.uncertainty.verdict(*key) for key in (("camera", "c", "phi"), ("station", "s", "height"))
    )
    assert phi.value == pytest.approx(820.0, rel=0.04) and phi.low < 655.0 < 820.0 < phi.high  # 794 measured
    assert height.low < 3.36 < 4.2 < height.high


def test_swapped_pixels_of_boards_are_no_reason_for_distrust(case: Callable[[str], Path]) -> None:
    """Other lenses differ in corners that no board reached, which rotated the whole picture: 1114 px of uncertainty."""
    observations = Observations.load(case("swapped.json"))
    calibration = calibrate(observations)
    phi = calibration.uncertainty.verdict("camera", "camera", "phi")
    assert phi.value == pytest.approx(800.0, abs=2.0 * phi.sd) and phi.sd < 3.0
    quality = quality_of(calibration, observations)
    assert quality.observed_px < 8.0 and judge_quality(quality).level != "no"  # 5.5 measured
    (warning,) = calibration.warnings  # the principal point is (479, 638), the centre of a picture of 960 x 1280
    assert "principal point lies 226 px from the middle" in warning and "that x comes before y" in warning


@pytest.mark.parametrize(
    "share, off_px", [(0.0, 74.0), pytest.param(0.0, 8.0, marks=pytest.mark.thorough), (0.2, 20.0)]
)
def test_outliers_do_not_decide_the_lens(case: Callable[[str], Path], share: float, off_px: float) -> None:
    """Lenses are compared with the rows that one robust solve keeps, and by the logarithm of the groups' residuals: one
    stray corner of 408 once led to kannala-brandt k1, with 0.37 px.
    """
    observations, rng = Observations.load(case("stray_corner.json")), np.random.default_rng(5)
    strays = rng.choice(len(observations.points), max(1, int(share * len(observations.points))), replace=False)
    pixels = observations.points.pixels.copy()
    pixels[strays] += off_px * rng.standard_normal((len(strays), 2))
    pixels = np.clip(pixels, 0.0, np.array(observations.cameras["c"]) - 1.0)
    calibration = calibrate(replace(observations, points=replace(observations.points, pixels=pixels)))
    assert calibration.lens_choice and calibration.lens_choice.chosen.startswith("kannala-brandt k1 k2 k3 ")
    failed = {one.failed for one in calibration.lens_choice.tried if one.failed}
    assert "cannot show all that another lens shows" in failed and not any("Jacobian" in words for words in failed)
    assert calibration.fit.points_rms_px < 0.12  # 0.112 measured, 0.106 with a fifth aside
    assert calibration.cameras["c"].phi == pytest.approx(189.6, abs=0.5)  # 0.24 its standard deviation


def test_stereo_left_is_solved_as_built(case: Callable[[str], Path]) -> None:
    calibration = calibrate(Observations.load(case("stereo_left.json")), Options(as_built="estimate"))
    assert calibration.as_built and calibration.fit.points_rms_px < 0.09  # 0.076 measured
    assert np.all(np.isfinite(calibration.uncertainty.posterior.sd))


def test_stereo_left_b_is_scored_by_a_warped_board(case: Callable[[str], Path]) -> None:
    options = Options(tolerances={"board": Tolerance(warp_m=0.002)})
    calibration = calibrate(Observations.load(case("stereo_left_a.json")), options)
    (scored,) = score(calibration, Observations.load(case("stereo_left_b.json"))).values()
    assert scored.misfit.points_rms_px < 0.14  # 0.125 measured; 0.113 of the other half
    assert scored.misfit.noise[0] == pytest.approx(1.0, abs=0.2)  # 1.10 measured


def refused(capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that a refused command prints."""
    assert main(["calibrate", *arguments, "--quiet"]) in (2, 3)
    shown = capfd.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    assert "unexpected" not in line and "Warning" not in line
    return line


def calibrated(tmp_path: Path, *arguments: str) -> Calibration:
    file = str(tmp_path / "calibration.json")
    assert main(["calibrate", *arguments, "-o", file]) == 0
    return Calibration.load(file)


@pytest.mark.parametrize(
    "name, words",
    [
        ("onesigma.json", "point 'TopHalfwayCrossing': its sigma_px is 1e-12, but 0.3 is usual"),
        ("px1e7.json", "point 'BottomLeftCorner': pixel (96.2, 1e+07) lies"),
        ("one_curve_pixel.json", "curve 'ring_32': pixel (1e+308, 65.6) lies"),
        ("im1e5.json", "check that image_size is the size of the pictures"),
    ],
)
def test_an_impossible_number_is_named(
    case: Callable[[str], Path], capfd: pytest.CaptureFixture[str], name: str, words: str
) -> None:
    assert words in refused(capfd, str(case(name)))


def test_as_many_equations_as_numbers(case: Callable[[str], Path], capfd: pytest.CaptureFixture[str]) -> None:
    """soak48: four views of four corners are 32 equations for 32 numbers."""
    said = refused(capfd, str(case("soak48.json")), "--lens", "brown")
    assert "its observations do not determine" in said and "k3 of the brown lens" in said


@pytest.mark.parametrize("name", ["zero_division.json", "no_agree.json"])
def test_exact_data_gives_the_exact_camera(case: Callable[[str], Path], tmp_path: Path, name: str) -> None:
    found = calibrated(tmp_path, str(case(name)), *HELD, "--hold-principal-point")
    phi = found.uncertainty.verdict("camera", "c", "phi")
    assert abs(phi.value - 800.0) < 0.01 * phi.sd  # 0.0014 px of 2.5, by which the usual phi pulls at few equations
    assert abs(found.stations["c"].position[2] - 4.0) < 1e-4
    assert not found.conflicts and np.isfinite(found.uncertainty.verdict("camera", "c", "phi").sd)


def test_lines_in_two_directions_are_enough(case: Callable[[str], Path]) -> None:
    """two_by_two_lines: two lines in each of two directions determine a plane's pose, and an arc is added."""
    held = Options(lens="brown", fixed=dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0), free_principal_point=False)
    found = calibrate(Observations.load(case("two_by_two_lines.json")), held)
    assert found.fit.curves_rms_px < 3.0  # 0.8
    assert found.station().position[2] > 5.0  # on a stand
