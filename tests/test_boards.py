"""Boards in images: which are found, how accurately, with which names, and the messages where there are none."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal.base.arrays import AnyArray, Array, Image8
from ceres_cal.base.errors import InputError
from ceres_cal.base.threads import at_most
from ceres_cal.base.transforms import Pose
from ceres_cal.detect import boards
from ceres_cal.detect.boards import BoardDetections, detect_boards, right_handed
from ceres_cal.detect.images import read_grey
from ceres_cal.detect.partly import is_whole, part_of_board
from ceres_cal.detect.saddles import measure_saddles
from ceres_cal.observations import Observations
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Target, charuco, checkerboard, rings

BOARD = checkerboard(7, 6, 0.03)
CAMERA = Camera((480, 360), 450.0, (243.3, 177.8), Radial((1e-4, 7e-7)))
POSE = Pose.exp((0.35, -0.45, 0.1, -0.07, -0.08, 0.33))  # tilted by half a radian; the board fills half the image

Paint = Callable[[Array], Array]
"""Places on the board (N, 2) in squares -> brightness 0 to 1."""


# ---- pictures with known corners ------------------------------------------------------------------------------------


def squares(columns: int, rows: int) -> Paint:
    """A board with one more square than corners each way, dark between "0,0" and "1,1", and with a white margin."""

    def paint(places: Array) -> Array:
        x, y = places.T
        inside = (x > -1.0) & (y > -1.0) & (x < columns) & (y < rows)
        paper = (x > -1.5) & (y > -1.5) & (x < columns + 0.5) & (y < rows + 0.5)
        dark = inside & ((np.floor(x) + np.floor(y)) % 2 == 0)
        return np.where(dark, 0.0, np.where(paper, 1.0, 0.4))

    return paint


def ideal_picture(camera: Camera, square_m: float, paint: Paint) -> Array:
    """The mean brightness over each pixel, sampled at 64 places where an edge crosses it.

    Within a pixel the camera is taken as linear, which is accurate to a few 1e-5 px.
    """
    width, height = camera.image_size
    middle = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).reshape(-1, 2).astype(float)
    number = np.arange(64)
    lattice = (np.stack([number, number * 19 % 64], axis=1) + 0.5) / 64.0 - 0.5
    corners = 0.55 * np.array([[0, 0], [-1, -1], [1, -1], [-1, 1], [1, 1]])
    places = np.stack([camera.locate(middle + corner) / square_m for corner in corners])
    spread = np.stack([paint(place) for place in places])
    picture = spread[0]
    mixed = np.flatnonzero(np.ptp(spread, axis=0) > 0.0)
    there, slopes = places[0, mixed], np.einsum("ck,cni->nki", corners / np.sum(corners[:, 0] ** 2), places[:, mixed])
    picture[mixed] = paint((there[:, None] + lattice @ slopes).reshape(-1, 2)).reshape(-1, 64).mean(axis=1)
    return np.asarray(picture.reshape(height, width))


def photograph(picture: Array, blur_px: float = 0.7, noise: float = 2.0, seed: int = 1) -> Image8:
    """Grey levels 40 to 200 of a picture, blurred, with noise (grey levels)."""
    blurred = cv2.GaussianBlur(40.0 + 160.0 * picture, (0, 0), blur_px)
    levels = blurred + noise * np.random.default_rng(seed).standard_normal(picture.shape)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


def error_px(grid: Array, truth: Array) -> Array:
    """Measured minus true, (N, 2), of the corners that were measured."""
    return (grid - truth).reshape(-1, 2)[~np.isnan(grid[..., 0]).ravel()]


def rms(error: Array) -> float:
    """Per coordinate."""
    return float(np.sqrt(np.mean(error**2)))


@pytest.fixture(scope="module")
def picture() -> Array:
    return ideal_picture(CAMERA.at(POSE), 0.03, squares(7, 6))


@pytest.fixture(scope="module")
def truth() -> Array:
    return CAMERA.at(POSE).project(BOARD.point_array)


def write(path: Path, image: AnyArray) -> Path:
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


# ---- how well -------------------------------------------------------------------------------------------------------


def test_corners_are_good_to_a_hundredth_of_a_pixel(tmp_path: Path, picture: Array, truth: Array) -> None:
    path = write(tmp_path / "a.png", photograph(picture))
    points = detect_boards([path], BOARD, corner_fit="saddle").observations.points
    assert np.array_equal(points.feature, np.arange(42))
    error = points.pixels - truth
    assert np.all(np.abs(error.mean(axis=0)) < 0.003)  # (0.0000, 0.0007)
    assert np.all(error.std(axis=0) < 0.008)  # (0.0054, 0.0043)
    start = truth.astype(np.float32).reshape(-1, 1, 2)  # at the truth, so that only cornerSubPix's own error counts
    peer = cv2.cornerSubPix(read_grey(path), start, (7, 7), (-1, -1), (3, 100, 1e-4)).reshape(-1, 2)
    assert rms(error) < 0.5 * rms(peer - truth)  # 0.0049 against 0.0265


@pytest.mark.parametrize(
    "change, limit",
    [
        ("blur", 0.015),  # 0.009
        ("noise", 0.03),  # 0.017
        ("sharpened", 0.01),  # 0.0045
        ("uneven light", 0.01),  # 0.005
        ("gamma", 0.012),  # 0.007
    ],
)
def test_corners_stay_good_whatever_the_camera_does(change: str, limit: float, picture: Array, truth: Array) -> None:
    image = photograph(picture)
    if change == "blur":
        image = photograph(picture, blur_px=2.0)
    elif change == "noise":
        image = photograph(picture, noise=8.0)
    elif change == "sharpened":  # along the rows only, as video cameras do
        level = image.astype(float)
        sharp = level + 0.8 * (level - cv2.GaussianBlur(level, (9, 1), 1.2))
        image = np.clip(np.rint(sharp), 0, 255).astype(np.uint8)
    elif change == "uneven light":  # from 0.6 to 1.4 across the image
        image = np.rint(np.minimum(image * np.linspace(0.6, 1.4, 480), 255)).astype(np.uint8)
    else:
        image = np.rint(255.0 * (image / 255.0) ** 0.45).astype(np.uint8)
    start = truth.reshape(6, 7, 2) + np.random.default_rng(2).uniform(-0.7, 0.7, (6, 7, 2))
    error = error_px(measure_saddles(image, start).grid, truth.reshape(6, 7, 2))
    assert len(error) == 42
    assert rms(error) < limit


@pytest.mark.thorough
def test_large_squares_out_of_focus() -> None:
    """Squares of 120 px, blurred by 8 px: discs of 20 px contain almost only blur."""
    camera = Camera((1440, 1080), 1350.0, (730.0, 534.0), Radial((0.0,), (3,)))
    truth = camera.at(POSE).project(BOARD.point_array).reshape(6, 7, 2)
    image = photograph(ideal_picture(camera.at(POSE), 0.03, squares(7, 6)), blur_px=8.0)
    error = error_px(measure_saddles(image, truth + 1.0).grid, truth)
    assert len(error) == 42 and rms(error) < 0.02  # 0.011; 0.05 at the scale of the picture
    peer = cv2.cornerSubPix(image, truth.reshape(-1, 1, 2).astype(np.float32), (15, 15), (-1, -1), (3, 100, 1e-4))
    assert rms(error) < 0.2 * rms(peer.reshape(6, 7, 2) - truth)  # 0.2


@settings(max_examples=25, deadline=None)
@given(
    turn=st.floats(-np.pi, np.pi),
    shift=st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5)),
    tilt=st.tuples(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7)),
)
def test_any_turn_and_place(turn: float, shift: tuple[float, float], tilt: tuple[float, float]) -> None:
    facing = Pose.exp((*tilt, 0.0, 0.0, 0.0, 4.6)) @ Pose.exp((0.0, 0.0, turn, 0.0, 0.0, 0.0))
    pose = facing @ Pose.exp((0.0, 0.0, 0.0, -1.0, -1.0, 0.0))  # the middle of 3 x 3 corners before the camera
    camera = Camera((120, 120), 105.0, (59.5 + shift[0], 59.5 + shift[1]), Radial((0.0,), (3,)), cam_from_world=pose)
    truth = camera.project(checkerboard(3, 3, 1.0).point_array).reshape(3, 3, 2)
    image = photograph(ideal_picture(camera, 1.0, squares(3, 3)), noise=0.0)
    saddles = measure_saddles(image, truth + 0.6)
    error = error_px(saddles.grid, truth)
    assert len(error) == 9
    assert np.max(np.abs(error)) < 0.08  # 0.045 at worst in 600 examples
    assert np.all(saddles.contrast[::2, ::2] > 0.0) and np.all(saddles.contrast[1, ::2] < 0.0)


def test_what_is_no_corner_is_left_out(picture: Array, truth: Array) -> None:
    image = photograph(picture)
    start = truth.reshape(6, 7, 2).copy()
    column, row = np.rint(start[2, 3]).astype(int)
    image[row - 14 : row + 15, column - 14 : column + 15] = 120  # a sticker on "3,2"
    start[0, :] = np.nan
    start[5, 1:] = np.nan
    start[5, 0] += (14.0, 2.0)  # not a corner at all: half a square off
    grid = measure_saddles(image, start).grid
    lost = {(int(c), int(r)) for r, c in np.argwhere(np.isnan(grid[..., 0])) if r not in (0, 5)}
    assert lost == {(3, 2)}
    assert np.all(np.isnan(grid[0])) and np.all(np.isnan(grid[5]))
    kept = np.delete(grid[1:5].reshape(-1, 2) - truth.reshape(6, 7, 2)[1:5].reshape(-1, 2), 1 * 7 + 3, axis=0)
    assert rms(kept) < 0.02  # 0.010: the sticker reaches into the discs of its neighbours


def test_nothing_is_measured_where_nothing_is_seen(truth: Array) -> None:
    grid = truth.reshape(6, 7, 2)
    blank = np.full((360, 480), 90, np.uint8)
    assert np.all(np.isnan(measure_saddles(blank, grid).contrast))
    assert np.all(np.isnan(measure_saddles(blank, np.full((6, 7, 2), np.nan)).grid))
    assert np.all(np.isnan(measure_saddles(blank, grid + 500.0).grid))  # outside the image


# ---- real photographs -----------------------------------------------------------------------------------------------


def calibrated(detections: BoardDetections, flags: int) -> tuple[float, Array, Array]:
    """OpenCV's 2D rms (px), camera matrix and standard deviations of fx, fy, cx, cy from the detected corners."""
    observations = detections.observations
    points, (board,) = observations.points, observations.targets.values()
    rows = [points.view == number for number in range(len(observations.views))]
    objects = [board.point_array[points.feature[row]].astype(np.float32) for row in rows]
    pixels = [points.pixels[row].astype(np.float32) for row in rows]
    (size,) = observations.cameras.values()
    answer = cv2.calibrateCameraExtended(objects, pixels, size, None, None, flags=flags)  # type: ignore[call-overload]
    return float(answer[0]), np.asarray(answer[1]), np.ravel(answer[5])[:4]


