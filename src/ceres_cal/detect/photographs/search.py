"""The field in a photograph without any start: candidates are followed and judged, and one of its turns is chosen."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import Array32, CalibrationError, Frozen, InputError, attempt, replace
from ceres_cal.detect.photographs.by_hand import SIGMA_PX, unknown_optics
from ceres_cal.detect.photographs.candidates import (
    BUDGET_S,
    Auto,
    FieldSearch,
    alike,
    candidates,
    narrowed,
    off_centre,
    prepare_search,
)
from ceres_cal.detect.photographs.field_lines import SURE_SHARE, FieldLines
from ceres_cal.detect.photographs.follow import Tracker
from ceres_cal.detect.photographs.grid import (
    Facing,
    agreeing_with_facing,
    distinguishing_feature,
    grid_of,
    nearest_to_before,
    require_sides,
    side_of,
)
from ceres_cal.detect.photographs.judgement import detected_curves, explained, likelihood, objection, same_labels
from ceres_cal.detect.photographs.refit import PointHints
from ceres_cal.detect.strokes import Strokes
from ceres_cal.scene import Camera, Target, in_image
from ceres_cal.scene.targets import others_of_kind

# Of the strokes explained, by the first without an objection: no other is followed, nor after one whose lines lie as
# drawn to millimetres. It only saves time. Nothing changes from 0.82 to 0.95.
_SURE = 0.9
# Of the best one's likelihood: another way to see the picture that is as good makes it ambiguous. Of a circle and a
# cross a quarter turn that is wrong has 1.1 times as much as the right one.
_AS_GOOD = 0.87
# The likeliest candidates, which a lens of another kind may suit: of 41 pictures that show the field one needs two.
_MOST_REFINED = 2
OTHER = "it shows {0}: give that as the target (--target {0})"
_NO_LINES = (
    "no lines at right angles that could be this field's, two one way and one across: "
    "check the target's dimensions, or start from corners"
)


class SeveralWaysError(InputError):
    """The field is found, but what is known does not say which way round, or contradicts all ways; `seen` is one."""

    def __init__(self, message: str, seen: FieldLines) -> None:
        super().__init__(message)
        self.seen = seen


class SearchResult(Frozen):
    """What came of looking for the field.

    Attributes:
        followed: the field, or None. reason: why none was found.
        seen: the best candidate, where none is the field.
        ways: in how many ways the photograph can be taken for the field; 0: none was looked for, a start was given.
            chosen_by: what chose one of them: "facing", "before", or nothing, where there is but one.
        darker: whether its lines were looked for as darker ones than the floor.
        shows: the name of another target of the same kind that is found in its place.
    """

    followed: FieldLines | None
    reason: str = ""
    ways: int = 0
    chosen_by: str = ""
    seen: FieldLines | None = None
    darker: bool = False
    shows: str = ""


def search(
    grey: Array32, target: Target, curves: Collection[str], auto: Auto, strokes: Strokes | None = None
) -> SearchResult:
    """Find a target's painted curves in a photograph and follow them.

    The picture must show straight lines at right angles, two one way and one across at least; whatever else the target
    has takes part in telling the ways apart. Nothing is known of the lens but that it is about radial and centred; the
    camera looks down, at up to 55 degrees from the upright. A mirrored photograph of a field that is its own mirror
    image looks like another one's: it cannot be told, and is not.

    Args:
        strokes: of the photograph, where they were looked for already.

    Raises:
        SeveralWaysError: the photograph can be taken for the field in several ways, and nothing says which.
        InputError: the target has too few straight lines, or nothing that `auto.facing` names.
    """
    require_sides(auto.facing, target, curves)
    problem = prepare_search(grey, target, curves, auto, strokes)
    result = _search_about(problem)
    if result.followed is not None:
        return result
    for name, other in others_of_kind(target).items():
        if not problem.is_out_of_time and _shows(problem, other):
            return replace(result, reason=OTHER.format(name), shows=name)
    moved = off_centre(problem)
    if moved is problem:
        return result
    about = _search_about(moved)
    return about if about.followed is not None else result


def _search_about(problem: FieldSearch) -> SearchResult:
    """The same about one middle of the lens."""
    good, seen, reason = _looked(problem, problem)
    if not good:
        good, other, against = _looked(problem, narrowed(problem))
        if seen is None or (other is not None and other.share > seen.share):
            seen, reason = other, against
    if problem.is_out_of_time:
        return _given_up(seen)
    if not good:
        return SearchResult(None, reason, seen=seen)
    best = max(good, key=likelihood)
    problem = replace(problem, grid=grid_of(best.target, problem.grid.curves))
    similar = alike(problem, best.camera, detected_curves(problem, best))
    others = [_followed(problem, _turned(problem, camera)) for camera in similar]
    if problem.is_out_of_time:  # it may look alike in ways that nobody looked at
        return _given_up(best)
    distinct = [best]
    for other in (*good, *(one for one in others if not objection(problem, one))):
        as_good = likelihood(other) >= _AS_GOOD * likelihood(best)
        if as_good and not any(same_labels(problem, other, one) for one in distinct):
            distinct.append(other)
    return _one_way(problem, distinct)


def _shows(problem: FieldSearch, target: Target) -> bool:
    """Whether the picture surely shows this target, as it is drawn, in the place of the one that was looked for."""
    grid = attempt(partial(grid_of, target, target.painted), InputError)  # quiet: it has no lines to be found by
    if isinstance(grid, CalibrationError):
        return False
    own = replace(problem, grid=grid, asked=Auto(), others=(), cameras=[], reached=[])
    for camera, grid in candidates(own)[:1]:
        own = replace(own, grid=grid)
        one = _followed(own, camera)
        if not objection(own, one):
            refined = _tracker(own, one.target, one.camera).refined_from(one.camera, one.lacks_wholly)
            return not objection(own, refined) and not refined.built.dimensions
    return False


def _looked(problem: FieldSearch, among: FieldSearch) -> tuple[list[FieldLines], FieldLines | None, str]:
    """What may be the field, by candidates from some strokes; else the best there is, and what speaks against it."""
    good: list[FieldLines] = []
    seen: FieldLines | None = None
    reason, refined = _NO_LINES, 0
    for camera, grid in candidates(among):
        if problem.is_out_of_time:
            break
        own = replace(problem, grid=grid)
        first = followed = _followed(own, _turned(problem, camera))
        if any(followed is one for one in problem.refused):
            continue
        against = objection(problem, followed)
        if against and refined < _MOST_REFINED and (followed.holds or followed.share >= SURE_SHARE):
            refined += 1
            there = followed.camera
            followed = _tracker(problem, grid.target, there).refined_from(there, followed.lacks_wholly)
            against = objection(problem, followed)
        if not against:
            good.append(followed)
        else:
            problem.refused.append(first)
            if seen is None or followed.share > seen.share:
                seen, reason = followed, against
        if good and (good[-1].built.names or explained(problem, good[-1])[0] > _SURE):
            break
    return good, seen, reason


def _given_up(seen: FieldLines | None) -> SearchResult:
    why = f"the field was not found within {BUDGET_S:g} s of processor time"
    return SearchResult(None, f"{why}: check the target's dimensions, or start from corners", seen=seen)


def _turned(problem: FieldSearch, camera: Camera) -> Camera:
    """The one of a camera's turns that what is known favours, so that it need not be followed again."""
    ways = [camera.at(camera.cam_from_world @ turn) for turn in problem.grid.turns]
    agreeing = _consistent(problem, ways)
    return ways[agreeing[0]] if agreeing else camera


