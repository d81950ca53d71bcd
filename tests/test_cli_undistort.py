"""undistort, and reports with photographs, as users type them."""

import errno
import json
import os
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from photos import shots as script
from test_cli import Say, refused, say

from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli.terminal import ProgressBar
from ceres_cal.detect.photographs import FieldOptions, detect_field
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Station

__all__ = ["say"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, plain_shot: script.Shot) -> Path:
    """A photograph, the lines detected in it, and calibrations."""
    place = tmp_path_factory.mktemp("undistort")
    shot = plain_shot
    (place / "in").mkdir()
    cv2.imwrite(str(place / "in" / "shot.png"), shot.picture.image)
    asked = FieldOptions(points=True)  # for the closed form
    found = detect_field([place / "in" / "shot.png"], shot.target, script.clicks(shot, 0), options=asked)
    found.observations.save(place / "obs.json")
    options = script.OPTIONS[shot.camera.lens.kind]
    calibration = calibrate(found.observations, options)
    calibration.save(place / "c.json")
    calibrate(found.observations, replace(options, closed_form_only=True)).save(place / "closed.json")
    stations = calibration.estimate.stations
    moved = Station("camera", script.off_by(calibration.station(), 0.01, 1).cam_from_world)
    both = replace(calibration.estimate, stations={**stations, "second": moved})
    replace(calibration, estimate=both, posterior=None).save(place / "two.json")
    return place


def test_straight_images(say: Say, folder: Path) -> None:
    out = folder / "new" / "straight"
    said = say("undistort", folder / "c.json", folder / "in", "-o", out)
    assert said.code == 0 and said.err == ""
    first, second = said.out.splitlines()
    assert first.startswith(f"{out / 'shot-straight.png'}: 1280 x 960 px, phi ") and "nothing black" in first
    assert second == f"{out / 'straight.json'}: the straight image's camera: its matrix K, no distortion, its pose"
    picture = cv2.imread(str(out / "shot-straight.png"))
    assert picture is not None and picture.shape == (960, 1280, 3) and picture.max() > 150
    about = json.loads((out / "straight.json").read_text())
    matrix = np.array(about["matrix"])
    assert about["phi"] == matrix[0, 0] == matrix[1, 1] and about["black_px"] == 0
    # K and the pose project points of the field to their pixels, since the undistorted image is a pinhole's.
    camera = Calibration.load(folder / "c.json").station()
    place = np.array([-2.0, 1.0, 0.0])
    seen = matrix @ (np.array(about["rotation"]) @ place + about["translation_m"])
    ray = np.linalg.inv(matrix) @ (seen / seen[2])
    assert camera.rays(camera.project([place]))[0] == pytest.approx(ray / np.linalg.norm(ray), abs=1e-9)
    answer = json.loads(say("undistort", folder / "c.json", folder / "in", "-o", out, "--whole", "--json").out)
    assert answer["shown"] == 1.0 and answer["black_px"] > 0 and answer["output"] == str(out / "straight.json")
    assert [one["output"] for one in answer["pictures"]] == [str(out / "shot-straight.png")]


def test_sizes_and_formats(say: Say, folder: Path) -> None:
    out, photograph = folder / "sizes", folder / "in" / "shot.png"
    say("undistort", folder / "c.json", photograph, "-o", out, "--size", "640x400", "--format", "jpg")
    small = cv2.imread(str(out / "shot-straight.jpg"))
    assert small is not None and small.shape == (400, 640, 3)
    said = say("undistort", folder / "c.json", photograph, "-o", out, "--phi", "500", "--whole", "--json")
    answer = json.loads(said.out)
    assert answer["phi"] == 500.0 and answer["image_size"] != [1280, 960]


def test_the_top_view(say: Say, folder: Path) -> None:
    out = folder / "top"
    said = say("undistort", folder / "c.json", folder / "in", "-o", out, "--top-view", "--mm-per-px", "10")
    assert "960 x 660 px of 10 mm, x -4.8 to 4.8 m, y -3.3 to 3.3 m at 0 mm, " in said.out and " black" in said.out
    arguments = ("--top-view", "--area=-4.5,-3,0,3", "--height-mm", "150", "--json")
    answer = json.loads(say("undistort", folder / "c.json", folder / "in", "-o", out, *arguments).out)
    assert answer["image_size"] == [900, 1200] and answer["area_m"] == pytest.approx([-4.5, -3.0, 0.0, 3.0])
    assert answer["top_left_pixel_m"] == pytest.approx([-4.4975, 2.9975]) and answer["height_m"] == 0.15
    picture = cv2.imread(str(out / "shot-top.png"))
    assert picture is not None and picture.shape == (1200, 900, 3)


