"""The examples run unchanged, and their output is right."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import pytest

ROOT = Path(__file__).resolve().parents[1]


def said(name: str, *arguments: str) -> str:
    """The output of an example, run as its own process."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    call = [sys.executable, str(ROOT / "examples" / name), *arguments]
    return subprocess.run(call, cwd=ROOT, env=environment, capture_output=True, text=True, check=True).stdout


Script = Callable[..., str]


def number(pattern: str, text: str) -> float:
    found = re.search(pattern, text)
    assert found, text
    return float(found[1])


def test_every_example_is_tested() -> None:
    tested = {"opencv_arrays.py", "own_field.py", "two_cameras.py", "tracker.py", "calibration.ipynb"}
    assert {path.name for path in (ROOT / "examples").iterdir() if path.is_file()} == tested


def test_arrays_of_opencv(as_script: Script) -> None:
    text = as_script(ROOT / "examples" / "opencv_arrays.py", folder=ROOT)
    assert number(r"rms ([\d.]+) px over 8 boards", text) < 0.2  # 0.05 measured
    assert number(r"phi +([\d.]+)", text) == pytest.approx(872.0, abs=4.0)  # as this lens has it: whole sample


def test_a_field_of_ones_own(as_script: Script) -> None:
    text = as_script(ROOT / "examples" / "own_field.py", folder=ROOT)
    assert number(r"phi ([\d.]+) px", text) == pytest.approx(700.0, abs=10.0)
    assert number(r"off by ([\d.]+) mm", text) < 4.0 * number(r"stated ([\d.]+) mm", text)


def test_two_cameras(as_script: Script) -> None:
    text = as_script(ROOT / "examples" / "two_cameras.py", folder=ROOT)
    assert number(r"see: ([\d.]+) mm", text) < 4.0 * number(r"where ([\d.]+) mm", text)


def test_a_tracker(tmp_path: Path) -> None:
    assert number(r"robots: ([\d.]+) %", said("tracker.py")) < 50.0  # 1 % measured; others may use the machine, too


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.thorough
def test_the_notebook(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(ROOT / "examples")
    mpl.use("agg")
    cells = json.loads((ROOT / "examples/calibration.ipynb").read_text(encoding="utf-8"))["cells"]
    assert all(not cell.get("outputs") for cell in cells)  # it is kept without them
    names: dict[str, object] = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    plt.close("all")
    out = capsys.readouterr().out
    assert out.count("known") >= 10 and out.count("mm at worst, after:") == 3
