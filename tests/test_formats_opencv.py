"""OpenCV's files and numbers, read and used by OpenCV itself."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from foreign_cases import LENSES, over_field, places, same_camera, two_cameras, with_lens

from ceres_cal import Camera, InputError
from ceres_cal.base.arrays import Array
from ceres_cal.formats import export, import_calibration
from ceres_cal.scene.foreign import ForeignCamera
from ceres_cal.scene.lens import Brown, make_lens

ENDINGS = (".yml", ".xml", ".json")
EXACT = ("brown", "kannala-brandt", "brown-rational", "brown-all")


def projected(path: Path, points: Array, number: str = "") -> Array:
    """Projection by OpenCV with the file as OpenCV reads it."""
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    matrix = storage.getNode(f"M{number}" if number else "camera_matrix").mat()
    distortion = storage.getNode(f"D{number}" if number else "distortion_coefficients").mat()
    pose = storage.getNode(f"extrinsic_parameters{number}").mat()[0]
    project = cv2.fisheye.projectPoints if storage.getNode("distortion_model").string() == "fisheye" else None
    if project is not None:
        return np.asarray(project(points[:, None], pose[:3], pose[3:], matrix, distortion)[0][:, 0])
    return np.asarray(cv2.projectPoints(points, pose[:3], pose[3:], matrix, distortion)[0][:, 0])


@pytest.mark.parametrize(
    "lens, ending",
    [(lens, ".yml") for lens in LENSES if lens not in EXACT] + [(lens, one) for lens in EXACT for one in ENDINGS],
)
def test_opencv_projects_as_we_do_or_as_badly_as_stated(lens: str, ending: str, tmp_path: Path) -> None:
    camera = with_lens(lens, aspect=1.003)
    (loss,) = export(over_field(camera), "opencv", tmp_path / f"a{ending}").losses
    points, pixels = places(camera, 4000)
    off = np.linalg.norm(projected(tmp_path / f"a{ending}", points) - pixels, axis=1)
    assert loss.image_px is not None
    if lens in EXACT:
        assert off.max() < 1e-9 and loss.image_px == (0.0, 0.0)  # measured 5e-12
        return
    rms = float(np.sqrt(np.mean(off**2)))
    assert off.max() <= 1.1 * loss.image_px[1] and loss.image_px[0] < 0.01  # measured 0.007 at most
    assert rms == pytest.approx(loss.image_px[0], rel=0.1, abs=3e-4)  # the grid has the very edges, too


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("lens", EXACT)
def test_stereo_has_the_names_and_directions_of_the_sample(lens: str, ending: str, tmp_path: Path) -> None:
    both = two_cameras(lens)
    path = tmp_path / f"stereo{ending}"
    export(both, "opencv", path)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    first, second = (both.station(f"camera{n}") for n in (0, 1))
    turn, shift = storage.getNode("R").mat(), storage.getNode("T").mat()
    points, pixels = places(first)
    assert np.abs(projected(path, points, "1") - pixels).max() < 1e-9
    at_second = first.cam_from_world.transform(points) @ turn.T + shift.ravel()
    assert np.abs(at_second - second.cam_from_world.transform(points)).max() < 1e-12
    assert storage.getNode("P2").mat().shape == (3, 4) and storage.getNode("Q").mat().shape == (4, 4)
    back = import_calibration(path)
    assert all(same_camera(back.station(name), both.station(name)) for name in both.stations)


def test_a_stereo_file_of_opencv_alone_stands_at_its_first_camera(tmp_path: Path) -> None:
    path = tmp_path / "intrinsics.yml"
    export(two_cameras("brown"), "opencv", path)
    lines = path.read_text().split("extrinsic_parameters1")
    rest = lines[1].split("M2:")[1].split("extrinsic_parameters2")
    path.write_text(lines[0] + "M2:" + rest[0] + "R:" + rest[1].split("\nR:")[1])
    back = import_calibration(path)
    assert np.array_equal(back.station("camera0").cam_from_world.matrix, np.eye(3, 4))
    one, other = (two_cameras("brown").station(f"camera{n}").position for n in (0, 1))
    assert np.linalg.norm(back.station("camera1").position) == pytest.approx(np.linalg.norm(one - other))


def test_what_opencvs_inverse_misses_is_said(tmp_path: Path) -> None:
    camera = with_lens("brown")
    (warning,) = export(over_field(camera), "opencv", tmp_path / "a.yml").warnings
    assert "cv2.undistortPoints stops after five rounds, here up to" in warning and "call it with criteria=" in warning
    matrix, distortion, _, _ = camera.to_opencv()
    pixels = places(camera)[1]
    end = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)
    straight = cv2.undistortPoints(pixels[:, None], matrix, distortion, criteria=end)[:, 0]
    rays = camera.rays(pixels)
    assert np.abs(straight - rays[:, :2] / rays[:, 2:]).max() < 1e-7
    mild = with_lens(Brown((-0.02, 0.0, 0.0, 0.0, 0.0)))
    assert export(over_field(mild), "opencv", tmp_path / "b.yml").warnings == ()


def test_a_radial_lens_comes_back_as_a_rational_one(tmp_path: Path) -> None:
    camera = with_lens("radial-2-3")
    (loss,) = export(over_field(camera), "opencv", tmp_path / "a.yml").losses
    back = import_calibration(tmp_path / "a.yml")
    assert back.warnings == () and back.station().lens.terms == back.options.terms == ("rational",)
    points, pixels = places(camera)
    assert loss.image_px is not None
    assert np.abs(back.station().project(points) - pixels).max() < 1.1 * loss.image_px[1]  # measured 0.02


def test_skew_is_lost_in_opencv_and_said(tmp_path: Path) -> None:
    """`cv2.projectPoints` ignores K's second number."""
    camera = replace(with_lens("brown"), skew=2e-3)
    (loss,) = export(over_field(camera), "opencv", tmp_path / "a.yml").losses
    assert loss.image_px is not None and loss.image_px[1] > 0.1
    points, pixels = places(camera)
    off = np.linalg.norm(projected(tmp_path / "a.yml", points) - pixels, axis=1)
    assert off.max() <= 1.1 * loss.image_px[1]


