"""ROS, Kalibr, mrcal, COLMAP and the paper: read by their own programs or libraries, and exact round trips."""

import json
import os
import subprocess
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest
import yaml
from foreign_cases import LENSES, over_field, places, same_camera, two_cameras, with_lens
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal import Calibration, InputError
from ceres_cal.base.arrays import Array
from ceres_cal.formats import export, import_calibration
from ceres_cal.formats.loss import camera_loss
from ceres_cal.formats.yaml_files import read_yaml
from ceres_cal.scene.foreign import FISHEYE, ForeignCamera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial, make_lens

EXACT = ("brown", "kannala-brandt")
PLAIN_BROWN = Brown((-0.24, 0.082, 4e-4, -3e-4, 0.0))  # what four coefficients hold


def by_opencv(kind: str, points: Array, matrix: Any, coefficients: Any) -> Array:
    """Points in the camera's frame -> pixels."""
    matrix, coefficients, zero = np.array(matrix), np.array(coefficients), np.zeros(3)
    if kind == "equidistant":
        return np.asarray(cv2.fisheye.projectPoints(points[:, None], zero, zero, matrix, coefficients)[0][:, 0])
    return np.asarray(cv2.projectPoints(points, zero, zero, matrix, coefficients)[0][:, 0])


def wrong_px(shown: Array, pixels: Array) -> float:
    return float(np.linalg.norm(shown - pixels, axis=1).max())


@pytest.mark.parametrize("lens", ["brown", "brown-rational", "kannala-brandt", "radial-3"])
def test_ros_by_its_fields_and_opencv(lens: str, tmp_path: Path) -> None:
    camera = with_lens(lens)
    exported = export(over_field(camera), "ros", tmp_path / "a.yaml")
    data = yaml.safe_load((tmp_path / "a.yaml").read_text())
    matrices = {"camera_matrix": (3, 3), "rectification_matrix": (3, 3), "projection_matrix": (3, 4)}
    for name, (rows, cols) in matrices.items():
        assert (data[name]["rows"], data[name]["cols"], len(data[name]["data"])) == (rows, cols, rows * cols)
    order = ["image_width", "image_height", "camera_name", "camera_matrix", "distortion_model"]
    assert list(data)[:6] == [*order, "distortion_coefficients"] and data["image_width"] == 1280
    there = data["static_transform"]
    from_optical = pycolmap.Rotation3d([there[name] for name in ("qx", "qy", "qz", "qw")]).matrix()
    points, pixels = places(camera)
    seen = (points - [there[axis] for axis in "xyz"]) @ from_optical  # the transform's inverse
    matrix = np.array(data["camera_matrix"]["data"]).reshape(3, 3)
    shown = by_opencv(data["distortion_model"], seen, matrix, data["distortion_coefficients"]["data"])
    (loss,) = exported.losses
    assert loss.image_px is not None and wrong_px(shown, pixels) < 1e-9 + 1.1 * loss.image_px[1]
    assert (loss.image_px[1] == 0.0) == (lens != "radial-3")


def test_ros_as_its_message_is_echoed(tmp_path: Path) -> None:
    """By `rostopic echo` (D, K) and `ros2 topic echo` (d, k), one message after another; and lists in a file."""
    path, camera = tmp_path / "info.yaml", with_lens("brown")
    export(over_field(camera), "ros", path)
    data = yaml.safe_load(path.read_text())
    k, d = (data[name]["data"] for name in ("camera_matrix", "distortion_coefficients"))
    sizes = {"height": data["image_height"], "width": data["image_width"], "distortion_model": "plumb_bob"}
    echoed = [
        yaml.safe_dump({"header": {"seq": 0, "frame_id": "left"}, **sizes, **names}) + "---\n"
        for names in ({"D": d, "K": k, "R": [0.0] * 9, "P": [0.0] * 12}, {"d": d, "k": k})
    ]
    listed = yaml.safe_dump({**data, "camera_matrix": k, "distortion_coefficients": d})
    for text in (echoed[0], 2 * echoed[1], "---\n" + echoed[0], listed):
        path.write_text(text)
        (back,) = import_calibration(path).cameras.values()
        assert back.phi == pytest.approx(k[4], rel=1e-12)
        assert list(back.lens.coefficients.values()) == pytest.approx(d, rel=1e-12)
    path.write_text(yaml.safe_dump({**sizes, "D": d}))
    with pytest.raises(InputError, match="it has no camera_matrix with rows, cols and data, or as a list"):
        import_calibration(path)


