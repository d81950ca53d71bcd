"""Rendered photographs: lines, corners and rings agree with the model, and their truth is correct."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from data.built_in_scenes import scene_to_json
from rendering.album import take_album
from rendering.photograph import frames, photograph
from rendering.photography import Photography, photography_of, taken_as
from rendering.render import SUBPIXELS, averaged, blank_canvas, fill, paint_curves, print_sheet
from rendering.simulate_photographs import main as simulate_photographs
from rendering.things import BALL_RADIUS_M, Ball, Robot, outline
from scenery import BoardRanges, board_scene, field_scene, overhead_pose
from scenes import LENSES, camera, lines
from thorough import partly

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import Pose
from ceres_cal.base.words import ROBOT_TOP_M
from ceres_cal.detect.images import read_grey
from ceres_cal.detect.saddles import measure_saddles
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import curve_points
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Segment, checkerboard, custom, rings, ssl_field
from ceres_cal.simulate import Scene, Station, built_in_scene, scene_from_json, simulate

PLAIN = Photography(
    blur_px=0.0, vignetting=0.0, unevenness=0.0, carpet_texture=0.0, read_noise=0.0, shot_noise=0.0, carpet=0.2
)


def column_middles(paint: Array, near: Array) -> Array:
    """For each pixel (N, 2) on a nearly horizontal line: distance of the paint's middle below it in its column."""
    columns, rows = np.round(near).astype(int).T
    window = rows[:, None] + np.arange(-9, 10)
    share = paint[window, columns[:, None]]
    return np.asarray(np.sum(share * window, axis=1) / np.sum(share, axis=1))


@pytest.mark.parametrize("lens", partly(LENSES, LENSES[::2]))
def test_painted_lines_lie_where_the_model_says(lens: str) -> None:
    scene = lines(lens)
    posed, field = scene.camera_at("overhead"), scene.targets["field"]
    found = []
    for name in ("TopTouchLine", "BottomTouchLine", "CenterLine"):
        curve = field.curves[name]
        canvas = blank_canvas(posed.image_size)
        paint_curves(canvas, custom(curves={name: curve}), posed)
        there = posed.project(curve_points(curve, 0, 20_000))
        slope = np.gradient(there[:, 1]) / np.gradient(there[:, 0])
        inside = np.all((there > 10.0) & (there < np.array(posed.image_size) - 11.0), axis=1)
        inside &= np.minimum(np.abs(there - there[0]), np.abs(there - there[-1])).max(axis=1) > 20.0
        rows = np.flatnonzero(inside & (np.abs(slope) < 1.0))
        level = there[rows, 1] + (np.round(there[rows, 0]) - there[rows, 0]) * slope[rows]
        cv2.GaussianBlur(canvas, (0, 0), 0.7 * SUBPIXELS, canvas)  # otherwise the column's own squares are visible
        found.append(column_middles(averaged(canvas).astype(float), there[rows]) - level)
    error = np.concatenate(found)
    assert len(error) > 3000
    assert abs(np.mean(error)) < 5e-4  # 1e-4 px and less
    assert np.sqrt(np.mean(error**2)) < 5e-3  # 0.002 px and less


def test_rings_have_the_size_that_the_model_says() -> None:
    sheet = rings([0.05, 0.1, 0.15])
    posed = camera("radial-2-3").at(Pose.exp((0.1, -0.05, 0.2, 0.01, 0.02, 0.4)))
    canvas = blank_canvas(posed.image_size)
    print_sheet(canvas, sheet, posed)
    printed = (0.9 - averaged(canvas).astype(float)) / (0.9 - 0.06)
    areas = []
    for curve in sheet.curves.values():
        x, y = posed.project(curve_points(curve, 0, 5000))[:-1].T
        areas.append(0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))
    first, last = np.zeros(printed.shape, np.uint8), np.zeros(printed.shape, np.uint8)
    fill(first, posed.project(1.5 * curve_points(sheet.curves["ring_1"], 0, 500)))
    fill(last, posed.project(1.03 * curve_points(sheet.curves["ring_3"], 0, 500)))
    disc, whole = np.sum(printed[first > 0]), np.sum(printed[last > 0])
    assert np.sqrt(disc / np.pi) == pytest.approx(np.sqrt(areas[0] / np.pi), abs=1e-3)  # 1e-4 px
    assert whole == pytest.approx(areas[0] + areas[2] - areas[1], rel=2e-5)