# ---- numbers --------------------------------------------------------------------------------------------------------


def test_to_and_from_opencv() -> None:
    camera = with_lens("brown", aspect=0.99)
    matrix, distortion, rvec, tvec = camera.to_opencv()
    points, pixels = places(camera)
    assert np.abs(cv2.projectPoints(points, rvec, tvec, matrix, distortion)[0][:, 0] - pixels).max() < 1e-9
    assert same_camera(Camera.from_opencv(camera.image_size, matrix, distortion, rvec, tvec), camera)
    wide = with_lens("kannala-brandt")
    there = wide.to_opencv()
    assert there.fisheye and there.error_px == (0.0, 0.0)
    assert same_camera(Camera.from_opencv(wide.image_size, *there, fisheye=True), wide)
    assert with_lens("radial-2-3").to_opencv().error_px[0] == pytest.approx(0.0024, rel=0.1)
    everything = with_lens("brown-all")
    assert len(everything.to_opencv().distortion) == 12
    assert same_camera(Camera.from_opencv(camera.image_size, *everything.to_opencv()), everything)


def test_what_sees_across_is_a_fisheye() -> None:
    """Up to 106 degrees from the axis, with a lens that OpenCV does not have."""
    lens = make_lens("spline", coefficients={"rim": 800.0, "g11": 2.0, "p1": 1.0})
    camera = Camera((1280, 960), 300.0, (640.0, 480.0), lens)
    found = camera.to_opencv()
    assert found.fisheye and found.error_px[1] < 5.0  # 2.9 px
    assert not replace(camera, phi=900.0).to_opencv().fisheye


def test_a_decentred_fisheye_is_what_comes_nearer() -> None:
    """OpenCV's fisheye has no decentring: up to 60 degrees its rational model, which has it, fits better."""
    lens = make_lens("kannala-brandt", coefficients={"k1": 0.05, "k2": 0.01, "p1": 4e-3, "p2": -3e-3})
    camera = Camera((1280, 960), 800.0, (640.0, 480.0), lens)
    found = camera.to_opencv()
    assert not found.fisheye and found.error_px[0] < ForeignCamera.of(camera, "fisheye").error_px[0]


