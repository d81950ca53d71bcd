"""Targets: dimensions according to the rules, features at their named places, and specs with exact round trips."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.scene.curves import along_track, nearest_on_track
from ceres_cal.scene.targets import (
    SIDES,
    TARGET_KINDS,
    Arc,
    Curve,
    Segment,
    Target,
    checkerboard,
    custom,
    rings,
    ssl_field,
    target_from_spec,
)

quick = settings(deadline=None, max_examples=40)

CUSTOM = custom(
    {"pole_top": (1.0, 2.0, 1.0)},
    {
        "edge": Segment((0.0, 0.0, 0.0), (4.0, 0.0, 0.0), 0.01),
        "quarter": Arc((1.0, 1.0, 0.0), 0.5, 0.0, np.pi / 2, 0.02),
    },
)
TARGETS = [
    ssl_field("A"),
    ssl_field("B"),
    ssl_field("B", field_length_m=8.99, line_thickness_m=0.012),
    checkerboard(9, 6, 0.025),
    rings([0.01, 0.02, 0.04]),
    CUSTOM,
]


def on(curve: Curve, s: Array, side: int = 0) -> Array:
    return along_track(curve.track(side), isinstance(curve, Arc), s)


def distance(curve: Curve, point: tuple[float, float, float]) -> float:
    """Distance of a point from the nearest place between a curve's ends, m."""
    s = nearest_on_track(curve.track()[None], np.array([isinstance(curve, Arc)]), np.array([point]))
    first, last = curve.parameter_range
    s = first + (s - first) % (2.0 * np.pi) if isinstance(curve, Arc) else np.clip(s, first, last)
    return float(np.linalg.norm(on(curve, s)[0] - point))


# ---- the small-size league's field ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "division, length, width, area_depth, area_width, mark",
    [("A", 12.0, 9.0, 1.8, 3.6, 8.0), ("B", 9.0, 6.0, 1.0, 2.0, 6.0)],
)
def test_dimensions_of_the_divisions(
    division: str, length: float, width: float, area_depth: float, area_width: float, mark: float
) -> None:
    field = ssl_field(division)
    lengths = {name: curve.length_m for name, curve in field.curves.items()}
    for line in ("TopTouchLine", "BottomTouchLine", "CenterLine"):
        assert lengths[line] == length
    for line in ("LeftGoalLine", "RightGoalLine", "HalfwayLine"):
        assert lengths[line] == width
    for line in ("LeftPenaltyStretch", "RightPenaltyStretch"):
        assert lengths[line] == pytest.approx(area_width, rel=1e-15)
    for half in ("LeftField", "RightField"):
        for side in ("LeftPenaltyStretch", "RightPenaltyStretch"):
            assert lengths[half + side] == pytest.approx(area_depth, rel=1e-15)
    assert lengths["CenterCircle"] == pytest.approx(2.0 * np.pi * 0.5, rel=1e-15)
    assert len(lengths) == 13
    assert all(curve.width_m == 0.01 for curve in field.curves.values())
    assert np.array_equal(field.points["RightPenaltyMark"], (mark - length / 2.0, 0.0, 0.0))  # from the other goal


CROSSINGS = {
    "TopLeftCorner": ("TopTouchLine", "LeftGoalLine"),
    "TopRightCorner": ("TopTouchLine", "RightGoalLine"),
    "BottomLeftCorner": ("BottomTouchLine", "LeftGoalLine"),
    "BottomRightCorner": ("BottomTouchLine", "RightGoalLine"),
    "TopHalfwayCrossing": ("TopTouchLine", "HalfwayLine"),
    "BottomHalfwayCrossing": ("BottomTouchLine", "HalfwayLine"),
    "CenterMark": ("CenterLine", "HalfwayLine"),
    "TopCircleCrossing": ("CenterCircle", "HalfwayLine"),
    "BottomCircleCrossing": ("CenterCircle", "HalfwayLine"),
    "LeftCircleCrossing": ("CenterCircle", "CenterLine"),
    "RightCircleCrossing": ("CenterCircle", "CenterLine"),
    "LeftGoalCenterCrossing": ("LeftGoalLine", "CenterLine"),
    "RightGoalCenterCrossing": ("RightGoalLine", "CenterLine"),
    "LeftPenaltyCenterCrossing": ("LeftPenaltyStretch", "CenterLine"),
    "RightPenaltyCenterCrossing": ("RightPenaltyStretch", "CenterLine"),
    **{
        f"{half}{side}PenaltyCorner": (f"{half}{side}PenaltyStretch", f"{half.removesuffix('Field')}PenaltyStretch")
        for half in ("LeftField", "RightField")
        for side in ("Left", "Right")
    },
    **{
        f"{half}{side}PenaltyGoalCrossing": (f"{half}{side}PenaltyStretch", f"{half.removesuffix('Field')}GoalLine")
        for half in ("LeftField", "RightField")
        for side in ("Left", "Right")
    },
}


