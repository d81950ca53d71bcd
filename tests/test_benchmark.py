"""The benchmark runs, and compares answers of equal quality. No times are tested here."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[1] / "scripts" / "benchmark.py"


@pytest.mark.thorough
def test_quick_run(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    command = [sys.executable, str(SCRIPT), "--quick", "--json", str(path)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    report = json.loads(path.read_text(encoding="utf-8"))
    (found,) = report["comparison"]
    ours = found["solvers"]["ceres-cal"]
    # sqrt(2) times 0.3 px, less what 129 unknowns take of 3998 numbers, is 0.417 px; this seed gives 0.4163 px
    assert ours["rms_px"] == pytest.approx(0.417, abs=0.003)
    assert ours["mirrored"] == 0
    (row,) = (line.split() for line in printed.splitlines() if line.split()[:1] == ["ceres-cal"])
    assert f"{ours['rms_px']:.4f}" in row
    for name in ("opencv", "pycolmap"):
        # Their solves end at different tolerances: 0.4163 and 0.4167 px.
        assert found["solvers"][name]["rms_px"] == pytest.approx(ours["rms_px"], abs=0.001), name
    if report["import_seconds"]["mrcal"] is None:
        assert "mrcal is skipped" in printed
    assert np.isfinite(report["uncertainty_share"]) and "standard deviations of everything add" in printed
    (field,) = report["field"]
    assert field["rms_px"] == pytest.approx(0.3, abs=0.03)  # 0.293 of 1000 line points


@pytest.mark.thorough
def test_scale_leaves_nothing_behind(tmp_path: Path) -> None:
    pytest.importorskip("distributed", reason="Dask is an extra: pip install 'ceres-cal[dask]'")
    path, folder = tmp_path / "report.json", tmp_path / "folder"
    folder.mkdir()
    chosen = ["--scale", "4e3", "--workers", "1", "--scale-frames", "20,40", "--repeat", "1"]
    printed = subprocess.run(
        [sys.executable, str(SCRIPT), *chosen, "--json", str(path)],
        capture_output=True, text=True, check=True, env={**os.environ, "TMPDIR": str(folder)},
    ).stdout  # fmt: skip
    report = json.loads(path.read_text(encoding="utf-8"))
    assert not list(folder.iterdir())
    (row,) = report["stored"]
    assert abs(row["focal_error_px"]) < 1.0  # -0.30 measured
    assert all(one["peak_mib"] > 10.0 for one in (row, *report["frames"])) and row["worker_mib"] > 10.0
    assert "power" in printed and row["iteration_bytes"] < 10_000


def test_lenses_are_timed_side_by_side(tmp_path: Path) -> None:
    path = tmp_path / "report.json"
    command = [sys.executable, str(SCRIPT), "--lenses", "--frames", "20", "--repeat", "1", "--warm-up", "0"]
    printed = subprocess.run([*command, "--json", str(path)], capture_output=True, text=True, check=True).stdout
    (row,) = json.loads(path.read_text(encoding="utf-8"))["lenses"]
    assert row["chosen"] == "brown k1 k2 p1 p2" and row["chosen"] in printed
    assert row["spline_times"] == pytest.approx(row["spline"] / row["brown"])
    assert row["auto_adds"] == pytest.approx(100.0 * (row["auto"] / row["by_name"] - 1.0))
