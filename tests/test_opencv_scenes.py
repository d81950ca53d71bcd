"""Scenes projected by OpenCV's functions: `python scripts/run.py opencv_scenes` has the full samples."""

from __future__ import annotations

import numpy as np
import pytest
from accuracy import opencv_scenes
from accuracy.odd_scenes import MOST_RADII, MOST_SIGMAS, farthest, observed
from accuracy.opencv_camera import OpenCvCamera, TiltedSensor
from accuracy.opencv_scenes import CASES, KINDS, changed, checked, outcome, refitted
from accuracy.scenes import Problem
from scenery import overhead_pose
from thorough import partly

from ceres_cal.base.arrays import Array
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.moves.refits import refit
from ceres_cal.scene.camera import Camera, in_image
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens

_BROWN = (-0.24, 0.08, 5e-4, -3e-4, 0.0)
_LENSES: dict[str, tuple[float, Lens]] = {
    "brown": (850.0, Brown(_BROWN)),
    "folds in the picture": (850.0, Brown((-0.5, 0.05, 0.0, 0.0, 0.0))),
    "kannala-brandt": (520.0, KannalaBrandt((-0.02, 0.004, 0.001, 0.0002))),
}


def _seen_by(phi: float, lens: Lens) -> OpenCvCamera:
    pose = overhead_pose(0.3, 0.2, 4.0, tilt_x_deg=10.0, tilt_y_deg=20.0, yaw_deg=30.0)
    return OpenCvCamera((1280, 960), phi, (641.0, 477.0), lens, 1.01, pose)


def _places() -> Array:
    return np.random.default_rng(0).uniform((-8.0, -6.0, 0.15), (8.0, 6.0, 0.15), (2000, 3))


@pytest.mark.parametrize("name", _LENSES)
def test_opencv_shows_what_the_package_shows(name: str) -> None:
    """Pixels, and places that are not shown, for example beyond a fold."""
    camera, places = _seen_by(*_LENSES[name]), _places()
    pixels, own = camera.project(places), Camera(**vars(camera)).project(places)
    inside = in_image(pixels, camera.image_size)
    assert np.count_nonzero(inside) > 200
    assert np.array_equal(inside, in_image(own, camera.image_size))
    assert np.allclose(pixels[inside], own[inside], rtol=0.0, atol=1e-8)  # 1e-12


@pytest.mark.parametrize("name", ["brown", "kannala-brandt", "tilted"])
def test_there_and_back(name: str) -> None:
    camera = _seen_by(*_LENSES.get(name, (850.0, TiltedSensor((*_BROWN, 0.02, -0.01)))))
    places = _places()
    inside = in_image(camera.project(places), camera.image_size)
    back = camera.locate(camera.project(places[inside]), 0.15)
    assert np.allclose(back, places[inside, :2], rtol=0.0, atol=1e-9)  # 3e-14


def test_a_tilted_sensor_is_no_camera_of_the_package() -> None:
    """Its lens has more numbers than the package's lens."""
    camera, places = _seen_by(850.0, TiltedSensor((*_BROWN, 0.02, -0.01))), _places()
    own = _seen_by(850.0, Brown(_BROWN)).project(places)
    inside = in_image(own, camera.image_size)
    assert np.max(np.linalg.norm(camera.project(places) - own, axis=1)[inside]) > 5.0


_ASKED = [name for name, kind in KINDS.items() if kind.asked]


@pytest.mark.parametrize("name", partly(_ASKED, ["two cameras"]))
def test_known_numbers_and_places_are_right(name: str) -> None:
    found = outcome(name, 200_001)
    assert not found.refused
    assert found.sigmas < MOST_SIGMAS and found.radii < MOST_RADII


def test_a_camera_that_nobody_touched() -> None:
    assert checked(True, 200_001) is False and checked(False, 200_001) is False


def test_a_stated_zoom() -> None:
    found, zoomed = refitted("zoomed", "zoom", 200_002)
    assert zoomed and found.sigmas < MOST_SIGMAS and found.radii < MOST_RADII


def test_a_refit_knows_no_more_of_phi_than_other_lenses_leave_open() -> None:
    """Six clicks for a fisheye that was moved: phi was known to 30 px, and then to 5.6 px with an error of 6.9 standard
    deviations, since the phi of other lenses was limited to the range of the chosen one.
    """
    both = changed("moved", True, 200_234)
    old = both.calibrated(200_234)
    before, after = (one.uncertainty.verdict("camera", "a", "phi") for one in (old, refit(old, both.seen(200_234))))
    assert after.sd > 0.4 * before.sd  # 0.54: each lens's own phi is updated by the clicks
    assert after.low < both.after.cameras["a"].phi < after.high


def stated_height(kind: str, seed: int) -> tuple[Problem, Calibration]:
    """A scene whose height is stated to 10 mm, and its calibration."""
    problem = KINDS[kind].problem(seed)
    return problem, calibrate(observed(problem, KINDS[kind].noises_px, seed))


@pytest.mark.parametrize("seed", partly([200_055, 200_215], [200_215]))
def test_a_right_height_is_not_called_wrong(seed: int) -> None:
    """It was, by 10 and 9.3 standard deviations: a fisheye with one coefficient, chosen without it, contradicted it."""
    kind = "square pictures, height to 10 mm" if seed == 200_055 else "the same, height to 10 mm"
    problem, calibration = stated_height(kind, seed)
    assert not calibration.conflicts and not any("may be wrong" in one for one in calibration.warnings)
    sigmas, _, radii = farthest(calibration, problem.scene)
    assert sigmas < 2.0 and radii < 1.5  # 0.9 and 0.8; 1.1 and 1.1


def test_a_height_that_only_a_shorter_lens_contradicts_is_in_doubt() -> None:
    """A lens with one coefficient less gives 3.68 instead of 3.58 +- 0.01 m, and is as likely: the sd includes both."""
    problem, calibration = stated_height("square pictures, height to 10 mm", 200_206)
    (words,) = (one for one in calibration.warnings if "may be wrong" in one)
    assert words.startswith("the stated height of station 'a', 3.58 ± 0.01 m: with the lens kannala-brandt k1 p1 p2 ")
    (height,) = (one for one in calibration.uncertainty.verdicts if one.key.quantity == "height")
    assert 0.02 < height.sd < 0.1  # 0.05, where 0.01 is stated
    assert farthest(calibration, problem.scene)[0] < 1.0  # 0.5


def test_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    """A row for each figure of the given seeds; exit code 1 where one is missed: the few clicks of the test above."""
    case = "few clicks"
    assert opencv_scenes.main(["--runs", "1", "--first", "200001", "--case", case]) == 0
    printed = capsys.readouterr().out
    assert all(what in printed for what in ("refused", "known numbers over 5 sd off", "places over 2.5 radii off"))
    assert case in CASES and "1 scenes" in printed
