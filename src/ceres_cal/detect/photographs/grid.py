"""A target as lines in two perpendicular directions, which is how a photograph is searched for it without a start.

Orientation: the turns in which a target looks the same, and which of them a photograph shows.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, InputError, Mask, Pose, distinct, no_such, rotation_log
from ceres_cal.scene import Arc, Camera, Segment, Target, curve_points, middle_of, size_of, turns_of

_AXIS = 1e-6  # largest sine of the angle between the main direction and a line parallel to it
_DIGITS = 6  # decimals of metres to which two offsets must agree to be one
_OUTLINE = 300
_SHORT = 0.015  # least share of a line in the length of all straight lines, with which it helps to find the target


class LineGrid(Frozen):
    """A target's lines in its main direction and across.

    Attributes:
        curves: names of the painted curves. turns: the turns that map these onto themselves; the first is the identity.
        turn: (2, 2) target from grid; its columns are the main direction and the one across.
        along: y in the grid of lines in the main direction, and of arcs' tangents.
        across: x in the grid of lines across, and of arcs' tangents.
    """

    target: Target
    curves: tuple[str, ...]
    turns: tuple[Pose, ...]
    turn: Array
    along: Array
    across: Array

    @property
    def least_share(self) -> float:
        """Length of the straight lines in the direction that has fewer, as a share of all painted curves' length."""
        lines = _segments(self.target, self.curves)
        along = [sum(one.length_m for one in lines if abs(_way(one) @ self.turn[:, axis]) < _AXIS) for axis in (0, 1)]
        return min(along) / sum(self.target.curves[name].length_m for name in self.curves)

    @property
    def outline(self) -> Array:
        """(P, 2) places all along the painted curves, in the grid's frame."""
        return places_along(self, _OUTLINE)[0]


def places_along(grid: LineGrid, count: int) -> tuple[Array, Mask]:
    """Return about `count` places (P, 2), evenly spaced on the painted curves in the grid's frame, and whether each is
    the first of its curve.
    """
    painted = [grid.target.curves[name] for name in grid.curves]
    spacing = sum(curve.length_m for curve in painted) / count
    places, first = [], []
    for curve in painted:
        there = curve_points(curve, 0, max(int(curve.length_m / spacing), 2))
        places.append(there[:, :2] @ grid.turn)
        first.append(np.arange(len(there)) == 0)
    return np.concatenate(places).astype(np.float32), np.concatenate(first)


def grid_of(target: Target, curves: Collection[str]) -> LineGrid:
    """Return the painted lines that are parallel to the longest one, or perpendicular to it.

    Raises:
        InputError: fewer than two lines in one direction and one across.
    """
    lines = _segments(target, curves)
    if lines:
        x, y = _way(max(lines, key=lambda one: one.length_m))
        turn = np.array([[x, -y], [y, x]])
        numbers = [len(_offsets(lines, turn, axis)) for axis in (0, 1)]
        if max(numbers) > 1 and min(numbers) > 0:
            both = offsets_of(target, curves, turn)
            return LineGrid(target, tuple(curves), tuple(turns_of(target, curves)), turn, *both)
    raise InputError(
        "a field is found without a start by straight lines at right angles, two one way and one across at least: "
        "this target has fewer; start from a calibration or from corners"
    )


def offsets_of(target: Target, curves: Collection[str], turn: Array) -> tuple[Array, Array]:
    """Return the offsets `along` and `across` of a grid with these curves alone."""
    lines = _segments(target, curves)
    arcs = [curve for name, curve in target.curves.items() if name in curves and isinstance(curve, Arc)]
    both = [distinct(np.array([*_offsets(lines, turn, axis), *_tangents(arcs, turn[:, axis])])) for axis in (1, 0)]
    return both[0], both[1]


def _segments(target: Target, curves: Collection[str]) -> list[Segment]:
    return [curve for name, curve in target.curves.items() if name in curves and isinstance(curve, Segment)]


def _way(line: Segment) -> Array:
    """(2,) direction of a line, of length 1."""
    way = np.subtract(line.end, line.start)[:2]
    return np.asarray(way / np.linalg.norm(way))


def _offsets(lines: Sequence[Segment], turn: Array, axis: int) -> Array:
    """Return the constant grid coordinate, x (axis 0) or y, of lines across that axis, without short ones."""
    kept = [line for line in lines if abs(_way(line) @ turn[:, axis]) < _AXIS]
    places = np.round([line.start[:2] @ turn[:, axis] for line in kept], _DIGITS)
    offsets, which = np.unique(places, return_inverse=True)
    lengths = np.bincount(which, [line.length_m for line in kept], len(offsets))
    return np.asarray(offsets[lengths > _SHORT * sum(line.length_m for line in lines)])


