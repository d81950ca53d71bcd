"""refit and check from photographs: the sample's, of a camera before and after it was knocked."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import refit_after_move
from scenes import RADIAL
from test_cli import ROOT, Say, refused, say

from ceres_cal.base.errors import InputError, NothingShownError
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.detect.photographs import check_photographs, detect_field, detect_known
from ceres_cal.moves.checks import check
from ceres_cal.moves.refits import movements, refit
from ceres_cal.observations import Observations, combine
from ceres_cal.report.grounds import grounds
from ceres_cal.report.quality import quality_of
from ceres_cal.scene.camera import Camera
from ceres_cal.simulate import built_in_scene

__all__ = ["say"]

HOME = ROOT / "data" / "ssl_field" / "photographs"
NEW, BOARD = HOME / "0003.jpg", HOME / "board_08.jpg"
KNOCKED = ROOT / "data" / "ssl_field_moved" / "photographs" / "0001.jpg"


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    """The sample camera from two photographs of its field and four of boards, which the tests do not use."""
    scene, _ = built_in_scene("ssl-field")
    field = detect_field([HOME / "0001.jpg", HOME / "0002.jpg"], scene.targets["field"], scene.camera_at("overhead"))
    boards = detect_boards([HOME / f"board_{i:02d}.jpg" for i in range(1, 5)], scene.targets["board"])
    return calibrate(combine([field.observations, boards.observations]), RADIAL)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, calibration: Calibration) -> Path:
    place = tmp_path_factory.mktemp("photographs")
    calibration.save(place / "old.json")
    cv2.imwrite(str(place / "dark.png"), np.zeros((960, 1280), np.uint8))
    return place


def floor_error_mm(truth: Camera, found: Camera) -> float:
    """Largest error of places on the floor over the middle nine tenths of the image."""
    x, y = np.meshgrid(np.linspace(64.0, 1216.0, 15), np.linspace(48.0, 912.0, 12))
    pixels = np.column_stack([x.ravel(), y.ravel()])
    return float(np.max(1e3 * np.linalg.norm(found.locate(pixels) - truth.locate(pixels), axis=1)))


def knocked_truth() -> Camera:
    scene, _ = built_in_scene("ssl-field")
    entry = json.loads((KNOCKED.parents[1] / "truth.json").read_text())["stations"]["overhead"]
    return scene.camera_at("overhead").at(Pose.looking(entry["position_m"], np.array(entry["rotation"])))


def test_boards_and_fields_are_weighed_together(calibration: Calibration) -> None:
    assert calibration.fit.point_scale == pytest.approx(1.0, abs=0.1)  # 0.98
    assert calibration.fit.curve_scale == pytest.approx(1.0, abs=0.1)  # 0.98
    assert len(calibration.rejected) <= 3  # 0: stated at 1 px, boards made outliers of all crossings
    scene, _ = built_in_scene("ssl-field")
    assert floor_error_mm(scene.camera_at("overhead"), calibration.station()) < 0.3  # 0.05 mm


def test_an_unmoved_camera_holds(calibration: Calibration) -> None:
    found, seen = check_photographs(calibration, [NEW])
    station = found["camera"]
    assert found.holds and station.change is not None and station.misfit.noise[0] == pytest.approx(1.0, abs=0.2)  # 0.97
    assert station.change.moved_mm < 1.0 and station.change.turned_deg < 0.02
    assert seen.shown == {"field": 1} and seen.missed == () and seen.station == "camera"


def test_a_knock_is_found_and_mended(calibration: Calibration) -> None:
    found, seen = check_photographs(calibration, [KNOCKED])
    station, truth = found["camera"], knocked_truth()
    assert not found.holds and station.probability == pytest.approx(0.0, abs=1e-9) and station.change is not None
    assert station.change.moved_mm == pytest.approx(18.79, abs=1.0)
    assert station.change.turned_deg == pytest.approx(1.077, abs=0.01)
    mended = refit(calibration, seen.require())
    assert floor_error_mm(truth, calibration.station()) > 20.0
    assert floor_error_mm(truth, mended.station()) < 0.5  # 0.07 mm
    assert check(mended, seen.require()).holds
    assert movements(calibration, mended)["camera"][1] == pytest.approx(1.077, abs=0.005)


@pytest.mark.thorough
def test_everything_known_is_found_and_what_shows_nothing_is_named(calibration: Calibration, folder: Path) -> None:
    steps: list[tuple[int, int, str]] = []
    images = [NEW, BOARD, folder / "dark.png"]
    found = detect_known(calibration, images, progress=lambda *step: steps.append(step))
    seen = found.require()
    assert found.shown == {"field": 1, "board": 1} and found.images == 3
    ((path, reason),) = found.missed
    assert path == str(folder / "dark.png") and "lines were not found" in reason and "no chessboard" in reason
    assert {(view.frame, view.target, view.placement) for view in seen.views} == {
        ("0003", "field", None),
        ("board_08", "board", "board_08"),
    }
    with pytest.raises(NothingShownError, match=r"in any of 3 photographs within .*dark\.png"):
        replace(found, observations=None).require()
    assert [step[:2] for step in steps] == [(i, 6) for i in range(1, 7)]


def test_names_are_those_of_the_calibration(calibration: Calibration) -> None:
    targets = {"pitch": calibration.targets["field"]}
    found = detect_known(replace(calibration, targets=targets), [NEW], not_painted=["CenterLine"]).require()
    assert found.targets == targets and {view.target for view in found.views} == {"pitch"}
    painted = {found.feature_name("curve", row) for row in range(len(found.curves))}
    assert "HalfwayLine" in painted and "CenterLine" not in painted


def test_what_cannot_be_looked_for(calibration: Calibration) -> None:
    with pytest.raises(InputError, match="there is no station 'left'"):
        detect_known(calibration, [NEW], "left")
    with pytest.raises(InputError, match="curve 'Nowhere' is not one of"):
        detect_known(calibration, [NEW], not_painted=["Nowhere"])
    boards_only = replace(calibration, targets={"board": calibration.targets["board"]})
    with pytest.raises(InputError, match=r"targets \(board\) have no painted lines: give a file"):
        check_photographs(boards_only, [NEW])


def test_commands(say: Say, folder: Path) -> None:
    """For a moved camera, and for a picture that shows nothing; the test of docs/cron.md has the others."""
    old = folder / "old.json"
    moved = say("check", old, KNOCKED, "--json")
    data = json.loads(moved.out)
    assert moved.code == 1 and data["photographs"] == {"images": 1, "shown": {"field": 1}, "missed": []}
    lost = say("check", old, folder / "dark.png")
    assert lost.code == 1 and "station   camera not found: no field within" in lost.out
    assert f"field in 0\n          {folder / 'dark.png'}: its lines were not found" in lost.out


def test_wrong_input_is_refused_in_one_line(say: Say, folder: Path) -> None:
    old = folder / "old.json"
    detect_known(Calibration.load(old), [NEW], boards=False).require().save(folder / "seen.json")
    assert Observations.load(folder / "seen.json").views[0].frame == "0003"
    for arguments, message in (
        (("check", old, NEW, folder / "seen.json"), "observations cannot be mixed with photographs"),
        (("check", old, NEW, NEW), "given twice"),
        (("check", old, folder / "gone.jpg"), "no such file"),
        (("check", old, NEW, "--station", "left"), "there is no station 'left'"),
        (("check", old, folder / "seen.json", "--station", "camera"), "are of photographs"),
        (("check", old, ROOT / "data" / "field_2004" / "photographs"), "780 x 580 px"),
        (("check", old, NEW, "--not-painted", "Nowhere"), "curve 'Nowhere' is not one of"),
        (("refit", old, NEW, "-o", NEW), "is an input"),
    ):
        assert message in refused(say(*arguments, "--quiet"))


@pytest.mark.thorough
def test_a_folder_of_photographs_is_kept_up_with(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = tmp_path / "calibration.json"
    place.write_bytes((folder / "old.json").read_bytes())
    (tmp_path / "cut.jpg").write_bytes(NEW.read_bytes()[:200])
    images = [NEW, folder / "dark.png", KNOCKED, KNOCKED, tmp_path / "cut.jpg"]
    assert refit_after_move.main([str(path) for path in (place, *images)]) == 3
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["event"] for event in events] == ["holds", "suspected", "refitted", "holds", "unreadable"]
    assert "no field within" in str(events[1])
    assert floor_error_mm(knocked_truth(), Calibration.load(place).station()) < 0.5


def test_the_report_says_what_a_photograph_says_of_its_floor() -> None:
    """The floor is flat; the prior probability of a bowed one is one in five."""
    scene, _ = built_in_scene("ssl-field")
    seen = detect_field([NEW], scene.targets["field"], scene.camera_at("overhead")).observations
    calibration = calibrate(seen, RADIAL)
    floors = {one.kind: one.probability for one in calibration.effects}
    assert floors.keys() == {"floor bowed", "field sheared"} and floors["floor bowed"] < 0.005
    assert not any("solved for" in one for one in calibration.warnings)
    (said,) = [line for _, line in grounds(quality_of(calibration, seen)) if "--as-drawn" in line]
    assert "bowed" not in said  # 0.04 %
    assert f"'field sheared by 1.5\xa0mm' is {floors['field sheared'] * 100:.0f} % likely" in said  # 1 %
