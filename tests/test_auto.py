"""Detection of a field without an initial camera: strokes, upright direction, symmetry, refusals, and the command."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from photos import auto as auto_script
from photos import disturbed as disturbed
from photos import shots as script
from rendering.photograph import photograph
from rendering.photography import taken_as
from scenery import field_scene, overhead_pose
from thorough import partly

from ceres_cal.base.errors import InputError, NothingShownError
from ceres_cal.base.frozen import replace
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli import main
from ceres_cal.detect.courses import clear_px, predict
from ceres_cal.detect.images import light
from ceres_cal.detect.lines import SPACING_PX, measure
from ceres_cal.detect.photographs import Auto, Facing, detect_field
from ceres_cal.detect.photographs.by_hand import Clicks
from ceres_cal.detect.photographs.candidates import candidates, off_centre, prepare_search
from ceres_cal.detect.photographs.follow import Tracker
from ceres_cal.detect.photographs.grid import agreeing_with_facing, grid_of, nearest_to_before, side_of
from ceres_cal.detect.photographs.judgement import objection
from ceres_cal.detect.photographs.painted import likelihoods_of_places
from ceres_cal.detect.photographs.refit import FreeIntrinsics
from ceres_cal.detect.photographs.search import search
from ceres_cal.detect.photographs.upright import find_upright
from ceres_cal.detect.strokes import Strokes, alone, find_strokes
from ceres_cal.observations import Observations
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.symmetry import turns_of
from ceres_cal.scene.targets import Arc, Segment, Target, custom, ssl_field
from ceres_cal.simulate import Scene, Station

FIELD = ssl_field("B")
NAMES = FIELD.curve_names
TOP = Auto((Facing("LeftGoalLine", "top"),))


@pytest.fixture(scope="module")
def shot() -> script.Shot:
    """A photograph in bad light: dark, blurred, worn, with a shadow."""
    return script.take(1)


@pytest.fixture(scope="module")
def path(shot: script.Shot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("auto") / "shot.png"
    cv2.imwrite(str(path), shot.picture.image)
    return path


def lopsided() -> Target:
    """A field with a goal area only at the left, and a diagonal: it has no symmetry."""
    ends = {
        "top": (-2.0, 1.5, 2.0, 1.5),
        "bottom": (-2.0, -1.5, 2.0, -1.5),
        "left": (-2.0, -1.5, -2.0, 1.5),
        "right": (2.0, -1.5, 2.0, 1.5),
        "area": (-1.3, -1.5, -1.3, 1.5),
        "diagonal": (-1.3, -1.5, 0.5, 1.5),
    }
    curves = {name: Segment((a, b, 0.0), (c, d, 0.0), 0.02) for name, (a, b, c, d) in ends.items()}
    return custom({"corner": (-2.0, -1.5, 0.0)}, curves)


def small_scene() -> Scene:
    """A small photograph of it."""
    optics = Camera((640, 480), 420.0, (320.0, 240.0), Radial((0.0, 8e-7), (2, 3)))
    stations = {"overhead": Station("overhead", overhead_pose(0.1, -0.1, 3.2, 6.0, -4.0, 200.0))}
    return field_scene(lopsided(), {"overhead": optics}, stations)


# ---- the parts ------------------------------------------------------------------------------------------------------


def test_strokes_lie_on_paint(shot: script.Shot) -> None:
    strokes = find_strokes(shot.grey)
    middles = strokes.ends.mean(axis=1)
    away = [script.distances_px(shot, np.full(len(middles), n, np.int32), middles) for n in range(len(NAMES))]
    assert len(strokes) > 100  # 139
    assert np.mean(np.min(np.abs(away), axis=0) < 1.0) > 0.97  # all of them
    assert np.min(strokes.length_px) >= 9.0 and np.max(strokes.length_px) < 40.0  # a tile's diagonal
    assert len(find_strokes(np.full((480, 640), 90.0, np.float32))) == 0


def test_strokes_tell_how_the_camera_looks(shot: script.Shot) -> None:
    seen = prepare_search(shot.grey, FIELD, NAMES, Auto())
    upright = find_upright(seen.stroke_map.ends, seen.stroke_map.strokes.length_px, 3)[0]
    rotation = shot.camera.cam_from_world.rotation
    assert upright.rotation[:, 2] @ rotation[:, 2] > np.cos(np.deg2rad(1.5))  # 0.4 degrees
    assert np.max(np.abs(upright.rotation[:, :2].T @ rotation[:, 0])) > 0.999
    corner = shot.camera.corner_radius
    stretch = float(np.asarray(shot.camera.lens.ideal_radius(corner))) / corner  # type: ignore[attr-defined]
    assert 1.0 / (1.0 + upright.bend) == pytest.approx(stretch, rel=0.15)
    best, _ = candidates(seen)[0]
    assert any(
        np.linalg.norm((best.cam_from_world @ turn).position - shot.camera.position) < 0.4 for turn in seen.grid.turns
    )


def test_turns_of_a_target() -> None:
    assert len(turns_of(FIELD, NAMES)) == 2
    assert np.allclose(turns_of(FIELD, NAMES)[1].transform([1.0, 2.0, 0.0]), [-1.0, -2.0, 0.0])
    assert len(turns_of(FIELD, [name for name in NAMES if name != "LeftPenaltyStretch"])) == 1
    assert len(turns_of(lopsided(), lopsided().curve_names)) == 1
    corners = [(1.0, 0.0), (3.0, 0.0), (3.0, 2.0), (1.0, 2.0)]
    sides = {
        str(i): Segment((*corners[i], 0.0), (*corners[(i + 1) % 4], 0.0), 0.01) for i in range(4)
    }  # whose middle is not the origin
    turns = turns_of(custom({}, sides), tuple(sides))
    assert len(turns) == 4 and np.allclose(turns[1].transform([3.0, 1.0, 0.0]), [2.0, 2.0, 0.0])


def test_what_lies_towards_which_side() -> None:
    optics = Camera((1280, 960), 800.0, (640.0, 480.0), Radial((0.0, 0.0), (2, 3)))
    camera = optics.at(overhead_pose(-2.0, 0.3, 4.0, 5.0, 3.0, 90.0))
    ways = [camera.at(camera.cam_from_world @ turn) for turn in turns_of(FIELD, NAMES)]
    assert [side_of("LeftGoalLine", way, FIELD, NAMES) for way in ways] == ["top", "bottom"]
    assert [side_of("TopTouchLine", way, FIELD, NAMES) for way in ways] == ["right", "left"]
    for side, left in (("top", [0]), ("bottom", [1]), ("top-right", [0]), ("left", []), ("right", [])):
        assert agreeing_with_facing(ways, [Facing("LeftGoalLine", side)], FIELD, NAMES) == left, side
    both = [Facing("LeftGoalLine", "top"), Facing("TopTouchLine", "left")]
    assert agreeing_with_facing(ways, both, FIELD, NAMES) == []
    # The facing names a mirrored field: no rotation has the left goal at the top and the top touch line at the left.
    with pytest.raises(InputError, match="choose one of left, right"):
        Facing("LeftGoalLine", "up")


def test_an_old_calibration_settles_unless_it_lies_across() -> None:
    camera = Camera((1280, 960), 800.0, (640.0, 480.0), Radial((0.0, 0.0), (2, 3)), 1.0, overhead_pose(yaw_deg=10.0))
    ways = [camera.at(camera.cam_from_world @ turn) for turn in turns_of(FIELD, NAMES)]
    for yaw, left in ((10.0, [0]), (-50.0, [0]), (170.0, [1]), (-130.0, [1]), (100.0, [0, 1]), (-75.0, [0, 1])):
        before = camera.at(overhead_pose(1.0, 2.0, 3.0, 8.0, 0.0, yaw))
        assert nearest_to_before(ways, before) == left, yaw


def test_targets_without_lines_at_right_angles() -> None:
    circle = custom({}, {"circle": Arc((0.0, 0.0, 0.0), 1.0, width_m=0.01)})
    cross = {name: FIELD.curves[name] for name in ("CenterLine", "HalfwayLine", "CenterCircle")}
    for target in (circle, custom({}, cross)):
        with pytest.raises(InputError, match="two one way and one across at least"):
            grid_of(target, target.curve_names)


# ---- the search -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "view", partly(["quarter", "tilted 20 to 45 degrees", "tilted 50 to 70 degrees"], ["tilted 50 to 70 degrees"])
)
def test_views_of_any_kind(view: str) -> None:
    shot = auto_script.take_view(view, auto_script.VIEWS[view], 1)
    (found,) = auto_script.searched(iter([shot]))
    assert found.what == "right", found


def test_a_camera_within_the_floor_shows_no_field(shot: script.Shot) -> None:
    """Seen along the floor all lines are one, on which paint is found: a picture was "found" from 0.2 mm above it."""
    problem = prepare_search(shot.grey, FIELD, NAMES, TOP)
    found = search(shot.grey, FIELD, NAMES, TOP).followed
    assert found is not None and not objection(problem, found)
    pose = found.camera.cam_from_world
    for height_m, is_above in ((0.05, False), (1.0, True)):
        away = -pose.rotation @ (*found.camera.position[:2], height_m)
        there = found.camera.at(replace(pose, translation=away))
        against = objection(problem, replace(found, camera=there))
        assert against.startswith("its lines were not found in any view from above") != is_above


def test_without_a_word_on_which_way_round(shot: script.Shot) -> None:
    with pytest.raises(
        InputError,
        match=r"2 orientations look the same: LeftGoalLine lies towards the (top|bottom) or the (top|bottom) of",
    ):
        search(shot.grey, FIELD, NAMES, Auto())
    with pytest.raises(InputError, match="there is no line or point 'Nowhere'"):
        search(shot.grey, FIELD, NAMES, Auto((Facing("Nowhere", "top"),)))
    with pytest.raises(InputError, match="HalfwayLine lies in the middle of the field"):
        search(shot.grey, FIELD, NAMES, Auto((Facing("HalfwayLine", "top"),)))


def test_a_quarter_turn_that_looks_alike_too() -> None:
    optics = Camera((640, 480), 350.0, (320.0, 240.0), Radial((0.0, 0.0), (2, 3)))
    pose = overhead_pose(-0.1, 0.3, 1.6, 15.0, 4.0, 80.0)  # sees circle and cross only
    stations = {"overhead": Station("overhead", pose)}
    scene = taken_as(field_scene(FIELD, {"overhead": optics}, stations), script.varied(0))
    picture = photograph(scene, "overhead", "0001", seed=3)
    near = script.Shot(scene, scene.camera_at("overhead"), FIELD, picture, True)
    with pytest.raises(
        InputError, match="4 orientations look the same"
    ):  # only two of them by what the strokes tell alone
        search(near.grey, FIELD, NAMES, Auto())


@pytest.mark.parametrize("mirrored", partly([False, True], [False]))
def test_a_field_that_looks_alike_in_no_turn(mirrored: bool) -> None:
    target, scene = lopsided(), small_scene()
    image = photograph(scene, "overhead", "0001", seed=1).image
    grey = cv2.cvtColor(image[:, ::-1].copy() if mirrored else image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    found = search(grey, target, target.curve_names, Auto())
    if mirrored:  # a camera that looks down does not see it mirrored
        assert found.followed is None and found.reason
    else:
        assert found.followed is not None and (found.ways, found.chosen_by) == (1, "")
        truth = scene.camera_at("overhead")
        corner = [target.points["corner"]]
        assert np.allclose(found.followed.camera.project(corner), truth.project(corner), atol=0.5)


@pytest.mark.parametrize("looks", [0, 5])
def test_a_search_ends_and_says_so(shot: script.Shot, looks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The search ends after so many reads of the clock; lines of another field once took 200 s."""
    clock = iter([0.0, *[1.0] * looks])
    monkeypatch.setattr("ceres_cal.detect.photographs.candidates.thread_time", lambda: next(clock, 1000.0))
    result = search(light(shot.picture.image), FIELD, NAMES, TOP)
    assert result.followed is None
    assert result.reason.startswith("the field was not found within 60 s of processor time: check the target's")


