"""Frames of several cameras that were taken at the same moment, as stated by a rule and never guessed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from itertools import pairwise

from ceres_cal.base import InputError, finite, replace
from ceres_cal.observations.columns import View
from ceres_cal.observations.observations import Observations

RULES = "'left*,right*' (the part at * names the moment), index (in their order), or within:0.01 (numbers as names)"

_Frames = Mapping[str, tuple[str, ...]]  # names of each camera's frames, in the order of its views
_Moments = Mapping[tuple[str, str], str]  # name of the moment, by camera and frame


def with_same_frames(observations: Observations, rule: str) -> Observations:
    """Return the observations with frames renamed so that frames of one moment have one name in all cameras.

    A placement that has its frame's name, as detected boards have, is renamed, too: then the cameras see one board at
    one place.

    Args:
        rule: patterns separated by commas, exactly one of which fits each frame, such as "left*,right*"; what * stands
            for names the moment. "index": the n-th frames of all cameras belong together. "within:T": frame names are
            numbers, such as time stamps; frames of two cameras belong together if they are T or less apart.

    Raises:
        InputError: a frame that no pattern or more than one fits, different numbers of frames for "index", names that
            are no numbers, T at least half of the distance between frames of one camera, or no frames that belong
            together.
    """
    frames: dict[str, tuple[str, ...]] = {}
    for camera in observations.cameras:
        frames[camera] = tuple(dict.fromkeys(view.frame for view in observations.views if view.camera == camera))
    if rule == "index":
        moments = _by_index(frames)
    elif rule.startswith("within:"):
        moments = _within(frames, rule)
    else:
        moments = _by_pattern(frames, rule.split(","))
    if len(set(moments.values())) == len(moments):
        raise InputError(f"same frames by {rule!r}: no two cameras have a frame in common: match frames by {RULES}")
    return replace(observations, views=tuple(_renamed(view, moments) for view in observations.views))


def _renamed(view: View, moments: _Moments) -> View:
    moment = moments[view.camera, view.frame]
    return replace(view, frame=moment, placement=moment if view.placement == view.frame else view.placement)


def _by_index(frames: _Frames) -> _Moments:
    if len({len(names) for names in frames.values()}) > 1:
        counts = ", ".join(f"{camera!r} has {len(names)}" for camera, names in frames.items())
        raise InputError(f"same frames by index: {counts} frames (one was not found?): match frames by {RULES}")
    return {(camera, name): f"{n:04d}" for camera, names in frames.items() for n, name in enumerate(names, start=1)}


def _by_pattern(frames: _Frames, patterns: Iterable[str]) -> _Moments:
    shapes = []
    for pattern in patterns:
        before, star, after = pattern.strip().partition("*")
        if not star or "*" in after:
            raise InputError(f"same frames by {pattern!r}: write one * in each pattern, such as 'left*,right*'")
        shapes.append(re.compile(f"{re.escape(before)}(.+){re.escape(after)}"))
    moments = {}
    for camera, names in frames.items():
        for name in names:
            fits = {found[1] for shape in shapes if (found := shape.fullmatch(name))}
            if len(fits) != 1:
                how = "several patterns fit" if fits else "no pattern fits"
                raise InputError(f"same frames: {how} frame {name!r} of camera {camera!r}: match frames by {RULES}")
            moments[camera, name] = fits.pop()
    return moments


def _within(frames: _Frames, rule: str) -> _Moments:
    times = {camera: [(_number(name, "a frame's name"), name) for name in names] for camera, names in frames.items()}
    most = _number(rule.removeprefix("within:"), rule)
    for camera, stamps in times.items():
        ordered = sorted(time for time, _ in stamps)
        apart = min((b - a for a, b in pairwise(ordered)), default=float("inf"))
        if not 0.0 <= most < 0.5 * apart:
            raise InputError(
                f"same frames by {rule!r}: must be below half of {apart:g}, the interval of frames of camera {camera!r}"
            )
    moments: dict[tuple[str, str], str] = {}
    first_seen: list[tuple[float, str]] = []
    for camera, stamps in times.items():
        for time, name in stamps:
            near = [moment for at, moment in first_seen if abs(at - time) <= most]
            if len(near) > 1:
                raise InputError(f"same frames by {rule!r}: frame {name!r} of camera {camera!r} is near two moments")
            moments[camera, name] = near[0] if near else name
        first_seen += [(time, name) for time, name in stamps if moments[camera, name] == name]
    return moments


def _number(text: str, where: str) -> float:
    return finite(text, InputError(f"same frames within a time: {text!r} is not a number ({where})"))
