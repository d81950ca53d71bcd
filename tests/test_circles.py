"""Grids of circles in rendered pictures, compared with OpenCV's own detector, and sheets to print."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendering.paper import Footprints, dark_share
from test_boards import CAMERA, ideal_picture, photograph, write
from test_cli import Say, refused, say
from thorough import partly

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import Pose
from ceres_cal.detect.boards import detect_boards
from ceres_cal.report.target_pictures import sheet_pdf
from ceres_cal.scene.targets import Target, checkerboard, circle_grid, rings, ssl_field, target_from_spec

__all__ = ["say"]
PLAIN = circle_grid(7, 5, 0.03, 0.02)
ASYMMETRIC = circle_grid(4, 11, 0.02, 0.02, asymmetric=True)


def seen(board: Target, tilt: float, turn: float = 0.2) -> tuple[Array, Array]:
    """A picture (grey levels) of a board that fills it, and its circles' centres (N, 2) px."""
    middle = board.point_array.mean(axis=0)
    facing = Pose.exp((tilt, 0.6 * tilt, 0.0, 0.0, 0.0, 0.33)) @ Pose.exp((0.0, 0.0, turn, 0.0, 0.0, 0.0))
    camera = CAMERA.at(facing @ Pose(np.eye(3), -middle))
    paper = board.paper
    assert paper is not None

    def paint(places: Array) -> Array:
        still = np.zeros_like(places)
        inside = np.all((places > paper.low_m) & (places < paper.high_m), axis=1)
        dark = dark_share(board, Footprints(places, still + 1e-9, still + 1e-9)) > 0.5
        return np.where(inside, np.where(dark, 0.0, 1.0), 0.4)

    return ideal_picture(camera, 1.0, paint), camera.project(board.point_array)


@pytest.mark.parametrize("board", [PLAIN, ASYMMETRIC], ids=["plain", "asymmetric"])
@pytest.mark.parametrize("tilt", partly([0.1, 0.5], [0.5]))
def test_circles_are_found_and_their_centres_right(board: Target, tilt: float, tmp_path: Path) -> None:
    picture, truth = seen(board, tilt)
    image = photograph(picture)
    points = detect_boards([write(tmp_path / "a.png", image)], board).observations.points
    error = points.pixels - truth[points.feature]
    if board is PLAIN:  # looks the same turned by half a turn
        turned = points.pixels - truth[::-1][points.feature]
        error = min((error, turned), key=lambda off: float(np.sum(off**2)))
    assert len(points) == len(board.points)
    layout = cv2.CALIB_CB_ASYMMETRIC_GRID if board is ASYMMETRIC else cv2.CALIB_CB_SYMMETRIC_GRID
    size = board.spec["columns"], board.spec["rows"]
    shown, peer = cv2.findCirclesGrid(image, size, flags=layout)
    if not shown:
        shown, peer = cv2.findCirclesGrid(image, size, flags=layout | cv2.CALIB_CB_CLUSTERING)
    assert shown
    nearest = [np.min(np.linalg.norm(truth - one, axis=1)) for one in peer.reshape(-1, 2)]
    ours, theirs = (float(np.sqrt(np.mean(np.square(off)))) for off in (np.linalg.norm(error, axis=1), nearest))
    # 0.015; a homography alone is 0.05 off, as the lens moves the middles, too: phi was 7 standard deviations off.
    assert ours < 0.025
    assert ours < (0.15 if tilt > 0.3 else 0.4) * theirs  # 0.18 tilted, 0.07 else


