"""Targets: rigid things of known geometry with named points and named curves.

A target has its own frame, in metres; a field's frame is the world. Curves lie in a plane of constant z, seen from
above (from +z) when sides are named.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import astuple, dataclass
from functools import cached_property
from typing import Any

import msgspec
import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import InputError
from ceres_cal.base.files import convert

MOVABLE = ("checkerboard", "rings")
"""Kinds of targets that lie where somebody put them; the others are the world."""
SIDES = {"centre": 0, "left": 1, "right": -1}
"""Which part of a painted curve was observed. Left and right are those of someone walking along it: from `start` to
`end` of a segment, counter-clockwise on an arc (so left is the inside)."""


def _xyz(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _settle(curve: Any, *places: str) -> None:
    """Plain floats in a frozen curve, whatever kinds of numbers it was made of: what a file would give back."""
    for name, value in vars(curve).items():
        object.__setattr__(curve, name, _xyz(value) if name in places else float(value))


@dataclass(frozen=True)
class Segment:
    """A straight line from `start` to `end`, (x, y, z) m; `width_m` is that of the paint, 0 for a bare edge."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    width_m: float = 0.0

    def __post_init__(self) -> None:
        _settle(self, "start", "end")

    @property
    def parameter_range(self) -> tuple[float, float]:
        return 0.0, 1.0

    @property
    def length_m(self) -> float:
        return math.dist(self.start, self.end)

    def track(self, side: int = 0) -> Array:
        """(3, 3) rows c, a, b of C(s) = c + s a, s from 0 to 1; b is 0 for a segment."""
        start, along = np.asarray(self.start, dtype=float), np.subtract(self.end, self.start)
        left = np.array([-along[1], along[0], 0.0])
        norm = math.hypot(along[0], along[1])
        offset = side * 0.5 * self.width_m * left / norm if norm > 0.0 else np.zeros(3)
        return np.array([start + offset, along, np.zeros(3)])


@dataclass(frozen=True)
class Arc:
    """A circular arc around `centre` (x, y, z) m, counter-clockwise from `from_rad` to `to_rad` in the plane of z."""

    centre: tuple[float, float, float]
    radius_m: float
    from_rad: float = 0.0
    to_rad: float = 2.0 * np.pi
    width_m: float = 0.0

    def __post_init__(self) -> None:
        _settle(self, "centre")

    @property
    def parameter_range(self) -> tuple[float, float]:
        return self.from_rad, self.to_rad

    @property
    def length_m(self) -> float:
        return self.radius_m * (self.to_rad - self.from_rad)

    def track(self, side: int = 0) -> Array:
        """(3, 3) rows c, a, b of C(s) = c + a cos s + b sin s."""
        radius = self.radius_m - side * 0.5 * self.width_m
        return np.array([self.centre, (radius, 0.0, 0.0), (0.0, radius, 0.0)], dtype=float)


Curve = Segment | Arc


def along_track(track: ArrayLike, is_arc: bool | Mask, s: ArrayLike) -> Array:
    """C(s) on one track (3, 3) or on one track per s (N, 3, 3): (N, 3) m."""
    tracks, s = np.asarray(track, dtype=float), np.asarray(s, dtype=float)
    first = np.where(is_arc, np.cos(s), s)
    second = np.where(is_arc, np.sin(s), 0.0)
    c, a, b = tracks[..., 0, :], tracks[..., 1, :], tracks[..., 2, :]
    return np.asarray(c + first[:, None] * a + second[:, None] * b)


def nearest_on_track(tracks: Array, is_arc: Mask, points: Array) -> Array:
    """Parameter s (N,) of the place on each track (N, 3, 3) nearest to each point (N, 3)."""
    c, a, b = tracks[:, 0], tracks[:, 1], tracks[:, 2]
    away = points - c
    straight = np.sum(away * a, axis=1) / np.sum(a * a, axis=1)
    turned = np.arctan2(np.sum(away * b, axis=1), np.sum(away * a, axis=1))
    return np.asarray(np.where(is_arc, turned, straight))