@pytest.mark.thorough
def test_board_corners_lie_where_the_model_says() -> None:
    board = checkerboard(9, 6, 0.05)
    stations = {"camera": Station("camera", Pose.identity())}
    scene = board_scene(board, {"camera": camera("radial-2-3")}, stations, 3, seed=4, held=BoardRanges((0.6, 1.0)))
    errors = []
    for plan in scene.views:
        image = cv2.cvtColor(
            photograph(scene, "camera", plan.frames[0], replace(PLAIN, blur_px=0.7)).image, cv2.COLOR_BGR2GRAY
        )
        truth = scene.camera_at("camera").project(scene.placements[str(plan.placement)].transform(board.point_array))
        found = measure_saddles(image, truth.reshape(6, 9, 2)).grid
        errors.append((found - truth.reshape(6, 9, 2)).reshape(-1, 2))
    error = np.concatenate(errors)
    assert np.abs(np.mean(error, axis=0)).max() < 0.005  # 0.0012 px
    assert np.sqrt(np.mean(error**2)) < 0.01  # 0.006 px: 8 bits, and a saddle's window in a bent image


LARGE, SMALL = camera("radial-2-3"), Camera((320, 240), 217.0, (162.6, 117.0), Radial((-2.1e-4, 9.8e-6)))


def tilted_field(how: Photography, optics: Camera = LARGE) -> Scene:
    pose = overhead_pose(-1.0, 0.2, 4.5, tilt_x_deg=9.0, tilt_y_deg=-6.0, yaw_deg=12.0)
    stations = {"overhead": Station("overhead", pose)}
    return taken_as(field_scene(ssl_field("B"), {"overhead": optics}, stations, 2, spacing_m=0.02), how)


def test_what_falls_on_the_ground_and_how_the_camera_takes_it() -> None:
    line = {"line": Segment((0.0, -4.0, 0.0), (0.0, 4.0, 0.0), 0.1)}
    optics, pose = Camera((240, 180), 90.0, (119.5, 89.5), Radial((0.0,), (3,))), overhead_pose(0.0, 0.0, 4.0)
    scene = field_scene(custom(curves=line), {"o": optics}, {"o": Station("o", pose)})

    def green(how: Photography) -> Array:
        return photograph(scene, "o", "0001", how, seed=2).image[..., 1].astype(float)

    plain = green(PLAIN)
    carpet, paint = plain[0, 0], plain.max()
    sunny = green(replace(PLAIN, sun=0.5)) / plain
    assert np.mean(np.abs(sunny - 1.5) < 0.02) > 0.2 and np.mean(np.abs(sunny - 1.0) < 0.02) > 0.3
    strips = green(replace(PLAIN, strips=0.3))
    assert strips.max() == paint and np.ptp(strips[strips < 0.7 * paint]) > 0.2 * carpet
    assert len(np.unique(np.round(strips[:, :100]))) < 20  # strips, not a texture
    glare = green(replace(PLAIN, glare=0.4)) - plain
    assert glare.max() > 20.0 and np.median(glare) < 5.0
    moved = green(replace(PLAIN, motion_px=8.0))
    assert np.sum(moved) == pytest.approx(np.sum(plain), rel=2e-3)
    assert np.sum(moved > 1.2 * carpet) > 1.5 * np.sum(plain > 1.2 * carpet)
    mosaic = photograph(scene, "o", "0001", replace(PLAIN, mosaic=True), seed=2).image.astype(float)
    assert np.allclose(mosaic[20, 20], photograph(scene, "o", "0001", PLAIN, seed=2).image[20, 20])
    red = mosaic[..., 2] - carpet
    assert np.max(red) > 0 and not np.allclose(mosaic[..., 2], mosaic[..., 0], atol=20.0)


