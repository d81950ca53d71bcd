"""Unknown dimensions of a field: solved for with the camera, and reported where nothing determines them."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendering.photograph import photograph
from rendering.photography import Photography, taken_as
from scenery import board_scene, field_scene, join, overhead_pose

from ceres_cal.base.arrays import Image
from ceres_cal.base.errors import DegenerateError, InputError
from ceres_cal.base.transforms import rotation_exp
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.lens_forms import AS_GOOD_BESIDE_LENGTHS, PAPER, decide, standard_errors
from ceres_cal.cli import main
from ceres_cal.cli.arguments import parse_estimates
from ceres_cal.detect.photographs.candidates import Auto, candidates, prepare_search
from ceres_cal.detect.photographs.field_lines import FieldLines
from ceres_cal.detect.photographs.follow import Tracker
from ceres_cal.diagnostics import diagnose
from ceres_cal.moves.checks import check
from ceres_cal.moves.refits import refit
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.structure import Tolerance
from ceres_cal.report.document import Table
from ceres_cal.report.quality import quality_of
from ceres_cal.report.summary import numbers_chapter
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, Radial
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Disturbance, Scene, Station, simulate

FIELD = ssl_field("B")
TRUE = {"field_length_m": 8.28, "field_width_m": 5.52}
BOTH = tuple(f"field/{name}" for name in TRUE)
EVERY = tuple(f"field/{n}" for n in FIELD.dimensions if n not in ("goal_width_m", "line_thickness_m"))
CAMERA = Camera((780, 580), 350.0, (392.0, 287.0), Radial((-5.2e-5, 6.1e-7)))
HEIGHT = Prior("station", "s", "height_m", (5.0,), (0.01,))


def scene() -> Scene:
    station = Station("a", overhead_pose(0.2, -0.15, 5.0, 9.0, -6.0))
    return field_scene(ssl_field("B", **TRUE), {"a": CAMERA}, {"s": station}, spacing_m=0.1)


def seen(what: Scene, seed: int = 1) -> Observations:
    """Observations of the odd field, with division B as the target."""
    observations = simulate(what, Disturbance(0.1, 0.1), seed).observations
    return replace(observations, targets={**observations.targets, "field": FIELD})


@cache
def solved() -> tuple[Observations, Calibration]:
    observations = seen(scene())
    return observations, calibrate(observations, Options(lens="radial", dimensions=BOTH))


@pytest.mark.parametrize("name", TRUE)
def test_a_field_that_is_not_as_long_or_wide_as_drawn_is_named(name: str) -> None:
    """The drawing is 1 % too large; measured 8.999 ± 0.007 m and 6.000 ± 0.004 m."""
    true = FIELD.dimensions[name]
    painted = field_scene(FIELD, {"a": CAMERA}, {"s": Station("a", overhead_pose(0.2, -0.15, 5.0, 9.0, -6.0))})
    observations = simulate(painted, Disturbance(0.2, 0.2), 1).observations
    assert not diagnose(calibrate(observations, Options(lens="radial")), observations).findings
    observations = replace(observations, targets={"field": ssl_field("B", **{name: 1.01 * true})})
    findings = diagnose(calibrate(observations, Options(lens="radial")), observations).findings
    found = next(one for one in findings if one.subject == f"field/{name}")
    assert found.kind == "other length" and f"--estimate field.{name}" in found.advice
    (by,) = found.amounts
    assert abs(1.01e3 * true + by.value - 1e3 * true) < 4.0 * by.sd < 40.0


def test_a_field_of_odd_size_from_its_circle() -> None:
    _, calibration = solved()
    target = calibration.targets["field"]
    for name, true in TRUE.items():
        known = calibration.uncertainty.verdict("dimension", "field", name)
        assert known.low < true < known.high and known.sd < 0.005 and known.verdict == "known"  # 2 and 3 mm
        assert target.dimensions[name] == known.value == calibration.estimate.structure.dimensions[f"field/{name}"]
    assert not calibration.outliers and calibration.fit.curve_scale < 1.2
    assert np.allclose(calibration.estimate.structure.offsets, 0.0)  # it is drawn as it is
    corner = calibration.station().project(np.array([target.points["TopLeftCorner"]]))
    there = scene().camera_at("s").project(np.array([ssl_field("B", **TRUE).points["TopLeftCorner"]]))
    assert np.linalg.norm(corner - there) < 0.2  # 0.1 px


def test_what_comes_after_takes_the_field_as_it_was_found(tmp_path: Path) -> None:
    observations, calibration = solved()
    calibration.save(tmp_path / "c.json")
    again = Calibration.load(tmp_path / "c.json")
    assert again.targets == calibration.targets and again.options == calibration.options
    assert not diagnose(again, observations).findings
    new = seen(scene(), 2)
    assert check(again, new).holds
    moved = refit(again, new)
    known, before = (one.uncertainty.verdict("dimension", "field", "field_length_m") for one in (moved, again))
    assert known.sd < before.sd and abs(known.value - 8.28) < 3.0 * known.sd


def test_nothing_of_size_is_known() -> None:
    observations, _ = solved()
    with pytest.raises(DegenerateError, match=r"the size of target 'field' is unknown.* measure one of them "):
        calibrate(observations, Options(lens="radial", dimensions=EVERY))
    for known in (HEIGHT, Prior("target", "field", "field_length_m", (8.28,), (0.005,))):
        calibration = calibrate(observations, Options(lens="radial", dimensions=EVERY, priors=(known,)))
        radius = calibration.uncertainty.verdict("dimension", "field", "center_circle_radius_m")
        assert radius.low < 0.5 < radius.high and radius.sd < 0.02  # 12 mm by the height, 1 mm by the length


@pytest.mark.thorough
def test_a_dimension_that_nothing_shows_and_one_that_is_contradicted() -> None:
    observations, _ = solved()
    marks = [name for name in FIELD.point_names if "Mark" not in name]
    kept = np.isin(observations.points.feature, [FIELD.point_names.index(name) for name in marks])
    without = observations.part(kept, np.ones(len(observations.curves), dtype=bool))
    with pytest.raises(DegenerateError, match="depends on goal_center_to_penalty_mark_m of target 'field'"):
        calibrate(without, Options(lens="radial", dimensions=(*BOTH, "field/goal_center_to_penalty_mark_m")))
    for name, words in (("line_thickness_m", "no line or point depends on"), ("depth", "there is no dimension")):
        with pytest.raises(InputError, match=words):
            calibrate(observations, Options(lens="radial", dimensions=(f"field/{name}",)))
    wrong = Prior("target", "field", "field_length_m", (8.6,), (0.005,))
    calibration = calibrate(observations, Options(lens="radial", dimensions=BOTH, priors=(wrong,)))
    assert any("the stated field_length_m of target 'field'" in words for words in calibration.warnings)


def test_beside_tolerances_and_boards() -> None:
    boards = board_scene(checkerboard(9, 6, 0.1), {"a": CAMERA}, {"s": scene().stations["s"]}, count=6, seed=3)
    observations = seen(join(scene(), boards))
    options = Options(lens="radial", dimensions=BOTH, tolerances={"field": Tolerance(0.003, 0.003)})
    calibration = calibrate(observations, options)
    structure = calibration.estimate.structure
    assert structure.own == 65 == len(structure.offsets) and len(structure.values) == 67
    known = calibration.uncertainty.verdict("dimension", "field", "field_length_m")
    assert known.low < 8.28 < known.high and 0.002 < known.sd < 0.02  # 5 mm: its lines may be displaced


def shared_board(square_m: float) -> Observations:
    """Two cameras above a field see a board with such squares at the same time; the target has squares of 0.1 m."""
    rng, field, board = np.random.default_rng(1), ssl_field("B"), checkerboard(9, 6, 0.1)
    true, places = checkerboard(9, 6, square_m).point_array - (0.4, 0.25, 0.0), field.point_array
    shown: list[Observations] = []
    for name, x_m in (("a", -0.5), ("b", 0.5)):
        pose = overhead_pose(x_m, 0.2, 4.5, 8.0, -5.0, 20.0)
        camera = Camera((1280, 960), 800.0, (640.0, 480.0), Radial((-5e-5, 6e-7)), 1.0, pose)
        seen = camera.project(places) + rng.normal(0.0, 0.2, (len(places), 2))
        inside = np.all((seen > 0.0) & (seen < (1279.0, 959.0)), axis=1)
        shown.append(
            Observations.from_points([np.where(inside[:, None], seen, np.nan)], field, (1280, 960), camera=name)
        )
        boards = {}
        for number, (right, up) in enumerate(np.ndindex(3, 2)):
            turn = rotation_exp(np.array([0.3 * (-1) ** number, 0.2 * right, 0.5 * number]))
            pixels = camera.project(true @ turn.T + (0.8 * right - 0.8, 0.9 * up - 0.4, 0.6))
            boards[str(number)] = pixels + rng.normal(0.0, 0.1, pixels.shape)
        shown.append(Observations.from_points(boards, board, (1280, 960), camera=name))
    return sum(shown[1:], shown[0])


def test_a_board_that_contradicts_the_field_is_named_and_solved_for() -> None:
    """For a rig that sees it together, a moved camera or shifted points were reported."""
    observations, radial = shared_board(0.099), Options(lens="radial")
    (found,) = (
        one for one in diagnose(calibrate(observations, radial), observations).findings if one.kind == "other length"
    )
    assert found.subject == "board/square_m" and re.search(r"is 0\.0990\d ± 0\.000\d+ m, not 0\.1 m", found.sentence)
    solved = calibrate(observations, replace(radial, dimensions=("board/square_m",)))
    assert solved.targets["board"].dimensions["square_m"] == pytest.approx(0.099, abs=1e-4)
    assert np.linalg.norm(solved.station("a").position - (-0.5, 0.2, 4.5)) < 0.03  # 0.021, one standard deviation
    for name in ("a", "b"):
        height = solved.uncertainty.verdict("station", name, "height")
        assert height.low < 4.5 < height.high and height.sd < 0.025  # 0.021 and 0.015 m


@pytest.mark.thorough
def test_a_board_as_it_was_measured_is_not_named() -> None:
    observations = shared_board(0.1)
    assert not diagnose(calibrate(observations), observations).findings


def test_no_lens_that_is_too_simple_beside_lengths() -> None:
    rng = np.random.default_rng(0)
    best = rng.uniform(0.9, 1.1, 50)
    worse = best + rng.normal(0.01, 0.07, 50)  # by one standard error
    tried = ([PAPER, "brown k1 k2"], [2, 3], [worse, best])
    assert 0.5 < standard_errors(worse, best) < 1.5
    assert decide(*tried) == (1, 0) and decide(*tried, AS_GOOD_BESIDE_LENGTHS) == (1, 1)


def test_what_is_typed() -> None:
    length, width, circle = parse_estimates(["length,width=5.5", "circle=500mm:1mm"], {"field": FIELD})
    assert length == Prior("target", "field", "field_length_m", (9.0,), (np.inf,)) and length.is_open
    assert width.value == (5.5,) and width.is_open and circle.dimension == "field/center_circle_radius_m"
    assert circle.sigma == (0.001,)
    for text, words in (
        ("penalty", "may be penalty_area_depth_m or penalty_area_width_m"),
        ("height", "'height' is not a dimension: there are field_length_m"),
        ("length,length", "given twice"),
        ("length=long", "is not a finite number"),
        ("length=9:0", "sigma above 0"),
        ("length=-9", "at least 0.45 m"),
    ):
        with pytest.raises(InputError, match=words):
            parse_estimates([text], {"field": FIELD})


@cache
def picture() -> Image:
    photography = Photography(robots=3, carpet_texture=0.05)
    return photograph(taken_as(scene(), photography), "s", "0001", seed=1).image


def test_without_a_start_the_field_is_sought_in_several_sizes() -> None:
    grey, drawn = cv2.cvtColor(picture(), cv2.COLOR_BGR2GRAY).astype(np.float32), ssl_field("B", field_width_m=6.4)
    width = Prior("target", "field", "field_width_m", (6.4,), (0.9,))
    search = prepare_search(grey, drawn, drawn.curve_names, Auto(lengths=(width,)))
    assert len(search.others) == 2
    camera, grid = candidates(search)[0]
    assert grid is search.others[0]  # 6 % narrower: 9 to 6.0 m, as is 8.28 to 5.52
    away = [
        (camera.cam_from_world @ turn).position[:2] - scene().camera_at("s").position[:2] for turn in search.grid.turns
    ]
    assert min(np.linalg.norm(away, axis=1)) < 0.3


@pytest.mark.thorough
def test_from_a_photograph(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    path, observed, out = (str(tmp_path / name) for name in ("odd.png", "field.json", "calibration.json"))
    cv2.imwrite(path, picture())
    target, camera = ssl_field("B", **TRUE), scene().camera_at("s")
    names = [f"{side}{end}Corner" for side in ("Top", "Bottom") for end in ("Left", "Right")]
    clicked = np.round(camera.project(np.array([target.points[name] for name in names]))).astype(int)
    corners = [word for name, (x, y) in zip(names, clicked, strict=True) for word in ("--corner", f"{name}={x},{y}")]
    asked = ["detect", "field", path, "--target", "ssl-b", *corners, "-o", observed]
    refined, seen = Tracker.refined, list[FieldLines]()

    def counted(tracker: Tracker, followed: FieldLines) -> FieldLines:
        seen.append(followed)
        return refined(tracker, followed)

    monkeypatch.setattr(Tracker, "refined", counted)
    assert main([*asked, "--picture", str(tmp_path / "refused.png")]) == 2
    assert len(seen) == 1  # other dimensions fit with square pixels, so no stretched picture is searched
    error = capsys.readouterr().err
    assert re.search(r"the field (length|width) is [78]\.\d % smaller than the target says", error)
    assert "--estimate" in error  # says what would help
    drawn = cv2.imread(str(tmp_path / "refused.png"))
    assert drawn is not None and drawn.shape == picture().shape and np.any(drawn != picture())
    assert main([*asked, "--estimate", "mark"]) == 2
    assert "no painted line depends on goal_center_to_penalty_mark_m" in capsys.readouterr().err
    assert main([*asked, "--estimate", "length,width"]) == 0
    assert "lengths, roughly, for `calibrate` to solve for: field_length_m 8.2" in capsys.readouterr().out
    priors = json.loads(Path(observed).read_text())["priors"]
    assert [prior["sigma_m"] for prior in priors] == [None, None]
    assert main(["calibrate", observed, "-o", out, "--lens", "radial"]) == 0
    printed = capsys.readouterr().out
    assert "lengths   that were solved for" in printed and "field/field_length_m" in printed
    dimensions = Calibration.load(out).targets["field"].dimensions
    for name, true in TRUE.items():
        assert abs(dimensions[name] - true) < 0.003  # 0.5 mm
    quality = quality_of(Calibration.load(out), Observations.load(observed))
    tables = [piece for piece in numbers_chapter(quality, ()).pieces if isinstance(piece, Table)]
    assert "Lengths that were solved for" in [table.caption for table in tables]


@pytest.mark.parametrize(("aspect", "is_said"), [(1.004, False), (1.0085, True)])
def test_pixels_as_far_from_square_as_no_known_camera_has_them_are_said(aspect: float, is_said: bool) -> None:
    """A field that is 1 % longer than drawn looks the same, with the same errors of places and no other message."""
    camera = Camera((1280, 960), 700.0, (643.0, 475.0), Brown((-0.18, 0.05, 2e-4, -3e-4, 0.0)), aspect=aspect)
    world = {"camera": Station("camera", overhead_pose(0.2, -0.1, 5.2, 8.0, 3.0, yaw_deg=90.0))}
    scene = field_scene(ssl_field("B"), {"camera": camera}, world, points=(), spacing_m=0.1)
    warnings = calibrate(simulate(scene, Disturbance(0.3, 0.3), 1).observations).warnings
    assert any("pixels so far from square" in words for words in warnings) == is_said