@dataclass(frozen=True, eq=False)
class Target:
    """A rigid thing of known geometry.

    Attributes:
        spec: what a file says of it, `{"kind": ..., ...}`; two targets are equal when their specs are and their
            features come in the same order (observations number them).
        points: name -> (x, y, z) m.
        curves: name -> Segment or Arc.
    """

    spec: Mapping[str, Any]
    points: Mapping[str, tuple[float, float, float]]
    curves: Mapping[str, Curve]

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Target)
            and self.spec == other.spec
            and self.point_names == other.point_names
            and self.curve_names == other.curve_names
        )

    __hash__ = None  # type: ignore[assignment]

    @property
    def kind(self) -> str:
        return str(self.spec["kind"])

    @cached_property
    def point_names(self) -> tuple[str, ...]:
        return tuple(self.points)

    @cached_property
    def curve_names(self) -> tuple[str, ...]:
        return tuple(self.curves)

    @cached_property
    def point_array(self) -> Array:
        """(P, 3) m, in the order of `point_names`."""
        return np.array(list(self.points.values()), dtype=float).reshape(-1, 3)

    @cached_property
    def tracks(self) -> Array:
        """(3, C, 3, 3): for side 0, +1 and -1 (index it with the side itself) the track of each curve."""
        return np.array(
            [[curve.track(side) for curve in self.curves.values()] for side in (0, 1, -1)], dtype=float
        ).reshape(3, -1, 3, 3)

    @cached_property
    def is_arc(self) -> Mask:
        """(C,) whether each curve is an arc."""
        return np.array([isinstance(curve, Arc) for curve in self.curves.values()], dtype=bool)


# ---- the small-size league's field ----------------------------------------------------------------------------------

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
    return Target(spec, _ssl_points(dimensions), _ssl_curves(dimensions))


def _ssl_curves(d: Mapping[str, float]) -> dict[str, Curve]:
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


def _ssl_points(d: Mapping[str, float]) -> dict[str, tuple[float, float, float]]:
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


# ---- boards, rings and whatever else --------------------------------------------------------------------------------


def checkerboard(columns: int, rows: int, square_m: float) -> Target:
    """The inner corners of a checkerboard: feature "c,r" lies at (c, r, 0) squares, c < columns, r < rows.

    Raises:
        InputError: fewer than 2 corners a side, or a square that is not a positive number of metres.
    """
    if columns < 2 or rows < 2:
        raise InputError(f"checkerboard: columns and rows count inner corners, at least 2, not {columns} and {rows}")
    if not (np.isfinite(square_m) and square_m > 0.0):
        raise InputError(f"checkerboard: square_m must be a positive number of metres, not {square_m}")
    spec = {"kind": "checkerboard", "columns": int(columns), "rows": int(rows), "square_m": float(square_m)}
    points = {f"{c},{r}": (c * square_m, r * square_m, 0.0) for r in range(rows) for c in range(columns)}
    return Target(spec, points, {})


def rings(radii_m: Sequence[float]) -> Target:
    """The paper's concentric circles (section 2): edges "ring_1", "ring_2", ... from the inside out, point "centre".

    Raises:
        InputError: no radius, or radii that do not increase from above 0.
    """
    radii = [float(r) for r in radii_m]
    if not radii or not np.all(np.isfinite(radii)) or np.any(np.diff([0.0, *radii]) <= 0.0):
        raise InputError(f"rings: radii_m must increase and be positive, not {radii}")
    arcs: dict[str, Curve] = {f"ring_{i}": Arc((0.0, 0.0, 0.0), r) for i, r in enumerate(radii, start=1)}
    return Target({"kind": "rings", "radii_m": radii}, {"centre": (0.0, 0.0, 0.0)}, arcs)


class _SegmentSpec(msgspec.Struct, forbid_unknown_fields=True, rename={"start": "from", "end": "to"}):
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    width_m: float = 0.0


class _ArcSpec(msgspec.Struct, forbid_unknown_fields=True):
    centre: tuple[float, float, float]
    radius_m: float
    from_rad: float = 0.0
    to_rad: float = 2.0 * np.pi
    width_m: float = 0.0


