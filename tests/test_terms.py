"""Numbers that are 0 by default: OpenCV's rational and thin-prism terms, a fisheye's decentring, skew."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scenes

from ceres_cal.base.errors import InputError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.diagnostics import diagnose
from ceres_cal.observations import NO_CURVES, Observations, Points, View
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.bundle import solve
from ceres_cal.problem.parameters import Options, make_layout
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import make_lens
from ceres_cal.scene.targets import checkerboard
from ceres_cal.simulate import Disturbance, Simulation, simulate
from ceres_cal.start.initialise import initialise


def seen(lens: str, camera: Camera | None = None, sigma_px: float = 0.1) -> Simulation:
    """Boards in front of a camera of `scenes`, or of another one."""
    scene = scenes.boards("kannala-brandt" if lens.startswith("kannala") else "brown")
    scene = replace(scene, cameras=dict.fromkeys(scene.cameras, camera or scenes.camera(lens)))
    return simulate(scene, Disturbance(points_sigma_px=sigma_px), seed=5)


def test_terms_are_named_by_the_lens() -> None:
    assert Options(lens="brown", terms=("prism",)).blank_lens.names[5:] == ("s1", "s2", "s3", "s4")
    assert make_lens("brown", coefficients={"s2": 1e-3, "k5": 0.1}).terms == ("rational", "prism")
    assert make_lens("brown").with_terms(("rational",)).with_terms(()) == make_lens("brown")
    with pytest.raises(InputError, match="lens 'kannala-brandt' has no terms 'prism': there are tangential"):
        make_lens("kannala-brandt", terms=("prism",))
    with pytest.raises(InputError, match="lens 'radial' has no terms 'rational': there are tangential"):
        Options(lens="radial", terms=("rational",))
    with pytest.raises(InputError, match="terms need a named lens"):
        Options(lens="auto", terms=("rational",))


@pytest.mark.parametrize("lens", ["brown-rational", "kannala-brandt-tangential"])
def test_they_are_found(lens: str) -> None:
    truth = scenes.camera(lens)
    options = Options(lens=truth.lens.kind, terms=truth.lens.terms)
    calibration = calibrate(seen(lens, sigma_px=1e-4).observations, options)
    (camera,) = calibration.cameras.values()
    off = camera.project(truth.rays(MIDDLE)) - MIDDLE
    assert np.abs(off).max() < 0.01  # px; measured 0.002
    assert camera.lens.names == truth.lens.names


MIDDLE = np.stack(np.meshgrid(np.linspace(200.0, 1080.0, 9), np.linspace(150.0, 810.0, 7)), -1).reshape(-1, 2)


def test_a_skew_is_found(tmp_path: Path) -> None:
    lean = replace(scenes.camera("brown"), skew=2.5e-3)
    simulation = seen("brown", lean)
    assert "skew" in {finding.kind for finding in diagnose(calibrated("brown", lean), simulation.observations).findings}
    calibration = calibrate(simulation.observations, Options(lens="brown", free_skew=True))
    (camera,) = calibration.cameras.values()
    sd = calibration.uncertainty.verdict("camera", next(iter(calibration.cameras)), "skew").sd
    assert abs(camera.skew - 2.5e-3) < 4.0 * sd < 1e-3
    calibration.save(tmp_path / "a.json")
    assert Calibration.load(tmp_path / "a.json").cameras == calibration.cameras


def calibrated(lens: str, camera: Camera | None = None) -> Calibration:
    """With the plain lens of its kind."""
    kind = "kannala-brandt" if lens.startswith("kannala") else "brown"
    return calibrate(seen(lens, camera).observations, Options(lens=kind, usual_camera=False))


def test_a_fisheye_that_is_decentred_is_named() -> None:
    lens = "kannala-brandt-tangential"
    findings = diagnose(calibrated(lens), seen(lens).observations).findings
    (finding,) = [one for one in findings if one.kind == "decentring"]
    assert "--terms tangential" in finding.advice
    freed = calibrate(seen(lens).observations, Options(lens="kannala-brandt", terms=("tangential",)))
    assert not [one for one in diagnose(freed, seen(lens).observations).findings if one.kind == "decentring"]


def test_a_thin_prism_is_named() -> None:
    lens = make_lens("brown", coefficients={"k1": -0.24, "k2": 0.08, "s1": 2e-3, "s2": -9e-3, "s4": 8e-3})
    camera = replace(scenes.camera("brown"), lens=lens)
    findings = diagnose(calibrated("brown", camera), seen("brown", camera).observations).findings
    (finding,) = [one for one in findings if one.kind == "prism"]
    assert "--terms prism" in finding.advice


def test_the_optimum_is_opencvs(real_data: Path) -> None:
    """Its rational model on its own photographs, to 1e-6 of rms: measured 5e-8 with corners in float32."""
    board, corners = checkerboard(9, 6, 0.025), []
    for path in sorted((real_data / "opencv_left_right").glob("right*.jpg")):
        picture: Any = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found, places = cv2.findChessboardCorners(picture, (9, 6))
        assert found
        corners.append(places.reshape(-1, 1, 2).astype(np.float32))
    size, count = (640, 480), len(board.point_array)
    plane = [board.point_array.reshape(-1, 1, 3).astype(np.float32)] * len(corners)
    end = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 3000, 1e-14)
    given: Any = (plane, corners, size, None, None)
    how: Any = {"flags": cv2.CALIB_RATIONAL_MODEL, "criteria": end}
    rms, matrix, *_ = cv2.calibrateCamera(*given, **how)
    views = tuple(View(str(k), "camera", "camera", "board", str(k)) for k in range(len(corners)))
    rows = np.arange(len(corners) * count, dtype=np.int32)
    pixels = np.concatenate(corners)[:, 0].astype(float)
    points = Points(rows // count, rows % count, pixels, np.ones(len(rows)))
    observations = Observations({"board": board}, {"camera": size}, views, points, NO_CURVES)
    options = Options(lens="brown", terms=("rational",), free_aspect=True, usual_camera=False)
    sights = gather_sights(observations)
    problem = Problem(sights, make_layout(observations, options), (), Weighting(loss="trivial"), options)
    estimate = solve(problem, initialise(sights, options).estimate).estimate
    left = residuals(sights, estimate).lengths[0]
    assert np.sqrt(np.mean(left**2)) == pytest.approx(rms, abs=1e-6)
    assert estimate.cameras["camera"].phi == pytest.approx(matrix[0, 0], rel=1e-5)


def test_files_of_before_load(tmp_path: Path) -> None:
    calibration = calibrated("brown")
    calibration.save(tmp_path / "a.json")
    data = json.loads((tmp_path / "a.json").read_text())
    for camera in data["cameras"].values():
        assert camera.pop("skew", 0.0) == 0.0 and len(camera["lens"]["coefficients"]) == 5
    del data["options"]["terms"], data["options"]["free_skew"]
    data["options"]["free_aspect"] = False
    (tmp_path / "a.json").write_text(json.dumps(data))
    loaded = Calibration.load(tmp_path / "a.json")
    assert loaded.cameras == calibration.cameras
    assert loaded.options == replace(calibration.options, free_aspect=False)


def test_the_command_line_takes_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    seen("kannala-brandt-tangential").observations.save(tmp_path / "a.json")
    arguments = ["calibrate", str(tmp_path / "a.json"), "-o", str(tmp_path / "b.json")]
    assert main([*arguments, "--lens", "kannala-brandt", "--terms", "tangential", "--free-skew"]) == 0
    assert "p2" in capsys.readouterr().out
    assert Calibration.load(tmp_path / "b.json").options.terms == ("tangential",)
    assert main([*arguments, "--lens", "radial", "--terms", "rational"]) == 2
    assert "lens 'radial' has no terms 'rational'" in capsys.readouterr().err