@pytest.mark.parametrize("count", [12, 14])
def test_thin_prisms_are_opencvs(count: int) -> None:
    k = np.array([-0.2, 0.05, 1e-3, -5e-4, 0.01, 0.02, 0.01, 0.0, 1e-3, 2e-4, -1e-3, 3e-4, 0.0, 0.0])[:count]
    matrix = np.array([[800.0, 0.0, 640.0], [0.0, 790.0, 470.0], [0.0, 0.0, 1.0]])
    rays = np.random.default_rng(1).uniform((-0.6, -0.5, 1.0), (0.6, 0.5, 1.0), (1000, 3))
    ours = ForeignCamera.opencv((1280, 960), matrix, k).project_rays(rays)
    theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), matrix, k)[0][:, 0]
    assert np.abs(ours - theirs).max() < 1e-9
    camera, error_px = ForeignCamera.opencv((1280, 960), matrix, k).camera()
    assert np.abs(camera.project(rays) - theirs).max() < 1e-9 and error_px == (0.0, 0.0)


@pytest.mark.parametrize("lens", ["brown", "radial-2-3", "kannala-brandt"])
def test_maps_for_remap(lens: str) -> None:
    camera = with_lens(lens)
    map_x, map_y = camera.undistort_maps()
    assert map_x.shape == (960, 1280) and map_x.dtype == np.float32
    if lens == "brown":
        by_opencv = cv2.initUndistortRectifyMap(
            camera.matrix, np.array(camera.lens.values), np.eye(3), camera.matrix, (1280, 960), cv2.CV_32FC1
        )
        assert max(np.nanmax(np.abs(map_x - by_opencv[0])), np.nanmax(np.abs(map_y - by_opencv[1]))) < 1e-3
    row, column = 300, 900
    ray = np.linalg.solve(camera.matrix, (column, row, 1.0))
    seen = camera.project(camera.position + ray @ camera.cam_from_world.rotation)
    assert np.abs(seen - (map_x[row, column], map_y[row, column])).max() < 1e-3
    straight = cv2.remap(np.full((960, 1280), 7, np.uint8), map_x, map_y, cv2.INTER_LINEAR)
    assert straight[row, column] == 7


def test_a_fisheye_is_known_by_either_word_and_four_coefficients_without_one_are_asked_about(tmp_path: Path) -> None:
    """OpenCV's tutorial writes `fisheye_model`; a script that saves K and D writes neither."""
    path, camera = tmp_path / "a.yml", over_field(with_lens("kannala-brandt"))
    export(camera, "opencv", path)
    told = path.read_text()
    path.write_text(told.replace("distortion_model: fisheye", "fisheye_model: 1"))
    assert same_camera(import_calibration(path).station(), camera.station())
    path.write_text(told.replace("distortion_model: fisheye", ""))
    assert "if they are of cv2.fisheye, add `distortion_model: fisheye`" in import_calibration(path).warnings[0]


# ---- what is at fault -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("camera_matrix", "kamera", "it has no camera matrix"),
        ("image_width: 1280", "width: 1280", "the image size is not there: give image_size"),
        ("distortion_coefficients", "d", "it has no matrix 'distortion_coefficients'"),
        ("rows: 3", "rows: 1", "camera_matrix must be a matrix: its rows and cols"),
        ("cols: 5", "cols: 3", "distortion_coefficients must be a matrix"),
        ("%YAML", "{YAML", "not a FileStorage of OpenCV|no camera matrix"),
    ],
)
def test_broken_files_are_one_line(old: str, new: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "a.yml"
    export(over_field(with_lens("brown")), "opencv", path)
    path.write_text(path.read_text().replace(old, new, 1))
    with pytest.raises(InputError, match=words) as caught:
        import_calibration(path, "opencv")
    assert str(caught.value).startswith(str(path)) and len(str(caught.value).splitlines()) == 1


def test_too_many_stations_are_refused(tmp_path: Path) -> None:
    mixed = two_cameras("brown")
    with pytest.raises(InputError, match="there is no station 'x'"):
        export(mixed, "opencv", tmp_path / "a.yml", ["x"])
    with pytest.raises(InputError, match=r"off by .* mm on the field, more than 0.001"):
        export(over_field(with_lens("radial-2-3")), "opencv", tmp_path / "a.yml", max_loss_mm=1e-3)
    assert not (tmp_path / "a.yml").exists()


def test_elements_within_elements_by_the_thousand_are_refused(tmp_path: Path) -> None:
    """OpenCV reads them by recursion, and the process crashed."""
    text = '<?xml version="1.0"?>\n<opencv_storage>\n' + "<extrinsic_parameters>\n" * 40_000
    (tmp_path / "deep.xml").write_text(text)
    with pytest.raises(InputError, match="more than 32 elements within each other"):
        import_calibration(tmp_path / "deep.xml", "opencv")
