"""Conversion between targets and the field of the league's geometry message, in which lengths are millimetres, and line
ends and radii refer to the lines' centres.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.scene import Arc, Curve, Segment, Target, custom, ssl_field
from ceres_cal.scene.symmetry import samples

_LENGTHS = "field_length field_width goal_width penalty_area_depth penalty_area_width"
_SIZES = (*_LENGTHS.split(), "center_circle_radius", "line_thickness", "goal_center_to_penalty_mark")
"""Sizes by their names in the message; in the target they end in _m."""
_A_LENGTH_MM = 10500  # limit between divisions B and A
_RULES = {"goal_depth": 180, "goal_height": 155, "boundary_width": 300, "ball_radius": 21.5, "max_robot_radius": 90.0}
_SHAPES = "CenterCircle TopTouchLine BottomTouchLine LeftGoalLine RightGoalLine HalfwayLine CenterLine"
_PENALTY = "LeftPenalty RightPenalty LeftFieldLeftPenalty LeftFieldRightPenalty RightFieldLeftPenalty"
_TYPES = {*_SHAPES.split(), *(f"{name}Stretch" for name in f"{_PENALTY} RightFieldRightPenalty".split())}


def target_of(field: Mapping[str, Any]) -> Target:
    """Return the target that a field message (SSL_GeometryFieldSize as plain data) describes.

    Its sizes make a field of the league; if its own lines differ from that, they are the target.

    Raises:
        InputError: a size that is missing or makes no field, a line or an arc with something else than numbers.
    """
    for name in ("field_length", "field_width", "goal_width"):
        if not isinstance(field.get(name), (int, float)):
            raise InputError(f"the field has no {name} in mm")
    try:
        curves = _curves(field)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"a line or an arc of the field has an invalid value: {error}") from None
    division = _division_of(field["field_length"])
    given = {f"{name}_m": 1e-3 * float(field[name]) for name in _SIZES if field.get(name)}
    by_rule, nominal = ssl_field(division), ssl_field(division, **given)
    if nominal.curves == by_rule.curves and nominal.points == by_rule.points:
        nominal = by_rule
    if all(name in nominal.curves and _alike(curve, nominal.curves[name]) for name, curve in curves.items()):
        return nominal
    return custom({}, curves)


def _curves(field: Mapping[str, Any]) -> dict[str, Curve]:
    curves: dict[str, Curve] = {}
    for line in field.get("field_lines") or []:
        start, end = ((1e-3 * line[end]["x"], 1e-3 * line[end]["y"], 0.0) for end in ("p1", "p2"))
        curves[str(line["name"])] = Segment(start, end, 1e-3 * line["thickness"])
    for arc in field.get("field_arcs") or []:
        centre = (1e-3 * arc["center"]["x"], 1e-3 * arc["center"]["y"], 0.0)
        turn = min(float(arc["a2"]), float(arc["a1"]) + 2.0 * np.pi)  # 2 pi in float32 is slightly larger
        turn = float(arc["a1"]) + 2.0 * np.pi if turn - float(arc["a1"]) > 2.0 * np.pi - 1e-6 else turn
        curves[str(arc["name"])] = Arc(centre, 1e-3 * arc["radius"], float(arc["a1"]), turn, 1e-3 * arc["thickness"])
    return curves


def _alike(one: Curve, other: Curve) -> bool:
    same_m = 6e-4  # tolerance: sizes are whole millimetres, while the lines are exact
    if isinstance(one, Segment) and isinstance(other, Segment):
        ends = np.array([other.start, other.end])
        off = min(np.max(np.abs(np.array(e) - ends)) for e in ((one.start, one.end), (one.end, one.start)))
        return bool(off < same_m)
    if isinstance(one, Arc) and isinstance(other, Arc):
        off = np.max(np.abs(np.subtract((*one.centre, one.radius_m), (*other.centre, other.radius_m))))
        return bool(off < same_m and abs(one.length_m - other.length_m) < same_m)
    return False


def field_of(target: Target) -> dict[str, Any]:
    """Return the message of a target: sizes in whole millimetres, its curves as lines and arcs.

    Raises:
        InputError: it has no curve on the floor, and so is no field.
    """
    curves = target.curves
    if not curves:
        raise InputError("the target has no lines: it is not a field")
    reach = samples(curves.values())
    length, width = (round(2e3 * float(np.max(np.abs(reach[:, axis])))) for axis in (0, 1))
    by_rule = _sizes_of(ssl_field(_division_of(length)))
    sizes = {**by_rule, "field_length": length, "field_width": width, **_RULES, **_sizes_of(target)}
    lines, arcs = [], []
    for name, curve in curves.items():
        paint = {"thickness": _mm(curve.width_m), **_type(name)}
        if isinstance(curve, Segment):
            lines.append({"name": name, "p1": _place(curve.start), "p2": _place(curve.end), **paint})
        else:
            angles = {"a1": curve.from_rad, "a2": curve.to_rad}
            circle = {"center": _place(curve.centre), "radius": _mm(curve.radius_m)}
            arcs.append({"name": name, **circle, **angles, **paint})
    return {**sizes, "field_lines": lines, "field_arcs": arcs}


def _sizes_of(target: Target) -> dict[str, int]:
    """Sizes of a field of the league; empty for another target."""
    if target.kind != "ssl-field":
        return {}
    return {name: round(1e3 * target.dimensions[f"{name}_m"]) for name in _SIZES}


def _division_of(length_mm: float) -> str:
    return "A" if length_mm > _A_LENGTH_MM else "B"


def _mm(metres: float) -> float:
    return round(1e3 * metres, 6)


def _place(place: tuple[float, float, float]) -> dict[str, float]:
    return {"x": _mm(place[0]), "y": _mm(place[1])}


def _type(name: str) -> dict[str, str]:
    return {"type": name} if name in _TYPES else {}