@pytest.mark.parametrize(
    "topics, names",
    [
        (("/stereo/left/image_raw", "/stereo/right/image_raw"), ["left", "right"]),
        (("/left/image_raw", "/right/image_raw"), ["left", "right"]),
        (("/camera/image_raw", "/camera/image_raw"), ["cam0", "cam1"]),
    ],
)
def test_kalibrs_cameras_are_called_by_what_tells_their_topics_apart(
    topics: tuple[str, str], names: list[str], tmp_path: Path
) -> None:
    path = tmp_path / "chain.yaml"
    export(two_cameras(PLAIN_BROWN), "kalibr", path)
    data = yaml.safe_load(path.read_text())
    for entry, topic in zip(data.values(), topics, strict=True):
        entry["rostopic"] = topic
    path.write_text(yaml.safe_dump(data))
    assert list(import_calibration(path).stations) == names


@pytest.mark.parametrize("lens", [PLAIN_BROWN, KannalaBrandt((-0.012, 0.004, -0.003, 0.0006)), Radial((6e-7,), (3,))])
def test_kalibr_by_its_chain_and_opencv(lens: Lens, tmp_path: Path) -> None:
    both = two_cameras(lens)
    exported = export(both, "kalibr", tmp_path / "chain.yaml")
    data = yaml.safe_load((tmp_path / "chain.yaml").read_text())
    assert list(data) == ["cam0", "cam1"]
    cam_from_field = np.eye(4)
    for name, loss in zip(data, exported.losses, strict=True):
        entry = data[name]
        cam_from_field = np.array(entry["T_cn_cnm1"]) @ cam_from_field
        camera = both.station(name.replace("cam", "camera"))
        points, pixels = places(camera)
        seen = points @ cam_from_field[:3, :3].T + cam_from_field[:3, 3]
        fu, fv, pu, pv = entry["intrinsics"]
        matrix = [[fu, 0, pu], [0, fv, pv], [0, 0, 1]]
        shown = by_opencv(entry["distortion_model"], seen, matrix, entry["distortion_coeffs"])
        assert loss.image_px is not None and wrong_px(shown, pixels) < 1e-9 + 1.1 * loss.image_px[1]
        assert (loss.image_px[1] == 0.0) == (lens.kind != "radial")


@pytest.mark.parametrize("lens", [*EXACT, "brown-rational", "kannala-brandt-tangential", "radial-3"])
def test_colmap_by_pycolmap(lens: str, tmp_path: Path) -> None:
    both = two_cameras(lens)
    exported = export(both, "colmap", tmp_path / "model")
    model = pycolmap.Reconstruction(tmp_path / "model")
    assert (model.num_rigs(), model.num_frames(), model.num_images()) == (1, 1, 2)
    for image, loss in zip(model.images.values(), exported.losses, strict=True):
        camera = both.station(image.name)
        points, pixels = places(camera)
        shown = np.array([image.project_point(point) for point in points], dtype=float) - 0.5
        assert loss.image_px is not None and wrong_px(shown, pixels) < 1e-9 + 1.1 * loss.image_px[1]
        assert (loss.image_px[1] == 0.0) == (lens != "radial-3")
    if lens != "radial-3":
        back = import_calibration(tmp_path / "model")
        assert all(same_camera(back.station(name), both.station(name)) for name in both.stations)


