"""Inputs that ended badly once, made by other programs: what is right for each stands in the README beside them."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from ceres_cal.calibration import Calibration
from ceres_cal.cli import main

HELD = ("--lens", "brown", *(part for name in ("k1", "k2", "k3", "p1", "p2") for part in ("--fix", f"{name}=0")))


@pytest.fixture
def case(real_data: Path) -> Callable[[str], str]:
    """The path of a case by its name; skips where the cases are not there."""

    def path(name: str) -> str:
        file = real_data / "cases" / name
        if not file.exists():
            pytest.skip(f"no case: {file} is not there")
        return str(file)

    return path


def refused(capfd: pytest.CaptureFixture[str], *arguments: str) -> str:
    """The one line that a refused command prints."""
    assert main(["calibrate", *arguments, "--quiet"]) in (2, 3)
    shown = capfd.readouterr()
    assert shown.out == ""
    (line,) = shown.err.splitlines()
    assert "unexpected" not in line and "Warning" not in line
    return line


def calibrated(tmp_path: Path, *arguments: str) -> Calibration:
    file = str(tmp_path / "calibration.json")
    assert main(["calibrate", *arguments, "-o", file]) == 0
    return Calibration.load(file)


@pytest.mark.parametrize(
    "name, words",
    [
        ("onesigma.json", "point 'TopHalfwayCrossing': its sigma_px is 1e-12 where 0.3 is usual"),
        ("px1e7.json", "point 'BottomLeftCorner': pixel (96.2, 1e+07) lies"),
        ("one_curve_pixel.json", "curve 'ring_32': pixel (1e+308, 65.6) lies"),
        ("im1e5.json", "is image_size that of the pictures?"),
    ],
)
def test_an_impossible_number_is_named(
    case: Callable[[str], str], capfd: pytest.CaptureFixture[str], name: str, words: str
) -> None:
    assert words in refused(capfd, case(name))


def test_as_many_equations_as_numbers(case: Callable[[str], str], capfd: pytest.CaptureFixture[str]) -> None:
    """soak48: four views of four corners are 32 equations for 32 numbers."""
    assert "choose fewer or other coefficients" in refused(capfd, case("soak48.json"), "--lens", "brown")


@pytest.mark.parametrize("name", ["zero_division.json", "no_agree.json"])
def test_exact_data_gives_the_exact_camera(case: Callable[[str], str], tmp_path: Path, name: str) -> None:
    found = calibrated(tmp_path, case(name), *HELD, "--hold-principal-point")
    assert abs(found.cameras["c"].phi - 800.0) < 1e-6  # 1e-12 measured
    assert abs(found.stations["c"].position[2] - 4.0) < 1e-6
    assert not found.conflicts and np.isfinite(found.uncertainty.verdict("camera", "c", "phi").sd)


def test_lines_in_two_directions_are_not_called_parallel(
    case: Callable[[str], str], capfd: pytest.CaptureFixture[str]
) -> None:
    """two_by_two_lines: a plane's pose follows from two lines in each of two directions."""
    path = case("two_by_two_lines.json")
    assert len(json.loads(Path(path).read_text())["views"]) == 1
    assert "parallel" not in refused(capfd, path)