def test_circles_of_any_size_and_shade(tmp_path: Path) -> None:
    """OpenCV by itself finds dark circles of 6 to 80 px, darker than a fixed level of grey: none of these."""
    picture, truth = seen(PLAIN, 0.3)
    image = photograph(picture)  # circles of 26 px
    large = cv2.resize(image, None, fx=4.0, fy=4.0, interpolation=cv2.INTER_LINEAR)
    small = cv2.resize(image, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    for shown, scale in ((large, 4.0), (small, 0.25), (image // 6, 1.0), (255 - image, 1.0)):
        points = detect_boards([write(tmp_path / "a.png", shown)], PLAIN).observations.points
        wanted = (truth + 0.5) * scale - 0.5  # or turned by half a turn
        off = min(np.linalg.norm(points.pixels - one[points.feature], axis=1).max() for one in (wanted, wanted[::-1]))
        assert len(points) == 35 and off < 0.05 * max(scale, 1.0)  # 0.02 to 0.03
        assert not cv2.findCirclesGrid(shown, (7, 5), flags=cv2.CALIB_CB_SYMMETRIC_GRID | cv2.CALIB_CB_CLUSTERING)[0]


def test_a_description_comes_back() -> None:
    for board in (PLAIN, ASYMMETRIC):
        assert target_from_spec(json.loads(json.dumps(board.spec)), "here") == board
    assert ASYMMETRIC.points["1,3"] == pytest.approx((0.06, 0.06, 0.0))
    assert ASYMMETRIC.grid is None and PLAIN.grid is not None


@pytest.mark.parametrize(
    "numbers, why",
    [((1, 5, 0.03, 0.02), "at least 2"), ((7, 5, -1.0, 0.02), "positive"), ((7, 5, 0.03, 0.03), "below the 0.03 m")],
)
def test_grids_that_cannot_be(numbers: tuple[int, int, float, float], why: str) -> None:
    with pytest.raises(InputError, match=why):
        circle_grid(*numbers)


# ---- to print -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("board", [checkerboard(3, 3, 0.01), circle_grid(3, 3, 0.01, 0.005), rings((0.01, 0.02))])
def test_a_sheet_is_as_large_as_the_board(board: Target) -> None:
    content = sheet_pdf(board, "title")
    paper = board.paper
    assert paper is not None and content.startswith(b"%PDF")
    box = content[content.index(b"/MediaBox") :][:80]
    width, height = (float(number) * 0.0254 / 72.0 for number in box.split(b"[")[1].split(b"]")[0].split()[2:])
    assert width == pytest.approx(paper.high_m[0] - paper.low_m[0] + 0.016, abs=1e-4)
    assert height == pytest.approx(paper.high_m[1] - paper.low_m[1] + 0.016 + 0.022, abs=1e-4)
    assert sheet_pdf(board, "title") == content


@pytest.mark.parametrize(
    "board",
    [
        checkerboard(4, 3, 0.02),
        PLAIN,
        circle_grid(4, 5, 0.02, 0.015, asymmetric=True),
        rings((0.01, 0.02, 0.025, 0.05)),
    ],
)
def test_what_is_printed_is_what_a_camera_sees(board: Target) -> None:
    paper = board.paper
    assert paper is not None
    plane = np.random.default_rng(0).uniform(paper.low_m, paper.high_m, (4000, 2))
    steps = [np.tile(1e-9 * direction, (len(plane), 1)) for direction in np.eye(2)]
    printed = np.zeros(len(plane))
    for shape in paper.shapes():
        if shape.is_round:
            inside = np.linalg.norm(plane - shape.place_m, axis=1) < shape.size_m
        else:
            inside = np.all((plane > shape.place_m) & (plane < np.add(shape.place_m, shape.size_m)), axis=1)
        printed[inside] = shape.is_dark
    np.testing.assert_array_equal(printed, np.round(dark_share(board, Footprints(plane, *steps))))


def test_a_large_sheet_is_drawn_by_its_shapes() -> None:
    """The sample's own board is 1.2 x 0.9 m: as a picture with 400 dots per inch it took 6.6 GB and 17 s."""
    content = sheet_pdf(checkerboard(9, 6, 0.1), "board")
    assert b"/Subtype /Image" not in content and len(content) < 20_000  # 12 kB measured


def test_fields_are_not_printed() -> None:
    with pytest.raises(InputError, match="is not printed on paper"):
        sheet_pdf(ssl_field("B"), "field")
    wall = checkerboard(9, 6, 1.0)
    with pytest.raises(InputError, match="too large for one page"):
        sheet_pdf(wall, "wall")


def test_as_typed(say: Say, tmp_path: Path) -> None:
    sheet = tmp_path / "board.pdf"
    spec = json.dumps({**PLAIN.spec, "columns": 3, "rows": 3, "spacing_m": 0.012, "diameter_m": 0.006})
    assert say("targets", "print", spec, "-o", sheet).code == 0 and sheet.read_bytes().startswith(b"%PDF")
    assert ".pdf" in refused(say("targets", "print", spec, "-o", tmp_path / "board.png"))
    assert "not valid JSON" in refused(say("targets", "print", "{", "-o", sheet))
    write(tmp_path / "a.png", photograph(seen(PLAIN, 0.3)[0]))
    detect = ("detect", "board", tmp_path / "a.png", "--columns", 7, "--rows", 5, "-o", tmp_path / "o.json")
    said = say(*detect, "--circles", 0.03, "--diameter", 0.02, "--quiet")
    assert said.code == 0 and "35 corners in all" in said.out
    assert "give one of them" in refused(say(*detect))
    assert "--diameter" in refused(say(*detect, "--circles", 0.03))


@pytest.mark.usefixtures("words_alone")
def test_run_takes_a_board_of_circles(say: Say, tmp_path: Path) -> None:
    """It was refused as a field without painted curves, with advice that is right only for chessboards."""
    board, pictures = circle_grid(7, 5, 0.03, 0.02), tmp_path / "pictures"
    pictures.mkdir()
    for number, tilt in enumerate((0.3, -0.3, 0.4, -0.2)):
        write(pictures / f"{number}.png", photograph(seen(board, tilt)[0]))
    for name in ("--target", "--board"):
        said = say("run", pictures, name, json.dumps(board.spec), "-o", tmp_path / name[2:], "--quiet")
        assert said.code == 0 and "The intrinsics can be trusted, to 0." in said.out


def test_a_smaller_picture_has_no_grid(tmp_path: Path) -> None:
    blank = replace(CAMERA, image_size=(320, 240))
    image = write(tmp_path / "a.png", np.full(blank.image_size[::-1], 128, np.uint8))
    with pytest.raises(InputError, match=r"no board of 7 x 5 circles in any of 1 images .*no grid of 7 x 5 circles"):
        detect_boards([image], PLAIN)