@pytest.mark.parametrize("by_clicks", partly([False, True], [False]))
@pytest.mark.parametrize("painted", partly(["A", "B"], ["B"]))
def test_the_other_division_is_named(painted: str, by_clicks: bool, tmp_path: Path) -> None:
    """If the other division is painted, the message names it, with and without clicks."""
    asked = ssl_field("B" if painted == "A" else "A")
    shot = disturbed.taken("plain", 4, ssl_field(painted))
    path = tmp_path / "field.png"
    cv2.imwrite(str(path), shot.image)
    points = ssl_field(painted).points
    names = ("TopLeftCorner", "TopRightCorner", "BottomLeftCorner", "BottomRightCorner")
    x, y = shot.camera.project(np.array([points[name] for name in names])).T.tolist()
    clicks = Clicks(dict(zip(names, zip(x, y, strict=True), strict=True)))
    with pytest.raises(NothingShownError, match=f"it shows ssl-{painted.lower()}: give that as the target"):
        detect_field([path], asked, clicks if by_clicks else Auto())


@pytest.mark.parametrize("kind", ["flat", "noise", "board"])
def test_pictures_without_a_field_are_misses(kind: str) -> None:
    rng = np.random.default_rng(2)
    image = {
        "flat": np.full((240, 320), 90),
        "noise": rng.integers(0, 255, (240, 320)),
        "board": np.kron(np.indices((12, 16)).sum(axis=0) % 2 * 200 + 20, np.ones((20, 20))),
    }[kind]
    found = search(image.astype(np.float32), FIELD, NAMES, TOP)
    assert found.followed is None and found.reason


