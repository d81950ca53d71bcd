"""Five jobs with at most twelve lines of Python each: they run unchanged, and type checkers accept them."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

import ceres_cal as cc

ROOT = Path(__file__).resolve().parents[1]
JOBS = ROOT / "examples" / "jobs"
MOST_LINES = 12
NAMES = ["ball_at_60_hz", "compare_two", "lines_from_array", "opencv_corners", "refit_by_cron"]


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("jobs") / "calibration.json"
    sample = cc.Observations.load(ROOT / "data/ssl_field/observations.json")
    cc.calibrate(sample, cc.Options(lens="radial", powers=(2, 3))).save(path)
    return path


@pytest.fixture
def said(as_script: Callable[..., str]) -> Callable[..., str]:
    """The output of a job."""

    def run(name: str, *arguments: object, folder: Path = ROOT) -> str:
        return as_script(JOBS / f"{name}.py", *arguments, folder=folder)

    return run


JobOutput = Callable[..., str]


def test_each_is_short() -> None:
    lines = {path.stem: len(path.read_text(encoding="utf-8").splitlines()) for path in sorted(JOBS.glob("*.py"))}
    assert list(lines) == NAMES
    assert {name: count for name, count in lines.items() if count > MOST_LINES + 1} == {}  # plus its docstring


def test_corners_of_opencv(said: JobOutput) -> None:
    phi = float(said("opencv_corners").split("[[")[1].split()[0])
    assert phi == pytest.approx(869.7, abs=1.0)  # 869.72 measured


def test_lines_from_arrays(said: JobOutput) -> None:
    assert "phi 868.8 px" in (text := said("lines_from_array")) and float(text.split()[-1]) < 1.5  # 1.04 mm measured


def test_the_ball(said: JobOutput, calibration: Path) -> None:
    lines = said("ball_at_60_hz", folder=calibration.parent).splitlines()
    assert len(lines) == 60 and float(lines[0].split()[0]) == pytest.approx(-2.117, abs=0.002)


def test_a_refit_and_a_comparison(said: JobOutput, calibration: Path, tmp_path: Path) -> None:
    now = Path(shutil.copy(calibration, tmp_path / "now.json"))
    assert said("refit_by_cron", now, ROOT / "data/ssl_field_moved/photographs/0001.jpg").startswith("moved, 0.")
    assert said("refit_by_cron", now, ROOT / "data/ssl_field_moved/photographs/0001.jpg") == ""
    assert said("compare_two", calibration, now).endswith("explained: False\n")


@pytest.mark.thorough
def test_pyright_accepts_them() -> None:
    pytest.importorskip("basedpyright", reason="pip install 'ceres-cal[dev]'")
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    call = [sys.executable, "-m", "basedpyright", "--level", "error", str(JOBS)]
    done = subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
