"""refit, check, compare and export-table as users type them."""

import json
import shutil
from pathlib import Path

import pytest
from test_cli import Say, refused, say

from ceres_cal.calibration import Calibration
from ceres_cal.formats import LookupTable

__all__ = ["say"]


@pytest.fixture(scope="module")
def folder(files_of_a_move: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return Path(shutil.copytree(files_of_a_move, tmp_path_factory.mktemp("moves"), dirs_exist_ok=True))


def test_refit(say: Say, folder: Path) -> None:
    said = say("refit", folder / "old.json", folder / "after.json", "-o", folder / "new.json")
    assert said.code == 0 and said.err == ""
    assert said.out.startswith("refit     station 'overhead' moved by ") and "under what was known of it" in said.out
    assert Calibration.load(folder / "new.json").refitted is not None
    data = json.loads(say("refit", folder / "old.json", folder / "after.json", "--json").out)
    assert data["what"] == "pose" and 300.0 < data["moved"]["overhead"]["mm"] < 350.0
    prior = say("refit", folder / "old.json", folder / "after.json", "--prior", "height_m=4.002:0.0001", "--json")
    height = json.loads(prior.out)["calibration"]["stations"]["overhead"]["position_m"][2]
    assert height == pytest.approx(4.002, abs=0.0003)


def test_refit_may_replace_the_old_calibration(say: Say, folder: Path) -> None:
    (folder / "kept.json").write_bytes((folder / "old.json").read_bytes())
    assert say("refit", folder / "kept.json", folder / "after.json", "-o", folder / "kept.json").code == 0
    assert say("check", folder / "kept.json", folder / "after.json").code == 0


def test_refit_refuses_in_one_line(say: Say, folder: Path) -> None:
    old, after = folder / "old.json", folder / "after.json"
    assert "mirrored labels" in refused(say("refit", old, folder / "mirrored.json", "-o", folder / "x.json"), 3)
    assert not (folder / "x.json").exists()
    assert "is an input" in refused(say("refit", old, after, "-o", after))
    assert "given twice" in refused(say("refit", old, after, after))
    assert "no such file" in refused(say("refit", old, folder / "missing.json"))
    assert "was not observed" in refused(say("refit", old, after, "--moved", "other"))
    for prior in ("overhead.phi=868:1", "elsewhere.height_m=4:1", "height_m=4", "height_m=4:0"):
        refused(say("refit", old, after, "--prior", prior))


def test_check_answers_with_its_exit_code(say: Say, folder: Path) -> None:
    said = say("check", folder / "old.json", folder / "same.json")
    assert said.code == 0 and said.out.startswith("check     yes (1 % false alarms)\n")
    said = say("check", folder / "old.json", folder / "after.json", "--false-alarms", "0.1%")
    assert said.code == 1 and said.out.startswith("check     no (0.1 % false alarms)\n") and "deg" in said.out
    said = say("check", folder / "old.json", folder / "after.json", "--json")
    found = json.loads(said.out)
    assert said.code == 1 and found["holds"] is False and found["stations"]["overhead"]["probability"] == 0.0
    for share in ("0", "1", "200%", "x"):
        assert "--false-alarms" in refused(
            say("check", folder / "old.json", folder / "same.json", "--false-alarms", share)
        )


def test_compare(say: Say, folder: Path) -> None:
    say("refit", folder / "old.json", folder / "after.json", "-o", folder / "b.json")
    said = say("compare", folder / "old.json", folder / "b.json", "--picture", folder / "map.svg")
    assert said.code == 0 and "more than their uncertainties explain" in said.out
    assert (folder / "map.svg").read_text().startswith("<svg ")
    data = json.loads(say("compare", folder / "old.json", folder / "b.json", "--height-mm", "150", "--json").out)
    found = data["stations"]["overhead"]
    assert found["height_m"] == 0.15 and found["explained_by_uncertainty"] is False
    assert len(found["difference_mm"]) == len(found["y_m"]) and None in found["expected_mm"][0]
    assert "not in both" in refused(say("compare", folder / "old.json", folder / "b.json", "--station", "x"))


def test_export_table(say: Say, folder: Path) -> None:
    said = say("export-table", folder / "old.json", "-o", folder / "table.npz", "--error-mm", "1")
    assert said.code == 0 and "mm at most, at 150 mm" in said.out
    table = LookupTable.load(folder / "table.npz")
    assert table.station == "overhead" and table.error_mm[0.15][1] <= 1.0
    assert "above 0" in refused(say("export-table", folder / "old.json", "-o", folder / "t.npz", "--error-mm", "0"))
