"""One picture from several, and photographs from videos: moving objects are removed, bad frames are named."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from ceres_cal.base.arrays import Image
from ceres_cal.base.errors import InputError
from ceres_cal.cli import main
from ceres_cal.detect import video as video_module
from ceres_cal.detect.median import MOST_PICTURES, merged
from ceres_cal.detect.video import frames_of_videos, sharpest_frames, spread_frames, turned_words

SAMPLE = Path(__file__).resolve().parents[1] / "data" / "ssl_field"
SIZE = (320, 240)


def floor(shift_px: float = 0.0) -> Image:
    """Lines on a carpet, shifted as a whole."""
    grey = np.full((SIZE[1], SIZE[0]), 70, np.uint8)
    for x in (40.0, 160.0, 290.0):
        ends = [(round(256 * (x + shift_px)), round(256 * y)) for y in (10.0, 230.0)]
        cv2.line(grey, *ends, 200, 2, cv2.LINE_AA, 8)  # type: ignore[call-overload]
    for y in (20.0, 120.0, 215.0):
        ends = [(round(256 * (x + shift_px)), round(256 * y)) for x in (20.0, 300.0)]
        cv2.line(grey, *ends, 200, 2, cv2.LINE_AA, 8)  # type: ignore[call-overload]
    return grey


def shot(seed: int, shift_px: float = 0.0, blur_px: float = 0.0, gain: float = 1.0) -> Image:
    """The same with robots at other places each time, sometimes a person, and noise."""
    rng = np.random.default_rng(seed)
    grey = floor(shift_px)
    for x, y in rng.integers((10, 10), (310, 230), size=(8, 2)).tolist():
        cv2.circle(grey, (x, y), 8, 10, -1)
        cv2.circle(grey, (x + 3, y), 2, 240, -1)
    if seed % 4 == 0:
        cv2.rectangle(grey, (0, 0), (60, 240), 120, -1)
    seen = cv2.GaussianBlur(grey, (0, 0), blur_px) if blur_px else grey
    return np.asarray(np.clip(gain * seen + rng.normal(0.0, 2.0, grey.shape), 0.0, 255.0).astype(np.uint8))


def write_video(path: Path, frames: Sequence[Image], code: str = "MJPG") -> Path:
    size = (frames[0].shape[1], frames[0].shape[0]) if frames else SIZE
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*code), 10.0, size)
    for frame in frames:
        writer.write(frame if frame.ndim == 3 else cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def test_what_moves_is_gone_and_what_is_blurred_or_bumped_is_left_out() -> None:
    pictures = [(str(seed), shot(seed, gain=0.8 if seed == 4 else 1.0)) for seed in range(7)]
    pictures += [("blurred", shot(8, blur_px=2.5)), ("bumped", shot(9, 0.5)), ("gone", shot(10, 15.0))]
    one = merged(pictures)
    assert one.used == tuple(map(str, range(7))) and one.white == 255
    moved = "the camera had moved"
    assert one.left_out == (("blurred", "blurred"), ("bumped", moved), ("gone", moved))
    off = np.abs(one.picture - floor())
    assert np.mean(off) < 2.0 and np.mean(off > 30.0) < 1e-3  # 0.81 and 4e-5; a single shot has 3.2 and 0.02
    assert len(np.unique(one.picture)) > 300  # finer than the levels of one picture


def test_a_camera_that_was_bumped_half_way_and_one_that_is_carried() -> None:
    bumped = merged((str(n), shot(n, 0.0 if n < 4 else 2.0)) for n in range(9))
    assert bumped.used == tuple(map(str, range(4, 9)))
    with pytest.raises(InputError, match="no two of 5 pictures agree"):
        merged((str(n), shot(n, 3.0 * n)) for n in range(5))
    assert merged([("alone", shot(1))]).used == ("alone",)


def test_pictures_of_a_camera_that_shakes_are_moved_back() -> None:
    shifts = np.linspace(-0.6, 0.6, 8)
    one = merged((str(n), shot(n, shift)) for n, shift in enumerate(shifts))
    assert len(one.used) == 8 and one.shaken_px == pytest.approx(np.std(shifts), rel=0.2)
    off = np.abs(one.picture - floor(float(np.mean(shifts))))
    assert np.mean(off) < 1.5 and np.max(off) < 30.0  # 1.1 and 19; with two pictures of the eight 7.1 and 110


def test_pictures_that_do_not_go_together(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="b: 100 x 100 px of uint8, but a has 320 x 240 px of uint8"):
        merged([("a", shot(1)), ("b", shot(2)[:100, :100])])
    with pytest.raises(InputError, match="no picture"):
        merged([])
    monkeypatch.setenv("CERES_CAL_MOST_MB", "1")
    with pytest.raises(InputError, match="20: more than 13 pictures of 320 x 240 px are too many"):
        merged((str(n + 7), floor()) for n in range(99))


def test_frames_are_spread_over_a_video(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = write_video(tmp_path / "whole.avi", [shot(n) for n in range(20)])
    names = [name for name, _ in spread_frames(whole, 7)]
    assert names == [f"frame {number} of whole.avi" for number in range(0, 20, 3)]
    cut = tmp_path / "cut.avi"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert 3 <= len(list(spread_frames(cut, MOST_PICTURES))) < 20
    monkeypatch.setattr(video_module, "MOST_FRAMES", 10)
    with pytest.raises(InputError, match=r"whole.avi: more than 10 frames: cut out the part"):
        next(spread_frames(whole, 7))
    monkeypatch.setenv("CERES_CAL_MOST_MB", "1")
    large = write_video(tmp_path / "large.avi", [np.zeros((480, 640), np.uint8)])
    with pytest.raises(InputError, match="frames of 640 x 480 px: would take"):
        sharpest_frames(large, tmp_path / "frames", 3)


@pytest.mark.parametrize("content", [b"", b"not a video", None])
def test_what_is_no_video_ends_in_one_line(
    content: bytes | None, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "odd.avi"
    if content is None:
        write_video(path, [])
    else:
        path.write_bytes(content)
    out = ("-o", str(tmp_path / "x.json"), "--quiet")
    for asked in (
        ("detect", "field", str(path), "--target", "ssl-b", "--auto", *out),
        ("detect", "board", str(path), "--columns", "9", "--rows", "6", "--square", "25mm", *out),
        ("run", str(path), "--target", "ssl-b", "-o", str(tmp_path / "run"), "--quiet"),
    ):
        assert main(list(asked)) == 2
        said = capsys.readouterr().err
        assert said.startswith(f"ceres-cal: {path}: not a video that OpenCV can read") and said.count("\n") == 1


def test_a_field_in_a_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = np.asarray(cv2.imread(str(SAMPLE / "photographs" / "0001.jpg")))
    frames = []
    for number in range(4):
        frame = still.copy()
        for x in range(100 + 40 * number, 1280, 200):  # robots on lines, elsewhere each time
            cv2.circle(frame, (x, 150 + 20 * number), 16, (20, 20, 20), -1)
        frames.append(frame)
    frames.append(np.roll(still, 3, axis=1))
    path, out = write_video(tmp_path / "game.avi", frames), tmp_path / "field.json"
    asked = ["detect", "field", str(path), "--target", "ssl-b", "--auto", "--facing", "LeftGoalLine=top", "--json"]
    assert main([*asked, "-o", str(out)]) == 0
    data = json.loads(capsys.readouterr().out)
    picture = str(tmp_path / "field_median.png")
    assert data["median"] == {
        "picture": picture,
        "used": [f"frame {number} of game.avi" for number in range(4)],
        "left_out": [{"image": "frame 4 of game.avi", "reason": "the camera had moved"}],
        "shaken_px": 0.0,
    }
    (found,) = data["found"]
    assert found["image"] == picture and found["found"] > 0.9 * found["places"]  # 0.91: it has robots of its own
    written = cv2.imread(picture, cv2.IMREAD_UNCHANGED)
    assert written is not None and written.dtype == np.uint16 and written.shape == (960, 1280)
    assert main([*asked, picture, "-o", str(out)]) == 2 and "is an input" in capsys.readouterr().err


def test_a_board_in_a_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    boards = [np.asarray(cv2.imread(str(SAMPLE / "photographs" / f"board_0{n}.jpg"))) for n in (1, 3)]
    path = write_video(tmp_path / "boards.avi", [boards[0], cv2.blur(boards[0], (9, 9)), boards[1]])
    board = ("--columns", "9", "--rows", "6", "--square", "100mm", "-o", str(tmp_path / "board.json"))
    assert main(["detect", "board", str(path), *board, "--frames", "2", "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("2 of 2 images show the board, 108 corners in all")
    assert sorted(one.name for one in (tmp_path / "boards_frames").iterdir()) == ["0001.png", "0002.png"]
    assert main(["detect", "board", str(path), *board, "--frames", "0"]) == 2
    assert "'0' is not a whole number of 1 or more" in capsys.readouterr().err


def turned(path: Path, source: Path) -> Path:
    """A video whose header asks viewers to rotate it by 180 degrees, as of a telephone held upside down."""
    content = bytearray(source.read_bytes())
    matrix = content.find(b"tkhd") + 4 + 40  # nine fixed-point numbers of 32 bits, with 16 or 30 fractional bits
    struct.pack_into(">9i", content, matrix, -(1 << 16), 0, 0, 0, -(1 << 16), 0, 0, 0, 1 << 30)
    path.write_bytes(content)
    return path


def test_frames_are_as_the_sensor_stored_them_and_a_turn_for_viewers_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plain = write_video(tmp_path / "plain.mp4", [shot(n) for n in range(3)], "mp4v")
    upside_down = turned(tmp_path / "turned.mp4", plain)
    capture = cv2.VideoCapture(str(upside_down))
    assert np.array_equal(np.asarray(capture.read()[1]), np.rot90(next(spread_frames(plain, 3))[1], 2))  # as viewers do
    for (_, stored), (_, seen) in zip(spread_frames(plain, 3), spread_frames(upside_down, 3), strict=True):
        assert np.array_equal(seen, stored)
    assert turned_words(plain) == "" and turned_words(upside_down).startswith(
        "its file tells viewers to turn it by 180 "
    )
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0\0\0\0\0"  # orientation 3
    content = (SAMPLE / "photographs" / "0001.jpg").read_bytes()
    (tmp_path / "0001.jpg").write_bytes(
        content[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + content[2:]
    )
    asked = [
        "detect",
        "field",
        str(tmp_path / "0001.jpg"),
        "--target",
        "ssl-b",
        "--auto",
        "-o",
        str(tmp_path / "o.json"),
    ]
    assert main([*asked, "--facing", "LeftGoalLine=top"]) == 0
    assert "0001.jpg: its file tells viewers to turn it by 180 degrees, but" in " ".join(
        capsys.readouterr().out.split()
    )
    assert main([*asked, "--facing", "LeftGoalLine=left"]) == 2
    assert "give an old calibration of the station (--start); its file tells viewers" in capsys.readouterr().err


def test_frames_of_two_videos_go_into_two_folders(tmp_path: Path) -> None:
    """And not into a folder that may contain photographs."""
    one = write_video(tmp_path / "board.avi", [shot(1)])
    other = one.with_suffix(".mpg")
    with pytest.raises(InputError, match=r"board\.mpg: another video is called 'board', too: rename one"):
        frames_of_videos([one, other], 1, tmp_path)
    assert frames_of_videos([one], 1, tmp_path) == [tmp_path / "board_frames" / "0001.png"]


def test_a_video_where_photographs_are_needed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video, text = write_video(tmp_path / "now.avi", [shot(1)]), tmp_path / "notes.md"
    text.write_text("# Notes\n")
    for path, words in ((video, "a video: give frames of it, as PNG"), (text, "text: give photographs (files of obs")):
        assert main(["detect", "rings", str(path), "--radii", "10mm:90mm:10mm", "-o", str(tmp_path / "o.json")]) == 2
        assert f"{path}: not an image but {words}" in capsys.readouterr().err


@pytest.mark.usefixtures("words_alone")
def test_run_names_the_frames_that_it_leaves_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    still = np.asarray(cv2.imread(str(SAMPLE / "photographs" / "0001.jpg"), cv2.IMREAD_REDUCED_COLOR_2))
    path = write_video(tmp_path / "game.avi", [still, still, still, np.roll(still, 3, axis=1)])
    asked = ["--target", "ssl-b", "--facing", "LeftGoalLine=top", "--prior", "height_m=4.02:0.01", "--lens", "radial"]
    assert main(["run", str(path), *asked, "-o", str(tmp_path / "out")]) == 0
    assert "the median of 3 pictures of 4; 1 left out, the camera had moved (" in capsys.readouterr().out