class _CustomSpec(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    kind: str
    points: dict[str, tuple[float, float, float]] = {}
    segments: dict[str, _SegmentSpec] = {}
    arcs: dict[str, _ArcSpec] = {}


def custom(
    points: Mapping[str, tuple[float, float, float]] | None = None, curves: Mapping[str, Curve] | None = None
) -> Target:
    """A target given in full.

    Raises:
        InputError: no features at all, a number that is not finite, a curve without length, or paint that covers the
            centre of its arc.
    """
    points, curves = {name: _xyz(place) for name, place in (points or {}).items()}, dict(curves or {})
    if not points and not curves:
        raise InputError("custom target: give at least one point, segment or arc")
    for name, place in points.items():
        if not np.all(np.isfinite(place)):
            raise InputError(f"custom target: point {name!r} must have three finite numbers, not {place}")
    for name, curve in curves.items():
        if not np.all(np.isfinite(np.hstack(astuple(curve)))) or curve.length_m <= 0.0 or curve.width_m < 0.0:
            raise InputError(f"custom target: curve {name!r} needs finite numbers, a length and a width_m from 0 on")
        if isinstance(curve, Arc) and not curve.radius_m > 0.5 * curve.width_m:
            raise InputError(f"custom target: arc {name!r} must have a radius of more than half its width")
    segments = {name: _SegmentSpec(c.start, c.end, c.width_m) for name, c in curves.items() if isinstance(c, Segment)}
    arcs = {
        name: _ArcSpec(c.centre, c.radius_m, c.from_rad, c.to_rad, c.width_m)
        for name, c in curves.items()
        if isinstance(c, Arc)
    }
    spec = msgspec.to_builtins(_CustomSpec("custom", points, segments, arcs))
    ordered = {name: curves[name] for name in (*segments, *arcs)}  # as a file would give them back
    return Target(spec, points, ordered)


class _CheckerboardSpec(msgspec.Struct, forbid_unknown_fields=True):
    kind: str
    columns: int
    rows: int
    square_m: float


class _RingsSpec(msgspec.Struct, forbid_unknown_fields=True):
    kind: str
    radii_m: list[float]


def _ssl_from_spec(spec: dict[str, Any], where: str) -> Target:
    data = {name: value for name, value in spec.items() if name != "kind"}
    division = convert(data.pop("division", None), str | None, f"{where}.division")  # type: ignore[arg-type]
    return ssl_field(division, **{name: convert(value, float, f"{where}: {name}") for name, value in data.items()})


def _checkerboard_from_spec(spec: dict[str, Any], where: str) -> Target:
    board = convert(spec, _CheckerboardSpec, where)
    return checkerboard(board.columns, board.rows, board.square_m)


def _rings_from_spec(spec: dict[str, Any], where: str) -> Target:
    return rings(convert(spec, _RingsSpec, where).radii_m)


def _custom_from_spec(spec: dict[str, Any], where: str) -> Target:
    given = convert(spec, _CustomSpec, where)
    if both := given.segments.keys() & given.arcs.keys():
        raise InputError(f"two curves are named {min(both)!r}")
    curves: dict[str, Curve] = {name: Segment(s.start, s.end, s.width_m) for name, s in given.segments.items()}
    curves |= {name: Arc(a.centre, a.radius_m, a.from_rad, a.to_rad, a.width_m) for name, a in given.arcs.items()}
    return custom(given.points, curves)


_KINDS: dict[str, Callable[[dict[str, Any], str], Target]] = {
    "ssl-field": _ssl_from_spec,
    "checkerboard": _checkerboard_from_spec,
    "rings": _rings_from_spec,
    "custom": _custom_from_spec,
}
TARGET_KINDS = tuple(_KINDS)


def target_from_spec(spec: Any, where: str) -> Target:
    """The target that a file describes (design, section 9).

    Args:
        spec: `{"kind": ..., ...}`.
        where: how to name the place in messages, such as 'obs.json: target "field"'.

    Raises:
        InputError: unknown kind, or a description that does not fit its kind.
    """
    kind = spec.get("kind") if isinstance(spec, dict) else None
    if not isinstance(kind, str) or kind not in _KINDS:
        raise InputError(f"{where}: unknown kind {kind!r}: choose one of {', '.join(_KINDS)}")
    try:
        return _KINDS[kind](spec, where)
    except InputError as error:
        text = str(error)
        raise InputError(text if text.startswith(where) else f"{where}: {text}") from None