@pytest.mark.thorough
def test_the_real_photograph_without_its_clicks(real_data: Path) -> None:
    """Its lines deviate by pixels, which must not bend the lens."""
    path, target = real_data / "ssl_tigers_line_corners" / "camera_frame_1224x1024_crop.png", script.real_target()
    painted = [name for name in target.curve_names if name not in script.NOT_PAINTED]
    found = detect_field([path], target, Auto((Facing("LeftGoalLine", "left"),)), painted)
    corner = found.found[str(path)].camera.project([target.points["BottomLeftCorner"]])[0]
    assert np.linalg.norm(corner - (55.0, 984.0)) < 15.0  # 3.8 px from its published click
    calibration = calibrate(found.observations)
    assert calibration.lens_choice is not None and not calibration.lens_choice.chosen.startswith("spline")
    phi = calibration.uncertainty.verdict("camera", next(iter(calibration.cameras)), "phi")
    # 722 +- 61, and 726 to 731 with centre and decentring held: what such lines tell of phi.
    assert abs(calibration.station().phi - 728.0) < 2.0 * phi.sd < 150.0


# ---- the whole way --------------------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_from_photographs_alone_to_a_calibration(
    tmp_path: Path, shot: script.Shot, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    again, out, calibration = (str(tmp_path / name) for name in ("again.png", "obs.json", "calibration.json"))
    cv2.imwrite(again, photograph(shot.scene, "overhead", "0001", seed=77).image)
    detect = ["detect", "field", str(path), "-o", out, "--auto"]
    assert main([*detect, again, "--target", "ssl-b", "--facing", "LeftGoalLine=top", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["found"]
    # The second starts from the first.
    assert [one.get("searched") for one in found] == [{"ways": 2, "settled_by": "facing"}, None]
    assert main(["calibrate", out, "-o", calibration, "--lens", shot.camera.lens.kind, "--quiet"]) == 0
    capsys.readouterr()
    assert np.mean(script.floor_error_mm(shot, Calibration.load(calibration).station())) < 1.0  # 0.2 mm
    assert main([*detect, "--start", calibration]) == 0
    assert "in one of 2 possible orientations, chosen by the earlier calibration" in capsys.readouterr().out
    assert len(Observations.load(out).curves) > 250  # 292
    corners = tmp_path / "corners.json"
    corners.write_text(json.dumps({"format": "ceres-cal/corners", "version": 1, "points": {}}))
    for arguments, message in (
        (("--facing", "LeftGoalLine=up"), "no side 'up': choose one of left, right, top"),
        (("--facing", "LeftGoalLine"), "write NAME=SIDE"),
        (("--corner", "TopLeftCorner=1,2"), "give one of them"),
        (("--start", str(corners)), "--auto takes a calibration as start"),
        (("--facing", "Nowhere=left"), "facing: there is no line or point 'Nowhere'"),
    ):
        assert main([*detect, "--target", "ssl-b", *arguments]) == 2
        assert message in capsys.readouterr().err
    without = [argument for argument in detect if argument != "--auto"]
    assert main([*without, "--start", calibration, "--facing", "LeftGoalLine=top"]) == 2
    assert "--facing needs --auto" in capsys.readouterr().err
    assert main([*without, "--target", "ssl-b"]) == 2
    assert "or --auto" in capsys.readouterr().err


@pytest.mark.parametrize(
    "kind, seed",
    [
        pytest.param("boundary", 100, marks=pytest.mark.thorough),  # twice as bright as the touch line, 7 px beside it
        ("another sport", 0),  # 46 % of the strokes are lines of the field
        ("an old field", 4),
    ],
)
def test_what_disturbs_does_not_hide_the_field(kind: str, seed: int) -> None:
    shot = disturbed.taken(kind, seed, FIELD)
    found = search(light(shot.image), FIELD, NAMES, disturbed.AUTO).followed
    assert found is not None
    pixels = found.lines.pixels[found.lines.found]
    away = np.linalg.norm(found.camera.locate(pixels) - shot.camera.locate(pixels), axis=1)
    assert np.median(away) < 0.01  # 0.002 m at most


def test_a_field_under_boxes_is_followed() -> None:
    """They hide some lines completely and leave others, as if the field were elsewhere."""
    shot = disturbed.taken("covered", 5, FIELD)
    floor = FIELD.point_array
    away = [
        np.median(
            np.linalg.norm(camera.at(camera.cam_from_world @ turn).project(floor) - shot.camera.project(floor), axis=1)
        )
        for camera, grid in candidates(prepare_search(light(shot.image), FIELD, NAMES, disturbed.AUTO))
        for turn in grid.turns
    ]
    assert min(away) < 5.0  # 1.5 px


def test_lines_that_motion_makes_faint_are_seen() -> None:
    """Lines across the motion are a sixth as bright as those along it."""
    shot = disturbed.taken("motion", 105, FIELD)
    aside = shot.camera.at(shot.camera.cam_from_world @ Pose(np.eye(3), np.array([0.9, 0.3, 0.0])))
    seen, beside = likelihoods_of_places(light(shot.image), [(FIELD, shot.camera), (FIELD, aside)], NAMES)
    assert seen > 400.0 > 200.0 > beside  # 559 and less than 100
    course = predict(FIELD, shot.camera, NAMES, SPACING_PX, SPACING_PX)
    clear = clear_px(FIELD, shot.camera, course, NAMES)
    assert np.mean(measure(light(shot.image), course, 5.0, clear).found) > 0.95  # 0.99


def test_corners_are_not_extrapolated_along_a_lens_that_folds() -> None:
    """Brown's lens fits these blurred lines best, but folds 13 px beyond a corner near which nothing was measured."""
    shot = disturbed.taken("motion", 307, FIELD)
    seen = Tracker(light(shot.image), FIELD, NAMES, FreeIntrinsics()).refined_from(shot.camera).camera
    assert not seen.folds and seen.skew == 0.0
    corner = FIELD.points["TopRightCorner"]
    assert np.max(np.abs(seen.project([corner]) - shot.camera.project([corner]))) < 0.3  # 0.15 px; 0.6 with Brown's


def test_lines_are_measured_again_only_where_a_camera_has_them_elsewhere(shot: script.Shot) -> None:
    tracker = Tracker(light(shot.picture.image), FIELD, NAMES, FreeIntrinsics())
    lines = tracker.measured(shot.camera)
    near, elsewhere = (replace(shot.camera, phi=times * shot.camera.phi) for times in (1.0 + 1e-5, 1.001))
    assert tracker.measured(near) is lines
    assert tracker.measured(elsewhere) is not lines


def test_strokes_of_striped_floors_are_not_alone() -> None:
    """Six stripes 20 px apart, and a distant line across."""
    y = 20.0 * np.arange(6)
    ends = np.stack([np.column_stack([np.zeros(6), y]), np.column_stack([np.full(6, 24.0), y])], axis=1)
    strokes = Strokes(np.concatenate([ends, [[[300.0, 0.0], [300.0, 24.0]]]]), np.ones(7))
    assert np.allclose(alone(strokes, 45.0), 1.0 / (1.0 + np.array([2, 3, 4, 4, 3, 2, 0]) ** 2))


def test_the_middle_of_the_lens_is_told_by_its_strokes() -> None:
    """In a part of a sensor, strokes are straighter about its own quarter than about the picture's centre."""
    problem = prepare_search(light(disturbed.taken("cropped", 14, FIELD).image), FIELD, FIELD.curve_names, Auto())
    centre = off_centre(problem).stroke_map.centre
    assert np.allclose(centre, (0.28 * 780.0, 0.72 * 580.0))
