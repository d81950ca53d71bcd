"""ArUco and AprilTag markers at known places: each has a number, a centre, a side and a rotation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base import InputError, checked, convert
from ceres_cal.scene.targets.target import Target, TargetKind, require_size

CORNERS = ("top_left", "top_right", "bottom_right", "bottom_left")
"""Corners of a marker that is seen upright, in OpenCV's order."""
_OFF = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])


class Marker(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True, frozen=True):
    """The place of a marker that lies level, with its face up.

    Attributes:
        at_m: (x, y) or (x, y, z) of its centre. side_m: of its dark square, without the white around it.
        turn_deg: its rotation, counterclockwise seen from above; at 0 its right is along x.
    """

    at_m: tuple[float, ...]
    side_m: float
    turn_deg: float = 0.0

    @property
    def corners_m(self) -> list[tuple[float, float, float]]:
        """The four corners in the order of CORNERS, m."""
        turn, (x, y, z) = np.radians(self.turn_deg), (*self.at_m, 0.0)[:3]
        right, up = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
        away = self.side_m * (_OFF[:, :1] * right + _OFF[:, 1:] * up)
        return [(x + dx, y + dy, z) for dx, dy in away.tolist()]


class _MarkersSpec(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    kind: str
    dictionary: str
    markers: dict[str, Marker]
    movable: bool = False


@checked
def markers(dictionary: str, places: Mapping[int, Marker], *, movable: bool = False) -> Target:
    """Return the corners of markers: features "7.top_left" and so on for marker 7, as it is seen upright.

    Args:
        dictionary: OpenCV's name of the markers' dictionary, such as "DICT_4X4_50" or "DICT_APRILTAG_36h11".
        places: number of each marker -> where it lies. movable: whether they are all on one board or sheet, not on the
            floor.

    Raises:
        InputError: no markers, more than MOST_FEATURES corners, a negative number, or an invalid place.
    """
    if not places:
        raise InputError("markers: give at least one")
    require_size(4 * len(places), "markers")
    for number, marker in places.items():
        finite = np.all(np.isfinite([*marker.at_m, marker.side_m, marker.turn_deg]))
        is_number = isinstance(number, int | np.integer) and number >= 0
        if not is_number or len(marker.at_m) not in (2, 3) or not finite or not marker.side_m > 0.0:
            raise InputError(
                f"marker {number!r}: it needs a number from 0 on, at_m with two or three finite numbers, and a side_m "
                "above 0"
            )
    points = {
        f"{number}.{corner}": place
        for number, marker in places.items()
        for corner, place in zip(CORNERS, marker.corners_m, strict=True)
    }
    given = _MarkersSpec("markers", dictionary, {str(number): marker for number, marker in places.items()}, movable)
    return Target(msgspec.to_builtins(given), points, {}, movable=movable, bows=movable)


def _from_spec(spec: dict[str, Any], where: str) -> Target:
    given = convert(spec, _MarkersSpec, where)
    if wrong := [name for name in given.markers if not (name.isascii() and name.isdigit())]:
        raise InputError(f"a marker is named by its number, not {wrong[0]!r}")
    places = {int(name): marker for name, marker in given.markers.items()}
    if len(places) < len(given.markers):
        raise InputError("a marker is given twice")
    return markers(given.dictionary, places, movable=given.movable)


def _example() -> dict[str, Target]:
    places = {7: Marker((0.5, 0.25), 0.15), 12: Marker((-1.0, 0.8, 0.0), 0.15, 90.0)}
    return {"markers": markers("DICT_APRILTAG_36h11", places)}


KIND = TargetKind(
    "markers",
    "the corners of ArUco or AprilTag markers of known place, face up",
    "dictionary (OpenCV's name), markers (number: at_m, side_m, turn_deg), movable (one board, not the floor)",
    'points "7.top_left", "7.top_right", "7.bottom_right" and "7.bottom_left" of marker 7 as it is seen upright',
    _example,
    _from_spec,
)
