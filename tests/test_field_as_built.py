"""Displaced lines, and other dimensions: distinguished, named, refused."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from photos import shots as script
from photos.disturbed import AUTO, taken
from scenery import overhead_pose

from ceres_cal.base import Pose
from ceres_cal.base.errors import NothingShownError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.cli.detect_field import _sections
from ceres_cal.detect.courses import predict
from ceres_cal.detect.images import filled, light
from ceres_cal.detect.lines import Lines, measure
from ceres_cal.detect.photographs import Auto, Clicks, FieldDetections, FieldOptions, detect_field
from ceres_cal.detect.photographs.as_built import FieldAsBuilt, as_built
from ceres_cal.detect.photographs.by_hand import unknown_optics
from ceres_cal.detect.photographs.field import _observations
from ceres_cal.detect.photographs.field_lines import FieldLines
from ceres_cal.detect.photographs.grid import Facing
from ceres_cal.detect.photographs.matching import StrokeMap
from ceres_cal.detect.photographs.refit import observations_of
from ceres_cal.detect.photographs.search import _contradiction, search
from ceres_cal.detect.registration import nearness_to
from ceres_cal.detect.strokes import Strokes, drawn, find_strokes
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.report.document import Document
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Arc, Segment, Target, custom, ssl_field

FIELD = ssl_field("B")
CAMERA = Camera(
    (780, 580),
    340.0,
    (389.5, 289.5),
    Radial((0.0, 1.0e-6, 0.0, 0.0), (2, 3, 4, 5)),
    1.0,
    overhead_pose(0.2, -0.1, 5.0, 4.0),
)


def measured(painted: Target, noise_px: float = 0.1) -> Lines:
    """Measured lines of this field."""
    course = predict(painted, CAMERA, painted.curve_names, 8.0, 8.0)
    offset = np.random.default_rng(3).normal(0.0, noise_px, len(course))
    every = np.ones(len(course), dtype=bool)
    return Lines(course, every, offset, np.full(len(course), noise_px), 0.8, 1.0)


def told(painted: Target, asked: Target = FIELD, noise_px: float = 0.1) -> FieldAsBuilt:
    """The result for the field that is asked for."""
    return as_built(measured(painted, noise_px), CAMERA, asked, unknown_optics(CAMERA, None).priors)


def moved(aside_m: dict[str, tuple[float, float]], field: Target = FIELD) -> Target:
    """The field with some of its lines moved."""
    curves = dict(field.curves)
    for name, (x, y) in aside_m.items():
        line = curves[name]
        assert isinstance(line, Segment)
        ends = [(a + x, b + y, c) for a, b, c in (line.start, line.end)]
        curves[name] = Segment(ends[0], ends[1], line.width_m)
    painted = custom(FIELD.points, {name: curves[name] for name in FIELD.curve_names})
    assert painted.curve_names == FIELD.curve_names
    return painted


def test_a_field_as_drawn_and_one_of_its_own_scale() -> None:
    for painted in (FIELD, custom(FIELD.points, FIELD.curves)):
        built = told(painted)
        assert not built.aside_m and not built.dimensions and not built.is_other and built.words() == ()


def test_lines_that_lie_aside_are_named_and_measured() -> None:
    true = {"BottomTouchLine": -0.03, "RightGoalLine": -0.031, "HalfwayLine": 0.019, "LeftPenaltyStretch": -0.024}
    built = told(moved({name: (0.0, a) if "Touch" in name else (-a, 0.0) for name, a in true.items()}))
    assert built.aside_m.keys() == true.keys() and not built.dimensions and not built.is_other
    for name, aside in true.items():
        assert abs(built.aside_m[name] - aside) < 0.004  # 0.002 m
    assert any(words.startswith("BottomTouchLine lies ") for words in built.words())


def test_lines_that_are_bent_as_by_no_lens_are_another_field_s() -> None:
    """For example a camera that is bent until parts of a field of another width fit; tape that is not straight does
    less.
    """
    course = predict(FIELD, CAMERA, FIELD.curve_names, 8.0, 8.0)
    every = np.ones(len(course), dtype=bool)
    for wave_px, wander_m, is_other in ((0.15, 0.0, False), (0.35, 0.004, False), (1.0, 0.013, True)):
        wave = wave_px * np.sin(course.pixels @ np.array([0.05, 0.04]))
        lines = Lines(course, every, wave, np.full(len(course), 0.1), 0.8, 1.0)
        built = as_built(lines, CAMERA, FIELD, unknown_optics(CAMERA, None).priors)
        assert built.is_other == is_other and built.wander_m == pytest.approx(wander_m, rel=0.2)
        assert is_other == any("bent, which no lens explains" in words for words in built.words())


def test_two_sides_tell_a_mirrored_picture() -> None:
    ways = [CAMERA, CAMERA.at(CAMERA.cam_from_world @ Pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)))]
    for sides, said in (
        (("left", "bottom"), "only if the picture is mirrored"),
        (("top", "left"), "contradicts the photograph"),
    ):
        facing = [Facing(name, side) for name, side in zip(("LeftGoalLine", "TopTouchLine"), sides, strict=True)]
        assert said in _contradiction(ways, facing, FIELD, FIELD.curve_names)


def test_a_line_that_lies_aside_is_straight_nevertheless(tmp_path: Path) -> None:
    painted = moved({"BottomTouchLine": (0.0, -0.03), "RightGoalLine": (0.03, 0.0), "HalfwayLine": (-0.02, 0.0)})
    course = predict(painted, CAMERA, painted.curve_names, 8.0, 8.0)
    places = course.pixels + np.random.default_rng(4).normal(0.0, 0.1, (len(course), 1)) * course.normals
    seen = observations_of(FIELD, CAMERA.image_size, course.curve, places, np.full(len(course), 0.1))
    aside = ("BottomTouchLine", "RightGoalLine", "HalfwayLine")
    left = np.flatnonzero(~np.isin(course.curve, [FIELD.curve_index[name] for name in aside]))
    pixels, sds = CAMERA.project(FIELD.point_array), []
    for some in (
        seen.part(np.empty(0, dtype=np.int64), left),
        replace(seen, priors=tuple(Prior.of_offset("field", name, 0.04) for name in aside)),
    ):
        some.save(tmp_path / "seen.json")
        calibration = calibrate(Observations.load(tmp_path / "seen.json"), Options(lens="radial", powers=(2, 3)))
        calibration.save(tmp_path / "calibration.json")
        calibration = Calibration.load(tmp_path / "calibration.json")
        off = calibration.station().locate(pixels) - FIELD.point_array[:, :2]
        sd = calibration.uncertainty.located(pixels).sd_m
        sds.append(float(np.sqrt(np.mean(sd**2))))
        assert np.sqrt(np.mean(off**2)) < 2.0 * sds[-1]
    assert sds[1] < 0.9 * sds[0]  # 0.78
    offsets = dict(zip(calibration.estimate.structure.names, calibration.estimate.structure.values, strict=True))
    for name, offset in zip(aside, (-0.03, -0.03, 0.02), strict=True):
        assert offsets[f"field/{name}"] == pytest.approx(offset, abs=0.003)


def test_a_stated_length_that_everything_else_contradicts_is_named() -> None:
    """The field is 1 % larger than asked for, with lengths stated to 2 cm: areas and circle determine its size."""
    lines = measured(ssl_field("B", field_length_m=9.09, field_width_m=6.06))
    seen = observations_of(FIELD, CAMERA.image_size, lines.course.curve, lines.pixels, lines.sigma_px)
    lengths = {"field_length_m": 9.0, "field_width_m": 6.0}
    priors = tuple(Prior("target", "field", name, (drawn,), (0.02,)) for name, drawn in lengths.items())
    calibration = calibrate(replace(seen, priors=priors), Options(lens="radial", powers=(2, 3)))
    assert len(calibration.conflicts) == 1
    assert calibration.conflicts[0].words.startswith("the stated field_length_m of target 'field', 9.00 ± 0.02 m: ")
    assert any(words.startswith("the stated field_width_m") for words in calibration.warnings)
    assert calibration.estimate.structure.dimensions["field/field_length_m"] == pytest.approx(9.09, abs=0.007)  # 9.0878


def test_length_and_width_are_solved_for_where_lines_scatter() -> None:
    """Lines displaced by 4 mm on a field 12 mm longer and 9 mm narrower: with the drawing the error is 3.0 times the
    stated one, with free dimensions 0.58 times.
    """
    rng = np.random.default_rng(0)
    painted = ssl_field("B", field_length_m=9.012, field_width_m=5.991)
    straight = {name: line for name, line in painted.curves.items() if isinstance(line, Segment)}
    is_along = {name: line.start[0] != line.end[0] for name, line in straight.items()}
    lines = measured(
        moved(
            {
                n: (0.0, rng.normal(0.0, 0.004)) if along else (rng.normal(0.0, 0.004), 0.0)
                for n, along in is_along.items()
            },
            painted,
        )
    )
    built = as_built(lines, CAMERA, FIELD, unknown_optics(CAMERA, None).priors)
    assert built.scatter_m > 0.0 and not built.is_other
    followed = FieldLines(CAMERA, FIELD, FIELD.curve_names, (), lines, FIELD.curve_names, built)
    seen = _observations("0001", followed, FIELD, FieldOptions())
    pixels, over = CAMERA.project(FIELD.point_array), []
    for priors in (seen.priors, tuple(one for one in seen.priors if one.curve)):
        calibration = calibrate(replace(seen, priors=priors), Options(lens="radial", powers=(2, 3)))
        off = np.linalg.norm(calibration.station().locate(pixels) - FIELD.point_array[:, :2], axis=1)
        over.append(float(np.sqrt(np.mean(off**2) / np.mean(calibration.uncertainty.located(pixels).sd_m ** 2))))
    assert over[0] < 1.6 < over[1]


def test_lines_scatter_by_what_all_likely_sizes_say() -> None:
    """Not the likeliest of sizes with factors of two between them: pitches with lines 6 cm off were trusted to half of
    their error.
    """
    laid_m, found = 0.0045, []
    for seed in range(16):
        rng = np.random.default_rng([seed, 7])
        painted = moved({name: tuple(laid_m * rng.normal(size=2)) for name in FIELD.curves if name != "CenterCircle"})
        circle = FIELD.curves["CenterCircle"]
        assert isinstance(circle, Arc)
        x, y, more = laid_m * rng.normal(size=3)
        aside = Arc((x, y, 0.0), circle.radius_m + more, *circle.parameter_range, circle.width_m)
        found.append(told(replace(painted, curves={**painted.curves, "CenterCircle": aside})).scatter_m)
    assert 0.8 < np.sqrt(np.mean(np.square(found))) / laid_m < 1.25  # 0.99
    assert len({round(one, 6) for one in found}) > 8  # 16, and 3


def test_an_offset_is_no_length() -> None:
    """Only lengths are printed as lengths to solve for; an offset is reported as a displaced line."""
    seen = observations_of(FIELD, CAMERA.image_size, np.zeros(1, int), np.full((1, 2), 99.0), np.ones(1))
    priors = (Prior.of_offset("field", "HalfwayLine", 0.04), Prior("target", "field", "field_width_m", (5.9,), (0.1,)))
    detections = FieldDetections(replace(seen, priors=priors), {}, (), {})
    assert Document(tuple(_sections(detections, {}, Path("field.json")))).data["lengths_m"] == {"field_width_m": 5.9}


@pytest.mark.parametrize("share", [0.92, 0.95, 0.97])
def test_a_smaller_field_with_the_same_circle_and_areas_is_another_one(share: float) -> None:
    built = told(ssl_field("B", field_length_m=9.0 * share, field_width_m=6.0 * share))
    assert built.is_other and not built.aside_m
    assert built.dimensions.keys() == {"field_length_m", "field_width_m"}
    assert abs(built.dimensions["field_length_m"] / (9.0 * share) - 1.0) < 0.005  # 0.002 at 0.92
    assert "the field length is" in built.words()[0] and "other dimensions?" in built.words()[0]


@pytest.mark.parametrize(
    "name, length_m", [("field_width_m", 5.8), ("center_circle_radius_m", 0.55), ("penalty_area_depth_m", 1.1)]
)
def test_one_other_dimension_is_named(name: str, length_m: float) -> None:
    built = told(ssl_field("B", **{name: length_m}))
    assert built.is_other and abs(built.dimensions[name] / length_m - 1.0) < 0.01  # 0.002


def test_a_target_without_dimensions_has_lines_only() -> None:
    asked = custom(FIELD.points, FIELD.curves)
    built = told(moved({"HalfwayLine": (0.05, 0.0)}), asked)
    assert built.aside_m.keys() == {"HalfwayLine"} and not built.dimensions


# ---- through photographs --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shot(plain_shot: script.Shot) -> script.Shot:
    return plain_shot


@pytest.fixture(scope="module")
def path(shot: script.Shot, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("built") / "shot.png"
    cv2.imwrite(str(path), shot.picture.image)
    return path


def test_what_is_left_out_and_a_start_that_is_kept(shot: script.Shot, path: Path) -> None:
    height, width = shot.grey.shape
    left_out = np.zeros((height, width), dtype=bool)
    left_out[:, : width // 4] = True
    pixels = shot.camera.project([shot.target.points[name] for name in script.CORNERS])
    exact = Clicks({name: (float(x), float(y)) for name, (x, y) in zip(script.CORNERS, pixels, strict=True)})
    options = FieldOptions(left_out=left_out, keep_start=True)
    found = detect_field([path], FIELD, exact, options=options)
    assert found.observations.curves.pixels[:, 0].min() > width // 4 - 2.0
    plane = filled(shot.grey, left_out)
    assert np.array_equal(plane[~left_out], shot.grey[~left_out])
    assert np.std(np.diff(plane[:, : width // 4 - 20], axis=1)) < 0.5 * np.std(np.diff(shot.grey, axis=1))


def test_a_moved_camera_smears_lines_across_its_way_alone(shot: script.Shot) -> None:
    smear = np.full((1, 9), 1.0 / 9.0, np.float32)
    grey = np.asarray(cv2.filter2D(shot.grey, -1, smear), dtype=np.float32)
    course = predict(FIELD, shot.camera, ["LeftGoalLine", "HalfwayLine", "TopTouchLine", "BottomTouchLine"], 8.0, 12.0)
    lines = measure(grey, course, 3.0)
    assert np.mean(lines.found) > 0.5  # 0.54: what is 9 px wide is left out where other paint is near
    errors = script.distances_px(shot, course.curve[lines.found], lines.pixels[lines.found])
    assert abs(np.mean(errors)) < 0.1 and lines.blur_px > 1.2


def test_strokes_are_of_thin_lines_in_sun_and_of_dashes() -> None:
    rng = np.random.default_rng(1)
    grey = rng.normal(60.0, 1.0, (400, 600))
    for x in range(20, 600, 80):  # stripes of sun, noisy
        stripe = grey[:, x : x + 24]
        stripe += 90.0 + rng.normal(0.0, 12.0, stripe.shape)
    line = np.zeros((400, 600), np.float32)
    line[99:101, 20:580] = 1.0
    dashed = (np.arange(580 - 20) % 28) < 20
    line[299:301, 20:580] = dashed
    picture = (grey + 40.0 * cv2.GaussianBlur(line, (0, 0), 0.8)).astype(np.float32)
    strokes = find_strokes(picture)
    middles, length = strokes.ends.mean(axis=1), strokes.length_px
    solid, dashes = (length[np.abs(middles[:, 1] - y) < 2.0].sum() for y in (99.5, 299.5))
    assert solid > 300.0 and dashes > 200.0
    assert solid + dashes > 0.7 * length.sum()


def test_worn_lines_are_covered_by_their_dashes() -> None:
    course = predict(FIELD, CAMERA, FIELD.curve_names, 2.0)
    way = 7.0 * np.column_stack([course.normals[:, 1], -course.normals[:, 0]])
    middles = np.arange(6, len(course), 13)  # dashes of 14 px, 12 px apart
    ends = np.stack([course.pixels[middles] - way[middles], course.pixels[middles] + way[middles]], axis=1)
    strokes = Strokes(ends, np.ones(len(ends)))
    near = nearness_to(drawn(strokes, CAMERA.image_size))
    shown = StrokeMap(strokes, near, CAMERA.image_size, 0.5 * (np.array(CAMERA.image_size) - 1.0))
    outer = ("TopTouchLine", "BottomTouchLine", "LeftGoalLine", "RightGoalLine")
    likelihoods = [  # of the field, and of another one that shares its outer lines and has half as much elsewhere
        float(shown.likelihood(2.0 * np.array(near.at(*one.pixels.T).sum()), np.array(times * 2.0 * len(one))))
        for one, times in ((course, 1.0), (predict(FIELD, CAMERA, outer, 2.0), 1.5))
    ]
    assert likelihoods[0] > 1.5 * likelihoods[1]  # 0.82 and 0.28; with the length of the dashes alone 0.42 and 0.47


def test_wide_lines_are_one_stroke_each_and_a_picture_border_is_none() -> None:
    grey = np.full((300, 400), 30.0, np.float32)
    grey[:, 196:206] = 200.0  # 10 px wide
    grey[:, 300:302] = 200.0
    grey[:2] = 120.0
    strokes = find_strokes(np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), np.float32))
    middles, length = strokes.ends.mean(axis=1), strokes.length_px
    wide, thin = (np.abs(middles[:, 0] - x) < 1.0 for x in (200.5, 300.5))
    assert np.all(wide | thin)
    assert all(200.0 < length[some].sum() < 310.0 for some in (wide, thin))


def test_a_part_that_a_field_may_lack_is_said_to_be_missing() -> None:
    shot = taken("plain", 0, ssl_field("B", center_circle=False))
    followed = search(light(shot.image), FIELD, FIELD.curve_names, AUTO).followed
    assert followed is not None and followed.lacking == ("CenterCircle",)
    away = followed.camera.locate(shot.camera.project(FIELD.point_array)) - FIELD.point_array[:, :2]
    assert np.max(np.linalg.norm(away, axis=1)) < 0.05


@pytest.mark.thorough
def test_auto_takes_no_other_target(path: Path) -> None:
    with pytest.raises(
        NothingShownError, match=rf"no field in any of 1 images; {path}: .*(corners|dimensions|it shows ssl-b)"
    ):
        detect_field([path], ssl_field("A"), Auto())
