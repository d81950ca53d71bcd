"""Which way round: the turns in which a target looks alike, and which of them a photograph shows."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.frozen import Frozen
from ceres_cal.base.transforms import rotation_log
from ceres_cal.base.words import no_such
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import curve_points
from ceres_cal.scene.symmetry import middle_of, size_of
from ceres_cal.scene.targets import Target

_FOUR = {"left": (-1.0, 0.0), "right": (1.0, 0.0), "top": (0.0, -1.0), "bottom": (0.0, 1.0)}
SIDES = _FOUR | {f"{y}-{x}": (_FOUR[x][0], _FOUR[y][1]) for y in ("top", "bottom") for x in ("left", "right")}
# Cosine of the angle between a side of the picture and a feature that lies towards it, at least: within 73 degrees.
_FACES = 0.3
# A cosine less by no more than this is no worse.
_AS_WELL = 0.2
# By which an old calibration must be nearer to one turn than to the next: quarters are 90 degrees apart.
_NEARER_DEG = 30.0
_LONG = 0.4  # of the longest curve: one that people know by its name
_MIDDLE = 0.02  # of the target's size: nearer to its middle a feature lies on no side


class Facing(Frozen, eq=True):
    """A named curve or point of the target lies towards a side of the picture, seen from the target's middle.

    It need not be in the picture: of a half field the goal line of the other half lies towards some side too.

    Attributes:
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
                f"facing {one.feature}={one.side}: {one.feature} lies in the middle of the field, towards no side: "
                "name another line or point"
            )


def facing_cosine(facing: Facing, camera: Camera, target: Target, curves: Collection[str]) -> float:
    """Cosine of the angle, on the floor, between the side of the picture and the way from the middle to the feature."""
    way = _place(facing.feature, target) - middle_of(target, curves)[:2]
    x, y = SIDES[facing.side]
    towards = (x * camera.cam_from_world.rotation[0] + y * camera.cam_from_world.rotation[1])[:2]
    return float(way @ towards / np.linalg.norm(way) / max(float(np.linalg.norm(towards)), 1e-9))


def agreeing_with_facing(
    cameras: Sequence[Camera], facings: Sequence[Facing], target: Target, curves: Collection[str]
) -> list[int]:
    """Numbers of the cameras for which every feature lies towards its side."""
    cosines = np.array([[facing_cosine(one, camera, target, curves) for one in facings] for camera in cameras])
    worst = cosines.reshape(len(cameras), -1).min(axis=1)
    return [int(n) for n in np.flatnonzero((worst > _FACES) & (worst >= worst.max(initial=0.0) - _AS_WELL))]


def nearest_to_before(cameras: Sequence[Camera], before: Camera) -> list[int]:
    """Numbers of the cameras that are turned least from the one before, and of those turned little more."""
    back = before.cam_from_world.rotation.T
    angles = [float(np.linalg.norm(rotation_log(one.cam_from_world.rotation @ back))) for one in cameras]
    limit = min(angles) + np.deg2rad(_NEARER_DEG)
    return [number for number, angle in enumerate(angles) if angle <= limit]


def side_of(feature: str, camera: Camera, target: Target, curves: Collection[str]) -> str:
    """The side of the picture, left, right, top or bottom, that a feature lies towards."""
    return max(_FOUR, key=lambda side: facing_cosine(Facing(feature, side), camera, target, curves))


def distinguishing_feature(target: Target, curves: Collection[str]) -> str:
    """The long painted curve whose middle lies farthest from the target's: to say by it which way round it is."""
    middle = middle_of(target, curves)[:2]
    longest = max(target.curves[name].length_m for name in curves)
    long = [name for name in curves if target.curves[name].length_m >= _LONG * longest]  # no marks in corners
    return max(long, key=lambda name: round(float(np.linalg.norm(_place(name, target) - middle)), 6))


def _place(feature: str, target: Target) -> Array:
    if feature in target.point_index:
        return np.asarray(target.point_array[target.point_index[feature], :2])
    return np.asarray(curve_points(target.curves[feature], 0, 2)[1, :2])
