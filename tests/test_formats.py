"""The table of export formats: a new format is exported to like the built-in ones."""

import json
from functools import cache
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
from scenes import RADIAL, lines_and_arcs

from ceres_cal import Calibration, InputError, calibrate
from ceres_cal.cli import main
from ceres_cal.formats import EXPORT_FORMATS, Export, ExportFormat, ExportLoss, ExportRequest, LookupTable, export
from ceres_cal.simulate import Disturbance, simulate


def write_toy(
    request: ExportRequest,
    *,
    digits: Annotated[int, "after the point"] = 3,
    comment: Annotated[str, "what to say of it"] = "",
) -> Export:
    """phi of each station's camera with so many digits; the previous content stays above."""
    cameras = {name: request.calibration.station(name) for name in request.stations}
    lines = [f"{name} {camera.phi:.{digits}f}" for name, camera in cameras.items()]
    lines = [comment, *lines] if comment else lines
    losses = tuple(ExportLoss(name, {0.0: (0.1, 0.2), 0.15: (0.3, 0.4)}, (0.01, 0.02)) for name in cameras)
    before = request.existing or b""
    return Export(
        before + "\n".join(lines).encode(), losses, f"{len(lines)} lines", {"lines": len(lines)}, ("toys break",)
    )


def write_folder(request: ExportRequest) -> Export:
    return Export({f"{name}.txt": b"here" for name in request.stations}, (), "a file for each station")


TOY = ExportFormat("toy", "for this test", (".toy", ".gz.toy"), write_toy, most_stations=None, edits=True)
FOLDER = ExportFormat("folder", "for this test, too", (), write_folder)


@pytest.fixture(autouse=True)
def in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(EXPORT_FORMATS, "toy", TOY)
    monkeypatch.setitem(EXPORT_FORMATS, "folder", FOLDER)


@cache
def calibrated() -> Calibration:
    noise = Disturbance(curves_sigma_px=0.2)
    return calibrate(simulate(lines_and_arcs("radial-2-3"), noise, seed=1).observations, RADIAL)


@cache
def saved(folder: Path) -> Path:
    calibrated().save(folder / "calibration.json")
    return folder / "calibration.json"


def test_from_python(tmp_path: Path) -> None:
    exported = export(calibrated(), "toy", tmp_path / "a.toy", digits=1)
    phi = calibrated().station().phi
    assert (tmp_path / "a.toy").read_text() == f"overhead {phi:.1f}"
    assert exported.losses[0].field_mm[0.15] == (0.3, 0.4) and exported.warnings == ("toys break",)
    export(calibrated(), "toy", tmp_path / "a.toy", ["overhead"], digits=0)  # it edits the existing file
    assert (tmp_path / "a.toy").read_text() == f"overhead {phi:.1f}overhead {phi:.0f}"
    export(calibrated(), "folder", tmp_path / "many")
    assert (tmp_path / "many" / "overhead.txt").read_bytes() == b"here"


def test_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.toy"
    ask = ["export", str(saved(tmp_path)), "--to", "toy", "-o", str(out), "--comment", "hello", "--digits", "2"]
    assert main(ask) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == f"toy       2 lines, written to {out}"
    assert said[1:] == [
        "off       overhead: 0.1 mm rms, 0.2 mm at most, on the floor",
        "off       overhead: 0.3 mm rms, 0.4 mm at most, at 150 mm",
        "off       overhead: 0.01 px rms, 0.02 px at most, over the image",
        "warning   toys break",
    ]
    assert out.read_text() == f"hello\noverhead {calibrated().station().phi:.2f}"
    assert main([*ask, "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["lines"] == 2 and data["format"] == "toy"
    assert data["errors"][1] == {"station": "overhead", "height_m": 0.15, "rms_mm": 0.3, "worst_mm": 0.4}
    assert data["errors_px"] == [{"station": "overhead", "rms_px": 0.01, "worst_px": 0.02}]
    assert main(["export", str(saved(tmp_path)), "--to", "folder", "-o", str(tmp_path / "many")]) == 0
    assert (tmp_path / "many" / "overhead.txt").exists()
    assert main(["export", "--help"]) == 0
    helped = " ".join(capsys.readouterr().out.split())
    assert "toy: for this test (.toy, .gz.toy)" in helped and "a folder" in helped and "--digits" in helped
    assert "table: a look-up table from pixels to the field (.npz)" in helped


def test_the_look_up_table_is_a_format(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, new = tmp_path / "old.npz", tmp_path / "new.npz"
    assert main(["export-table", str(saved(tmp_path)), "-o", str(old), "--error-mm", "1"]) == 0
    said = capsys.readouterr().out
    assert main(["export", str(saved(tmp_path)), "--to", "table", "-o", str(new), "--error-mm", "1"]) == 0
    assert capsys.readouterr().out == said.replace("old.npz", "new.npz")
    exported = export(calibrated(), "table", tmp_path / "python.npz", error_mm=1.0)
    one, other = LookupTable.load(old), LookupTable.load(new)
    assert np.array_equal(one.floor_m, other.floor_m, equal_nan=True) and one.error_mm == other.error_mm
    assert exported.losses == (ExportLoss("overhead", one.error_mm),) and exported.losses[0].field_mm[0.0][1] <= 1.0


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("--to", "shoes", "-o", "a.toy"), "no export format 'shoes': choose one of table, "),
        (("--to", "toy", "-o", "a.txt"), "a.txt: a file of format toy ends in .toy or .gz.toy"),
        (("--to", "toy", "-o", "a.toy", "--station", "x"), "there is no station 'x'"),
        (("--to", "toy", "-o", "a.toy", "--digits", "x"), "--digits: 'x' is not a valid value"),
        (("--to", "toy", "-o", "a.toy", "--step-px", "4"), "--step-px is not an option of format toy"),
        (("--to", "folder", "-o", "d", "--station", "overhead", "--station", "overhead"), "holds one station, not 2"),
        (("--to", "table", "-o", "t.npz", "--error-mm", "nan"), "--error-mm: 'nan' is not a finite number"),
        (("--to", "toy", "-o", "calibration.json"), "is an input, and the output would replace it"),
    ],
)
def test_what_cannot_be_exported_is_one_line(
    arguments: tuple[str, ...],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    saved(tmp_path)
    monkeypatch.chdir(tmp_path)
    assert main(["export", "calibration.json", *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert words in line
    assert [path.name for path in tmp_path.iterdir()] == ["calibration.json"]


def test_without_any_format(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in reversed(list(EXPORT_FORMATS)):  # they come back the other way round
        monkeypatch.delitem(EXPORT_FORMATS, name)
    assert main(["export", str(tmp_path / "c.json"), "--to", "toy", "-o", str(tmp_path / "a.toy")]) == 2
    assert "no export format 'toy': none is known" in capsys.readouterr().err


def test_from_python_refusals(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no option of format toy 'size': choose one of digits, comment"):
        export(calibrated(), "toy", tmp_path / "a.toy", size=3)
    with pytest.raises(InputError, match="there is no option of format folder 'size': none is known"):
        export(calibrated(), "folder", tmp_path / "a", size=3)
