"""Rigs from `detect board` on: frames of one moment, consistent labels, baseline and angle."""

import json
import shutil
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import scenes
from scenery import BoardRanges, board_scene, field_scene, overhead_pose
from test_cli import Say, refused, say

from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.lens_seen import profiles_of, seen_through
from ceres_cal.calibration.renaming import relabelled
from ceres_cal.detect.images import read_grey
from ceres_cal.observations import Observations, Prior, View, combine
from ceres_cal.observations.same_frame import with_same_frames
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.parameters import Estimate, Options, Station
from ceres_cal.problem.structure import EXACT
from ceres_cal.robust.robust import solve_robustly
from ceres_cal.scene.symmetry import TURNED
from ceres_cal.scene.targets import Target, checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, simulate
from ceres_cal.start.same_labels import with_same_labels
from ceres_cal.start.same_moments import shown_otherwise

__all__ = ["say"]
_BROWN = Options(usual_camera=False, lens="brown")
_LEFT = scenes.camera("brown")
_BASELINE_M, _ANGLE_RAD = 0.3, 0.12
_STATIONS = {
    "left": Station("left", Pose.identity()),
    "right": Station("right", Pose.looking([_BASELINE_M, 0.0, 0.0], rotation_exp([0.0, _ANGLE_RAD, 0.0]))),
}


def _rig(board: Target, count: int = 11, seed: int = 3) -> Observations:
    cameras = {"left": _LEFT, "right": replace(_LEFT, phi=873.4)}
    scene = board_scene(board, cameras, _STATIONS, count, seed, BoardRanges((1.2, 2.2)))
    return simulate(scene, Disturbance(points_sigma_px=0.1), seed=seed).observations


def _turned(observations: Observations, station: str, frames: tuple[str, ...]) -> Observations:
    """The points of a board in some frames of one station with labels rotated by 180 degrees: the last first."""
    points = observations.points
    last = len(observations.targets["board"].points) - 1
    own = np.array([view.station == station and view.frame in frames for view in observations.views])
    feature = np.where(own[points.view], last - points.feature, points.feature).astype(np.int32)
    return replace(observations, points=replace(points, feature=feature))


# ---- labels ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [("board_05",), ("board_01", "board_02", "board_07", "board_09")])
def test_a_turned_label_is_found_and_mended(turned: tuple[str, ...]) -> None:
    seen = _rig(checkerboard(4, 6, 0.1))
    labels = with_same_labels(_turned(seen, "right", turned))
    assert labels.turned == tuple(("right", name) for name in turned) and not labels.open
    assert np.array_equal(labels.observations.points.feature, seen.points.feature)
    assert with_same_labels(seen).turned == ()


def test_square_boards_have_four_ways_round() -> None:
    seen = _rig(checkerboard(5, 5, 0.1))
    points = seen.points
    column, row = points.feature % 5, points.feature // 5
    own = np.array([view.station == "right" and view.frame == "board_04" for view in seen.views])[points.view]
    quarter = np.where(own, 5 * column + 4 - row, points.feature).astype(np.int32)
    labels = with_same_labels(replace(seen, points=replace(points, feature=quarter)))
    assert labels.turned == (("right", "board_04"),)
    assert np.array_equal(labels.observations.points.feature, points.feature)


def test_a_board_that_tells_its_end_is_left_alone() -> None:
    seen = _turned(_rig(checkerboard(5, 6, 0.1)), "right", ("board_02",))
    assert with_same_labels(seen).observations is seen


def test_one_moment_tells_nothing_of_labels() -> None:
    labels = with_same_labels(_rig(checkerboard(4, 6, 0.1), count=1))
    assert labels.open == ("right",) and not labels.turned


# ---- frames ---------------------------------------------------------------------------------------------------------


def _named(names: dict[str, list[str]]) -> Observations:
    seen = _rig(checkerboard(5, 6, 0.1), count=3)
    order = [view.frame for view in seen.views if view.camera == "left"]
    views = tuple(
        replace(view, frame=(name := names[view.camera][order.index(view.frame)]), placement=name)
        for view in seen.views
    )
    return replace(seen, views=views)