@pytest.mark.parametrize(
    "corner_fit, most_px, phi",
    [
        ("opencv", 0.163, 700.9),  # 0.1624 and 700.93, OpenCV's own figures
        ("saddle", 0.145, 702.6),  # 0.1383 and 702.59
    ],
)
def test_sony_photographs(
    real_data: Path, sony_boards: BoardDetections, corner_fit: str, most_px: float, phi: float
) -> None:
    detections = sony_boards
    if corner_fit == "opencv":
        seen: list[tuple[int, int, str]] = []
        images, board = sorted((real_data / "boofcv_sony_chess").glob("*.jpg")), checkerboard(4, 6, 0.03)
        detections = detect_boards(images, board, corner_fit="opencv", progress=lambda *done: seen.append(done))
        assert seen == [(i, 13, path.name) for i, path in enumerate(images, start=1)]
    assert len(detections.found) == 13 and not detections.missed
    assert len(detections.observations.points) == 13 * 24
    rms_px, matrix, sigma = calibrated(detections, cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3)
    assert rms_px < most_px
    assert abs(matrix[0, 0] - phi) < 0.1
    # phi has a standard deviation of 1.2 px here: both agree with BoofCV's published 701.0. cornerSubPix is 0.4 to
    # 1.0 px short in renderings of these very views, saddles 0.04 px.
    assert abs(matrix[0, 0] - 701.0) < 2.0 * sigma[0]
    assert abs(matrix[1, 1] - 698.65) < 2.0 * sigma[1]


