"""Fields and courts from data files: shapes compared with the rules, symmetry, and dimensions that may be changed."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from photos.templates import take_field
from scenery import field_scene, overhead_pose
from scenes import camera

from ceres_cal import InputError, Observations, calibrate, painted_field, ssl_field, tape_grid
from ceres_cal.base.frozen import replace
from ceres_cal.cli import main
from ceres_cal.detect.courses import predict
from ceres_cal.detect.photographs.refit import best_fit, observations_of
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import Arc, Segment, curve_points, distance_to_curve
from ceres_cal.scene.lens import Brown
from ceres_cal.scene.symmetry import counterparts, turns_of
from ceres_cal.scene.targets import Target, target_from_spec, targets_by_name
from ceres_cal.scene.targets.painted_fields import templates
from ceres_cal.simulate import Disturbance, Station, simulate

EVERY = {**targets_by_name(), "tape-grid": tape_grid(5, 4, 0.5, 0.02)}
each = pytest.mark.parametrize("name", EVERY)
FREE_ENDS = ("Mark", "CenterLine", "NoCharge", "Cut", "Halfway")
"""Curves that end without a line: marks, overhanging lines, and lines that end at unpainted walls."""


@each
def test_it_is_closed_under_its_symmetry(name: str) -> None:
    target = EVERY[name]
    if name == "tape-grid":
        assert len(turns_of(target, target.curve_names)) == 2
        return
    for image in ((-1.0, 1.0, 1.0), (1.0, -1.0, 1.0), (-1.0, -1.0, 1.0)):
        points, curves, _ = counterparts(target, np.array(image))
        assert np.all(points >= 0) and np.all(curves >= 0)
    assert len(turns_of(target, target.curve_names)) == 2  # symmetric under rotation by 180 degrees: see --facing


@each
def test_line_ends_meet_other_lines(name: str) -> None:
    target = EVERY[name]
    for line, curve in target.curves.items():
        if any(part in line for part in FREE_ENDS) or curve.length_m == pytest.approx(2 * np.pi * _radius(curve)):
            continue
        for end in curve_points(curve, 0, 1):
            away = [distance_to_curve(other, end[None])[0] for key, other in target.curves.items() if key != line]
            assert min(away) < 1e-6 or name.startswith("vss"), (line, end)  # its walls are not painted


def _radius(curve: Segment | Arc) -> float:
    return curve.radius_m if isinstance(curve, Arc) else 0.0


@each
def test_files_give_it_back(name: str) -> None:
    target = EVERY[name]
    assert target_from_spec(json.loads(json.dumps(target.spec)), "here") == target


def test_sources_and_measures_are_named() -> None:
    assert {"vss-field", "spl-field", "humanoid-field", "football-field", "basketball-court", "tennis-court"} < set(
        templates()
    )
    assert all(one.source and one.measured for one in templates().values())


@pytest.mark.parametrize(
    "kind, variant, curve, side, from_the_rules",
    [  # an edge or a middle, and its |x| or |y| according to the rules
        ("football-field", None, "LeftGoalLine", 1, {"x": 52.5}),
        ("football-field", None, "LeftPenaltyArea", -1, {"x": 36.0}),
        ("football-field", None, "TopLeftPenaltyAreaSide", 1, {"y": 20.16}),
        ("basketball-court", None, "TopSideLine", -1, {"y": 7.5}),
        ("basketball-court", None, "LeftFreeThrowLine", -1, {"x": 8.2}),
        ("basketball-court", None, "TopLeftThreePointLine", 1, {"y": 6.6}),
        ("basketball-court", None, "TopLeftLane", 1, {"y": 2.45}),
        ("tennis-court", None, "TopSinglesLine", 1, {"y": 13.5 * 0.3048}),
        ("tennis-court", None, "LeftBaseline", 1, {"x": 39 * 0.3048}),
        ("tennis-court", None, "LeftServiceLine", 1, {"x": 21 * 0.3048}),
        ("humanoid-field", "adult", "TopTouchLine", 1, {"y": 4.5}),
        ("spl-field", None, "LeftPenaltyArea", 0, {"x": 2.85}),  # xPosOpponentPenaltyArea of B-Human's field
        ("vss-field", "5v5", "LeftPenaltyArea", 0, {"x": 0.75}),
    ],
)
def test_edges_lie_where_the_rules_say(
    kind: str, variant: str | None, curve: str, side: int, from_the_rules: dict[str, float]
) -> None:
    there = np.abs(curve_points(painted_field(kind, variant).curves[curve], side, 1))
    for axis, value in from_the_rules.items():
        assert there[:, "xy".index(axis)] == pytest.approx(value, abs=1e-9)


def test_arcs_lie_where_the_rules_say() -> None:
    football, court = painted_field("football-field").curves, painted_field("basketball-court").curves
    penalty = curve_points(football["LeftPenaltyArc"], -1, 8)  # its outer edge, from the penalty mark
    assert np.hypot(penalty[:, 0] + 41.5, penalty[:, 1]) == pytest.approx(9.15)
    three = curve_points(court["RightThreePointArc"], -1, 8)
    assert np.hypot(three[:, 0] - 12.425, three[:, 1]) == pytest.approx(6.75)
    no_charge = curve_points(court["LeftNoChargeArc"], 1, 8)  # its inner edge
    assert np.hypot(no_charge[:, 0] + 12.425, no_charge[:, 1]) == pytest.approx(1.25)
    area = curve_points(painted_field("vss-field", "3v3").curves["LeftAreaArc"], 0, 2)
    assert area[:, 0] == pytest.approx([-0.6, -0.55, -0.6]) and np.ptp(area[:, 1]) == pytest.approx(0.2)


def test_parts_are_switched_and_dimensions_replaced() -> None:
    field = painted_field("vss-field", "3v3", center_circle=False, touch_lines=True, field_length_m=1.6)
    assert "CenterCircle" not in field.curves and "TopTouchLine" in field.curves
    assert field.spec == {
        **{"kind": "vss-field", "size": "3v3", "center_circle": False, "touch_lines": True},
        "field_length_m": 1.6,
    }
    assert field.mistaken_for == {
        "a 5v5 field": {"kind": "vss-field", "size": "5v5", "center_circle": False, "touch_lines": True}
    }
    plain = ssl_field("B", center_circle=False, center_line=False)
    assert set(ssl_field("B").curves) - set(plain.curves) == {"CenterCircle", "CenterLine"}
    assert "TopCircleCrossing" not in plain.points and "LeftGoalCenterCrossing" not in plain.points
    singles = painted_field("tennis-court", doubles=False)
    assert singles.box == pytest.approx(np.array([[-39, -13.5], [39, 13.5]]) * 0.3048, abs=0.06)


@given(st.sampled_from(sorted(templates())), st.data())
def test_a_dimension_moves_features_in_proportion(kind: str, data: st.DataObject) -> None:
    """The basis of `dimension_slopes`: any dimension may be slightly larger, and features keep their names."""
    target = next(target for target in EVERY.values() if target.kind == kind)
    name = data.draw(st.sampled_from(sorted(target.dimensions)))
    other = target_from_spec({**target.spec, name: 1.001 * target.dimensions[name]}, "here")
    assert other.curve_names == target.curve_names and other.point_names == target.point_names
    moved = np.max(np.abs(other.point_array - target.point_array), initial=0.0)
    assert moved <= 0.006 * target.dimensions[name] + 1e-12  # 0.0047: where lines meet the three-point arc


@pytest.mark.parametrize(
    "spec, message",
    [
        ({"kind": "vss-field"}, "vss-field: field_length_m is missing: name a size or give every dimension"),
        ({"kind": "vss-field", "size": "9v9"}, "unknown size '9v9': 3v3 or 5v5"),
        ({"kind": "vss-field", "size": "3v3", "circle": True}, "dimension 'circle': did you mean 'center_circle'"),
        ({"kind": "vss-field", "size": "3v3", "length": 2.0}, "dimension 'length': did you mean 'field_length_m'"),
        ({"kind": "vss-field", "size": "3v3", "marks": 1.0}, "marks: Expected true or false, got a number"),
        ({"kind": "basketball-court", "three_point_radius_m": 1.0}, "its lines do not meet"),
        ({"kind": "tape-grid", "columns": 1, "rows": 4, "pitch_m": 1.0, "line_thickness_m": 0.1}, "at least 2"),
        ({"kind": "tape-grid", "columns": 2, "rows": 4, "pitch_m": 0.1, "line_thickness_m": 0.2}, "must increase"),
    ],
)
def test_what_makes_no_field(spec: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        target_from_spec(spec, "here")


@pytest.mark.parametrize("unit, in_a_metre", [("mm", 1e3), ("cm", 1e2), ("km", 1e-3), ("inch", 39.37), ("ft", 3.281)])
def test_dimensions_in_another_unit_are_refused(unit: str, in_a_metre: float) -> None:
    spec = {"kind": "ssl-field", "field_length_m": 9.0 * in_a_metre, "field_width_m": 6.0 * in_a_metre}
    with pytest.raises(InputError, match=f"its dimensions are in {unit}, it seems: give them in metres"):
        target_from_spec({**spec, "division": "B"}, "here")


def test_a_court_is_calibrated_over(tmp_path: Path) -> None:
    """From observations of a template to a camera, through files and the command line."""
    court = painted_field("vss-field", "3v3")
    stations = {"overhead": Station("overhead", overhead_pose(0.05, -0.03, 1.6, tilt_x_deg=7.0, tilt_y_deg=-5.0))}
    scene = field_scene(court, {"overhead": camera("radial-2-3")}, stations, frames=2, spacing_m=0.03)
    simulate(scene, Disturbance(points_sigma_px=0.2, curves_sigma_px=0.2), seed=1).observations.save(
        tmp_path / "o.json"
    )
    assert main(["calibrate", str(tmp_path / "o.json"), "-o", str(tmp_path / "c.json"), "--quiet"]) == 0
    observations = Observations.load(tmp_path / "o.json")
    assert list(observations.targets.values()) == [court]
    assert calibrate(observations).station().position[2] == pytest.approx(1.6, abs=0.02)


def test_it_is_drawn_and_spelled_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "vss.svg"
    spelled = json.dumps({"kind": "vss-field", "size": "3v3", "center_circle": False})
    assert main(["targets", spelled, "--picture", str(picture)]) == 0
    said, drawn = capsys.readouterr().out, picture.read_text()
    assert "LeftGoalArea*LeftAreaArc#1" in said and "CenterCircle" not in said
    assert "LeftGoalArea" in drawn and "TopLeftCorner" in drawn and len(drawn) < 100_000
    assert main(["targets", "vss-3", "--picture", str(tmp_path / "vss.png")]) == 2
    assert main(["targets", "vss-field", "--picture", str(picture)]) == 2  # two of them
    assert main(["targets", "--picture", str(picture)]) == 2
    assert main(["targets", "checkerboard", "--picture", str(picture)]) == 2


def test_a_photograph_of_another_league(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Without an initial camera; where the symmetry is not resolved, the detected lines are drawn."""
    shot = take_field("vss-3", EVERY["vss-3"], 2)
    path, refused, out = (str(tmp_path / name) for name in ("vss.png", "refused.png", "o.json"))
    cv2.imwrite(path, shot.picture.image)
    command = ["detect", "field", path, "--target", "vss-3", "--auto", "--points", "-o", out, "--picture", refused]
    assert main(command) == 2
    assert "2 orientations look the same: LeftGoalLine lies towards" in capsys.readouterr().err
    assert cv2.imread(refused) is not None
    assert main([*command, "--facing", f"LeftGoalLine={_towards(shot.camera)}"]) == 0
    observations = Observations.load(out)
    truth = shot.camera.project(shot.target.point_array[observations.points.feature])
    assert np.max(np.linalg.norm(observations.points.pixels - truth, axis=1)) < 0.5  # 0.11 px
    assert len(truth) >= 4