@pytest.mark.parametrize(
    "left, right, rule, moments",
    [
        (["left1", "left2", "left3"], ["right1", "right2", "right3"], "left*,right*", ["1", "2", "3"]),
        (["a", "b", "c"], ["x", "y", "z"], "index", ["0001", "0002", "0003"]),
        (["1.00", "2.00", "3.00"], ["1.004", "1.996", "3.0"], "within:0.01", ["1.00", "2.00", "3.00"]),
    ],
)
def test_frames_of_one_moment(left: list[str], right: list[str], rule: str, moments: list[str]) -> None:
    seen = with_same_frames(_named({"left": left, "right": right}), rule)
    for camera in ("left", "right"):
        assert [view.frame for view in seen.views if view.camera == camera] == moments
    assert all(view.placement == view.frame for view in seen.views)


@pytest.mark.parametrize(
    "left, rule, why",
    [
        (["left1", "left2", "left3"], "up*,right*", "no pattern fits frame 'left1' of camera 'left'"),
        (["left1", "left2", "left3"], "left*,*", "several patterns fit"),
        (["left1", "left2", "left3"], "left,right", r"one \* in each"),
        (["left7", "left8", "left9"], "left*,right*", "no two cameras have a frame in common"),
        (["left1", "left2", "left3"], "within:0.4", "'left1' is not a number"),
    ],
)
def test_frames_are_never_guessed(left: list[str], rule: str, why: str) -> None:
    with pytest.raises(InputError, match=why):
        with_same_frames(_named({"left": left, "right": ["right1", "right2", "right3"]}), rule)


def test_moments_must_be_apart() -> None:
    seen = _named({"left": ["1.0", "1.5", "2.0"], "right": ["1.1", "1.6", "2.1"]})
    with pytest.raises(InputError, match=r"below half of 0\.5, the interval of frames of camera 'left'"):
        with_same_frames(seen, "within:0.4")


def test_index_needs_as_many_frames() -> None:
    left, right = (_rig(checkerboard(5, 6, 0.1), count) for count in (3, 2))
    both = combine([left.of_station("left"), right.of_station("right")])
    with pytest.raises(InputError, match="'left' has 3, 'right' has 2 frames"):
        with_same_frames(both, "index")


# ---- baseline and angle ---------------------------------------------------------------------------------------------


def test_baseline_and_angle_with_their_sd() -> None:
    off = []
    for seed in range(1, 7):
        (pair,) = calibrate(_rig(checkerboard(9, 6, 0.1), 8, seed), _BROWN).uncertainty.rig
        assert pair.stations == ("left", "right")
        off.append((pair.baseline_m - _BASELINE_M) / pair.baseline_sd_m)
        off.append((pair.angle_rad - _ANGLE_RAD) / pair.angle_sd_rad)
        assert pair.baseline_sd_m < 1e-3 and pair.angle_sd_rad < 1e-3
    assert 0.5 < np.sqrt(np.mean(np.square(off))) < 1.5  # 0.9


def test_cameras_without_a_common_moment_have_no_baseline() -> None:
    """Frames named by different time stamps: the baseline was 0 ± 0 mm, without a message."""
    rig = _rig(checkerboard(9, 6, 0.1))
    late = {view.station for view in rig.views[-1:]}

    def apart(view: View) -> View:
        return (
            replace(view, frame=view.frame + ".004", placement=f"{view.placement}.004")
            if view.station in late
            else view
        )

    calibration = calibrate(replace(rig, views=tuple(map(apart, rig.views))))
    assert calibration.uncertainty.rig == () and len(calibrate(rig).uncertainty.rig) == 1
    (said,) = (text for text in calibration.remarks if "nothing connects" in text)
    assert "join --same-frame" in said and not any("nothing connects" in text for text in calibrate(rig).remarks)


@pytest.mark.thorough
def test_few_boards_before_a_pair_are_as_wide_as_they_are_off() -> None:
    """A weak direction was fixed together with the boards that both see, without a prior: sd of 3 to 490 mm."""
    off = []
    for seed in range(4):
        (pair,) = calibrate(_rig(checkerboard(5, 4, 0.1), 3, seed)).uncertainty.rig
        assert pair.baseline_sd_m < 4e-3  # 0.7 to 2.8 mm
        off.append((pair.baseline_m - _BASELINE_M) / pair.baseline_sd_m)
    assert 0.2 < np.sqrt(np.mean(np.square(off))) < 1.5  # 0.45; 0.03 before