@pytest.mark.parametrize("field", [t for t in TARGETS if t.kind == "ssl-field"], ids=("A", "B", "as built"))
def test_points_lie_where_the_lines_of_their_names_cross(field: Target) -> None:
    # The marks are dots of their own on the centre line.
    assert field.points.keys() == {*CROSSINGS, "LeftPenaltyMark", "RightPenaltyMark"}
    crossings = CROSSINGS | dict.fromkeys(("LeftPenaltyMark", "RightPenaltyMark"), ("CenterLine",))
    for point, curves in crossings.items():
        for curve in curves:
            assert distance(field.curves[curve], field.points[point]) < 3e-15, (point, curve)  # m; measured 9e-16
        x, y, _ = field.points[point]
        for word, holds in (("Left", x < 0.0), ("Right", x > 0.0), ("Top", y > 0.0), ("Bottom", y < 0.0)):
            assert holds or not point.startswith(word), point


def test_sides_of_the_penalty_areas_are_those_of_the_leagues_vision() -> None:
    # Some simulators exchange left and right.
    field = ssl_field("B")
    ys = {name: curve.track()[0, 1] for name, curve in field.curves.items() if name.count("Field")}
    assert ys == {
        "LeftFieldLeftPenaltyStretch": -1.0,
        "LeftFieldRightPenaltyStretch": 1.0,
        "RightFieldRightPenaltyStretch": -1.0,
        "RightFieldLeftPenaltyStretch": 1.0,
    }


def test_given_dimensions_replace_the_divisions() -> None:
    field = ssl_field("B", field_length_m=10)
    assert field.points["TopRightCorner"] == (5.0, 3.0, 0.0)
    assert field.spec == {"kind": "ssl-field", "division": "B", "field_length_m": 10.0}
    whole = ssl_field(
        field_length_m=9.0,
        field_width_m=6.0,
        goal_width_m=1.0,
        penalty_area_depth_m=1.0,
        penalty_area_width_m=2.0,
        goal_center_to_penalty_mark_m=6.0,
        center_circle_radius_m=0.5,
        line_thickness_m=0.01,
    )
    assert np.array_equal(whole.point_array, ssl_field("B").point_array)
    assert np.array_equal(whole.tracks, ssl_field("B").tracks)


DIMENSIONS = (
    "field_length",
    "field_width",
    "goal_width",
    "penalty_area_depth",
    "penalty_area_width",
    "goal_center_to_penalty_mark",
    "center_circle_radius",
    "line_thickness",
)


@pytest.mark.parametrize("division", ["A", "B"])
def test_dimensions_agree_with_a_vision_systems_file(division: str, real_data: Path) -> None:
    text = (real_data / "ssl_tigers_line_corners" / f"geometry-div{division}.yml").read_text(encoding="utf-8")
    field = text[text.index("\nfield:") :]
    mm = {name: float(re.search(rf"^  {name}: (\S+)", field, re.MULTILINE)[1]) for name in DIMENSIONS}  # type: ignore[index]
    theirs = ssl_field(None, **{f"{name}_m": value / 1000.0 for name, value in mm.items()})
    assert np.array_equal(theirs.point_array, ssl_field(division).point_array)
    assert np.array_equal(theirs.tracks, ssl_field(division).tracks)


