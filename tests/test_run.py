"""`ceres-cal run`: from photographs or a video to a calibration that can be trusted, or one that states why not."""

import json
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from ceres_cal import detect_board, run
from ceres_cal.base.arrays import AnyArray
from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.base.images import each_camera
from ceres_cal.calibration import Calibration
from ceres_cal.cli import main
from ceres_cal.cli.command import COMMANDS
from ceres_cal.cli.run import RunArguments, _attempted, _calibrated, _short, _Step
from ceres_cal.detect.video import sharpest_frames
from ceres_cal.scene.targets import checkerboard

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "ssl_field"
PHOTOGRAPH = str(SAMPLE / "photographs" / "0001.jpg")
CHARUCO = '{"kind": "charuco", "columns": 9, "rows": 6, "square_m": 0.04, "marker_m": 0.03}'
FIELD = ("--target", "ssl-b", "--facing", "LeftGoalLine=top")


def half_size(path: Path | str) -> AnyArray:
    """A photograph of 640 x 480 px, in which a field or board is found in less time."""
    return np.asarray(cv2.resize(np.asarray(cv2.imread(str(path))), (640, 480), interpolation=cv2.INTER_AREA))


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photographs of a board, in one folder."""
    folder = tmp_path_factory.mktemp("photographs")
    for name in ("board_01", "board_03", "board_05"):
        shutil.copy(SAMPLE / "photographs" / f"{name}.jpg", folder)
    return folder


@pytest.mark.usefixtures("words_alone")
def test_a_folder_to_a_camera_and_its_export(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With boards; the test of the README has also a field."""
    out = tmp_path / "camera"
    ask = ["run", str(photographs), "--lens", "radial", "--board", "9x6x100mm", "--to", "opencv", "-o", str(out)]
    assert main(ask) == 0
    said = capsys.readouterr().out
    for words in (
        f"read      3 photographs in {photographs}\n",
        "3 of 3 images show the board",
        "verdict   The intrinsics can be trusted",
        f"written   {out}/: board.json, calibration.json, opencv.yml, report.html",
    ):
        assert words in said
    assert {path.name for path in out.iterdir()} == set(said.rpartition("/: ")[2].strip().split(", "))
    (camera,) = Calibration.load(out / "calibration.json").cameras.values()
    truth = json.loads((SAMPLE / "truth.json").read_text())
    assert camera.phi == pytest.approx(truth["cameras"]["overhead"]["phi"], abs=0.5)
    # Each step is printed as a command that can be typed.
    commands = [line.partition("ceres-cal ")[2].split() for line in said.splitlines() if line.startswith("step ")]
    assert [words[0] for words in commands] == ["detect", "calibrate", "export"]
    COMMANDS["calibrate"].parse(commands[1][1:])


