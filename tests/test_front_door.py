"""From arrays to a calibration and back in a few lines, as users of OpenCV type them."""

from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import pytest
from scenery import overhead_pose

import ceres_cal
from ceres_cal import (
    Camera,
    InputError,
    Observations,
    Pose,
    View,
    calibrate,
    checkerboard,
    custom,
    join,
    ssl_field,
)
from ceres_cal.base.arrays import Array32
from ceres_cal.base.images import image_files
from ceres_cal.scene.lens import Brown

BOARD = checkerboard(9, 6, 0.1)
TRUE = Camera((1280, 960), 900.0, (650.0, 470.0), Brown((-0.2, 0.05, 0.0, 0.0, 0.0)))


def corners(count: int = 8) -> list[Array32]:
    """OpenCV's arrays, one for each frame, with 0.1 px noise."""
    draw, seen = np.random.default_rng(2), []
    for _ in range(count):
        turn = draw.uniform(-0.5, 0.5, 3)
        at = TRUE.at(Pose.exp((*turn, *draw.uniform((-0.5, -0.4, 1.4), (-0.2, -0.1, 2.0)))))
        seen.append((at.project(BOARD.point_array) + draw.normal(0.0, 0.1, (54, 2)))[:, None].astype(np.float32))
    return seen


def test_opencvs_corners_to_a_calibration_and_back() -> None:
    observations = Observations.from_points(corners(), BOARD, (1280, 960))
    calibration = calibrate(observations, ceres_cal.Options(lens="brown"))
    matrix, distortion, rvec, tvec = calibration.station().to_opencv()
    by_opencv = cv2.calibrateCamera([BOARD.point_array.astype(np.float32)] * 8, corners(), (1280, 960), None, None)
    assert abs(matrix[0, 0] - by_opencv[1][0, 0]) < 2.0 and abs(matrix[0, 0] - 900.0) < 5.0  # aspect is held here
    assert distortion.shape == (5,) and rvec.shape == tvec.shape == (3,)
    rows = calibration.uncertainty.table()
    assert {"kind", "owner", "quantity", "unit", "value", "sd", "low", "high", "verdict"} == set(rows[0])
    assert next(row for row in rows if row["quantity"] == "phi")["value"] == calibration.station().phi
    for thing in (calibration, observations, observations.points, calibration.station(), BOARD, Pose.identity()):
        assert len(repr(thing)) < 160
    assert repr(observations) == "Observations(432 points, 0 curve observations in 8 views of camera)"


def test_places_frames_and_what_was_not_seen() -> None:
    places = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    pixels = np.array([[100.0, 100.0], [200.0, 100.0], [np.nan, np.nan], [100.0, 200.0]])
    one = Observations.from_points(pixels, places, (640, 480), sigma_px=0.3)
    assert one.points.feature.tolist() == [0, 1, 3] and one.points.sigma_px.tolist() == [0.3] * 3
    assert one.views == (View("0", "camera", "camera", "target"),)
    for listed in (pixels.tolist(), list(pixels)):  # pixel by pixel, as they are typed or collected
        assert np.array_equal(Observations.from_points(listed, places, (640, 480)).points.pixels, one.points.pixels)
    named = Observations.from_points({"a": pixels, "b": pixels}, places, (640, 480), moves=True, camera="left")
    assert named.views[1] == View("b", "left", "left", "target", "b")
    with pytest.raises(InputError, match="frame 'a': 3 pixels for 4 points"):
        Observations.from_points({"a": pixels[:3]}, places, (640, 480))
    with pytest.raises(InputError, match=r"points must have shape \(N, 3\)"):
        Observations.from_points(pixels, places[0], (640, 480))
    with pytest.raises(InputError, match="frame '0': pixels must have shape"):
        Observations.from_points([pixels.T], places, (640, 480))


def test_a_frame_in_which_opencv_found_no_board() -> None:
    """OpenCV's None ended in "pixels must have shape (N, 2), not ()", which names nothing that the user gave."""
    found = {**{str(number): seen for number, seen in enumerate(corners())}, "none": None}
    with_none = Observations.from_points(found, BOARD, (1280, 960))
    unseen = Observations.from_points({**found, "none": np.full((54, 2), np.nan)}, BOARD, (1280, 960))
    assert with_none.digest == unseen.digest and with_none.views[-1].frame == "none"
    assert (
        calibrate(with_none).station().phi
        == calibrate(Observations.from_points(corners(), BOARD, (1280, 960))).station().phi
    )
    with pytest.raises(InputError, match="no frame shows the target"):
        Observations.from_points([None, None], BOARD, (1280, 960))


@pytest.mark.parametrize("given", [np.ones((4, 2)), [np.ones((480, 640, 3))], 7])
def test_what_are_no_photographs(given: Any) -> None:
    """Pixels, or images that were read, given to `check` caused a ValueError of NumPy."""
    with pytest.raises(InputError, match=r"photographs must be file names, not \w+;"):
        image_files(given)


def test_hidden_files_of_a_folder_are_no_photographs(tmp_path: Path) -> None:
    """A Mac leaves "._0001.jpg" beside "0001.jpg" on other disks, which stopped the whole folder."""
    for name in ("0001.jpg", "._0001.jpg"):
        (tmp_path / name).touch()
    assert image_files([tmp_path]) == [tmp_path / "0001.jpg"]


def test_a_field_is_named_as_on_the_command_line() -> None:
    photograph = Path(__file__).resolve().parents[1] / "data" / "ssl_field" / "photographs" / "0001.jpg"
    found = ceres_cal.detect_field(photograph, "ssl-b", facing={"LeftGoalLine": "top"})
    assert found.observations.targets["field"] == ssl_field("B")
    with pytest.raises(InputError, match="there is no target 'ssl-c': did you mean 'ssl-b'"):
        ceres_cal.detect_field(photograph, "ssl-c")