def test_gopro_photographs(gopro_boards: BoardDetections) -> None:
    detections = gopro_boards
    assert len(detections.found) == 35
    assert [Path(path).name for path, _ in detections.missed] == ["GOPR0055.jpg"]  # shows a part of the board only
    assert len(detections.observations.points) == 35 * 48
    rms_px, matrix, _ = calibrated(detections, cv2.CALIB_ZERO_TANGENT_DIST)
    assert rms_px < 0.53  # 0.5236; 0.5208 with saddles
    assert abs(matrix[0, 0] - 560.07) < 0.5  # 560.07


# ---- names ----------------------------------------------------------------------------------------------------------


def corner_names(observations: Observations) -> list[str]:
    return [observations.feature_name("point", row) for row in range(len(observations.points))]


@pytest.mark.parametrize("quarter_turns", range(4))
def test_labelling_is_never_mirrored_and_stays_on_the_board(
    quarter_turns: int, tmp_path: Path, picture: Array, truth: Array
) -> None:
    image = np.rot90(photograph(picture), quarter_turns)
    points = detect_boards([write(tmp_path / "a.png", image)], BOARD).observations.points
    grid = points.pixels[np.argsort(points.feature)].reshape(6, 7, 2)
    along_row, along_column = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    assert along_row[0] * along_column[1] - along_row[1] * along_column[0] > 0.0
    # 7 + 6 is odd: the picture itself tells which end is "0,0".
    width, height = CAMERA.image_size
    origin = truth[0]
    for _ in range(quarter_turns):
        origin, width, height = np.array([origin[1], width - 1 - origin[0]]), height, width
    assert np.linalg.norm(grid[0, 0] - origin) < 0.1  # 0.003; the other end is 230 px away


