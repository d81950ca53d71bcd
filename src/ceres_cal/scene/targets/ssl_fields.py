"""Fields of the RoboCup small-size league: dimensions by division, and features under the league's names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import convert
from ceres_cal.scene.curves import Arc, Curve, Segment
from ceres_cal.scene.targets.target import Target, TargetKind

_DIVISIONS: dict[str, dict[str, float]] = {
    "A": {
        "field_length_m": 12.0,
        "field_width_m": 9.0,
        "goal_width_m": 1.8,
        "penalty_area_depth_m": 1.8,
        "penalty_area_width_m": 3.6,
        "goal_center_to_penalty_mark_m": 8.0,
        "center_circle_radius_m": 0.5,
        "line_thickness_m": 0.01,
    },
    "B": {
        "field_length_m": 9.0,
        "field_width_m": 6.0,
        "goal_width_m": 1.0,
        "penalty_area_depth_m": 1.0,
        "penalty_area_width_m": 2.0,
        "goal_center_to_penalty_mark_m": 6.0,
        "center_circle_radius_m": 0.5,
        "line_thickness_m": 0.01,
    },
}


def ssl_field(division: str | None = None, **dimensions_m: float) -> Target:
    """A field of the RoboCup small-size league, its lines, circle, corners and crossings under the league's names.

    Lines are named as in the league's geometry message (and lie where ssl-vision puts them); the message names no
    points, so those are named after the lines that meet there. All distances are between line centres (league rules,
    "distances between lines are measured from their centers").

    Args:
        division: "A" or "B"; without it every dimension must be given.
        dimensions_m: field_length_m, field_width_m, goal_width_m, penalty_area_depth_m, penalty_area_width_m,
            goal_center_to_penalty_mark_m, center_circle_radius_m, line_thickness_m; what is given replaces the
            division's value.

    Raises:
        InputError: unknown division or dimension, a missing or a non-positive one.
    """
    if division is not None and division not in _DIVISIONS:
        raise InputError(f"ssl-field: unknown division {division!r}: A or B, or give every dimension")
    names = tuple(_DIVISIONS["A"])
    if unknown := [name for name in dimensions_m if name not in names]:
        raise InputError(f"ssl-field: unknown dimension {unknown[0]!r}: the dimensions are {', '.join(names)}")
    given = {name: float(value) for name, value in dimensions_m.items()}
    dimensions = {**(_DIVISIONS[division] if division else {}), **given}
    if missing := [name for name in names if name not in dimensions]:
        raise InputError(f"ssl-field: {missing[0]} is missing: name a division or give every dimension")
    for name, value in dimensions.items():
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"ssl-field: {name} must be a positive number of metres, not {value}")
    spec = {"kind": "ssl-field", **({"division": division} if division else {}), **given}
    others = [other for other in _DIVISIONS if division not in (None, other)]
    mistaken_for = {f"a division {other} field": {"kind": "ssl-field", "division": other} for other in others}
    return Target(spec, _points(dimensions), _curves(dimensions), mistaken_for=mistaken_for, dimensions=dimensions)


def _curves(d: Mapping[str, float]) -> dict[str, Curve]:
    x, y = 0.5 * d["field_length_m"], 0.5 * d["field_width_m"]
    px, py = x - d["penalty_area_depth_m"], 0.5 * d["penalty_area_width_m"]
    ends = {
        "TopTouchLine": (-x, y, x, y),
        "BottomTouchLine": (-x, -y, x, -y),
        "LeftGoalLine": (-x, -y, -x, y),
        "RightGoalLine": (x, -y, x, y),
        "HalfwayLine": (0.0, -y, 0.0, y),
        "CenterLine": (-x, 0.0, x, 0.0),
        "LeftPenaltyStretch": (-px, -py, -px, py),
        "RightPenaltyStretch": (px, -py, px, py),
        "LeftFieldLeftPenaltyStretch": (-x, -py, -px, -py),
        "LeftFieldRightPenaltyStretch": (-x, py, -px, py),
        "RightFieldRightPenaltyStretch": (x, -py, px, -py),
        "RightFieldLeftPenaltyStretch": (x, py, px, py),
    }
    width = d["line_thickness_m"]
    curves: dict[str, Curve] = {
        name: Segment((x1, y1, 0.0), (x2, y2, 0.0), width) for name, (x1, y1, x2, y2) in ends.items()
    }
    curves["CenterCircle"] = Arc((0.0, 0.0, 0.0), d["center_circle_radius_m"], width_m=width)
    return curves


def _points(d: Mapping[str, float]) -> dict[str, tuple[float, float, float]]:
    x, y = 0.5 * d["field_length_m"], 0.5 * d["field_width_m"]
    px, py = x - d["penalty_area_depth_m"], 0.5 * d["penalty_area_width_m"]
    radius, mark = d["center_circle_radius_m"], d["goal_center_to_penalty_mark_m"] - x
    flat = {
        "TopLeftCorner": (-x, y),
        "TopRightCorner": (x, y),
        "BottomLeftCorner": (-x, -y),
        "BottomRightCorner": (x, -y),
        "TopHalfwayCrossing": (0.0, y),
        "BottomHalfwayCrossing": (0.0, -y),
        "CenterMark": (0.0, 0.0),
        "TopCircleCrossing": (0.0, radius),
        "BottomCircleCrossing": (0.0, -radius),
        "LeftCircleCrossing": (-radius, 0.0),
        "RightCircleCrossing": (radius, 0.0),
        "LeftGoalCenterCrossing": (-x, 0.0),
        "RightGoalCenterCrossing": (x, 0.0),
        "LeftPenaltyCenterCrossing": (-px, 0.0),
        "RightPenaltyCenterCrossing": (px, 0.0),
        "LeftPenaltyMark": (-mark, 0.0),
        "RightPenaltyMark": (mark, 0.0),
        "LeftFieldLeftPenaltyCorner": (-px, -py),
        "LeftFieldRightPenaltyCorner": (-px, py),
        "RightFieldRightPenaltyCorner": (px, -py),
        "RightFieldLeftPenaltyCorner": (px, py),
        "LeftFieldLeftPenaltyGoalCrossing": (-x, -py),
        "LeftFieldRightPenaltyGoalCrossing": (-x, py),
        "RightFieldRightPenaltyGoalCrossing": (x, -py),
        "RightFieldLeftPenaltyGoalCrossing": (x, py),
    }
    return {name: (px_, py_, 0.0) for name, (px_, py_) in flat.items()}


def _from_spec(spec: dict[str, Any], where: str) -> Target:
    data = {name: value for name, value in spec.items() if name != "kind"}
    division = convert(data.pop("division", None), str | None, f"{where}.division")  # type: ignore[arg-type]
    return ssl_field(division, **{name: convert(value, float, f"{where}: {name}") for name, value in data.items()})


KIND = TargetKind(
    "ssl-field",
    "a field of the RoboCup small-size league: x along its length, the centre mark at 0, 0",
    f"division (A or B), or {', '.join(_DIVISIONS['A'])}; a dimension beside a division replaces the division's",
    "lines and circle as in the league's geometry message, points after the lines that meet there",
    lambda: {"ssl-a": ssl_field("A"), "ssl-b": ssl_field("B")},
    _from_spec,
)