def test_robots_stand_up_and_hide_lines() -> None:
    scene = tilted_field(replace(PLAIN, robots=25, balls=10))
    shot = photograph(scene, "overhead", "0001")
    posed, field = scene.camera_at("overhead"), scene.targets["field"]
    assert sum(isinstance(thing, Robot) for thing in shot.things) == 25
    assert sum(isinstance(thing, Ball) for thing in shot.things) == 10
    grey = shot.image.astype(float).mean(axis=2)
    hidden = 0
    for name, stretches in shot.hidden["field"].items():
        curve = field.curves[name]
        for first, last in stretches:
            share = (np.linspace(first, last, 9) / curve.length_m)[1:-1]
            places = curve_points(curve, 0, 1000)[np.round(share * 1000).astype(int)]
            pixels = posed.project(places)[[3]]
            hidden += 1
            assert shot.hides(pixels).all() or last - first < 0.03
    assert hidden >= 5
    # Visible parts are as bright as paint in the middle of the line.
    seen = posed.project(curve_points(field.curves["HalfwayLine"], 0, 600))
    seen = seen[np.all((seen > 2.0) & (seen < np.array(posed.image_size) - 3.0), axis=1)]
    around = [seen + step for step in ((0.0, 0.0), (3.0, 0.0), (-3.0, 0.0), (0.0, 3.0), (0.0, -3.0))]
    clear = ~np.any([shot.hides(pixels) for pixels in around], axis=0)
    x, y = np.round(seen[clear]).astype(int).T
    assert np.percentile(grey[y, x], 5) > 90.0  # carpet is at 38, paint at 195 where it fills the pixel


def test_covers_are_seen_at_their_height() -> None:
    posed = camera("radial-3").at(overhead_pose(height_m=4.0))
    robot = outline(Robot(2.0, 0.0, 0.0, 0), posed)
    away = np.hypot(*(robot - posed.principal_point).T)
    assert away.max() == pytest.approx(posed.project([[2.09, 0.0, ROBOT_TOP_M]])[0, 0] - posed.principal_point[0])
    assert away.min() == pytest.approx(posed.project([[1.91, 0.0, 0.0]])[0, 0] - posed.principal_point[0], abs=0.01)
    ball = outline(Ball(0.0, 0.0), posed) - posed.principal_point
    assert np.hypot(*ball.T) == pytest.approx(posed.phi * BALL_RADIUS_M / (4.0 - BALL_RADIUS_M), rel=1e-3)


@pytest.mark.thorough
def test_light_wear_and_noise_are_as_told() -> None:
    scene = tilted_field(PLAIN)
    bright = photograph(scene, "overhead", "0001").image.astype(float)
    dim = photograph(scene, "overhead", "0001", replace(PLAIN, vignetting=0.6)).image.astype(float)
    assert dim[:20, :20].mean() / bright[:20, :20].mean() < 0.5
    assert dim[470, 650, 1] == pytest.approx(bright[470, 650, 1], abs=1.0)
    noisy = photograph(scene, "overhead", "0001", replace(PLAIN, read_noise=3.0, shot_noise=0.1)).image
    level = 230.0 * 0.2 * 1.25
    assert np.std(noisy[400:440, 560:600, 1] - bright[400:440, 560:600, 1]) == pytest.approx(
        np.sqrt(9.0 + 0.1 * level), rel=0.1
    )
    worn = photograph(scene, "overhead", "0001", replace(PLAIN, wear=0.3)).image.astype(float)
    lines = bright[..., 2] > 120.0
    lost = (bright - worn)[..., 2][lines].sum() / (bright[..., 2][lines] - 230.0 * 0.2 * 0.65).sum()
    assert lost == pytest.approx(0.3, abs=0.05)
    shadow = photograph(scene, "overhead", "0001", replace(PLAIN, shadows=2, shadow_depth=0.5))
    middle = scene.camera_at("overhead").project([[shadow.shadows[0].x_m, shadow.shadows[0].y_m, 0.0]])
    x, y = np.clip(np.round(middle[0]).astype(int), 0, (1279, 959))
    assert shadow.image[y, x, 1] < 0.8 * bright[y, x, 1]
    small = photograph(scene, "overhead", "0001", replace(PLAIN, jpeg_quality=30)).image
    assert 0.0 < np.abs(small.astype(float) - bright).mean() < 3.0