def test_opencv_left_right(real_data: Path) -> None:
    """With its own corners, cv2.stereoCalibrate ends at 83.1815 mm and 0.2150 px with everything free."""
    board, sides = checkerboard(9, 6, 0.025), []
    for side in ("left", "right"):
        corners = {p.stem: _opencv_corners(p) for p in sorted((real_data / "opencv_left_right").glob(f"{side}*.jpg"))}
        sides.append(Observations.from_points(corners, board, (640, 480), camera=side))
    seen = with_same_frames(combine(sides), "left*,right*")
    plain = replace(_BROWN, free_aspect=True, loss="trivial", reject_sigma=np.inf, as_built="as drawn")
    calibration = calibrate(seen, plain)
    (pair,) = calibration.uncertainty.rig
    assert calibration.fit.points_rms_px == pytest.approx(0.2150, abs=1e-4)
    assert 1e3 * pair.baseline_m == pytest.approx(83.1815, abs=2e-3)
    assert 1e3 * pair.baseline_sd_m < 0.5


@pytest.mark.usefixtures("words_alone")
@pytest.mark.thorough
def test_opencv_left_right_by_defaults_is_usable(real_data: Path, say: Say, tmp_path: Path) -> None:
    """A possible thin prism of 4 ± 2 px, beside a spline that leaves 0.006 px of it, moved the principal point by 42
    standard deviations: "cannot be trusted". Heights above the other camera were "known to 9.6 % only".
    """
    for side in ("left", "right"):
        (tmp_path / "rig" / side).mkdir(parents=True)
        for path in (real_data / "opencv_left_right").glob(f"{side}*.jpg"):
            shutil.copy(path, tmp_path / "rig" / side / path.name.removeprefix(side))
    said = say("run", tmp_path / "rig", "--board", "9x6x25mm", "-o", tmp_path / "out").out
    assert "The intrinsics are usable with limits" in said and "\nweak" not in said
    (pair,) = Calibration.load(tmp_path / "out" / "calibration.json").uncertainty.rig
    assert f"rig       left - right: baseline {1e3 * pair.baseline_m:.3f}" in said
    assert 1e3 * pair.baseline_m == pytest.approx(83.3, abs=0.3)  # of 25 mm squares; 83.2 by cv2.stereoCalibrate


def _opencv_corners(path: Path) -> np.ndarray:
    image = read_grey(path)
    shown, corners = cv2.findChessboardCorners(image, (9, 6))
    assert shown
    return np.asarray(cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), (3, 100, 1e-6)), dtype=float)


def test_a_camera_of_which_nothing_is_left_gets_the_same_kind_of_lens() -> None:
    """If all of its observations were rejected, it kept its previous lens: "unexpected KeyError: 'a2'"."""
    sights = gather_sights(_rig(checkerboard(5, 4, 0.1), 2).of_station("left"))
    there = Estimate({"left": _LEFT, "right": _LEFT}, _STATIONS, {}, EXACT)
    seen = seen_through(there, Options(lens="radial"), profiles_of(there, sights))
    assert {name: camera.lens.kind for name, camera in seen.cameras.items()} == {"left": "radial", "right": "radial"}


def test_exchanged_frames_take_out_no_others() -> None:
    """As displaced views they indicated a principal point that moves by 60 px, and half of all rows were rejected."""
    seen = _rig(checkerboard(9, 6, 0.1))
    exchanged = _in_other_frames(seen, {"board_05": "board_08", "board_08": "board_05"})
    calibration = calibrate(exchanged)
    at = [n for n, view in enumerate(seen.views) if view != exchanged.views[n]]
    assert np.array_equal(calibration.outlier_masks(seen)[0], np.isin(seen.points.view, at))
    assert "it shows the board where another camera sees it at 'board_05'" in calibration.warnings[0]
    (pair,) = calibration.uncertainty.rig
    assert abs(pair.baseline_m - _BASELINE_M) < 3.0 * pair.baseline_sd_m < 1e-3


def test_turned_labels_are_no_exchanged_frames() -> None:
    """A board with rotated labels may fit another frame better by chance."""
    seen = _turned(_rig(checkerboard(4, 6, 0.1), 8), "right", ("board_02", "board_05"))
    otherwise = shown_otherwise(seen)
    assert set(otherwise) == {("right", "board_02"), ("right", "board_05")}
    assert all("its points are turned" in words for words in otherwise.values())


