"""An effect that nobody has heard of, in one file: solved for, in the covariance, diagnosed and reported."""

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
from ceres_cal.diagnostics import diagnose
from ceres_cal.effects import table
from ceres_cal.effects.table import EFFECTS, rows
from ceres_cal.observations import Observations
from ceres_cal.problem.quantities import difference
from ceres_cal.simulate import simulate

SWAY_PX, PERIOD_PX = 1.5, 1500.0  # long: the camera takes up a part of it

FILE = f'''"""Rows of pixels that sway."""

from collections.abc import Iterator

import numpy as np

from ceres_cal.effects.columns import EffectColumns
from ceres_cal.effects.effect import amounts
from ceres_cal.effects.effect import Case, Effect, Evidence, Words
from ceres_cal.effects.evidence import SizePrior


def swaying(case: Case) -> Iterator[EffectColumns]:
    """Rows of pixels lie to the right and left in turn, as a sensor on a shaking mount reads them."""
    along = case.equations.direction[:, 0] * np.sin(2.0 * np.pi * case.equations.pixel[:, 1] / {PERIOD_PX})
    yield EffectColumns(along[:, None], case.camera, case.cameras)


def words(evidence: Evidence) -> Words:
    amount, sd = evidence.score.amount, evidence.score.sd
    sentence = f"camera {{evidence.score.subject!r}}: its rows of pixels sway by {{amount[0]:.2f}} px"
    return Words(sentence, "have the sensor looked at", amounts(["sway"], amount, sd, "px"))


EFFECTS = (Effect("sway", swaying, words, absorbed=True, prior=SizePrior(0.9, (0.1, 0.3, 1.0, 3.0))),)
'''


@pytest.fixture(scope="module")
def added(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The file, put into the folder of the table."""
    folder = tmp_path_factory.mktemp("table")
    (folder / "sway.py").write_text(FILE)
    table.__path__.append(str(folder))
    EFFECTS.update(rows())
    yield
    table.__path__.remove(str(folder))
    del EFFECTS["sway"]


def swaying(pixels: Array) -> Array:
    return pixels + SWAY_PX * np.sin(2.0 * np.pi * pixels[:, 1:] / PERIOD_PX) * (1.0, 0.0)


@pytest.fixture(scope="module")
def swayed() -> Observations:
    seen = simulate(scenes.overhead(boards=8), scenes.NOISE, 1).observations
    points = replace(seen.points, pixels=swaying(seen.points.pixels))
    return replace(seen, points=points, curves=replace(seen.curves, pixels=swaying(seen.curves.pixels)))


@pytest.fixture(scope="module")
def without(swayed: Observations) -> Calibration:
    return calibrate(swayed, RADIAL)


@pytest.fixture(scope="module")
def calibration(without: Calibration, swayed: Observations, added: None) -> Calibration:
    """After the one without it."""
    return calibrate(swayed, RADIAL)


def off(calibration: Calibration) -> Array:
    """(K,) standard deviations by which the camera's numbers are off."""
    posterior = calibration.uncertainty.posterior
    keys = [key for key in posterior.keys if key.kind == "camera"]
    truth = replace(calibration.estimate, cameras=scenes.overhead().cameras)
    sd = posterior.sd[posterior.information.columns(keys)]
    return np.asarray(difference(calibration.estimate, truth, keys) / sd)


def test_it_is_solved_for(calibration: Calibration, without: Calibration) -> None:
    (one,) = [one for one in calibration.effects if one.amounts]
    assert (one.kind, one.subject, one.frame) == ("sway", "overhead", None) and one.probability > 0.999
    (sway,) = one.amounts
    assert abs(sway.value - SWAY_PX) < 4.0 * sway.sd  # 1.492 +- 0.023
    assert np.max(np.abs(off(calibration))) < 3.5 < np.max(np.abs(off(without)))  # 2.0, 5.5
    assert calibration.fit.points_rms_px < 0.9 * without.fit.points_rms_px  # 0.41, 0.51 px


def test_it_widens(calibration: Calibration) -> None:
    """By what is open of its amounts: the same noise before a steady camera says more."""
    steady = calibrate(simulate(scenes.overhead(boards=8), scenes.NOISE, 1).observations, RADIAL)
    sds = [one.uncertainty.posterior.sd for one in (calibration, steady)]
    assert np.all(sds[0] > 0.99 * sds[1]) and np.max(sds[0] / sds[1]) > 1.1


def test_it_is_diagnosed_and_reported(calibration: Calibration, swayed: Observations, tmp_path: Path) -> None:
    assert any("its rows of pixels sway by" in words and "solved for" in words for words in calibration.warnings)
    diagnosis = diagnose(calibration, swayed)
    finding = next(one for one in diagnosis.findings if one.kind == "sway")
    assert "it was solved for" in finding.sentence and finding.wrong == "observations"
    calibration.save(tmp_path / "calibration.json")
    assert Calibration.load(tmp_path / "calibration.json").effects == calibration.effects
    write_report(tmp_path / "report.html", calibration, swayed, diagnosis)
    assert "its rows of pixels sway by" in (tmp_path / "report.html").read_text()


def test_sound_data_are_left_alone(added: None) -> None:
    for seed in (2, 3):
        sound = simulate(scenes.overhead(boards=8), scenes.NOISE, seed).observations
        assert not any(one.amounts for one in calibrate(sound, RADIAL).effects)
