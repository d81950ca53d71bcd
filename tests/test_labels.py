"""Features that have the name of another one are named, and renamed."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenery import field_scene, overhead_pose
from test_cli import Say, say

from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics.diagnosis import diagnose
from ceres_cal.diagnostics.labels import mended, renamings
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Options
from ceres_cal.report.grounds import judge_quality
from ceres_cal.report.quality import quality_of
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Disturbance, Station, simulate

__all__ = ["say"]

CAMERA = Camera((1280, 960), 700.0, (639.5, 479.5), Radial((-5e-5, 6e-7)))


@pytest.fixture(scope="module")
def right() -> Observations:
    station = Station("c", overhead_pose(0.3, -0.2, 4.5, 6.0, -9.0))
    scene = field_scene(ssl_field("B"), {"c": CAMERA}, {"c": station}, spacing_m=0.3)
    return simulate(scene, Disturbance(0.3, 0.3), 1).observations


def renamed(observations: Observations, kind: str, names: dict[str, str]) -> Observations:
    columns = getattr(observations, f"{kind}s")
    index = getattr(observations.targets["field"], f"{kind}_index")
    feature = columns.feature.copy()
    for name, other in names.items():
        feature[columns.feature == index[name]] = index[other]
    return replace(observations, **{f"{kind}s": replace(columns, feature=feature)})


@pytest.mark.parametrize(
    "kind, first, second",
    [
        ("curve", "HalfwayLine", "CenterLine"),
        pytest.param("curve", "BottomTouchLine", "RightGoalLine", marks=pytest.mark.thorough),
        ("point", "CenterMark", "TopRightCorner"),
        ("curve", "LeftFieldRightPenaltyStretch", "RightFieldLeftPenaltyStretch"),  # on one line
        ("curve", "LeftFieldLeftPenaltyStretch", "RightFieldLeftPenaltyStretch"),  # each taken out as a whole
    ],
)
def test_exchanged_names_are_found_and_mended(right: Observations, kind: str, first: str, second: str) -> None:
    wrong = renamed(right, kind, {first: second, second: first})
    found = tuple(renamings(wrong, calibrate(wrong, Options(lens="radial"))))
    seen = set(getattr(wrong, f"{kind}s").feature.tolist())
    index = getattr(wrong.targets["field"], f"{kind}_index")
    exchanged = {(index[a], index[b]) for a, b in ((first, second), (second, first)) if index[a] in seen}
    assert exchanged and {(one.feature, one.instead) for one in found} == exchanged
    assert {one.is_curve for one in found} == {kind == "curve"}
    again = mended(wrong, found)
    assert np.array_equal(again.points.feature, right.points.feature)
    assert np.array_equal(again.curves.feature, right.curves.feature)


def test_a_circle_of_another_radius_is_no_wrong_label() -> None:
    """It was rejected as a whole; two of its six rows, where it crosses a line, were attributed to that line."""
    drawn, station = ssl_field("B"), Station("c", overhead_pose(0.3, -0.2, 4.5, 6.0, -9.0))
    painted = ssl_field("B", center_circle_radius_m=0.55)
    scene = field_scene(painted, {"c": CAMERA}, {"c": station}, spacing_m=0.55)
    seen = replace(simulate(scene, Disturbance(0.3, 0.3), 1).observations, targets={"field": drawn})
    calibration = calibrate(seen, Options(lens="radial"))
    assert not calibration.inlier_masks(seen)[1][seen.curves.feature == drawn.curve_index["CenterCircle"]].any()
    assert not diagnose(calibration, seen).findings


def test_right_names_stay(right: Observations) -> None:
    assert not list(renamings(right, calibrate(right, Options(lens="radial"))))


def test_the_command_says_it_without_another_verdict_than_python(right: Observations, say: Say, tmp_path: Path) -> None:
    wrong = renamed(right, "point", {"CenterMark": "TopRightCorner", "TopRightCorner": "CenterMark"})
    wrong.save(tmp_path / "wrong.json")
    said = json.loads(say("calibrate", tmp_path / "wrong.json", "--json").out)
    python = judge_quality(quality_of(calibrate(wrong), wrong))
    assert (said["verdict"]["level"], said["verdict"]["headline"]) == (python.level, python.headline)
    told = "point 'CenterMark' is seen where 'TopRightCorner' lies: taken out; --mend-labels corrects the name"
    assert any(told in one for one in said["calibration"]["remarks"])
