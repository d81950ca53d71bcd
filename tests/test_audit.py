"""Audits of other programs' calibrations. Many of them: scripts/accuracy/audit.py --runs."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from accuracy import audit as planted

from ceres_cal import Calibration, Camera, InputError, Observations, Options, audit, calibrate, checkerboard
from ceres_cal.base.transforms import Pose
from ceres_cal.cli import main
from ceres_cal.formats import export
from ceres_cal.formats.format import calibration_of
from ceres_cal.simulate import simulate

CALIBRATED: dict[tuple[str, str], Calibration] = {}


@cache
def seen(seed: int = 3) -> Observations:
    return simulate(planted.scene_of(planted.drawn(1)), planted.NOISE, seed=seed).observations


@cache
def sound() -> Calibration:
    return calibrate(seen(), planted.FREE)


@pytest.fixture(autouse=True)
def _calibrated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Audits of the same observations compare with the same calibration, which is made once."""

    def once(observations: Observations, options: Options) -> Calibration:
        key = observations.digest, repr(options)
        if key not in CALIBRATED:
            CALIBRATED[key] = calibrate(observations, options)
        return CALIBRATED[key]

    monkeypatch.setattr("ceres_cal.moves.audits.calibrate", once)


@pytest.mark.parametrize("fault", planted.FAULTS)
def test_planted_faults_are_named(fault: str, tmp_path: Path) -> None:
    assert planted.one_run(1001, fault, tmp_path) == fault


def test_a_sound_one_is_trusted_to_so_many_millimetres() -> None:
    one = audit(sound(), seen(4))["overhead"]
    assert one.holds and one.cause is None and not one.pose_free and one.change is not None
    (floor, _) = one.change.maps
    assert floor.rms_mm < 3.0 * np.hypot(floor.known_mm, floor.known_mm)  # both have that error
    assert (
        "explains the observations as well as a new calibration would; its map differs from the new one by" in one.words
    )


def test_without_a_pose_the_best_one_is_taken() -> None:
    bare = calibration_of("a test", {"other name": sound().station().at(Pose.identity())})
    one = audit(bare, seen(4))["overhead"]
    assert one.holds and one.pose_free and "its file has none" in one.words
    swapped = planted.FAULTS["half a pixel"](sound().station().at(Pose.identity()))
    # Half a pixel is a rotation by 0.03 degrees, which the pose absorbs.
    assert audit(calibration_of("a test", {"x": swapped}), seen(4))["overhead"].holds
    long = replace(sound().station(), phi=1.05 * sound().station().phi).at(Pose.identity())
    assert audit(calibration_of("a test", {"x": long}), seen(4))["overhead"].cause == "another focal length"


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen(4).save(tmp_path / "obs.npz")
    sound().save(tmp_path / "ours.json")
    assert main(["audit", str(tmp_path / "ours.json"), "--observations", str(tmp_path / "obs.npz")]) == 0
    assert capsys.readouterr().out.startswith("audit     yes\nstation   overhead explains the observations")
    half = planted.FAULTS["half a pixel"](sound().station())
    export(calibration_of("x", {"overhead": half}, sound().targets), "opencv", tmp_path / "b.yml")
    ask = ["audit", str(tmp_path / "b.yml"), "--observations", str(tmp_path / "obs.npz"), "--json"]
    assert main(ask) == 1
    said = json.loads(capsys.readouterr().out)["stations"]["overhead"]
    assert said["cause"] == "half a pixel" and said["off_px"] == pytest.approx(0.7, abs=0.15)
    assert said["off_mm"][0]["rms_mm"] > 1.0 > said["known_mm"][0]["sd_mm"]


def test_other_stations_are_refused() -> None:
    two = calibration_of("a test", {"a": sound().station(), "b": sound().station()})
    with pytest.raises(InputError, match="has stations 'a', 'b', the observations 'overhead': name them alike"):
        audit(two, seen(4))


def test_opencvs_own_calibration_of_real_photographs(real_data: Path) -> None:
    """OpenCV calibrates with every other photograph, and the rest is used for the audit."""
    board = checkerboard(9, 6, 0.025)
    corners = {}
    for path in sorted((real_data / "opencv_left_right").glob("left*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        found, rough = cv2.findChessboardCorners(image, (9, 6))
        assert found
        corners[path.stem] = cv2.cornerSubPix(image, rough, (5, 5), (-1, -1), (3, 100, 1e-6))
    names = list(corners)
    seen = Observations.from_points({name: corners[name] for name in names[1::2]}, board, (640, 480), sigma_px=0.2)
    places = [board.point_array.astype(np.float32)] * len(names[::2])
    few = cv2.CALIB_FIX_K2 + cv2.CALIB_FIX_K3 + cv2.CALIB_ZERO_TANGENT_DIST
    for flags, cause in ((0, None), (few, "too few coefficients")):
        nothing = np.empty(0)
        made = cv2.calibrateCamera(places, [corners[n] for n in names[::2]], (640, 480), nothing, nothing, flags=flags)
        given = Camera.from_opencv((640, 480), made[1], made[2])
        answer = audit(calibration_of("OpenCV", {"camera": given}), seen)["camera"]
        assert answer.cause == cause and answer.pose_free and answer.change is not None and not answer.change.maps
