"""The field in a photograph without any start: candidates are followed and judged, and one of its turns is chosen."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array32
from ceres_cal.base.errors import InputError
from ceres_cal.photographs.candidates import Seen, alike, candidates, see
from ceres_cal.photographs.clicks import SIGMA_PX, unknown_optics
from ceres_cal.photographs.facing import (
    Facing,
    require_sides,
    settled_by_before,
    settled_by_facing,
    side_of,
    telling_feature,
)
from ceres_cal.photographs.follow import Followed, follow
from ceres_cal.photographs.judgement import doubt, explained, same_labels, told, worth
from ceres_cal.photographs.refit import Shown
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target

# Of the strokes explained, by the first that is not doubted: no other is followed. It only saves time. Nothing
# changes from 0.82 to 0.95.
_SURE = 0.9
# Of the best one's score: another way to see the picture that is as good makes it ambiguous. Nothing changes from
# 0.85 to 0.96.
_AS_GOOD = 0.92
_NO_LINES = (
    "no lines at right angles that could be this field's, two one way and one across: "
    "check the target's dimensions, or start from corners"
)


@dataclass(frozen=True)
class Auto:
    """No start: the field is to be found in the photograph.

    Attributes:
        facing: what settles which way round it is, where it looks alike turned.
        before: or the station's camera before it was moved; the way that it is turned least is taken.
    """

    facing: tuple[Facing, ...] = ()
    before: Camera | None = None


@dataclass(frozen=True, eq=False)
class Searched:
    """What came of looking for the field.

    Attributes:
        followed: the field, or None. reason: why none was found.
        ways: in how many ways the photograph can be taken for the field; 0: none was looked for, a start was given.
            settled_by: what chose one of them: "facing", "before", or nothing, where there is but one.
    """

    followed: Followed | None
    reason: str = ""
    ways: int = 0
    settled_by: str = ""


def search(grey: Array32, target: Target, curves: Collection[str], auto: Auto) -> Searched:
    """Find a target's painted curves in a photograph and follow them.

    The picture must show straight lines at right angles, two one way and one across at least; whatever else the target
    has takes part in telling the ways apart. Nothing is known of the lens but that it is about radial and centred; the
    camera looks down, at up to 55 degrees from the upright. A mirrored photograph of a field that is its own mirror
    image looks like another one's: it cannot be told, and is not.

    Raises:
        InputError: the photograph can be taken for the field in several ways, and nothing settles which; the target has
            too few straight lines; or nothing that `auto.facing` names.
    """
    require_sides(auto.facing, target, curves)
    seen = see(grey, target, curves)
    good, reason = [], _NO_LINES
    for number, camera in enumerate(candidates(seen)):
        followed = _followed(seen, _turned(seen, auto, camera))
        against = doubt(seen, followed)
        if not against:
            good.append(followed)
        elif number == 0:
            reason = against
        if good and explained(seen, good[-1].camera) > _SURE:
            break
    if not good:
        return Searched(None, reason)
    best = max(good, key=lambda one: worth(seen, one.camera))
    others = [_followed(seen, _turned(seen, auto, camera)) for camera in alike(seen, best.camera, told(seen, best))]
    found = [best]
    for other in (*good, *(one for one in others if not doubt(seen, one))):
        as_good = worth(seen, other.camera) >= _AS_GOOD * worth(seen, best.camera)
        if as_good and not any(same_labels(seen, other, one) for one in found):
            found.append(other)
    return _settled(seen, auto, found)


def _turned(seen: Seen, auto: Auto, camera: Camera) -> Camera:
    """The one of a camera's turns that what is known favours, so that it need not be followed again."""
    ways = [camera.at(camera.cam_from_world @ turn) for turn in seen.turns]
    left = _left(seen, auto, ways)
    return ways[left[0]] if left else camera


def _followed(seen: Seen, camera: Camera) -> Followed:
    """The target's lines from a camera that is about right, held by the points that it puts into the picture."""
    pixels = camera.project(seen.target.point_array)
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels > -0.5) & (pixels < np.array(camera.image_size) - 0.5), axis=1)
    rows = np.flatnonzero(inside)
    shown = Shown(rows.astype(np.int32), pixels[rows], np.full(len(rows), SIGMA_PX))
    freedom = unknown_optics(camera.image_size, camera.phi, shown)
    return follow(seen.grey, seen.target, [camera], seen.curves, freedom)


# ---- which way round ------------------------------------------------------------------------------------------------


def _settled(seen: Seen, auto: Auto, found: Sequence[Followed]) -> Searched:
    """The one way that what is known settles; InputError where it settles none."""
    target, curves = seen.target, seen.curves
    ways = [(one, turn, one.camera.at(one.camera.cam_from_world @ turn)) for one in found for turn in seen.turns]
    cameras = [camera for _, _, camera in ways]
    left = _left(seen, auto, cameras)
    if not left:
        given = ", ".join(f"{one.feature}={one.side}" for one in auto.facing)
        raise InputError(f"not with {given}: in this photograph {_sides(cameras, target, curves)}")
    if len(left) > 1:
        raise InputError(
            f"the field is found, but it looks alike in {len(left)} ways: "
            f"{_sides([cameras[number] for number in left], target, curves)}"
        )
    followed, turn, camera = ways[left[0]]
    if turn is not seen.turns[0]:
        followed = follow(seen.grey, target, [camera], curves)
        if against := doubt(seen, followed):
            return Searched(None, against)
    settled_by = "" if len(ways) == 1 else "facing" if auto.facing else "before"
    return Searched(followed, "", len(ways), settled_by)


def _left(seen: Seen, auto: Auto, cameras: Sequence[Camera]) -> list[int]:
    """Numbers of the cameras that agree with what is known; one alone needs no old calibration to agree with."""
    if auto.facing:
        return settled_by_facing(cameras, auto.facing, seen.target, seen.curves)
    if auto.before is not None and len(cameras) > 1:
        return settled_by_before(cameras, auto.before)
    return list(range(len(cameras)))


def _sides(cameras: Sequence[Camera], target: Target, curves: Collection[str]) -> str:
    """Where something that tells these cameras apart lies, and how to say which is meant."""
    name = telling_feature(target, curves)
    sides = list(dict.fromkeys(side_of(name, camera, target, curves) for camera in cameras))
    if len(sides) < len(cameras):
        heights = ", ".join(f"{camera.position[2]:.1f} m" for camera in cameras)
        return f"seen from {heights}, with {name} towards the {' or '.join(sides)}: start from corners instead"
    return (
        f"{name} lies towards the {' or the '.join(sides)} of the picture: "
        f"say which, such as --facing {name}={sides[0]}, or give an old calibration of the station (--start)"
    )