@pytest.mark.usefixtures("words_alone")
def test_what_cannot_be_trusted_is_not_exported_and_advice_may_fail(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise SolutionError("no advice can be given")

    monkeypatch.setattr("ceres_cal.diagnostics.advise", fails)
    wrong = ("--lens", "radial", "--prior", "phi=700:1", "--to", "paper", "-o", str(tmp_path))
    assert main(["run", PHOTOGRAPH, *FIELD, *wrong]) == 1
    said = capsys.readouterr()
    assert "error     no advice: no advice can be given\n" in said.out
    assert f"written   {tmp_path}/: calibration.json, field.json, report.html\n" in said.out
    assert (tmp_path / "report.html").exists() and not list(tmp_path.glob("paper*"))


@pytest.mark.usefixtures("words_alone")
def test_boards_alone_in_a_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = [np.asarray(cv2.imread(str(path))) for path in sorted((SAMPLE / "photographs").glob("board_0[1-6].jpg"))]
    video = tmp_path / "boards.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (1280, 960))
    for image in images:
        for sharp in (False, True, False):
            writer.write(image if sharp else cv2.GaussianBlur(image, (0, 0), 4.0))
    writer.release()
    paths = sharpest_frames(video, tmp_path / "frames", 6)
    assert [path.name for path in paths] == [f"{number:04d}.png" for number in range(1, 7)]
    for path, image in zip(paths, images, strict=True):
        assert np.mean(cv2.absdiff(np.asarray(cv2.imread(str(path))), image)) < 2.0  # 1.0 measured; blurred ones 5
    ask = ("--board", "9x6x100", "--frames", "6", "--to", "vision-processor", "-o", str(tmp_path / "out"), "--json")
    code = main(["run", str(video), *ask])
    data = json.loads(capsys.readouterr().out)
    assert code == 1 and data["steps"][2]["answer"] == {}  # that message needs a field; all else is made
    assert data["images"] == 6 and len(data["steps"]) == 3
    assert data["steps"][1]["answer"]["calibration"]["cameras"]["camera"]["phi"] == pytest.approx(868.0, abs=6.0)


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("x.jpg",), "say what the photographs show: --target ssl-b, --board 9x6x25mm, or both"),
        ((PHOTOGRAPH, "--board", "9x6"), "board '9x6': write COLUMNSxROWSxSQUARE"),
        ((PHOTOGRAPH, "--board", CHARUCO), "--board: 'dictionary' is missing"),
        ((PHOTOGRAPH, "--target", CHARUCO), "--target: 'dictionary' is missing"),
        (("x.jpg", "--target", "ssl-b"), "x.jpg: no such file"),
        ((PHOTOGRAPH, "--target", "ssl-b", "--to", "atlantis"), "there is no export format 'atlantis'"),
    ],
)
def test_wrong_usage(
    arguments: tuple[str, ...], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", *arguments, "-o", str(tmp_path / "out")]) == 2
    assert words in capsys.readouterr().err


def test_what_is_no_video(tmp_path: Path) -> None:
    (tmp_path / "no.mp4").write_bytes(b"nothing")
    for name in ("no.mp4", "missing.mp4"):
        with pytest.raises(InputError, match="not a video that OpenCV can read"):
            sharpest_frames(tmp_path / name, tmp_path / "frames", 3)


@pytest.mark.usefixtures("words_alone")
def test_photographs_whose_endings_are_in_capitals_are_in_the_report(photographs: Path, tmp_path: Path) -> None:
    given = [str(shutil.copy(path, tmp_path / path.with_suffix(".JPG").name)) for path in photographs.iterdir()]
    assert main(["run", *given, "--lens", "radial", "--board", "9x6x100mm", "-o", str(tmp_path / "out")]) == 0
    assert "data:image/jpeg" in (tmp_path / "out" / "report.html").read_text()


def test_a_plan_names_the_first_of_many_photographs() -> None:
    many = " ".join(f"{number}.jpg" for number in range(9))
    assert _short(f"ceres-cal detect board {many} --rows 6") == "ceres-cal detect board 0.jpg ... --rows 6"
    shown = " ".join(f"--images {number}.jpg" for number in range(9))
    assert _short(f"ceres-cal calibrate x.json {shown}") == "ceres-cal calibrate x.json --images 0.jpg ..."
    assert _short("ceres-cal detect field 0.jpg 1.jpg -o x") == "ceres-cal detect field 0.jpg 1.jpg -o x"


@pytest.mark.usefixtures("words_alone")
def test_a_folder_of_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One calibration of all of them, with the names of their folders or videos, and a report with a picture of each. A
    video of a field ended without a report, and two in a folder were "no images".
    """
    cameras, out = tmp_path / "cameras", tmp_path / "out"
    (cameras / "left").mkdir(parents=True)
    image = half_size(PHOTOGRAPH)
    cv2.imwrite(str(cameras / "left" / "0001.jpg"), image)
    video = cv2.VideoWriter(str(cameras / "right.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, image.shape[1::-1])
    for _ in range(3):
        video.write(np.ascontiguousarray(image[::-1, ::-1]))
    video.release()
    asked = ["run", str(cameras), "--target", "ssl-b", "--lens", "radial", "--quiet", "-o", str(out)]
    assert main(asked) == 2
    assert "say which, such as --facing left.LeftGoalLine=" in capsys.readouterr().err
    sides = ("--facing", "left.LeftGoalLine=top", "--facing", "right.LeftGoalLine=bottom")
    advised: list[str] = []  # of one of them, where the verdict has limits

    def cautiously(*given: Any) -> _Step:
        step = _calibrated(*given)
        step.data["verdict"]["level"] = "care"
        return step

    def attempted(args: RunArguments, name: str, arguments: list[str], most: int | None = None) -> _Step:
        if name != "advise":
            return _attempted(args, name, arguments, most)
        advised.extend(arguments[1:])
        return _Step(name, (), {}, 0)

    monkeypatch.setattr("ceres_cal.cli.run._calibrated", cautiously)
    monkeypatch.setattr("ceres_cal.cli.run._attempted", attempted)
    main([*asked, *sides, "--to", "opencv", "--to", "paper"])
    said = capsys.readouterr().out
    found = Calibration.load(out / "calibration.json")
    assert advised[0] == "--station" and advised[1] in found.stations
    heights = [found.station(name).position[2] for name in ("left", "right")]
    assert heights[0] == pytest.approx(heights[1], rel=0.01)
    for made in ("opencv.yml", "left/paper.txt", "right/paper.txt", "report.html", "left/field.json"):
        assert (out / made).exists(), said
    assert "field_median" in (out / "report.html").read_text()
    assert main([*asked, "--camera", "left"]) == 2
    assert "--camera names one camera: several are called like their folders" in capsys.readouterr().err
    shutil.copy(cameras / "right.avi", cameras / "left.avi")
    assert main(asked) == 2
    assert "two cameras would be called 'left', like their folder or video" in capsys.readouterr().err
    assert each_camera([str(cameras / "right.avi")]) == []
    both = [str(cameras / "left"), str(cameras / "right.avi")]
    assert [str(one) for one in each_camera(both)] == both  # they were taken for the files of one camera
    assert each_camera([*both, PHOTOGRAPH]) == []


@pytest.mark.usefixtures("words_alone")
def test_two_folders_of_one_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Boards in one folder and the field in another connect no cameras, but belong to one camera if it is named."""
    asked = ["run", "--target", "ssl-b", "--facing", "LeftGoalLine=top", "--board", "9x6x100mm", "--lens", "radial"]
    for name, folder in (("0001", "field"), ("board_01", "boards"), ("board_02", "boards")):
        (tmp_path / folder).mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / folder / f"{name}.jpg"), half_size(SAMPLE / "photographs" / f"{name}.jpg"))
    asked = [*asked, str(tmp_path / "field"), str(tmp_path / "boards"), "--quiet", "-o", str(tmp_path / "out")]
    assert main(asked) == 2
    assert "'boards' shows boards alone and 'field' the field alone" in capsys.readouterr().err
    assert main([*asked, "--camera", "overhead"]) == 0
    assert [*Calibration.load(tmp_path / "out" / "calibration.json").cameras] == ["overhead"]