def test_a_camera_one_frame_late_is_named() -> None:
    """It lost half of its observations, with the message "check labels, target dimensions and the lens"."""
    seen = _rig(checkerboard(9, 6, 0.1), 8)
    names = list(dict.fromkeys(view.frame for view in seen.views))
    late = _in_other_frames(seen, dict(zip(names, names[1:] + names[:1], strict=True)))
    with pytest.raises(SolutionError, match=r"frames of 'left' and 'right' are shifted.* shows 1 frame later"):
        calibrate(late, _BROWN)


def test_a_board_that_moves_between_two_shutters_is_named() -> None:
    """By 3 mm: one of ten such rigs was usable with limits, and numbers had errors of hundreds of
    standard deviations.
    """
    scene = board_scene(
        checkerboard(9, 6, 0.05), {"left": _LEFT, "right": _LEFT}, _STATIONS, 8, 3, BoardRanges((0.6, 1.2))
    )
    shifts = np.random.default_rng(0).normal(0.0, 0.003, (len(scene.placements), 3))
    moved = {
        name: Pose(pose.rotation, pose.translation + shift)
        for (name, pose), shift in zip(scene.placements.items(), shifts, strict=True)
    }
    sides = [
        simulate(one, Disturbance(points_sigma_px=0.1), seed=3).observations.of_station(station)
        for one, station in ((scene, "left"), (replace(scene, placements=moved), "right"))
    ]
    with pytest.raises(SolutionError, match="in most frames 'left' and 'right' see the board at different places"):
        calibrate(combine(sides), _BROWN)


def test_frames_of_one_name_and_of_other_moments_are_named() -> None:
    """They were refused with "check labels, target dimensions and the lens"."""
    sides = [_rig(checkerboard(9, 6, 0.1), 5, seed=seed).of_station(name) for seed, name in ((3, "left"), (4, "right"))]
    with pytest.raises(SolutionError, match="in most frames 'left' and 'right' see the board at different places"):
        calibrate(combine(sides), _BROWN)


def test_a_lost_board_that_both_cameras_see_is_posed_again() -> None:
    """Lenses were compared without it, so that it kept its initial pose, and both of its views were rejected."""
    seen = _rig(checkerboard(9, 6, 0.1), 5)
    calibration = calibrate(seen, _BROWN)
    name, pose = next(iter(calibration.placements.items()))
    lost = {**calibration.placements, name: Pose(pose.rotation, pose.translation + np.array([0.3, 0.2, 0.5]))}
    end = solve_robustly(calibration.problem(seen), replace(calibration.estimate, placements=lost), is_near=True)
    assert end.inliers.points.all()


def test_a_frame_under_the_other_cameras_name_is_named() -> None:
    """In the first or last of three frames all that it shows was rejected row by row, and nothing was said of it."""
    stations = {name: Station(name, overhead_pose(x, 0.1, 5.0, 8.0, 3.0)) for name, x in (("left", -2.2), ("right", 2))}
    cameras, other = dict.fromkeys(stations, scenes.camera("radial-2-3")), {"left": "right", "right": "left"}
    scene = field_scene(ssl_field("B"), cameras, stations, 3, spacing_m=0.6)
    seen, drawn = simulate(scene, Disturbance(0.3, 0.3), 1).observations, Options(lens="radial", as_built="as drawn")
    views = [
        replace(view, camera=other[view.camera], station=other[view.camera]) if view.frame == "0003" else view
        for view in seen.views
    ]
    said = calibrate(replace(seen, views=tuple(views)), drawn).warnings
    assert len([text for text in said if "of 1 of its 3 frames ('0003') were taken out" in text]) == 2, said


