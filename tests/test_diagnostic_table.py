"""The table of effects: a new effect is tested, named and shown like the built-in ones."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from accuracy import diagnostic_scenes as scenes
from scenes import RADIAL

from ceres_cal import write_report
from ceres_cal.base.arrays import Array
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.diagnostics import diagnose
from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import Case, Effect, Evidence, Words, amounts
from ceres_cal.effects.table import EFFECTS
from ceres_cal.observations import Observations
from ceres_cal.simulate import simulate

WAVE_PX, PERIOD_PX = 0.5, 200.0


def wave(pixels: Array) -> Array:
    """(N,) horizontal displacement of the sensor's rows, in amplitudes."""
    return np.sin(2.0 * np.pi * pixels[:, 1] / PERIOD_PX)


def columns_of_wave(case: Case) -> Iterator[EffectColumns]:
    columns = case.equations.direction[:, 0] * wave(case.equations.pixel)
    yield EffectColumns(columns[:, None], case.camera, case.cameras)


def words_of_wave(evidence: Evidence) -> Words:
    amount, sd = evidence.score.amount, evidence.score.sd
    return Words(
        f"camera {evidence.score.subject!r}: its rows of pixels sway by {amount[0]:.2f} ± {sd[0]:.2f} px "
        f"({evidence.size})",
        "have the sensor looked at",
        amounts(["wave"], amount, sd, "px"),
    )


WAVE = Effect("wave", columns_of_wave, words_of_wave, absorbed=True)
"""Rows of pixels are displaced to the right and left in turns, as by a sensor on a shaking mount."""


def swaying(pixels: Array) -> Array:
    return pixels + WAVE_PX * wave(pixels)[:, None] * (1.0, 0.0)


@pytest.fixture(autouse=True)
def in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EFFECTS, "wave", WAVE)


@pytest.fixture(scope="module")
def swayed() -> Observations:
    """Observations by a camera whose rows of pixels are displaced by a wave."""
    scene = scenes.overhead(boards=4)
    seen = simulate(scene, scenes.NOISE, 1).observations
    points, curves = seen.points, seen.curves
    return replace(
        seen,
        points=replace(points, pixels=swaying(points.pixels)),
        curves=replace(curves, pixels=swaying(curves.pixels)),
    )


@pytest.fixture(scope="module")
def calibration(swayed: Observations) -> Calibration:
    return calibrate(swayed, RADIAL)


def test_an_effect_of_one_s_own_names_its_fault(calibration: Calibration, swayed: Observations) -> None:
    diagnosis = diagnose(calibration, swayed)
    (finding,) = diagnosis.findings
    assert (finding.kind, finding.subject, finding.frame) == ("wave", "overhead", None)
    assert finding.is_model_error and diagnosis.model_error and finding.log10_p < -20.0
    (sway,) = finding.amounts
    assert sway.value == pytest.approx(WAVE_PX, abs=4.0 * sway.sd) and sway.sd < 0.05
    swaying_by = f"sway by {sway.value:.2f} ± {sway.sd:.2f} px"
    assert finding.sentence.startswith(f"camera 'overhead': its rows of pixels {swaying_by} (")


def test_it_counts_among_the_tests_and_is_silent_on_sound_data(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = simulate(scenes.overhead(boards=4), scenes.NOISE, 2).observations
    diagnosis = diagnose(calibrate(sound, RADIAL), sound)
    assert not diagnosis.findings
    monkeypatch.delitem(EFFECTS, "wave")
    assert diagnose(calibrate(sound, RADIAL), sound).tests == diagnosis.tests - 1


@pytest.mark.usefixtures("words_alone")
def test_it_is_in_the_command_s_answer_and_in_the_report(
    calibration: Calibration, swayed: Observations, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calibration.save(tmp_path / "calibration.json")
    swayed.save(tmp_path / "observations.json")
    files = [str(tmp_path / "calibration.json"), str(tmp_path / "observations.json")]
    assert main(["diagnose", *files]) == 1
    text = " ".join(capsys.readouterr().out.split())
    assert "its rows of pixels sway by" in text and "-> Have the sensor looked at" in text
    assert main(["diagnose", *files, "--json"]) == 1
    (finding,) = json.loads(capsys.readouterr().out)["findings"]
    assert finding["kind"] == "wave" and finding["wrong"] == "model" and finding["amounts"][0]["unit"] == "px"
    write_report(tmp_path / "report.html", calibration, swayed, diagnose(calibration, swayed))
    page = (tmp_path / "report.html").read_text()
    assert (
        "its rows of pixels sway by" in page and "The model is wrong by up to " in page and ": wave (overhead)" in page
    )


def test_without_it_the_fault_has_no_name(
    calibration: Calibration, swayed: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(EFFECTS, "wave")
    assert "wave" not in {finding.kind for finding in diagnose(calibration, swayed).findings}


def test_kinds_stand_under_their_own_names() -> None:
    assert all(kind == row.kind for kind, row in EFFECTS.items())


def test_what_the_data_cannot_tell_apart_is_named_by_both_names(
    calibration: Calibration, swayed: Observations, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(EFFECTS, "shaking", replace(WAVE, kind="shaking"))
    (finding,) = diagnose(calibration, swayed).findings
    other = {"wave": "shaking", "shaking": "wave"}[finding.kind]
    assert finding.sentence.endswith(f"; these data do not distinguish it from {other} (overhead)")
