"""Observations imported from other programs' files."""

import base64
import io
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest

from ceres_cal import InputError, Observations
from ceres_cal.cli import main
from ceres_cal.formats import import_calibration, import_observations
from ceres_cal.observations import View

BOARD: dict[str, Any] = {"columns": 3, "rows": 2, "square": 0.1, "image_size": "640x480"}
CORNERS = """# filename x y level
a/0001.png 10 20 0
a/0001.png 30 20 1
a/0001.png 50 20 -
a/0001.png 10 40 0
a/0001.png 30 40 0
a/0001.png 50 40 2
a/0002.png - - -
"""


def test_corners_of_mrcal(tmp_path: Path) -> None:
    (tmp_path / "corners.vnl").write_text(CORNERS)
    seen = import_observations(tmp_path / "corners.vnl", sigma_px=0.3, camera="left", **BOARD)
    assert seen.views == (View("0001", "left", "left", "board", "0001"),)
    assert seen.points.feature.tolist() == [0, 1, 3, 4, 5]
    assert seen.points.sigma_px == pytest.approx([0.3, 0.6, 0.3, 0.3, 1.2])
    assert seen.points.pixels[1].tolist() == [30.0, 20.0]


def test_the_command_takes_the_formats_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "corners.vnl").write_text(CORNERS)
    ask = ["import", str(tmp_path / "corners.vnl"), "-o", str(tmp_path / "o.json"), "--columns", "3", "--rows", "2"]
    assert main(ask) == 2
    assert "give columns, rows and square (--columns N --rows N --square M)" in capsys.readouterr().err
    assert main([*ask, "--square", "0.1"]) == 2
    assert "give image_size (--image-size) as WIDTHxHEIGHT" in capsys.readouterr().err
    assert main([*ask, "--square", "0.1", "--image-size", "640x480"]) == 0
    assert "5 points and 0 curve observations in 1 view\n" in capsys.readouterr().out
    assert len(Observations.load(tmp_path / "o.json").points) == 5


TABLE = """frame,point,curve,side,x_px,y_px,sigma_px
1,TopLeftCorner,,,100,50,0.3
1,,TopTouchLine,left,120,51,0.2
2,BottomLeftCorner,,,100,400,
"""


SPREADSHEET = TABLE.replace(",", ";").replace(".", ",").replace("100;50", "100,0;50,00")


@pytest.mark.parametrize(
    "table",
    [
        TABLE,
        "\ufeff" + TABLE.replace("\n", "\r\n"),
        SPREADSHEET,
        SPREADSHEET.replace(";", "\t"),
        TABLE.replace(",", ", "),
        "# by hand; on Monday\n#\n" + TABLE,
    ],
)
def test_named_columns(tmp_path: Path, table: str) -> None:
    """With any separator that spreadsheets use, blanks after it, and comments above."""
    (tmp_path / "a.csv").write_text(table, newline="")
    seen = import_observations(tmp_path / "a.csv", target="ssl-b", image_size="640x480")
    assert [view.frame for view in seen.views] == ["1", "2"] and seen.views[0].placement is None
    assert [seen.feature_name("point", row) for row in (0, 1)] == ["TopLeftCorner", "BottomLeftCorner"]
    assert seen.curves.side.tolist() == [1] and seen.curves.sigma_px.tolist() == [0.2]
    assert seen.points.sigma_px.tolist() == [0.3, 1.0]
    assert seen.points.pixels.tolist() == [[100.0, 50.0], [100.0, 400.0]]


def test_places_far_from_their_origin_stay_apart(tmp_path: Path) -> None:
    """Rounded to six digits, places of a survey had one name, and all but the last were lost."""
    places = [(412345.25 + 0.5 * n, 5765432.75) for n in range(4)]
    rows = [f"{100 * n},50,{x},{y}" for n, (x, y) in enumerate(places)]
    (tmp_path / "a.csv").write_text("\n".join(["x_px,y_px,X_m,Y_m", *rows]))
    seen = import_observations(tmp_path / "a.csv", image_size="640x480")
    assert [place[:2] for place in seen.targets["target"].points.values()] == places


def test_named_arrays(tmp_path: Path) -> None:
    columns: dict[str, Any] = {
        "x_px": [1.0, 2.0, 3.0],
        "y_px": [4.0, 5.0, 6.0],
        "X_m": [0.0, 1.0, 1.0],
        "Y_m": [0.0, 0.0, 2.0],
    }
    arrays: Any = {name: np.array(values) for name, values in columns.items()}
    np.savez(tmp_path / "a.npz", **arrays)
    places = import_observations(tmp_path / "a.npz", image_size="640x480")
    assert places.targets["target"].points["1 2 0"] == (1.0, 2.0, 0.0)
    assert places.points.pixels.tolist() == [[1.0, 4.0], [2.0, 5.0], [3.0, 6.0]]


