"""Whether what was followed is the field: what speaks against it, how good it is, and when two are one and the same."""

from __future__ import annotations

import numpy as np

from ceres_cal.detect.courses import predict
from ceres_cal.photographs.candidates import FieldSearch
from ceres_cal.photographs.follow import LEAST_SHARE, Followed
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target
from ceres_cal.start.initialise import PHI_RANGE

_COURSE_PX = 3.0
# Of the target: a stroke that lies on it. Wide paint's edge is that far from its middle. Nothing changes from half to
# double.
_NEAR_PX = 6.0
# Of the strokes inside the target's outline, the share that must lie on it. Nothing changes from 0.67 to 0.89.
_EXPLAINED = 0.8
_RIM = 0.02  # of its size
# Found on a curve, and curves of which so many were: fewer could be any lines. Nothing changes from half to double.
_FEWEST_PLACES, _FEWEST_CURVES = 5, 3
# Cosine of the tilt: 65 degrees, 20 more than is promised. Nothing changes at half of it; at double, 33 degrees,
# tilted views are missed.
_LEAST_UPRIGHT = 0.42
# Of the extent of what is seen: cameras that put it nearer together than that name it alike. Nothing changes from
# half to double.
_SAME_FLOOR = 0.1


def why_missed(followed: Followed, target: Target, *, started: bool) -> str:
    """Why lines that were followed are not the target's; for those that do not hold.

    Args:
        started: whether somebody said where to start.
    """
    if followed.share >= LEAST_SHARE:
        names = ", ".join(target.curve_names[number] for number in followed.absent)
        return f"there is no {names} where they should be: say which lines are not painted, or check the dimensions"
    share = f" (paint at {100.0 * followed.share:.0f} % of where this start, moved, puts them)" if started else ""
    elsewhere = "start from other points" if started else "start from corners"
    return f"its lines were not found{share}: check the target's dimensions and which lines are painted, or {elsewhere}"


def objection(search: FieldSearch, followed: Followed) -> str:
    """What speaks against taking what was followed for the field, or nothing."""
    if not followed.holds:
        return why_missed(followed, search.target, started=False)
    names = detected_curves(search, followed)
    if len(names) < _FEWEST_CURVES or not _in_two_directions(search, names):
        return f"only {', '.join(names)} would be in the picture: too little to find a field by; start from corners"
    phi = followed.camera.phi / search.stroke_map.unit_px
    if -followed.camera.cam_from_world.rotation[2, 2] < _LEAST_UPRIGHT or not PHI_RANGE[0] < phi < PHI_RANGE[1]:
        return "its lines were not found in any view from above: start from corners"
    share = explained(search, followed.camera)
    if share < _EXPLAINED:
        return (
            f"of the bright lines where the field would be, only {100.0 * share:.0f} % are lines of it: "
            "check the target's dimensions and which lines are painted, or start from corners"
        )
    return ""


def dice(search: FieldSearch, camera: Camera) -> float:
    """Dice's coefficient of strokes and target, by length: twice what one covers of the other, over both together."""
    course = predict(search.target, camera, search.curves, _COURSE_PX)
    in_view = _COURSE_PX * len(course)
    covered = search.stroke_map.near.score(course.pixels) * in_view if len(course) else 0.0
    return 2.0 * covered / (in_view + float(np.sum(search.stroke_map.strokes.length_px)))


def explained(search: FieldSearch, camera: Camera) -> float:
    """Of the strokes inside the target's outline, the share (by length) that lies on its curves."""
    strokes = search.stroke_map.strokes
    middles = strokes.ends.mean(axis=1)
    places = search.grid.outline
    margin = _RIM * np.ptp(places, axis=0)
    floor = camera.locate(middles) @ search.grid.turn
    with np.errstate(invalid="ignore"):
        inside = np.all((floor > places.min(axis=0) - margin) & (floor < places.max(axis=0) + margin), axis=1)
    course = predict(search.target, camera, search.curves, _COURSE_PX)
    if not np.any(inside) or not len(course):
        return 0.0
    away = np.min(np.linalg.norm(middles[inside, None] - course.pixels, axis=2), axis=1)
    return float(np.average(away < _NEAR_PX, weights=strokes.length_px[inside]))


def same_labels(search: FieldSearch, one: Followed, other: Followed) -> bool:
    """Whether two put what is seen onto the same places of the target, whatever its turn."""
    pixels = one.lines.pixels[one.lines.found]
    here, there = (np.column_stack([c.locate(pixels), np.zeros(len(pixels))]) for c in (one.camera, other.camera))
    extent = float(np.max(np.ptp(here, axis=0)))
    away = [np.linalg.norm(turn.inverse.transform(here) - there, axis=1) for turn in search.turns]
    return min(float(np.median(np.nan_to_num(one, nan=np.inf))) for one in away) < _SAME_FLOOR * extent


def detected_curves(search: FieldSearch, followed: Followed) -> list[str]:
    """Names of the curves that were found."""
    numbers, places = np.unique(followed.lines.course.curve[followed.lines.found], return_counts=True)
    return [search.target.curve_names[number] for number in numbers[places >= _FEWEST_PLACES]]


def _in_two_directions(search: FieldSearch, names: list[str]) -> bool:
    """Whether these curves run in more than one direction."""
    numbers = [search.target.curve_names.index(name) for name in names]
    tracks, is_arc = search.target.tracks[0, numbers], search.target.is_arc[numbers]
    ways = tracks[~is_arc, 1, :2]
    parallel = np.abs(ways[:, 0] * ways[:1, 1] - ways[:, 1] * ways[:1, 0]) < 1e-6 * np.linalg.norm(ways, axis=1)
    return bool(np.any(is_arc) or not np.all(parallel))