def test_overlays(say: Say, folder: Path) -> None:
    out = folder / "overlay"
    more = (
        "--overlay",
        "--before",
        folder / "closed.json",
        "--observations",
        folder / "obs.json",
        "--height-mm",
        "150",
    )
    said = say("undistort", folder / "c.json", folder / "in", "-o", out, *more)
    assert said.code == 0 and re.search(r"shot-overlay\.png: field: \d+ lines and points in view; [\d.]+ px", said.out)
    drawn, plain = (cv2.imread(str(path)) for path in (out / "shot-overlay.png", folder / "in" / "shot.png"))
    assert drawn is not None and plain is not None and drawn.shape == plain.shape
    assert 0.005 < np.mean(np.any(drawn != plain, axis=2)) < 0.2
    assert say("undistort", folder / "c.json", folder / "in", "-o", out, "--overlay").code == 0


def test_ctrl_c_says_what_is_written(say: Say, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(ProgressBar, "update", interrupt)
    out = folder / "interrupted"
    line = refused(say("undistort", folder / "c.json", folder / "in", "-o", out), code=130)
    assert line == f"ceres-cal: interrupted: files written: {out / 'shot-straight.png'}\n"
    assert [path.name for path in out.iterdir()] == ["shot-straight.png"]


def test_several_stations(say: Say, folder: Path) -> None:
    two, photograph, out = folder / "two.json", folder / "in" / "shot.png", folder / "several"
    answer = json.loads(say("undistort", two, photograph, "-o", out, "--json").out)
    assert answer["station"] is None and "rotation" not in answer  # undistorted all the same
    assert "name one: --station camera or second" in refused(say("undistort", two, photograph, "-o", out, "--top-view"))
    named = say("undistort", two, photograph, "-o", out, "--top-view", "--station", "second", "--json")
    assert json.loads(named.out)["station"] == "second"
    assert "there is no camera 'x'" in refused(say("undistort", two, photograph, "-o", out, "--camera", "x"))
    assert "there is no station 'x'" in refused(say("undistort", two, photograph, "-o", out, "--station", "x"))


def test_refusals(say: Say, folder: Path, tmp_path: Path) -> None:
    photograph, out = folder / "in" / "shot.png", tmp_path / "out"
    small, text = tmp_path / "small.png", tmp_path / "text.png"
    cv2.imwrite(str(small), np.zeros((48, 64), np.uint8))
    text.write_text("no image")
    (tmp_path / "again").mkdir()
    (tmp_path / "again" / "shot.png").write_bytes(photograph.read_bytes())
    (tmp_path / "file").write_text("")
    for arguments, message in (
        ((small,), "64 x 48 px, but camera 'camera' has 1280 x 960"),
        ((text,), "not an image"),
        ((tmp_path / "missing.png",), "no such file"),
        ((photograph, tmp_path / "again" / "shot.png"), "would both become"),
        ((photograph, "--top-view", "--overlay"), "two kinds of pictures"),
        ((photograph, "--area", "0,0,1,1"), "--area needs --top-view"),
        ((photograph, "--overlay", "--whole"), "--whole is for straight images"),
        ((photograph, "--height-mm", "150"), "--height-mm needs --top-view or --overlay"),
        ((photograph, "--size", "12"), "write WIDTHxHEIGHT"),
        ((photograph, "--size", "0x7"), "0 x 7 px"),
        ((photograph, "--phi", "nan"), "not a finite number"),
        ((photograph, "--angle", "190"), "must be 1 to 175 degrees"),
        ((photograph, "--top-view", "--area", "1,2,3"), "write X0,Y0,X1,Y1"),
        ((photograph, "--top-view", "--area", "1,2,0,3"), "x0 below x1"),
        ((photograph, "--top-view", "--mm-per-px", "0"), "above 0 mm per pixel"),
        ((photograph, "--overlay", "--before", tmp_path / "missing.json"), "no such file"),
    ):
        assert message in refused(say("undistort", folder / "c.json", *arguments, "-o", out)), message
        assert not out.exists() or list(out.iterdir()) == []
    assert "is a file" in refused(say("undistort", folder / "c.json", photograph, "-o", tmp_path / "file"))
    straight = folder / "in2"
    straight.mkdir()
    (straight / "a-straight.png").write_bytes(photograph.read_bytes())
    (straight / "a.png").write_bytes(photograph.read_bytes())
    assert "is an input" in refused(say("undistort", folder / "c.json", straight, "-o", straight))


def test_a_folder_whose_name_is_no_utf8(say: Say, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "ou\udce9t"
    assert say("undistort", folder / "c.json", folder / "in", "-o", out, "--size", "64x48", "--json").code == 0
    (picture,) = json.loads((out / "straight.json").read_text())["pictures"]
    assert picture["output"] == str(tmp_path / "ou\\udce9t" / "shot-straight.png")


# ---- the report -----------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("words_alone")
def test_reports_with_photographs(say: Say, folder: Path, tmp_path: Path) -> None:
    page, images = tmp_path / "page.html", ("--images", folder / "in")
    said = say("calibrate", folder / "obs.json", "--report", page, *images, "--quiet")
    assert said.code == 0
    text = page.read_text(encoding="utf-8")
    sections = re.findall(r'<section id="(\w+)"', text)
    assert sections == ["verdict", "photographs", "support", "findings", "numbers", "residuals", "maps", "solve"]
    (photograph,) = re.findall(r'<figure id="photograph-0".*?</figure>', text, flags=re.S)
    assert 'src="data:image/jpeg;base64,' in photograph and "the paper&#x27;s closed form, " in photograph
    assert len(photograph) < 320_000
    seen, later = Observations.load(folder / "obs.json"), tmp_path / "later.json"
    replace(seen, points=replace(seen.points, pixels=seen.points.pixels + 0.05)).save(later)
    refit = ("refit", folder / "c.json", later, "--report", page, *images)
    assert say(*refit).code == 0 and "Cyan: the calibration before, " in page.read_text(encoding="utf-8")
    assert say("diagnose", folder / "c.json", folder / "obs.json", "--report", page, *images).code in (0, 1)
    assert '<section id="photographs"' in page.read_text(encoding="utf-8")


def _full_disk(_: int, target: Path) -> None:
    """A disk that has room for a calibration but not for a page."""
    if target.suffix == ".html":
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_photographs_that_do_not_belong(say: Say, folder: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "other.png"
    cv2.imwrite(str(wrong), np.zeros((48, 64), np.uint8))
    command = ("calibrate", folder / "obs.json", "--report", tmp_path / "page.html", "--quiet", "--images")
    assert "called like a frame of the observations, such as 'shot'" in refused(say(*command, wrong))
    wrong.rename(tmp_path / "shot.png")
    # An error in the report leaves the calibration unchanged.
    said = say(*command, tmp_path / "shot.png", "-o", tmp_path / "c.json")
    assert said.code == 1 and said.err == "" and (tmp_path / "c.json").exists()
    assert said.out.startswith("This calibration ")
    why = f"{tmp_path / 'shot.png'}: 64 x 48 px, but camera 'camera' has 1280 x 960"
    assert f"\nerror     no report: {why}" in said.out
    (tmp_path / "folder.html").mkdir()
    page = ("--report", tmp_path / "folder.html" / "page.html", "-o", tmp_path / "d.json")
    with pytest.MonkeyPatch.context() as full:
        full.setattr("ceres_cal.base.files._keep_owner", _full_disk)
        said = say("calibrate", folder / "obs.json", *page, "--quiet")
    assert said.code == 1 and (tmp_path / "d.json").exists() and not page[1].exists()
    assert said.out.endswith(f"\nerror     no report: {page[1]}: cannot be written: No space left on device\n")
    assert "--images needs --report" in refused(say("calibrate", folder / "obs.json", "--images", wrong))
    assert not (tmp_path / "page.html").exists()