def test_no_photograph_at_all(tmp_path: Path) -> None:
    for call in (partial(run, [], tmp_path, target="ssl-b"), partial(detect_board, [], checkerboard(9, 6, 0.025))):
        with pytest.raises(InputError, match="no photograph is given: name files, folders, or videos"):
            call()


@pytest.mark.usefixtures("words_alone")
def test_a_folder_that_holds_nothing_but_a_folder_for_each_camera(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The answer looked for videos in the given folder, where there were none, and was not printed."""
    for name, numbers in (("left", "1234"), ("right", "5678")):
        (tmp_path / "cameras" / name).mkdir(parents=True)
        for number in numbers:
            shutil.copy(SAMPLE / "photographs" / f"board_0{number}.jpg", tmp_path / "cameras" / name)
    asked = ["run", str(tmp_path / "cameras"), "--board", "9x6x100mm", "--lens", "radial"]
    main([*asked, "-o", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert f"8 photographs in {tmp_path / 'cameras'}" in printed and "left/board.json" in printed
    assert [*Calibration.load(tmp_path / "out" / "calibration.json").cameras] == ["left", "right"]


def test_a_folder_without_images_names_those_of_its_cameras(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "left").mkdir()
    shutil.copy(PHOTOGRAPH, tmp_path / "left")
    assert main(["detect", "field", str(tmp_path), "--target", "ssl-b", "--auto", "-o", str(tmp_path / "x.json")]) == 2
    assert "this folder contains no images; there are some in left" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["bad.png", "bad.avi"])
def test_no_folder_is_left_where_nothing_could_be_read(tmp_path: Path, name: str) -> None:
    bad = tmp_path / name
    bad.write_bytes(b"no picture")
    for kind in (
        ("run", "--board", "9x6x25mm"),
        ("run", "--target", "9x6x25mm"),
        ("detect", "board", "--target", "9x6x25mm"),
    ):
        out = tmp_path / ("out/deep" if kind[0] == "run" else "x.json")
        assert main([*kind, str(bad), "-o", str(out)]) == 2
        assert list(tmp_path.iterdir()) == [bad]
    assert main(["run", str(bad), "--board", "9x6x25mm", "-o", str(tmp_path)]) == 2  # a folder that was there stays
    assert list(tmp_path.iterdir()) == [bad]