# ---- curves ---------------------------------------------------------------------------------------------------------


def test_left_is_that_of_someone_walking_along() -> None:
    walked = Segment((1.0, 1.0, 0.3), (1.0, 5.0, 0.3), 0.2)  # towards +y: left is -x
    s = np.array([0.0, 0.5, 1.0])
    centre, left, right = (on(walked, s, SIDES[side]) for side in ("centre", "left", "right"))
    assert (
        np.abs(left - centre - [-0.1, 0.0, 0.0]).max() < 1e-15
        and np.abs(right - centre - [0.1, 0.0, 0.0]).max() < 1e-15
    )
    circle = Arc((2.0, 3.0, 0.0), 0.5, width_m=0.02)  # counter-clockwise: left is the inside
    s = np.linspace(0.0, 2.0 * np.pi, 9)
    for side, radius in (("centre", 0.5), ("left", 0.49), ("right", 0.51)):
        assert np.linalg.norm(on(circle, s, SIDES[side]) - circle.centre, axis=1) == pytest.approx(radius, rel=1e-15)


@quick
@given(
    st.tuples(*[st.floats(-5.0, 5.0)] * 2),
    st.floats(0.1, 5.0),
    st.floats(-np.pi, np.pi),
    st.floats(0.0, 0.05),
    st.sampled_from([-1, 0, 1]),
    st.booleans(),
)
def test_sides_lie_half_a_width_off(
    place: tuple[float, float], size: float, turn: float, width_m: float, side: int, arc: bool
) -> None:
    centre = np.array([*place, 0.0])
    ahead = np.array([np.cos(turn), np.sin(turn), 0.0])
    end = centre + size * ahead
    curve: Curve = (
        Arc((*place, 0.0), size, turn, turn + 1.0, width_m) if arc else Segment((*place, 0.0), tuple(end), width_m)
    )
    s = np.linspace(*curve.parameter_range, 7)
    middle, edge = on(curve, s), on(curve, s, side)
    step = on(curve, s + 1e-6) - middle
    to_the_left = np.cross([0.0, 0.0, 1.0], step / np.linalg.norm(step, axis=1, keepdims=True))
    off = edge - middle - 0.5 * side * width_m * to_the_left
    assert np.abs(off).max() < 1e-7  # m; the step is a chord, 1e-6 rad off on an arc: measured 1.3e-8
    begins = on(curve, s[:1])[0]
    assert np.abs(begins - (end if arc else centre)).max() < 1e-14  # m; measured 0


@quick
@given(st.tuples(*[st.floats(-3.0, 3.0)] * 3), st.floats(-3.0, 3.0), st.floats(0.05, 3.0), st.booleans())
def test_no_place_on_the_track_is_nearer(point: tuple[float, ...], turn: float, size: float, arc: bool) -> None:
    end = (1.0 + size * np.cos(turn), -0.5 + size * np.sin(turn), 0.2)
    curve: Curve = Arc((1.0, -0.5, 0.2), size) if arc else Segment((1.0, -0.5, 0.2), end)
    tracks, is_arc = curve.track()[None], np.array([arc])
    s = nearest_on_track(tracks, is_arc, np.array([point]))
    nearest = np.linalg.norm(along_track(tracks, is_arc, s)[0] - point)
    others = np.linalg.norm(on(curve, np.linspace(-4.0, 4.0, 400)) - point, axis=1)
    assert nearest <= others.min() + 1e-14
    again = nearest_on_track(tracks, is_arc, along_track(tracks, is_arc, s))
    off = along_track(tracks, is_arc, again) - along_track(tracks, is_arc, s)
    assert np.abs(off).max() < 1e-13  # m; measured 9e-16