def _followed(problem: FieldSearch, camera: Camera) -> FieldLines:
    """The target's lines from a camera that is about right, held by the points that it puts into the picture."""
    return _tracker(problem, problem.grid.target, camera).approached(camera)


def _tracker(problem: FieldSearch, target: Target, camera: Camera) -> Tracker:
    """What follows a target as it is drawn, from about there."""
    pixels = camera.project(target.point_array)
    rows = np.flatnonzero(in_image(pixels, camera.image_size))
    hints = PointHints(target, rows.astype(np.int32), pixels[rows], np.full(len(rows), SIGMA_PX))
    free = unknown_optics(camera, hints, problem.asked.lengths)
    return Tracker(problem.grey, target, problem.grid.curves, free, reached=problem.reached)


# ---- which way round ------------------------------------------------------------------------------------------------


def _one_way(problem: FieldSearch, distinct: Sequence[FieldLines]) -> SearchResult:
    """The one way that agrees with what is known; SeveralWaysError where none does, or several."""
    target, curves = problem.grid.target, problem.grid.curves
    ways = [one.camera.at(one.camera.cam_from_world @ turn) for one in distinct for turn in problem.grid.turns]
    agreeing = _consistent(problem, ways)
    number = agreeing[0] if agreeing else 0
    camera, one = ways[number], distinct[number // len(problem.grid.turns)]
    is_refined = one.built.names and number % len(problem.grid.turns) == 0  # and not turned
    followed = one if is_refined else _tracker(problem, one.target, camera).refined_from(camera, one.lacks_wholly)
    if against := objection(problem, followed):
        return SearchResult(None, against, seen=followed)
    if not agreeing:
        raise SeveralWaysError(_contradiction(ways, problem.asked.facing, target, curves), followed)
    if len(agreeing) > 1:
        raise SeveralWaysError(
            f"the field is found, but it looks alike in {len(agreeing)} ways: "
            f"{_sides([ways[number] for number in agreeing], target, curves)}",
            followed,
        )
    chosen_by = "" if len(ways) == 1 else "facing" if problem.asked.facing else "before"
    return SearchResult(followed, "", len(ways), chosen_by)


def _consistent(problem: FieldSearch, cameras: Sequence[Camera]) -> list[int]:
    """Numbers of the cameras that agree with what is known; one alone needs no old calibration to agree with."""
    if problem.asked.facing:
        return agreeing_with_facing(cameras, problem.asked.facing, problem.grid.target, problem.grid.curves)
    if problem.asked.before is not None and len(cameras) > 1:
        return nearest_to_before(cameras, problem.asked.before)
    return list(range(len(cameras)))


def _contradiction(ways: Sequence[Camera], facing: Sequence[Facing], target: Target, curves: Collection[str]) -> str:
    """That no way agrees with all of what is known."""
    given = ", ".join(f"{one.feature}={one.side}" for one in facing)
    if len(facing) > 1 and all(agreeing_with_facing(ways, [one], target, curves) for one in facing):
        return f"{given} hold together in a mirrored picture only: mirror it back, or check them"
    return f"not with {given}: in this photograph {_sides(ways, target, curves)}"


def _sides(cameras: Sequence[Camera], target: Target, curves: Collection[str]) -> str:
    """Where something that tells these cameras apart lies, and how to say which is meant."""
    name = distinguishing_feature(target, curves)
    sides = list(dict.fromkeys(side_of(name, camera, target, curves) for camera in cameras))
    if len(sides) < len(cameras):
        heights = ", ".join(f"{camera.position[2]:.1f} m" for camera in cameras)
        return f"seen from {heights}, with {name} towards the {' or '.join(sides)}: start from corners instead"
    return (
        f"{name} lies towards the {' or the '.join(sides)} of the picture: "
        f"say which, such as --facing {name}={sides[0]}, or give an old calibration of the station (--start)"
    )
