"""The table of diagnostics: one that nobody has heard of is tested, named and shown like the built-in ones."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import diagnostic_scenes as scenes
import numpy as np
import pytest

from ceres_cal import write_report
from ceres_cal.base.arrays import Array
from ceres_cal.calibrating import calibrate
from ceres_cal.calibration import Calibration
from ceres_cal.cli import main
from ceres_cal.diagnostics import DIAGNOSTICS, Case, Evidence, Family, ScoreTest, Words, diagnose
from ceres_cal.diagnostics.findings import amounts
from ceres_cal.observations import Observations
from ceres_cal.simulate import simulate

SKEW = 0.004


class Skew(ScoreTest):
    """The axes of the pixels are not perpendicular: x grows with y."""

    kind = "skew"
    absorbed = True

    def families(self, case: Case) -> Iterator[Family]:
        down = np.empty(len(case.equations))
        for number, name in enumerate(case.cameras):
            own = case.camera == number
            down[own] = case.estimate.cameras[name].offsets(case.equations.pixel[own])[:, 1]
        yield Family(self.kind, (case.equations.direction[:, 0] * down)[:, None], case.camera, case.cameras)

    def words(self, evidence: Evidence) -> Words:
        skew, sd = 1e3 * evidence.score.amount, 1e3 * evidence.score.sd
        return Words(
            f"camera {evidence.score.subject!r}: the axes of its pixels lean by {skew[0]:.2f} ± {sd[0]:.2f} mrad "
            f"({evidence.size})",
            "have the sensor looked at",
            amounts(["skew"], skew, sd, "mrad"),
        )


def sheared_about(middle: float, pixels: Array) -> Array:
    return pixels + (pixels[:, 1:] - middle) * (SKEW, 0.0)


@pytest.fixture(autouse=True)
def in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(DIAGNOSTICS, "skew", Skew())


@pytest.fixture(scope="module")
def sheared() -> Observations:
    """Seen by a camera whose pixels are sheared about its principal point."""
    scene = scenes.overhead(boards=4)
    seen = simulate(scene, scenes.NOISE, 1).observations
    middle = scene.cameras["overhead"].principal_point[1]
    points, curves = seen.points, seen.curves
    return replace(
        seen,
        points=replace(points, pixels=sheared_about(middle, points.pixels)),
        curves=replace(curves, pixels=sheared_about(middle, curves.pixels)),
    )


@pytest.fixture(scope="module")
def calibration(sheared: Observations) -> Calibration:
    return calibrate(sheared)


def test_a_diagnostic_of_one_s_own_names_its_fault(calibration: Calibration, sheared: Observations) -> None:
    diagnosis = diagnose(calibration, sheared)
    (finding,) = diagnosis.findings
    assert (finding.kind, finding.subject, finding.frame) == ("skew", "overhead", None)
    assert finding.is_model_error and diagnosis.model_error and finding.log10_p < -20.0
    (lean,) = finding.amounts
    assert lean.value == pytest.approx(1e3 * SKEW, abs=4.0 * lean.sd) and lean.sd < 0.2
    leaning = f"lean by {lean.value:.2f} ± {lean.sd:.2f} mrad"
    assert finding.sentence.startswith(f"camera 'overhead': the axes of its pixels {leaning} (")


def test_it_counts_among_the_tests_and_is_silent_on_sound_data(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = simulate(scenes.overhead(boards=4), scenes.NOISE, 2).observations
    diagnosis = diagnose(calibrate(sound), sound)
    assert not diagnosis.findings
    monkeypatch.delitem(DIAGNOSTICS, "skew")
    assert diagnose(calibrate(sound), sound).tests == diagnosis.tests - 1


def test_it_is_in_the_command_s_answer_and_in_the_report(
    calibration: Calibration, sheared: Observations, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration.save(tmp_path / "calibration.json")
    sheared.save(tmp_path / "observations.json")
    files = [str(tmp_path / "calibration.json"), str(tmp_path / "observations.json")]
    assert main(["diagnose", *files]) == 1
    text = " ".join(capsys.readouterr().out.split())
    assert "the axes of its pixels lean by" in text and "-> have the sensor looked at" in text
    assert main(["diagnose", *files, "--json"]) == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["kind"] == "skew" and finding["wrong"] == "model" and finding["amounts"][0]["unit"] == "mrad"
    write_report(tmp_path / "report.html", calibration, sheared, diagnose(calibration, sheared))
    page = (tmp_path / "report.html").read_text()
    assert "the axes of its pixels lean by" in page and "The model is wrong: skew (overhead)" in page


def test_without_it_the_fault_has_no_name(
    calibration: Calibration, sheared: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(DIAGNOSTICS, "skew")
    assert "skew" not in {finding.kind for finding in diagnose(calibration, sheared).findings}


def test_kinds_stand_under_their_own_names() -> None:
    assert all(kind == diagnostic.kind for kind, diagnostic in DIAGNOSTICS.items())