_MRCAL = """
import sys, json, numpy as np, mrcal
model = mrcal.cameramodel(sys.argv[1])
points = np.array(json.load(sys.stdin))
seen = mrcal.transform_point_rt(model.extrinsics_rt_fromref(), points)
print(json.dumps([mrcal.project(seen, *model.intrinsics()).tolist(), [int(s) for s in model.imagersize()]]))
"""


def in_mrcal(path: Path, points: Array) -> tuple[Array, list[int]]:
    """Projection by mrcal's own reader in the Python that $CERES_CAL_MRCAL names, or the system's."""
    python = os.environ.get("CERES_CAL_MRCAL", "/usr/bin/python3")
    ask = [python, "-c", _MRCAL, str(path)]
    clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    try:
        ran = subprocess.run(ask, input=json.dumps(points.tolist()), capture_output=True, text=True, env=clean)
    except OSError:
        pytest.skip(f"mrcal is missing: there is no {python} (CERES_CAL_MRCAL names a Python that has it)")
    if "No module named 'mrcal'" in ran.stderr or "No module named 'numpy'" in ran.stderr:
        pytest.skip(f"mrcal is missing in {python}: install Debian's python3-mrcal, or name one in CERES_CAL_MRCAL")
    assert ran.returncode == 0, ran.stderr
    shown, size = json.loads(ran.stdout)
    return np.array(shown), size


@pytest.mark.parametrize("lens", ["brown", "brown-rational", "brown-all", "radial-3"])
def test_mrcal_by_itself(lens: str, tmp_path: Path) -> None:
    camera = with_lens(lens)
    (loss,) = export(over_field(camera), "mrcal", tmp_path / "a.cameramodel").losses
    points, pixels = places(camera)
    shown, size = in_mrcal(tmp_path / "a.cameramodel", points)
    assert loss.image_px is not None and wrong_px(shown, pixels) < 1e-9 + 1.1 * loss.image_px[1]
    assert tuple(size) == camera.image_size


def test_a_camera_that_sees_behind_itself_in_a_model_of_tangents(tmp_path: Path) -> None:
    """The fit uses what the model can show, which is the field: at most 1.7 mm error, where it was metres."""
    camera = replace(with_lens(KannalaBrandt((0.0,) * 4)), phi=437.0)  # corners 107 degrees off the axis
    (loss,) = export(over_field(camera), "mrcal", tmp_path / "a.cameramodel").losses
    assert max(worst for _, worst in loss.field_mm.values()) < 3.0
    assert "overhead: part of the image cannot be shown, over the image" in (tmp_path / "a.cameramodel").read_text()
    with pytest.raises(InputError, match="station 'overhead': the field of view is too wide for this format"):
        camera_loss(
            "overhead",
            camera,
            lambda points: np.full((len(points), 2), np.nan),
            (np.array([-1.0, 1.0]), np.array([0.0, 1.0])),
        )


def test_a_fisheye_is_fitted_by_all_that_it_shows() -> None:
    """Corners 102 degrees from the axis, and decentring, which it lacks: 8.2 px at most, 12 px with only the front
    half.
    """
    lens = make_lens("kannala-brandt", coefficients={"k1": -0.02, "p1": 0.002, "p2": -0.001})
    assert ForeignCamera.of(replace(with_lens(lens), phi=480.0), FISHEYE).error_px[1] < 8.5