def test_same_seed_same_picture() -> None:
    scene = tilted_field(Photography(robots=3), SMALL)
    first, again, other = (photograph(scene, "overhead", "0001", seed=seed).image for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    assert frames(scene) == (("overhead", "0001"), ("overhead", "0002"))
    assert not np.array_equal(first, photograph(scene, "overhead", "0002", seed=1).image)


def test_album_leaves_out_what_is_hidden(tmp_path: Path) -> None:
    simulation = simulate(tilted_field(replace(PLAIN, robots=20, jpeg_quality=80), SMALL), seed=3)
    album = take_album(simulation, "jpg")
    album.write(tmp_path)
    assert 0 < len(album.simulation.observations.curves) < len(simulation.observations.curves)
    assert len(album.simulation.curves.flag) == len(album.simulation.observations.curves)
    truth = json.loads((tmp_path / "truth.json").read_text())["photographs"]
    assert list(truth) == ["photographs/0001.jpg", "photographs/0002.jpg"]
    assert read_grey(tmp_path / "photographs" / "0001.jpg").shape == (240, 320)
    left = album.simulation
    for view, frame in enumerate(("0001", "0002")):
        shot = photograph(left.scene, "overhead", frame, seed=3)
        assert not shot.hides(left.curves.pixels[left.observations.curves.view == view]).any()
        assert truth[f"photographs/{frame}.jpg"]["hidden_m"]["field"].keys() == shot.hidden["field"].keys()
    with pytest.raises(InputError, match="not as 'gif'"):
        take_album(simulation, "gif")


def test_scene_files_carry_photography() -> None:
    scene, disturbance = built_in_scene("photographs")
    assert scene_from_json(scene_to_json(scene, disturbance), "scene")[0].photography == scene.photography
    data = scene_to_json(scene)
    with pytest.raises(InputError, match="photography: 'robotts' is unknown: there are blur_px"):
        photography_of(scene_from_json(data | {"photography": {"robotts": 1}}, "scene")[0])
    with pytest.raises(InputError, match=r"wear is a share and at most 1, not 1\.5"):
        photography_of(scene_from_json(data | {"photography": {"wear": 1.5}}, "scene")[0])


def test_command_writes_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene, disturbance = built_in_scene("photographs")
    data = scene_to_json(scene, disturbance)
    data["cameras"]["overhead"]["image_size"] = [320, 240]
    del data["cameras"]["overhead"]["camera_matrix"]
    data["cameras"]["overhead"] |= {"phi": 217.0, "principal_point": [161.0, 119.0]}
    data["cameras"]["overhead"]["lens"]["coefficients"] = {"a2": -2e-4, "a3": 9.8e-6}
    (tmp_path / "scene.json").write_text(json.dumps(data))
    assert simulate_photographs([str(tmp_path / "scene.json"), "-o", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.endswith("4 photographs\n")
    images = sorted((tmp_path / "out" / "photographs").iterdir())
    assert [path.name for path in images] == ["0001.png", "0002.png", "0003.png", "0004.png"]
    assert read_grey(images[3]).shape == (240, 320)
    assert simulate_photographs(["nothing", "-o", str(tmp_path / "out")]) == 2
    assert "there is no scene 'nothing'" in capsys.readouterr().err