def test_what_mrcal_calibrated_from(tmp_path: Path) -> None:
    boards = np.zeros((2, 2, 3, 3))
    boards[..., 0], boards[..., 1], boards[..., 2] = 100.0, 200.0, 0.5
    boards[1, 0, 0, 2] = -1.0
    stream = io.BytesIO()
    np.savez_compressed(
        stream,
        observations_board=boards,
        indices_frame_camintrinsics_camextrinsics=np.array([[0, 0, -1], [0, 1, 0]], np.int32),
        calibration_object_spacing=np.array(0.1),
        imagersizes=np.array([[640, 480], [1280, 960]], np.int32),
    )
    packed = base64.b85encode(stream.getvalue())
    (tmp_path / "a.cameramodel").write_text(f"{{ 'optimization_inputs': {packed!r}, 'icam_intrinsics': 0 }}")
    seen = import_observations(tmp_path / "a.cameramodel", "mrcal-observations")
    assert [view.camera for view in seen.views] == ["camera0", "camera1"] and seen.placements == ("0000",)
    assert len(seen.points) == 11 and set(seen.points.sigma_px) == {2.0}
    assert seen.cameras["camera1"] == (1280, 960) and seen.targets["board"].spec["columns"] == 3


def test_keypoints_of_colmap_lose_their_half_pixel(tmp_path: Path) -> None:
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 500, 320, 240])
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name="a.png", camera_id=1, image_id=1)
    image.points2D = pycolmap.Point2DList([pycolmap.Point2D(np.array([100.5, 50.5])), pycolmap.Point2D(np.zeros(2))])
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    model.add_point3D(np.array([1.0, 2.0, 3.0]), pycolmap.Track([pycolmap.TrackElement(1, 0)]), np.zeros(3, np.uint8))
    model.write_text(tmp_path)
    seen = import_observations(tmp_path, "colmap-observations")
    assert seen.points.pixels.tolist() == [[100.0, 50.0]]
    assert next(iter(seen.targets["target"].points.values())) == (1.0, 2.0, 3.0)


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("a.csv", "x_px\n1", "column y_px is missing"),
        ("a.csv", "x_px,y_px,who\n1,2,3", "unknown column 'who'"),
        ("a.csv", "x_px,y_px,point\n1,2,Nose", "line 2: there is no feature 'Nose'"),
        ("a.csv", "x_px,y_px,point\n1,2,CentreMark", "no feature 'CentreMark': did you mean 'CenterMark'?"),
        ("a.csv", "x_px,y_px,point\n1,z,CenterMark", "line 2: y_px is not a finite number, but 'z'"),
        ("a.csv", "# hand\nx_px,y_px,point\n\n1,z,CenterMark", "line 4: y_px is not a finite number, but 'z'"),
        ("a.csv", "x_px,y_px,point\n", "it holds no row"),
        ("a.csv", "x_px,y_px,point,curve\n1,2,CenterMark,CenterLine", "line 2 names both a point and a curve"),
        ("a.csv", "x_px,y_px,point\n1,2,", "line 2 names neither a point nor a curve"),
        ("a.csv", "point,x_px,y_px\nCenterMark,102,4,800,1", "line 2 has more values than there are columns"),
        ("a.npz", "hello", "not an NPZ file"),
        ("a.csv", "x_px,x_px,y_px\n1,2,3", "a column is there twice"),
        ("a.csv", f"x_px,y_px\n1,{'2' * 200_000}", "not a CSV file"),
        ("a.csv", "x_px,y_px,point\n1,7000,CenterMark\n2,7000,CenterMark", "observations lie outside its image"),
        ("a.vnl", "a.png 1 2 9000", "line 1: x, y and level must be numbers"),
        ("a.vnl", "a.png 1 x 0", "line 1: x, y and level must be numbers"),
        ("a.vnl", "a.png 1 2 0\na.png 1 2 0", "image 'a.png' has 2 corners, the board 6"),
    ],
)
def test_broken_files_are_one_line(name: str, text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(text)
    options: dict[str, Any] = BOARD if name == "a.vnl" else {"target": "ssl-b", "image_size": "640x480"}
    with pytest.raises(InputError, match=words) as caught:
        import_observations(tmp_path / name, **options)
    assert str(caught.value).startswith(str(tmp_path / name)) and len(str(caught.value).splitlines()) == 1


def test_cameras_are_no_observations(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(TABLE)
    with pytest.raises(InputError, match="holds observations, not cameras: calibrate them"):
        import_calibration(tmp_path / "a.csv", target="ssl-b", image_size="640x480")