def test_the_paper_by_its_equations(tmp_path: Path) -> None:
    camera = with_lens("radial-2-3")
    (loss,) = export(over_field(camera), "paper", tmp_path / "a.txt").losses
    assert loss.image_px is not None and loss.image_px[1] < 1e-9
    lines = [line.split(" = ") for line in (tmp_path / "a.txt").read_text().splitlines() if line[0] != "#"]
    said = {name: np.array([[float(v) for v in row.split()] for row in text.split(";")]) for name, text in lines}
    points, pixels = places(camera)
    floor, shown = points[points[:, 2] == 0.0], pixels[points[:, 2] == 0.0]
    at_1 = np.column_stack([floor[:, :2], np.ones(len(floor))]) @ said["H"].T
    ideal = (at_1 @ said["K"].T)[:, :2] / at_1[:, 2:] - said["K"][:2, 2]
    offset = shown - said["K"][:2, 2]
    radius = np.linalg.norm(offset, axis=1)
    grown = sum(said[f"a{k}"].item() * radius**k for k in (1, 2, 3))
    assert np.abs(offset * (grown / radius)[:, None] - ideal).max() < 1e-9


# ---- there and back again -------------------------------------------------------------------------------------------

HOLDS = {
    "opencv": (Brown, KannalaBrandt),
    "ros": (Brown, KannalaBrandt),
    "colmap": (Brown, KannalaBrandt),
    "mrcal": (Brown,),
    "kalibr": (KannalaBrandt,),
    "paper": (Radial,),
    "ssl-vision": (Radial,),
    "vision-processor": (Radial,),
}
FILES = {"opencv": "a.yml", "ros": "a.yaml", "colmap": "a", "mrcal": "overhead.cameramodel", "kalibr": "a.yaml"}
FILES |= {"paper": "overhead.txt", "ssl-vision": "a.pb", "vision-processor": "a.yml"}
_small = st.floats(-0.02, 0.02, allow_subnormal=False)


@st.composite
def calibrations(draw: st.DrawFn, kind: type[Lens], powers: tuple[int, ...]) -> Calibration:
    bent = kind.blank(powers)
    shrink = bent.scales(800.0)
    lens = bent.with_values(np.array([draw(_small) for _ in bent.names]) / shrink)
    aspect = 1.0 if kind is Radial else 1.0 + draw(_small)
    turned = with_lens(lens, aspect, draw(st.integers(0, 1)))
    name = "overhead"
    return over_field(replace(turned, phi=1200.0 * (1.0 + 5.0 * draw(_small)), principal_point=(600.0, 500.0)), name)