def test_two_cameras_at_one_place_of_a_field_are_named() -> None:
    """With the labels of one half a turn off, both stood over one half, 4.4 m from the truth, and were trusted."""
    stations = {name: Station(name, overhead_pose(x, 0.1, 5.0, 8.0, 3.0)) for name, x in (("left", -2.2), ("right", 2))}
    cameras, drawn = dict.fromkeys(stations, scenes.camera("radial-2-3")), Options(lens="radial", as_built="as drawn")
    scene = field_scene(ssl_field("B"), cameras, stations, points=(), spacing_m=0.5)
    seen = simulate(scene, Disturbance(0.3, 0.3), 1).observations
    turned = relabelled(seen.of_station("right"), TURNED)
    assert turned is not None
    wrong = combine([seen.of_station("left"), turned])
    named = "stations 'left' and 'right' stand at one place and show the same part of 'field', and no station"
    assert named in " ".join(calibrate(wrong, drawn).warnings) and named not in " ".join(
        calibrate(seen, drawn).warnings
    )
    places = {"left": (-2.2, 0.1, 5.0), "right": (-2.0, -0.1, 5.0)}
    stated = tuple(Prior("station", name, "position_m", place, (0.1, 0.1, 0.1)) for name, place in places.items())
    assert named not in " ".join(calibrate(wrong, replace(drawn, priors=stated)).warnings)


def _in_other_frames(observations: Observations, frames: Mapping[str, str]) -> Observations:
    """Frames of the right camera with the names of others."""
    views = [
        replace(view, frame=frames[view.frame], placement=frames[view.frame])
        if view.station == "right" and view.frame in frames
        else view
        for view in observations.views
    ]
    return replace(observations, views=tuple(views))


# ---- as typed -------------------------------------------------------------------------------------------------------


def test_join_as_typed(say: Say, tmp_path: Path) -> None:
    seen = _turned(_rig(checkerboard(4, 6, 0.1)), "right", ("board_05",))
    paths = []
    for camera in ("left", "right"):
        own = seen.of_station(camera)
        views = tuple(
            replace(view, frame=f"{camera}_{view.frame}", placement=f"{camera}_{view.frame}") for view in own.views
        )
        paths.append(tmp_path / f"{camera}.json")
        replace(own, views=views).save(paths[-1])
    joined = tmp_path / "rig.json"
    said = say("join", *paths, "--same-frame", "left_*,right_*", "-o", joined)
    assert said.code == 0 and "11 seen by 2 cameras" in said.out and "'board_05' of 'right'" in said.out
    said = say("calibrate", joined, "--lens", "brown", "-o", tmp_path / "c.json")
    assert said.code == 0 and "left - right: baseline " in said.out
    data = json.loads(say("join", *paths, "--same-frame", "index", "-o", tmp_path / "i.json", "--json").out)
    assert data["moments_by_cameras"] == {"2": 11} and data["turned"] == [["right", "0005"]]
    assert "no pattern fits" in refused(say("join", *paths, "--same-frame", "up*", "-o", joined))


def test_run_makes_the_labels_of_a_camera_upside_down_agree(
    say: Say, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A board of 5 x 3 corners: without it the second camera lost half of its observations by more than 24 px."""

    def calibrated(*given: object) -> None:
        raise InputError(f"calibrate {given[-1]}")

    monkeypatch.setattr("ceres_cal.cli.run._calibrated", calibrated)
    squares = np.kron(np.indices((4, 6)).sum(axis=0) % 2, np.ones((20, 20)))
    board = np.pad(255 * squares, 20, constant_values=255).astype(np.uint8)
    for number, turns in enumerate([(0.5, 0.2), (-0.4, 0.4), (0.1, -0.6)]):
        for side, shift in (("left", 30.0), ("right", -30.0)):
            rotation = rotation_exp([*turns, 0.1])
            plane = np.column_stack([rotation[:, :2], rotation @ [-80.0, -60.0, 0.0] + [shift, 0.0, 400.0]])
            lens = np.array([[500.0, 0.0, 159.5], [0.0, 500.0, 119.5], [0.0, 0.0, 1.0]])
            image = cv2.warpPerspective(board, lens @ plane, (320, 240), borderValue=128)
            (tmp_path / "rig" / side).mkdir(parents=True, exist_ok=True)
            image = cv2.GaussianBlur(image, (0, 0), 0.7)
            cv2.imwrite(str(tmp_path / "rig" / side / f"{number}.png"), image[::-1, ::-1] if side == "right" else image)
    joined, out = tmp_path / "out" / "rig.json", tmp_path / "out"
    assert f"calibrate ['{joined}']" in refused(
        say("run", tmp_path / "rig", "--board", "5x3x20mm", "-o", out, "--quiet")
    )
    seen = combine([Observations.load(out / side / "board.json") for side in ("left", "right")])
    assert with_same_labels(seen).turned and not with_same_labels(Observations.load(joined)).turned
