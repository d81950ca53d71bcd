"""A lens that the package does not contain: defined here, it works wherever a lens is used."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import scenes
from data.built_in_scenes import scene_to_json
from scenery import join

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.lens_forms import candidates, label_of
from ceres_cal.cli import main
from ceres_cal.diagnostics import diagnose
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.parameters import Options, intrinsics_vector, with_intrinsics
from ceres_cal.problem.residuals import camera_optics, residuals
from ceres_cal.report import make_report
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import LENSES, Lens, make_lens, register
from ceres_cal.scene.lens.base import LinearEquations
from ceres_cal.simulate import Disturbance, Simulation, simulate
from ceres_cal.simulate.files import scene_from_json


def _inverse(ideal: Any, k: Any) -> Any:
    """r with r / (1 + k r^2) = ideal."""
    return 2.0 * ideal / (1.0 + np.sqrt(1.0 - 4.0 * k * ideal * ideal))


@dataclass(frozen=True)
class Division(Lens):
    """Fitzgibbon's division model: the ideal radius is r / (1 + k r^2), both in px."""

    values: tuple[float, ...] = (0.0,)
    kind: ClassVar[str] = "division"
    acts_on_pixels: ClassVar[bool] = True

    @property
    def names(self) -> tuple[str, ...]:
        return ("k",)

    @property
    def orders(self) -> tuple[int, ...]:
        return (3,)

    def _distort(self, rays: Array, phi: float) -> Array:
        ideal = phi * rays[:, :2] / np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)
        radius = np.hypot(ideal[:, :1], ideal[:, 1:])
        measured = _inverse(radius, self.values[0])
        return np.asarray(ideal * np.where(radius > 0.0, measured / radius, 1.0))

    def _undistort(self, offsets: Array, phi: float) -> Array:
        radius = np.hypot(offsets[:, 0], offsets[:, 1])
        depth = np.where(radius < self.monotone_radius(phi), phi * (1.0 + self.values[0] * radius**2), np.nan)
        rays = np.column_stack([offsets, depth])
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def monotone_radius(self, phi: float) -> float:
        return float(1.0 / np.sqrt(abs(self.values[0]))) if self.values[0] else np.inf

    def start_equations(self, measured: Array, ideal: Array, angle: Array, phi: float) -> LinearEquations:
        return {"k": ideal * measured**2}, measured - ideal


TRUE = Camera((1280, 960), 850.0, (646.5, 473.8), Division((-2.4e-7,)))


@pytest.fixture(scope="module", autouse=True)
def offered() -> Iterator[None]:
    """The lens is in the table while these tests run."""
    register(Division)
    yield
    del LENSES["division"]


@pytest.fixture(scope="module")
def simulation(offered: None) -> Simulation:
    both = join(scenes.lines_and_arcs("radial-2-3"), scenes.corners("radial-2-3"))
    scene = replace(both, cameras={"overhead": TRUE})
    whole = simulate(scene, Disturbance(points_sigma_px=0.2, curves_sigma_px=0.2), seed=3)
    every = whole.observations
    some = every.part(np.ones(len(every.points), dtype=bool), np.arange(len(every.curves)) % 3 == 0)
    return replace(whole, observations=some)


@pytest.fixture(scope="module")
def calibration(simulation: Simulation) -> Calibration:
    return calibrate(simulation.observations, Options(lens="division"))


def test_there_and_back() -> None:
    offsets = np.random.default_rng(0).uniform(-500.0, 500.0, (200, 2))
    rays = TRUE.lens.undistort(offsets, TRUE.phi)
    assert np.max(np.abs(TRUE.lens.distort(rays, TRUE.phi) - offsets)) < 1e-9


def test_a_name_is_given_once() -> None:
    register(Division)  # the same again is no other

    @dataclass(frozen=True)
    class SecondDivision(Division):
        pass

    with pytest.raises(InputError, match="there is a lens 'division' already"):
        register(SecondDivision)