@pytest.mark.parametrize("to, kind", [(to, kind) for to, kinds in HOLDS.items() for kind in kinds])
@settings(max_examples=8)
@given(data=st.data())
def test_import_export_import_changes_nothing(
    to: str, kind: type[Lens], data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    folder = tmp_path_factory.mktemp("round")
    powers = (3,) if "vision" in to else (2, 3)
    export(data.draw(calibrations(kind, powers)), to, folder / FILES[to])
    first = import_calibration(folder / FILES[to], to)
    (folder / "again").mkdir()
    export(first, to, folder / "again" / FILES[to])
    second = import_calibration(folder / "again" / FILES[to], to)
    assert list(first.stations) == list(second.stations)
    tolerance = 5e-7 if "vision" in to else 1e-12  # float32's
    for name in first.stations:
        assert same_camera(first.station(name), second.station(name), tolerance)


@pytest.mark.parametrize(
    "name, text, words",
    [
        ("a.yaml", "camera_model: [", "not valid YAML"),
        ("a.yaml", "cam1: {camera_model: pinhole}", "its cameras must be cam0, cam1"),
        ("a.yaml", "cam0: {camera_model: round, intrinsics: [1]}", "'round' with distortion 'none' is unknown"),
        ("a.yaml", "cam0: {camera_model: [1, 2]}", r"'.1, 2.' with distortion 'none' is unknown"),
        ("a.yaml", "cam0: {camera_model: pinhole}\n7: 1", "not a YAML file of names and values"),
        ("a.yaml", "cam0: {camera_model: pinhole, intrinsics: [1, 2]}", r"cam0.intrinsics must be 4 finite numbers"),
        ("a.yaml", "distortion_model: plumb_bob\ncols: 3", "image_width and image_height must be whole numbers"),
        ("a.yaml", "image_width: 9\nimage_height: 9\ndistortion_model: x\ncols: 1", "it has no camera_matrix with"),
        ("a.cameramodel", "{ 'lensmodel': ", "not a .cameramodel .cut short"),
        ("a.cameramodel", "{ 'lensmodel': 'LENSMODEL_CAHVOR' }", "lens model 'LENSMODEL_CAHVOR' cannot be read"),
        ("a.cameramodel", "{ 'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [1, 2] }", "intrinsics must be 4"),
        ("a.txt", "a1 = 1\na2 = x\n", "a2 must be 1 finite numbers, not 'x'"),
        ("model/cameras.txt", "1 PINHOLE 2", "not a model of COLMAP"),
    ],
)
def test_broken_files_are_one_line(name: str, text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    whole = path.parent if path.parent != tmp_path else path
    with pytest.raises(InputError, match=words) as caught:
        import_calibration(whole)
    assert str(caught.value).startswith(str(whole)) and len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("model, own", [("omni", [0.9]), ("ds", [-0.2, 0.55]), ("eucm", [0.6, 1.1])])
def test_kalibrs_other_models_come_as_the_nearest_lens(model: str, own: list[float], tmp_path: Path) -> None:
    entry = {"camera_model": model, "intrinsics": [*own, 600.0, 601.0, 640.0, 480.0], "resolution": [1280, 960]}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump({"cam0": entry}))
    (held, *_) = import_calibration(tmp_path / "a.yaml").warnings
    assert f"its {model}-none model is approximated by the nearest" in held
    assert float(held.split("off by ")[1].split(" px")[0]) < 0.2
    assert set(LENSES) >= set(EXACT)


@pytest.mark.parametrize(
    "text, words",
    [
        ("image_width: 9\nimage_width: 8\n", "'image_width' is given twice"),
        ("a: &a {b: 1}\nc: {<<: *a}\n", "'<<' is given twice or merged"),
        ("a: &a [*a]\n", "a reference to itself"),
        ("a0: &a0 [1, 1]\n" + "".join(f"a{n}: &a{n} [*a{n - 1}, *a{n - 1}]\n" for n in range(1, 40)), "would take"),
        ("[" * 5000, "not valid YAML"),
        ("a: 2026-99-99\n", "not valid YAML"),
    ],
)
def test_yaml_that_means_no_good(text: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        import_calibration(tmp_path / "a.yaml", "ros")
    assert str(caught.value).startswith(f"{tmp_path / 'a.yaml'}: ")


def test_yaml_in_base_60_is_text() -> None:
    """As in YAML 1.2; as numbers, 2.5 MB took 38 s, quadratic in their length."""
    assert read_yaml("a: 1:30:00\nb: 0x10\nc: -12\n") == {"a": "1:30:00", "b": 16, "c": -12}
    begin = time.process_time()
    long = "1" + ":1" * 150_000
    assert read_yaml(f"a: {long}\n") == {"a": long}
    assert time.process_time() - begin < 3.0  # 0.3 s; as a number 10 s


def test_like_images_of_a_model_of_colmap_stay_apart(tmp_path: Path) -> None:
    """A folder for each camera: 0001.jpg of the second camera replaced that of the first."""
    export(two_cameras("brown"), "colmap", tmp_path)
    images = tmp_path / "images.txt"
    images.write_text(images.read_text().replace("camera0", "left/1.jpg").replace("camera1", "right/1.jpg"))
    assert [*import_calibration(tmp_path).stations] == ["left/1.jpg", "right/1.jpg"]  # in the order of the file


def test_a_model_of_colmap_is_of_regular_files(tmp_path: Path) -> None:
    """The library itself would wait for ever for the writer of a pipe."""
    os.mkfifo(tmp_path / "cameras.txt")
    with pytest.raises(InputError, match="a pipe or a device"):
        import_calibration(tmp_path, "colmap")
    with pytest.raises(InputError, match="is a folder"):
        import_calibration(Path(__file__), "colmap")