# ---- partly out of the picture --------------------------------------------------------------------------------------


def _moved_aside(x_px: float, y_px: float, turn: float = 0.0, board: Target = BOARD) -> tuple[Image8, Array]:
    """A picture of a board whose centre is displaced from the picture's centre, and the pixels of its corners."""
    squares_of = board.grid
    assert squares_of is not None
    columns, rows = squares_of.columns, squares_of.rows
    middle = Pose.exp((0.0, 0.0, 0.0, -0.015 * (columns - 1), -0.015 * (rows - 1), 0.0))
    pose = Pose.exp((0.3, -0.35, 0.0, 0.0, 0.0, 0.3)) @ Pose.exp((0.0, 0.0, turn, 0.0, 0.0, 0.0)) @ middle
    camera = replace(CAMERA, principal_point=(243.3 + x_px, 177.8 + y_px)).at(pose)
    truth = camera.project(board.point_array).reshape(rows, columns, 2)
    return photograph(ideal_picture(camera, 0.03, squares(columns, rows))), truth


@pytest.mark.parametrize("x_px, y_px, turn, levels", [(-220, 0, 0.0, 256), (0, -140, np.pi, 256), (-220, 0, 0.0, 20)])
def test_a_board_partly_out_of_the_picture(x_px: float, y_px: float, turn: float, levels: int, tmp_path: Path) -> None:
    """Also with twenty grey levels, where OpenCV finds no squares before the contrast is increased."""
    image, truth = _moved_aside(x_px, y_px, turn)
    points = detect_boards([write(tmp_path / "a.png", image // (256 // levels))], BOARD).observations.points
    inside = np.all((truth > 3.0) & (truth < np.array([476.0, 356.0])), axis=-1)
    assert np.count_nonzero(inside) - 3 <= len(points) <= np.count_nonzero(inside) < 42
    error = points.pixels - truth.reshape(-1, 2)[points.feature]  # 7 + 6 is odd: every name is known
    assert np.max(np.abs(error)) < 0.1  # 0.04, next to the border


def test_a_part_that_has_several_places_on_the_board_is_refused(tmp_path: Path) -> None:
    both_ends = Camera((160, 360), 450.0, (80.0, 177.8), CAMERA.lens)
    whole, _ = _moved_aside(0.0, 0.0)
    cut = write(tmp_path / "cut.png", whole[:, 163 : 163 + both_ends.image_size[0]])
    with pytest.raises(InputError, match=r"in several positions|do not fit on the board|corners found"):
        detect_boards([cut], BOARD)
    with pytest.raises(InputError, match="no chessboard of 7 x 6"):  # OpenCV sees whole boards alone
        detect_boards([write(tmp_path / "a.png", _moved_aside(220, 0)[0])], BOARD, corner_fit="opencv")


def test_a_part_of_a_board_is_no_whole_one(picture: Array, truth: Array) -> None:
    sharp, grid = photograph(picture), truth.reshape(6, 7, 2)
    larger = np.concatenate([grid, 2.0 * grid[-1:] - grid[-2:-1]])
    for image in (sharp, np.asarray(cv2.GaussianBlur(sharp, (0, 0), 3.0))):
        for seen in (grid, grid[1:], grid[:-1], grid[:, 1:], grid[:, :-1], larger):
            assert is_whole(image, measure_saddles(image, seen)) == (seen is grid)


def test_a_mirrored_grid_is_turned_over(truth: Array) -> None:
    grid = truth.reshape(6, 7, 2)
    assert np.array_equal(right_handed(grid), grid)
    assert np.array_equal(right_handed(grid[::-1, ::-1]), grid[::-1, ::-1])  # turned is not mirrored
    assert np.array_equal(right_handed(grid[:, ::-1]), grid)
    assert np.array_equal(right_handed(grid[::-1]), grid[::-1, ::-1])
    assert np.array_equal(right_handed(grid.transpose(1, 0, 2)), grid.transpose(1, 0, 2)[:, ::-1])


def test_a_board_that_looks_alike_turned_is_named_as_it_is_held(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """OpenCV may begin at either end, as in one of 35 pictures of a public set."""
    square, margin = 40, 60
    dark = np.add.outer(np.arange(6), np.arange(8)) % 2 == 0
    drawn = np.pad(np.kron(np.where(dark, 30, 220), np.ones((square, square))), margin, constant_values=220)
    path = write(tmp_path / "a.png", cv2.GaussianBlur(drawn.astype(np.uint8), (0, 0), 1.0))
    found = boards._found_fast(read_grey(path), 7, 5)
    assert found is not None
    for step in (1, -1):
        monkeypatch.setattr(boards, "_found_fast", lambda *_, named=found[::step, ::step]: named)
        points = detect_boards([path], checkerboard(7, 5, 0.04)).observations.points
        assert points.feature is not None
        first, last = (points.pixels[points.feature == feature][0] for feature in (0, 34))
        assert np.all(first < last - square)


def test_pictures_side_by_side_are_measured_as_one_by_one(tmp_path: Path, picture: Array) -> None:
    images = [write(tmp_path / f"{seed}.png", photograph(picture, seed=seed)) for seed in range(5)]
    with at_most(3):
        together = detect_boards(images, BOARD).observations
    with at_most(1):
        alone = detect_boards(images, BOARD).observations
    assert np.array_equal(together.points.pixels, alone.points.pixels)
    assert np.array_equal(together.points.sigma_px, alone.points.sigma_px)


def test_views_stations_and_placements(tmp_path: Path, picture: Array) -> None:
    image = photograph(picture)
    files = ["one/a.png", "one/b.png", "two/a.png", "two/a.bmp"]
    images = [write(tmp_path / name, image) for name in files]
    blank = write(tmp_path / "blank.png", np.full_like(image, 90))
    detections = detect_boards([*images, blank], BOARD, camera="left")
    assert detections.found == tuple(map(str, images))
    assert detections.missed == ((str(blank), "no chessboard of 7 x 6 inner corners found"),)
    views = detections.observations.views
    assert [view.frame for view in views] == ["a", "b", "a", "a"]
    assert views[1].placement == "b" and views[0].placement == "one/a"
    assert len({view.placement for view in views}) == 4
    assert {(view.camera, view.station, view.target) for view in views} == {("left", "left", "board")}
    moved = detect_boards(images[:1], BOARD, camera="left", station="left-2").observations
    assert moved.views[0].station == "left-2"
    assert moved.cameras == {"left": (480, 360)} and moved.targets == {"board": BOARD}
    moved.save(tmp_path / "obs.json")
    assert np.array_equal(Observations.load(tmp_path / "obs.json").points.pixels, moved.points.pixels)


# ---- kinds of files -------------------------------------------------------------------------------------------------


def test_depth_and_colour_change_nothing(tmp_path: Path, picture: Array) -> None:
    grey = photograph(picture)
    images = {
        "grey": grey,
        "colour": cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR),
        "alpha": cv2.cvtColor(grey, cv2.COLOR_GRAY2BGRA),
        "deep": grey.astype(np.uint16) * 20 + 700,  # 12 bit in a 16-bit file, far from filling it
    }
    paths = [write(tmp_path / f"{name}.png", image) for name, image in images.items()]
    paths.append(write(tmp_path / "float.tiff", images["colour"].astype(np.float32) / 255.0))
    assert read_grey(paths[3]).dtype == np.uint16
    pixels = detect_boards(paths, BOARD, corner_fit="saddle").observations.points.pixels.reshape(5, 42, 2)
    assert np.max(np.abs(pixels - pixels[0])) < 0.001  # 0.00005


def test_a_noted_rotation_is_ignored(tmp_path: Path, picture: Array) -> None:
    path = write(tmp_path / "a.jpg", photograph(picture))
    plain = read_grey(path)
    content = path.read_bytes()
    entry = b"\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"  # Orientation = 6: turn by a quarter to look at it
    exif = b"Exif\x00\x00MM\x00\x2a\x00\x00\x00\x08\x00\x01" + entry + b"\x00\x00\x00\x00"
    path.write_bytes(content[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + content[2:])
    viewed = cv2.imread(str(path))
    assert viewed is not None and viewed.shape[:2] == (480, 360)  # what a viewer shows
    assert np.array_equal(read_grey(path), plain)


@pytest.mark.parametrize(
    "width, limit",
    [(2400, 0.4), (72, 0.2)],  # 0.27 and 0.14 px at worst; the small one is found at twice its size only
)
def test_any_size_of_image(width: int, limit: float, picture: Array, truth: Array, tmp_path: Path) -> None:
    how = cv2.INTER_AREA if width < 480 else cv2.INTER_CUBIC
    path = write(tmp_path / "a.png", cv2.resize(photograph(picture), (width, width * 3 // 4), interpolation=how))
    points = detect_boards([path], BOARD, corner_fit="saddle").observations.points
    assert np.max(np.abs(points.pixels - ((truth + 0.5) * width / 480 - 0.5))) < limit


def test_dark_images(tmp_path: Path, picture: Array, truth: Array) -> None:
    """Eleven grey levels in all: OpenCV's newer detector finds nothing there, the older one does."""
    path = write(tmp_path / "a.png", photograph(picture) // 16)
    points = detect_boards([path], BOARD, corner_fit="saddle").observations.points
    assert rms(points.pixels - truth) < 0.03  # 0.009


# ---- ChArUco --------------------------------------------------------------------------------------------------------

CHARUCO = charuco(7, 5, 0.04, 0.03, "DICT_4X4_50")


@pytest.fixture(scope="module")
def markered() -> tuple[Image8, Array]:
    """OpenCV's own drawing of the board, in perspective, and its corners (35, 2)."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    drawing = cv2.aruco.CharucoBoard((8, 6), 0.04, 0.03, dictionary).generateImage(
        (8 * 200 + 100, 6 * 200 + 100), None, 50
    )
    corners = 50 + 200 * (np.stack(np.meshgrid(np.arange(7), np.arange(5)), axis=-1).reshape(-1, 2) + 1) - 0.5
    from_drawing = cv2.getPerspectiveTransform(
        np.array([[0, 0], [1700, 0], [1700, 1300], [0, 1300]], np.float32),
        np.array([[70, 60], [585, 95], [548, 436], [102, 391]], np.float32),
    )
    finer = np.array([[8.0, 0.0, 3.5], [0.0, 8.0, 3.5], [0.0, 0.0, 1.0]])  # 8 x 8 places in each pixel
    fine = cv2.warpPerspective(drawing, finer @ from_drawing, (8 * 640, 8 * 480), borderValue=255)
    image = photograph(np.asarray(cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA), float) / 255.0)
    return image, cv2.perspectiveTransform(corners[None], from_drawing)[0]


def test_charuco_corners(tmp_path: Path, markered: tuple[Image8, Array]) -> None:
    image, truth = markered
    points = detect_boards([write(tmp_path / "a.png", image)], CHARUCO).observations.points
    assert np.array_equal(points.feature, np.arange(35))
    assert rms(points.pixels - truth) < 0.02  # 0.009; OpenCV's own corners 0.05


def test_charuco_may_be_partly_seen(tmp_path: Path, markered: tuple[Image8, Array]) -> None:
    image, truth = markered
    image = image.copy()
    image[:, 330:] = 128
    observations = detect_boards([write(tmp_path / "a.png", image)], CHARUCO).observations
    points = observations.points
    assert 10 <= len(points) < 25  # 15
    assert {"0,0", "0,4"} <= set(corner_names(observations)) and "6,0" not in corner_names(observations)
    assert rms(points.pixels - truth[points.feature]) < 0.02  # 0.011


@pytest.mark.parametrize(
    "right, below, reason",
    [
        (230, 480, "only 5 corners, 6 are needed"),  # one column
        (640, 220, "its 7 corners lie in one row or column (except for one at most)"),
        (0, 480, "no ChArUco corners found"),
    ],
)
def test_charuco_too_little_seen(
    right: int, below: int, reason: str, tmp_path: Path, markered: tuple[Image8, Array]
) -> None:
    whole = write(tmp_path / "a.png", markered[0])
    part = np.full_like(markered[0], 128)
    part[:below, :right] = markered[0][:below, :right]
    detections = detect_boards([write(tmp_path / "b.png", part), whole], CHARUCO)
    assert detections.found == (str(whole),)
    assert detections.missed == ((str(tmp_path / "b.png"), reason),)


def test_markers_in_other_places_are_another_board(tmp_path: Path, markered: tuple[Image8, Array]) -> None:
    path = write(tmp_path / "a.png", markered[0])
    for board in (charuco(8, 6, 0.04, 0.03, "DICT_4X4_50"), charuco(7, 5, 0.04, 0.03, "DICT_4X4_50", legacy=True)):
        with pytest.raises(InputError, match="though markers of its dictionary: check columns, rows and legacy"):
            detect_boards([path], board)


def test_the_markers_of_another_board_are_named(tmp_path: Path, markered: tuple[Image8, Array]) -> None:
    path = write(tmp_path / "a.png", markered[0])
    with pytest.raises(
        InputError, match=r"it shows markers of DICT_4X4_50: a board with markers is of kind charuco or"
    ):
        detect_boards([path], checkerboard(8, 6, 0.04))
    with pytest.raises(InputError, match=r"no ChArUco corners found; it shows markers of DICT_4X4_50$"):
        detect_boards([path], charuco(7, 5, 0.04, 0.03, "DICT_5X5_250"))


# ---- what is said ---------------------------------------------------------------------------------------------------


def test_unreadable_images_are_named(tmp_path: Path, picture: Array) -> None:
    good = write(tmp_path / "good.png", photograph(picture))
    text, empty = tmp_path / "text.png", tmp_path / "empty.png"
    text.write_text("no image")
    empty.touch()
    for bad in (text, empty):
        with pytest.raises(InputError, match=f"{bad.name}: not an image"):
            detect_boards([good, bad], BOARD)
    with pytest.raises(InputError, match=r"gone\.png: no such file"):
        detect_boards([good, tmp_path / "gone.png"], BOARD)


def test_another_size_is_another_camera(tmp_path: Path, picture: Array) -> None:
    image = photograph(picture)
    images = [write(tmp_path / "a.png", image), write(tmp_path / "b.png", image[:, 8:])]
    with pytest.raises(InputError, match=r"b\.png: 472 x 360 px, but .*a\.png has 480 x 360"):
        detect_boards(images, BOARD)


def test_the_search_ends_where_most_images_show_another_board(tmp_path: Path, picture: Array) -> None:
    """Of all images each was searched completely, which takes seconds, for an answer that no image to come changes."""
    small = photograph(picture)[::2, ::2]
    paths = [write(tmp_path / f"{name}.png", small) for name in "abcde"]
    looked: list[int] = []
    with pytest.raises(InputError, match=r"6 x 6 inner corners in the first 3 of 5 images .*a\.png: .* 7 x 6 corners"):
        detect_boards(paths, checkerboard(6, 6, 0.03), progress=lambda number, *_: looked.append(number))
    assert looked == [1, 2, 3]


def test_no_board_at_all(tmp_path: Path, picture: Array) -> None:
    path = write(tmp_path / "a.png", photograph(picture)[::2, ::2])
    with pytest.raises(
        InputError, match=r"no board of 6 x 6 inner corners in any of 1 images .*a\.png: .* 7 x 6 corners"
    ):
        detect_boards([path], checkerboard(6, 6, 0.03))
    with pytest.raises(InputError, match="no images were given"):
        detect_boards([], BOARD)
    with pytest.raises(InputError, match=r"a\.png: given twice"):
        detect_boards([path, path], BOARD)


@pytest.mark.parametrize(
    "board, message",
    [
        (rings([0.1, 0.2]), "kind 'rings'"),
        (checkerboard(2, 5, 0.03), "3 inner corners a side or more, not 2 x 5"),
        (charuco(7, 5, 0.04, 0.03, "DICT_9X9"), "unknown marker dictionary 'DICT_9X9'"),
        (charuco(7, 5, 0.04, 0.03, "Dictionary"), "unknown marker dictionary 'Dictionary'"),
        (charuco(11, 9, 0.04, 0.03, "DICT_4X4_50"), "has 50 markers, but a board of 12 x 10 squares needs 60"),
    ],
)
def test_wrong_targets(board: Target, message: str, tmp_path: Path) -> None:
    black = write(tmp_path / "a.png", np.zeros((50, 50), np.uint8))
    with pytest.raises(InputError, match=message):
        detect_boards([black], board)


@pytest.mark.parametrize("size", [(1, 60_000), (60_000, 1), (40, 30_000), (1, 1), (7, 7)])
def test_long_and_tiny_pictures_are_misses(size: tuple[int, int]) -> None:
    """OpenCV rotates a picture by 45 degrees; for 60000 x 1 px this took 5 GB."""
    scales = boards._scales(size)
    assert all(scale**2 * sum(size) ** 2 <= 16.001 * boards._MOST_PX for scale in scales)
    if not scales:
        picture = np.random.default_rng(0).integers(0, 255, size, dtype=np.uint8)
        assert boards._measured_chessboard(picture, 7, 6, "saddle") == "no chessboard of 7 x 6 inner corners found"


@pytest.mark.parametrize(
    ("size", "first"), [((480, 640), 1.0), ((1080, 1920), 0.98209), ((3000, 4000), 0.40825), ((1000, 10_000), 0.44721)]
)
def test_usual_pictures_are_searched_by_their_pixels(size: tuple[int, int], first: float) -> None:
    """Large ones first at two megapixels, small ones last at twice their size."""
    assert boards._scales(size) == pytest.approx([first, 2.0] if first == 1.0 else [first, 1.0], abs=1e-5)


@given(seed=st.integers(0, 1000), side=st.integers(2, 4))
@settings(max_examples=6)
def test_a_part_of_a_board_where_there_is_none_is_a_reason(seed: int, side: int) -> None:
    """Squares that a detector reports, but that have no corners, cause no warning of NumPy."""
    rng = np.random.default_rng(seed)
    picture = rng.integers(0, 255, (120, 160), dtype=np.uint8)
    corners = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1) * 15.0 + rng.uniform(20.0, 60.0, 2)
    assert isinstance(part_of_board(picture, corners, 7, 6), str)
    assert isinstance(part_of_board(np.zeros_like(picture), corners, 7, 6), str)