def test_its_derivatives_are_those_of_its_map(simulation: Simulation) -> None:
    """The derivatives of the solve, compared with differences of the residuals."""
    from ceres_cal.problem.residuals import write_equations

    observations, options = simulation.observations, Options(lens="division", fixed={"k": -2.4e-7})
    truth = calibrate(observations, options).estimate
    sights = gather_sights(observations)
    found = residuals(sights, truth)
    equations = write_equations(sights, truth, found)
    vector = intrinsics_vector(truth.cameras["overhead"])
    assert not len(camera_optics(truth.cameras["overhead"]).form)  # none of the compiled ones
    for number, step in ((0, 1e-2), (4, 1e-5)):
        moved = []
        for sign in (1.0, -1.0):
            changed = vector.copy()
            changed[number] += sign * step
            cameras = {"overhead": with_intrinsics(truth.cameras["overhead"], changed)}
            moved.append(residuals(sights, replace(truth, cameras=cameras), found.feet))
        slope = (np.concatenate([moved[0].points.ravel(), moved[0].curves]) - np.concatenate(
            [moved[1].points.ravel(), moved[1].curves]
        )) / (2.0 * step)  # fmt: skip
        expected = np.sort(slope)
        assert np.max(np.abs(np.sort(equations.intrinsics[:, number]) - expected)) < 1e-5 * np.max(np.abs(expected))


def test_it_calibrates(calibration: Calibration) -> None:
    camera = calibration.cameras["overhead"]
    assert isinstance(camera.lens, Division)
    assert camera.phi == pytest.approx(TRUE.phi, rel=5e-3)
    assert camera.lens.values[0] == pytest.approx(-2.4e-7, rel=0.05)
    assert calibration.fit.curves_rms_px < 0.25
    spread = calibration.uncertainty.verdict("camera", "overhead", "k")
    assert spread.key.unit == "px^-2" and 0.0 < spread.sd < 5e-9


@pytest.mark.usefixtures("words_alone")
def test_it_is_diagnosed_and_reported(calibration: Calibration, simulation: Simulation) -> None:
    diagnosis = diagnose(calibration, simulation.observations)
    assert not [finding for finding in diagnosis.findings if finding.kind in ("radius", "decentring")]
    page = make_report(calibration, simulation.observations, diagnosis)
    assert "division" in page and "px⁻²" in page


def test_what_it_lacks_is_said(simulation: Simulation) -> None:
    """Fixed at no distortion, the residuals depend on the radius."""
    every = simulation.observations
    few = every.part(np.ones(len(every.points), dtype=bool), np.arange(len(every.curves)) % 4 == 0)
    calibration = calibrate(few, Options(lens="division", fixed={"k": -1.8e-7}))
    findings = diagnose(calibration, few).findings
    radial = [finding for finding in findings if finding.kind == "radius"]
    assert radial and "solve for k" in radial[0].advice


def test_it_is_one_of_the_candidates() -> None:
    (only,) = candidates(Options(lens="division"))
    assert label_of(only) == "division k"


def test_it_is_saved_and_loaded(calibration: Calibration, simulation: Simulation, tmp_path: Path) -> None:
    calibration.save(tmp_path / "calibration.json")
    loaded = Calibration.load(tmp_path / "calibration.json")
    assert loaded.cameras["overhead"].lens == calibration.cameras["overhead"].lens
    scene = replace(scenes.corners("radial-2-3"), cameras={"overhead": TRUE})
    again, _ = scene_from_json(scene_to_json(scene), "scene")
    assert again.cameras["overhead"].lens == make_lens("division", (), {"k": -2.4e-7})


@pytest.mark.usefixtures("words_alone")
def test_the_command_line_offers_it(simulation: Simulation, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    simulation.observations.save(tmp_path / "observations.json")
    output = tmp_path / "calibration.json"
    arguments = [str(tmp_path / "observations.json"), "--quiet", "-o", str(output)]
    assert main(["calibrate", *arguments, "--lens", "division", "--report", str(tmp_path / "report.html")]) == 0
    assert json.loads(output.read_text())["cameras"]["overhead"]["lens"]["kind"] == "division"
    assert main(["diagnose", str(output), str(tmp_path / "observations.json")]) in (0, 1)
    capsys.readouterr()
    assert main(["calibrate", *arguments, "--lens", "?"]) == 2
    assert "division" in capsys.readouterr().err
    assert main(["calibrate", *arguments, "--lens", "division", "--powers", "3"]) == 2