def _tangents(arcs: Sequence[Arc], way: Array) -> Array:
    """Return offsets along `way` (2,) of the lines across it that are tangents of an arc, within its extent."""
    offsets: list[Array] = [np.empty(0)]
    for arc in arcs:
        angles = np.arctan2(way[1], way[0]) + np.array([0.0, np.pi])
        within = np.mod(angles - arc.from_rad, 2.0 * np.pi) < arc.to_rad - arc.from_rad
        offsets.append((way @ arc.centre[:2] + arc.radius_m * np.array([1.0, -1.0]))[within])
    return np.concatenate(offsets).round(_DIGITS)


# ---- which way round ------------------------------------------------------------------------------------------------


_FOUR = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "top": (0.0, -1.0), "bottom": (0.0, 1.0)}
SIDES = _FOUR | {f"{y}-{x}": (_FOUR[x][0], _FOUR[y][1]) for y in ("top", "bottom") for x in ("left", "right")}
# Least cosine of the angle between a side of the picture and a feature that lies towards it: within 73 degrees.
_FACES = 0.3
# A cosine that is lower by at most this is no worse.
_AS_WELL = 0.2
# Least difference of an old calibration's angles to the nearest turn and to the next: quarters are 90 degrees apart.
_NEARER_DEG = 30.0
_LONG = 0.4  # least length of a curve that people know by its name, as a share of the longest curve
_MIDDLE = 0.02  # share of the target's size: nearer to its middle a feature lies on no side


class Facing(Frozen, eq=True):
    """A named curve or point of the target lies towards a side of the picture, seen from the target's middle.

    It need not be in the picture: for a half field, the goal line of the other half lies towards some side, too.

    Attributes:
        feature: name of the curve or point.
        side: one of SIDES.
    """

    feature: str
    side: str

    def __post_init__(self) -> None:
        if self.side not in SIDES:
            raise InputError(f"facing {self.feature!r}: {no_such('side', self.side, SIDES)}")


def require_sides(facings: Sequence[Facing], target: Target, curves: Collection[str]) -> None:
    """Raise InputError for a feature that the target does not have, or that lies in its middle."""
    size, middle = size_of(target, curves), middle_of(target, curves)[:2]
    for one in facings:
        if one.feature not in target.point_index and one.feature not in target.curves:
            raise InputError(f"facing: {no_such('line or point', one.feature, (*target.curves, *target.point_index))}")
        if np.linalg.norm(_place(one.feature, target) - middle) < _MIDDLE * size:
            raise InputError(
                f"facing {one.feature}={one.side}: {one.feature} lies in the middle of the field, not towards a side: "
                "name another line or point"
            )


def facing_cosine(facing: Facing, camera: Camera, target: Target, curves: Collection[str]) -> float:
    """Cosine of the angle, on the floor, between the picture's side and the feature's direction from the middle."""
    way = _place(facing.feature, target) - middle_of(target, curves)[:2]
    x, y = SIDES[facing.side]
    towards = (x * camera.cam_from_world.rotation[0] + y * camera.cam_from_world.rotation[1])[:2]
    return float(way @ towards / np.linalg.norm(way) / max(float(np.linalg.norm(towards)), 1e-9))


def agreeing_with_facing(
    cameras: Sequence[Camera], facings: Sequence[Facing], target: Target, curves: Collection[str]
) -> list[int]:
    """Indices of the cameras for which every feature lies towards its side."""
    cosines = np.array([[facing_cosine(one, camera, target, curves) for one in facings] for camera in cameras])
    worst = cosines.reshape(len(cameras), -1).min(axis=1)
    return [int(n) for n in np.flatnonzero((worst > _FACES) & (worst >= worst.max(initial=0.0) - _AS_WELL))]


def nearest_to_before(cameras: Sequence[Camera], before: Camera) -> list[int]:
    """Indices of the cameras with the least rotation from the earlier one, and of those rotated little more."""
    back = before.cam_from_world.rotation.T
    angles = [float(np.linalg.norm(rotation_log(one.cam_from_world.rotation @ back))) for one in cameras]
    limit = min(angles) + np.deg2rad(_NEARER_DEG)
    return [number for number, angle in enumerate(angles) if angle <= limit]


def side_of(feature: str, camera: Camera, target: Target, curves: Collection[str]) -> str:
    """Return the side of the picture, left, right, top or bottom, that a feature lies towards."""
    return max(_FOUR, key=lambda side: facing_cosine(Facing(feature, side), camera, target, curves))


def distinguishing_feature(target: Target, curves: Collection[str]) -> str:
    """Return the long painted curve whose middle is farthest from the target's: its side describes the orientation."""
    middle = middle_of(target, curves)[:2]
    longest = max(target.curves[name].length_m for name in curves)
    long = [name for name in curves if target.curves[name].length_m >= _LONG * longest]  # excludes marks in corners
    return max(long, key=lambda name: round(float(np.linalg.norm(_place(name, target) - middle)), 6))


def _place(feature: str, target: Target) -> Array:
    if feature in target.point_index:
        return np.asarray(target.point_array[target.point_index[feature], :2])
    return np.asarray(curve_points(target.curves[feature], 0, 2)[1, :2])