def test_tracks_of_all_sides_and_kinds_at_once() -> None:
    for target in TARGETS:
        assert target.tracks.shape == (3, len(target.curves), 3, 3)
        assert target.point_array.shape == (len(target.points), 3)
        for name, row in zip(target.curve_names, range(len(target.curves)), strict=True):
            assert target.is_arc[row] == isinstance(target.curves[name], Arc)
            for side in SIDES.values():
                assert np.array_equal(target.tracks[side, row], target.curves[name].track(side))
    field = ssl_field("B")
    s = np.linspace(0.0, 1.0, len(field.curves))
    together = along_track(field.tracks[0], field.is_arc, s)
    one_by_one = [on(curve, s[i : i + 1])[0] for i, curve in enumerate(field.curves.values())]
    assert np.array_equal(together, one_by_one)
    assert np.abs(nearest_on_track(field.tracks[0], field.is_arc, together) - s).max() < 1e-14  # measured 2e-16


def test_an_upright_segment_has_no_sides() -> None:
    pole = Segment((1.0, 2.0, 0.0), (1.0, 2.0, 1.5), 0.05)
    assert np.array_equal(pole.track(1), pole.track(0))


# ---- boards and rings -----------------------------------------------------------------------------------------------


def test_corners_of_a_checkerboard() -> None:
    board = checkerboard(3, 2, 0.025)
    assert board.point_names == ("0,0", "1,0", "2,0", "0,1", "1,1", "2,1")
    assert board.points["2,1"] == (0.05, 0.025, 0.0) and not board.curves
    assert board.tracks.shape == (3, 0, 3, 3)


def test_rings_from_the_inside_out() -> None:
    target = rings([0.01, 0.02, 0.03])
    assert target.curve_names == ("ring_1", "ring_2", "ring_3") and target.point_names == ("centre",)
    assert [curve.track()[1, 0] for curve in target.curves.values()] == [0.01, 0.02, 0.03]


# ---- specs ----------------------------------------------------------------------------------------------------------

names = st.text(min_size=1, max_size=8)
lengths = st.floats(-100.0, 100.0)
places = st.tuples(lengths, lengths, lengths)
segments = st.builds(Segment, places, places, st.floats(0.0, 0.1)).filter(lambda s: s.length_m > 1e-6)
arcs = st.builds(
    lambda centre, radius, start, span, width: Arc(centre, radius, start, start + span, width),
    *(places, st.floats(0.1, 9.0), st.floats(-4.0, 4.0), st.floats(0.1, 6.0), st.floats(0.0, 0.1)),
)
positive, handy = st.floats(1e-3, 100.0), st.floats(1e-3, 8.0)
any_target = (
    st.builds(checkerboard, st.integers(2, 5), st.integers(2, 5), handy)
    | st.lists(handy, min_size=1, max_size=5, unique=True).map(lambda radii: rings(sorted(radii)))
    | st.builds(ssl_field, st.sampled_from("AB"), field_length_m=positive, penalty_area_width_m=positive)
    | st.builds(custom, st.dictionaries(names, places, min_size=1), st.dictionaries(names, segments | arcs))
)


def assert_same(one: Target, other: Target) -> None:
    assert one == other and one.spec == other.spec
    assert one.points == other.points and one.curves == other.curves
    assert one.point_names == other.point_names and one.curve_names == other.curve_names


@quick
@given(any_target)
def test_specs_come_back(target: Target) -> None:
    assert_same(target_from_spec(target.spec, "here"), target)
    assert_same(target_from_spec(json.loads(json.dumps(target.spec)), "here"), target)


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.kind)
def test_specs_of_the_built_in_kinds_come_back(target: Target) -> None:
    assert_same(target_from_spec(json.loads(json.dumps(target.spec)), "here"), target)
    assert target.kind in TARGET_KINDS


def test_the_designs_custom_target() -> None:
    spec = {
        "kind": "custom",
        "points": {"pole_top": [1.0, 2.0, 1.0]},
        "segments": {"edge": {"from": [0, 0, 0], "to": [4, 0, 0], "width_m": 0.01}},
        "arcs": {
            "circle": {
                "centre": [0, 0, 0],
                "radius_m": 0.5,
                "from_rad": 0,
                "to_rad": 6.283185307179586,
                "width_m": 0.01,
            }
        },
    }
    target = target_from_spec(spec, "here")
    assert target.points == {"pole_top": (1.0, 2.0, 1.0), "edge*circle": (0.5, 0.0, 0.0)}
    assert target.curves == {
        "edge": Segment((0.0, 0.0, 0.0), (4.0, 0.0, 0.0), 0.01),
        "circle": Arc((0.0, 0.0, 0.0), 0.5, 0.0, 2.0 * np.pi, 0.01),
    }


