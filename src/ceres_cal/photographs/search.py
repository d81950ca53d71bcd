"""The field in a photograph without any start: strokes of paint, how the camera looks, which line is which, all turns."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.camera import Camera
from ceres_cal.detect.courses import predict
from ceres_cal.detect.profiles import Grey
from ceres_cal.detect.registration import Nearness, nearness_to
from ceres_cal.detect.strokes import Strokes, drawn, find_strokes
from ceres_cal.errors import InputError
from ceres_cal.lens import Radial
from ceres_cal.photographs.clicks import SIGMA_PX, unknown_optics
from ceres_cal.photographs.facing import Facing, settled_by_facing, side_of, telling_feature, turns_of
from ceres_cal.photographs.follow import Followed, follow
from ceres_cal.photographs.matching import match
from ceres_cal.photographs.refit import Shown
from ceres_cal.photographs.upright import Upright, find_upright
from ceres_cal.targets import Target
from ceres_cal.transforms import Pose, rotation_log

_UPRIGHTS = 2  # answers for lens and tilt that are matched
_POWERS = (2, 3, 4, 5)
_WORTH_A_LOOK = 0.75  # of the best match's score
_MOST_FOLLOWED = 4
_AS_GOOD = 0.92  # of the best one's worth
_FAR_BETTER = 1.12
_SAME_PLACE, _SAME_TURN = 0.08, 0.1  # in heights, rad
_COURSE_PX = 6.0
_NEARER_DEG = 30.0  # by which an old calibration must be nearer to one turn than to the next


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
    """What a search found.

    Attributes:
        followed: the field, or the best that was taken for it (`Followed.holds` tells), or None: nothing was.
        ways: in how many ways the photograph can be taken for the field. settled_by: what chose one of them: "facing",
            "before", or nothing, where there is but one.
    """

    followed: Followed | None
    ways: int = 0
    settled_by: str = ""


def search(grey: Grey, target: Target, curves: Collection[str], auto: Auto) -> Searched:
    """Find a target's painted curves in a photograph and follow them.

    The picture must show straight lines at right angles, two one way and one across at least; whatever else the target
    has takes part in telling the ways apart. Nothing is known of the lens but that it is about radial and centred; the
    camera looks down, at up to 55 degrees from the upright. A mirrored photograph of a field that is its own mirror
    image looks like another one's: it cannot be told, and is not.

    Raises:
        InputError: the photograph can be taken for the field in several ways, and nothing settles which; or the target
            has too few straight lines.
    """
    strokes = find_strokes(grey)
    size = (int(grey.shape[1]), int(grey.shape[0]))
    near = nearness_to(drawn(strokes, size))
    turns = turns_of(target, curves)
    tried = []
    for score, camera in _distinct(_cameras(strokes, near, target, curves, size), turns):
        if tried and (tried[0][0] > _FAR_BETTER * score and tried[0][1].holds):
            break
        followed = follow(grey, target, [camera], curves, unknown_optics(size, camera.phi, _shown(camera, target)))
        tried.append((_worth(followed.camera, near, strokes, target, curves), followed))
    if not tried:
        return Searched(None)
    holding = [one for one in tried if one[1].holds]
    if not holding:
        return Searched(max(tried, key=lambda one: one[0])[1])
    best = max(worth for worth, _ in holding)
    found = [followed for worth, followed in holding if worth >= _AS_GOOD * best]
    return _settled(grey, target, curves, auto, found, turns)


# ---- which way round ------------------------------------------------------------------------------------------------


def _settled(
    grey: Grey, target: Target, curves: Collection[str], auto: Auto, found: Sequence[Followed], turns: Sequence[Pose]
) -> Searched:
    """The one way that what is known settles; InputError where it settles none."""
    ways = [(one, turn, one.camera.at(one.camera.cam_from_world @ turn)) for one in found for turn in turns]
    cameras = [camera for _, _, camera in ways]
    left, settled_by = list(range(len(ways))), ""
    if auto.facing:
        left, settled_by = settled_by_facing(cameras, auto.facing, target, curves), "facing"
        if not left:
            given = ", ".join(f"{one.feature}={one.side}" for one in auto.facing)
            raise InputError(f"--facing {given}: in this photograph {_sides(cameras, target, curves)}")
    elif auto.before is not None and len(ways) > 1:
        left, settled_by = _nearest(cameras, auto.before), "before"
    if len(left) > 1:
        raise InputError(
            f"the field is found, but it looks alike in {len(left)} ways: "
            f"{_sides([cameras[number] for number in left], target, curves)}"
        )
    followed, turn, camera = ways[left[0]]
    if turn is not turns[0]:
        followed = follow(grey, target, [camera], curves)
    return Searched(followed, len(ways), settled_by if len(ways) > 1 else "")


def _nearest(cameras: Sequence[Camera], before: Camera) -> list[int]:
    """Numbers of the cameras that are turned least from the one before, and of those turned little more."""
    angles = [
        float(np.linalg.norm(rotation_log(one.cam_from_world.rotation @ before.cam_from_world.rotation.T)))
        for one in cameras
    ]
    limit = min(angles) + np.deg2rad(_NEARER_DEG)
    return [number for number, angle in enumerate(angles) if angle <= limit]


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


# ---- candidates -----------------------------------------------------------------------------------------------------


def _cameras(
    strokes: Strokes, near: Nearness, target: Target, curves: Collection[str], size: tuple[int, int]
) -> list[tuple[float, Camera]]:
    """Cameras that may have seen these strokes of the target, with their scores, the best first."""
    half = 0.5 * float(np.hypot(*size))
    ends = (strokes.ends - 0.5 * (np.array(size) - 1.0)) / half
    found = []
    for upright in find_upright(ends, strokes.length_px, _UPRIGHTS):
        optics = _optics(upright, size)
        for one in match(upright, ends, strokes.length_px, near, target, curves, size):
            found.append((one.score, optics.at(Pose.looking(one.position, one.rotation))))
    found.sort(key=lambda one: -one[0])
    return found


def _optics(upright: Upright, size: tuple[int, int]) -> Camera:
    """A camera with the polynomial that is nearest to the one coefficient, over the image."""
    half = 0.5 * float(np.hypot(*size))
    share = np.linspace(0.0, 1.02, 60)
    basis = share[:, None] ** np.array(_POWERS)
    values = np.linalg.lstsq(basis, share / (1.0 + upright.bend * share**2) - share, rcond=None)[0]
    lens = Radial(tuple(values / half ** (np.array(_POWERS) - 1.0)), _POWERS)
    middle = 0.5 * (np.array(size) - 1.0)
    return Camera(size, upright.phi * half, (float(middle[0]), float(middle[1])), lens)


def _distinct(cameras: Sequence[tuple[float, Camera]], turns: Sequence[Pose]) -> list[tuple[float, Camera]]:
    """The best of those that put the target, in any of its turns, into the same place."""
    chosen: list[tuple[float, Camera]] = []
    for score, camera in cameras:
        if len(chosen) == _MOST_FOLLOWED or (chosen and score < _WORTH_A_LOOK * chosen[0][0]):
            break
        if not any(_same(camera, other, turns) for _, other in chosen):
            chosen.append((score, camera))
    return chosen


def _same(one: Camera, other: Camera, turns: Sequence[Pose]) -> bool:
    for turn in turns:
        between = (one.cam_from_world @ turn) @ other.cam_from_world.inverse
        near = np.linalg.norm(between.translation) < _SAME_PLACE * max(one.position[2], other.position[2])
        if near and np.linalg.norm(rotation_log(between.rotation)) < _SAME_TURN:
            return True
    return False


def _shown(camera: Camera, target: Target) -> Shown:
    """The target's points that a camera sees, as somebody might have shown them."""
    pixels = camera.project(target.point_array)
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels > -0.5) & (pixels < np.array(camera.image_size) - 0.5), axis=1)
    rows = np.flatnonzero(inside)
    return Shown(rows.astype(np.int32), pixels[rows], np.full(len(rows), SIGMA_PX))


def _worth(camera: Camera, near: Nearness, strokes: Strokes, target: Target, curves: Collection[str]) -> float:
    """Twice what the target covers of the strokes, over strokes and target in view together, in px: 1 at best."""
    course = predict(target, camera, curves, _COURSE_PX)
    if not len(course):
        return 0.0
    shown = _COURSE_PX * len(course)
    return 2.0 * near.score(course.pixels) * shown / (shown + float(np.sum(strokes.length_px)))