def test_names_from_arrays_are_text() -> None:
    """`np.array(["left"])[0]` is a str subclass, and caused a TypeError when the file was written."""
    name, frame = np.array(["left", "0001"])
    field = ssl_field(np.array(["B"])[0])
    seen = Observations.from_points({frame: np.ones((len(field.points), 2))}, field, (640, 480), camera=name)
    assert [type(one) for one in (*seen.cameras, seen.views[0].frame, seen.views[0].camera)] == [str, str, str]
    assert seen.digest


def test_one_pixel_and_metres() -> None:
    camera = TRUE.at(overhead_pose(0.0, 0.0, 4.0, 3.0, 2.0))
    assert camera.locate([640, 480]).shape == (2,)
    assert np.array_equal(camera.locate([640, 480], 0.15), camera.locate([[640, 480]], 0.15)[0])
    assert camera.project([0.1, 0.2, 0.0]).shape == (2,)
    with pytest.raises(
        InputError, match=r"height_m is 150 m, but the camera's height is 4\.00 m: for 150 mm give 0\.15"
    ):
        camera.locate([640, 480], 150)
    assert np.isnan(camera.locate([640, 480], 6.0)).all()  # over the camera, but a height


def test_small_integers_of_numpy_do_not_wrap_around() -> None:
    """Warned of an overflow, as 20 x 20 is 144 in eight bits."""
    assert len(checkerboard(cast(int, np.uint8(20)), cast(int, np.uint8(20)), 0.1).points) == 400


def test_what_are_no_numbers_is_named() -> None:
    """Both ended with a traceback of NumPy or of Python; an infinite height was said to be infinite millimetres."""
    camera = TRUE.at(overhead_pose(0.0, 0.0, 4.0, 3.0, 2.0))
    with pytest.raises(InputError, match=r"pixels must be numbers, not list \[\[1, 2\], \[3\]\]"):
        camera.locate([[1, 2], [3]])
    with pytest.raises(InputError, match=r"points_world must be numbers, not list \[\[1, 2\], \[3\]\]"):
        camera.project([[1, 2], [3]])
    with pytest.raises(InputError, match=r"height_m must be a number of metres, such as 0\.15, not inf"):
        camera.locate([[1.0, 2.0]], float("inf"))
    with pytest.raises(InputError, match=r"point 'pole' must be three numbers \(x, y, z\) in metres, not \(1.0, 2.0\)"):
        custom({"pole": (1.0, 2.0)})  # type: ignore[dict-item]


def test_what_is_public() -> None:
    for name in (
        "View",
        "Points",
        "Curves",
        "Target",
        "Segment",
        "Arc",
        "checkerboard",
        "rings",
        "ssl_field",
        "custom",
    ):
        assert getattr(ceres_cal, name).__module__.startswith("ceres_cal.")
    assert len(ceres_cal.ssl_field("B").points) == len(ssl_field("B").points)


def test_masked_pixels_are_not_seen() -> None:
    """The mask was ignored: what lay under it took part."""
    pixels = np.ma.array([[1.0, 2.0], [3.0, 4.0]], mask=[[True, False], [False, False]])
    seen = Observations.from_points(pixels, custom({"a": (0.0, 0.0, 0.0), "b": (1.0, 0.0, 0.0)}), (640, 480))
    assert seen.points.pixels.tolist() == [[3.0, 4.0]]


def test_places_that_move_and_were_not_said_to_are_named() -> None:
    """It was "check labels, target dimensions and the lens"."""
    places = np.array([[c * 0.1, r * 0.1, 0.0] for r in range(6) for c in range(9)])
    poses = [overhead_pose(0.4, 0.25, 1.6, 5 * n, 4 - 4 * n, 40 * n) for n in range(3)]
    views = {f"f{number}": TRUE.at(pose).project(places) for number, pose in enumerate(poses)}
    seen = Observations.from_points(views, places, (1280, 960))
    with pytest.raises(InputError, match=r"'camera', frame 'f.': half of what it shows of 'target' .* give moves=True"):
        calibrate(seen)
    assert calibrate(Observations.from_points(views, places, (1280, 960), moves=True)).station().phi > 0.0


def test_frames_that_a_fixed_camera_cannot_have_seen_are_named() -> None:
    """Two cameras whose names are exchanged in one of two frames. It took up to 108 s, and was not named."""
    field, along = ssl_field("B"), np.linspace(-4.0, 4.0, 60)
    lines = {
        name: np.column_stack([along, 0.0 * along + y]) for name, y in (("TopTouchLine", 3.0), ("CenterLine", 0.0))
    }
    lines["HalfwayLine"] = lines["CenterLine"][:, ::-1]
    seen = list[dict[str, np.ndarray[Any, Any]]]()
    for x, y in ((-2.0, 1.4), (2.0, 1.2)):
        camera = TRUE.at(overhead_pose(x, y, 4.0, 3.0, 2.0))
        every = {name: camera.project(np.column_stack([places, 0.0 * along])) for name, places in lines.items()}
        seen.append({name: p[np.all((p > 0) & (p < (1279, 959)), axis=1)] for name, p in every.items()})
    each = (("a", "0", 0), ("b", "0", 1), ("a", "1", 1), ("b", "1", 0))
    views = [Observations.from_curves(seen[of], field, (1280, 960), camera=name, frame=f) for name, f, of in each]
    with pytest.raises(InputError, match=r"station 'a', frame '1': half of what it shows of .* correct the names"):
        calibrate(join(*views))
    assert all(len(one) > 9 for own in seen for one in own.values())