def test_numbers_of_any_kind_make_the_same_target() -> None:
    assert checkerboard(9, 6, 1) == checkerboard(np.int64(9), np.int64(6), np.float64(1.0))  # type: ignore[arg-type]
    assert json.dumps(checkerboard(9, 6, 1).spec) == json.dumps(checkerboard(9, 6, 1.0).spec)
    loose = custom(
        {"a": np.array([1, 2, 3])},  # type: ignore[dict-item]
        {"b": Segment(np.zeros(3), [1, 0, 0], 0), "c": Arc(np.zeros(3), np.float64(1.0))},  # type: ignore[arg-type]
    )
    assert_same(target_from_spec(json.loads(json.dumps(loose.spec)), "here"), loose)


def test_the_order_of_features_counts() -> None:
    # Observations use the numbers of features: two orders are two targets.
    one, other = (
        custom({"a": (0.0, 0.0, 0.0), "b": (1.0, 0.0, 0.0)}),
        custom({"b": (1.0, 0.0, 0.0), "a": (0.0, 0.0, 0.0)}),
    )
    assert one.spec == other.spec and one != other


WIDE_ARC = {"centre": [0, 0, 0], "radius_m": 0.1, "width_m": 0.2}
BAD_SPECS: list[tuple[Any, str]] = [
    (
        None,
        "unknown kind None: choose one of ssl-field, .*tape-grid, checkerboard, .*, markers, rings, custom",
    ),
    ([1, 2], "unknown kind None"),
    ({"kind": "ssl"}, "unknown kind 'ssl'"),
    ({"kind": ["ssl-field"]}, r"unknown kind \['ssl-field'\]"),
    ({"kind": "ssl-field"}, "field_length_m is missing: name a division or give every dimension"),
    ({"kind": "ssl-field", "division": "C"}, "unknown division 'C': A or B"),
    ({"kind": "ssl-field", "division": 1}, "division: Expected a text or nothing, got a whole number"),
    (
        {"kind": "ssl-field", "division": "A", "field_length": 9.0},
        "unknown dimension 'field_length': did you mean 'field_length_m'",
    ),
    ({"kind": "ssl-field", "division": "A", "field_length_m": "9"}, "field_length_m: Expected a number, got a text"),
    (
        {"kind": "ssl-field", "division": "A", "field_length_m": -9},
        "field_length_m must be a positive number of metres",
    ),
    ({"kind": "ssl-field", "division": "A", "field_length_m": np.nan}, "field_length_m must be a positive number"),
    ({"kind": "checkerboard", "columns": 9, "rows": 6}, "'square_m' is missing"),
    (
        {"kind": "checkerboard", "columns": 9, "rows": 1, "square_m": 0.1},
        "count inner corners, at least 2, not 9 and 1",
    ),
    (
        {"kind": "checkerboard", "columns": 9.5, "rows": 6, "square_m": 0.1},
        "Expected a whole number, got a number, in columns",
    ),
    (
        {"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 0.0},
        "square_m must be a positive number of metres",
    ),
    ({"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 0.1, "square": 1}, "there is no field 'square'"),
    ({"kind": "rings", "radii_m": []}, "radii_m must increase and be positive"),
    ({"kind": "rings", "radii_m": [0.1, 0.1]}, "radii_m must increase and be positive"),
    ({"kind": "rings", "radii_m": [0.1, np.inf]}, "radii_m must increase and be positive"),
    ({"kind": "rings", "radii_m": [0.1, "b"]}, "Expected a number, got a text, in radii_m\\[1\\]"),
    ({"kind": "custom"}, "give at least one point, segment or arc"),
    ({"kind": "custom", "points": {"a": [0, 0]}}, "Expected a list of length 3"),
    ({"kind": "custom", "points": {"a": [0, 0, np.nan]}}, "point 'a' must have three finite numbers"),
    ({"kind": "custom", "segments": {"e": {"from": [0, 0, 0], "to": [0, 0, 0]}}}, "curve 'e' needs .* a length"),
    (
        {"kind": "custom", "segments": {"e": {"from": [0, 0, 0], "to": [np.inf, 0, 0]}}},
        "curve 'e' needs finite numbers",
    ),
    ({"kind": "custom", "segments": {"e": {"from": [0, 0, 0]}}}, "'to' is missing"),
    ({"kind": "custom", "segments": {"e": {"from": [0, 0, 0], "to": [1, 0, 0], "width_m": -1}}}, "a width_m from 0 on"),
    ({"kind": "custom", "arcs": {"c": {"centre": [0, 0, 0], "radius_m": -0.1}}}, "curve 'c' needs .* a length"),
    ({"kind": "custom", "arcs": {"c": {"centre": [0, 0, 0], "radius_m": 1, "from_rad": 2, "to_rad": 1}}}, "a length"),
    ({"kind": "custom", "arcs": {"c": WIDE_ARC}}, "arc 'c' must have a radius of more than half its width"),
    (
        {"kind": "custom", "arcs": {"e": WIDE_ARC}, "segments": {"e": {"from": [0, 0, 0], "to": [1, 0, 0]}}},
        "two curves are named 'e'",
    ),
    ({"kind": "custom", "lines": {}}, "there is no field 'lines'"),
    ({"kind": "custom", "points": {"a": [0, 0, 1e7]}}, "point 'a' must have three finite numbers of metres"),
    ({"kind": "custom", "segments": {"e": {"from": [0, 0, 0], "to": [1e300, 0, 0]}}}, "curve 'e' needs finite numbers"),
    ({"kind": "custom", "arcs": {"c": {"centre": [0, 0, 0], "radius_m": 1, "to_rad": 1e6}}}, "more than once round"),
    ({"kind": "rings", "radii_m": [0.1, 1e300]}, "curve 'ring_2' needs finite numbers"),
    (
        {"kind": "checkerboard", "columns": 9, "rows": 6, "square_m": 1e300},
        "point '1,0' must have three finite numbers",
    ),
    ({"kind": "ssl-field", "division": "B", "field_length_m": 1e300}, "field_length_m must be a positive number"),
]


@pytest.mark.parametrize("number", ["x", None, [1.0], (0.0, 1.0)])
def test_a_curve_of_no_numbers_is_named(number: Any) -> None:
    with pytest.raises(InputError, match=r"Segment\(end=\.\.\.\) must be "):
        Segment((0.0, 0.0, 0.0), number)
    with pytest.raises(InputError, match=r"Arc\(radius_m=\.\.\.\): .* is not a number"):
        Arc((0.0, 0.0, 0.0), number)


def test_a_target_of_nan_is_refused_however_it_is_made() -> None:
    """Also from Python: a NaN in a line would make every number of the calibration NaN."""
    line = Segment((0.0, 0.0, 0.0), (np.nan, 0.0, 0.0))
    with pytest.raises(InputError, match="custom: curve 'e' needs finite numbers"):
        Target({"kind": "custom"}, {}, {"e": line})


@pytest.mark.parametrize("spec, message", BAD_SPECS)
def test_bad_specs_get_one_line(spec: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as raised:
        target_from_spec(spec, "obs.json: target 'field'")
    text = str(raised.value)
    assert text.startswith("obs.json: target 'field'") and text.count("obs.json") == 1 and "\n" not in text


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: ssl_field("Z"), "ssl-field: unknown division 'Z'"),
        (lambda: ssl_field("A", width_m=1.0), "ssl-field: unknown dimension 'width_m'"),
        (lambda: custom({}, {}), "custom target: give at least one point"),
    ],
)
def test_what_is_no_target_is_refused(make: Callable[[], Target], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()