@pytest.mark.thorough
def test_a_real_photograph_that_was_stretched(
    real_data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its field is painted by hand, and its pixels are higher than wide."""
    path, out = str(real_data / "vss_overhead_robocin" / "test_frame.png"), str(tmp_path / "o.json")
    command = ["detect", "field", path, "--target", "vss-3", "--auto", "--facing", "LeftGoalLine=left", "-o", out]
    assert main([*command, "--points", "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert 0.945 < answer["found"][0]["aspect"] < 0.97  # 0.958; circle: 185 px high, 193 wide
    observations = Observations.load(out)
    names = [observations.targets["field"].point_names[number] for number in observations.points.feature]
    clicked = {"TopLeft": (75, 148), "TopRight": (654, 149), "BottomRight": (656, 467), "BottomLeft": (73, 470)}
    places = {f"{which}GoalAreaCorner": place for which, place in clicked.items()}
    away = [
        np.linalg.norm(pixel - places[name])
        for name, pixel in zip(names, observations.points.pixels, strict=True)
        if name in places
    ]
    assert len(away) >= 2 and max(away) < 5.0  # 2 or 3 of them, with rounding, 1.3 px away


def test_a_court_that_is_a_millimetre_off_is_no_stretched_picture() -> None:
    """Seen from a stand: with square pixels some lens fits its lines to 0.06 px, as well as with other pixels."""
    lens, pose = Brown((-0.2, 0.06, 2e-4, -3e-4, 0.0)), overhead_pose(0.5, -22.0, 12.0, -60.0)
    seen = Camera((960, 540), 790.0, (483.0, 266.0), lens, 1.0, pose)
    painted = painted_field("tennis-court", court_length_m=23.77, doubles_width_m=10.97, singles_width_m=8.23)
    course = predict(painted, seen, painted.curve_names, 24.0, 12.0)
    pixels = course.pixels + np.random.default_rng(1).normal(0.0, 0.05, (len(course), 1)) * course.normals
    asked, sigma_px = painted_field("tennis-court"), np.full(len(course), 0.05)
    observed = observations_of(asked, seen.image_size, course.curve, pixels, sigma_px)
    found = best_fit(replace(seen, aspect=0.93), observed)
    assert found is not None
    assert found.station().aspect == 1.0
    assert found.station().phi == pytest.approx(790.0, rel=0.005)  # 0.1 % off; 1.5 % with other pixels


def _towards(seen: Camera) -> str:
    left, right = seen.project([[-0.7, 0.0, 0.0], [0.7, 0.0, 0.0]])
    return "left" if left[0] < right[0] else "right"


def test_boxes_end_where_arcs_do() -> None:
    court: Target = painted_field("basketball-court")
    assert court.box == pytest.approx(np.array([[-14.025, -7.675], [14.025, 7.675]]))
