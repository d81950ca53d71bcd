"""Search for the field without an initial estimate: candidates are followed and judged, and one view is chosen."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import cache, partial

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

# Share of explained strokes for which the first candidate without an objection ends the search, to save time; so does
# one whose lines lie as drawn to millimetres. Nothing changes from 0.82 to 0.95.
_SURE = 0.9
# Share of the best likelihood from which on another view makes the picture ambiguous. For a circle and a cross, a wrong
# quarter turn has 1.1 times the likelihood of the right one.
_AS_GOOD = 0.87
# Number of the likeliest candidates that are refined with another kind of lens: of 41 pictures that show the field one
# needs two.
_MOST_REFINED = 2
OTHER = "it shows {0}: give that as the target (--target {0})"
_NO_LINES = (
    "no lines at right angles (two in one direction, one across) that fit this field: "
    "check the target's dimensions, or start from corners"
)


class SeveralWaysError(InputError):
    """The field is found, but what is known does not determine its orientation, or contradicts all; `seen` is one of
    them.
    """

    def __init__(self, message: str, seen: FieldLines) -> None:
        super().__init__(message)
        self.seen = seen


class SearchResult(Frozen):
    """Result of a search for the field.

    Attributes:
        followed: the field, or None. reason: why none was found.
        ways: number of ways in which the photograph can be taken for the field; 0 if a start was given.
        chosen_by: what chose one of several ways: "facing" or "before"; empty if there is only one.
        seen: the best candidate, where none is the field.
        darker: whether lines darker than the floor were searched.
        shows: name of another target of the same kind that is found instead.
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

    The picture must show straight lines at right angles, at least two one way and one across; all other curves of the
    target help to decide between possible views. Of the lens it is only assumed that it is approximately radial and
    centred. The camera looks down, tilted by up to 70 degrees. A mirrored photograph of a field that is its own mirror
    image looks like another field's; this cannot be detected.

    Args:
        strokes: strokes of the photograph, if they are known already.

    Raises:
        SeveralWaysError: the photograph can be taken for the field in several ways, and nothing decides between them.
        InputError: the target has too few straight lines, or nothing that `auto.facing` names.
    """
    require_sides(auto.facing, target, curves)
    problem = prepare_search(grey, target, curves, auto, strokes)

    @cache
    def shown() -> str:
        """The name of another target that the picture shows, "" of none."""
        others = others_of_kind(target).items()
        return next((name for name, one in others if not problem.is_out_of_time and _shows(problem, one)), "")

    result = _search_about(problem, shown)
    if result.followed is not None:
        return result
    if name := shown():
        return replace(result, reason=OTHER.format(name), shows=name)
    moved = off_centre(problem)
    if moved is problem:
        return result
    about = _search_about(moved, shown)
    return about if about.followed is not None else result


def _search_about(problem: FieldSearch, shown: Callable[[], str]) -> SearchResult:
    """Search with one assumed centre of the lens; the second search is left out where another target is `shown`."""
    good, seen, reason = _looked(problem, problem)
    if not (good or shown()):
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
    if problem.is_out_of_time:  # other views that look alike may not have been tried
        return _given_up(best)
    distinct = [best]
    for other in (*good, *(one for one in others if not objection(problem, one))):
        as_good = likelihood(other) >= _AS_GOOD * likelihood(best)
        if as_good and not any(same_labels(problem, other, one) for one in distinct):
            distinct.append(other)
    return _one_way(problem, distinct)


def _shows(problem: FieldSearch, target: Target) -> bool:
    """Whether the picture surely shows this target, as it is drawn, instead of the one that was searched."""
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
    """Return candidates from some strokes that may be the field, the best of the others, and what speaks against it."""
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
    """Return the turn of a camera that agrees best with what is known, so that it need not be followed again."""
    ways = [camera.at(camera.cam_from_world @ turn) for turn in problem.grid.turns]
    agreeing = _consistent(problem, ways)
    return ways[agreeing[0]] if agreeing else camera


def _followed(problem: FieldSearch, camera: Camera) -> FieldLines:
    """Follow the target's lines from a camera that is about right, held by the points that it puts into the picture."""
    return next(_tracker(problem, problem.grid.target, camera).tried([camera]))


def _tracker(problem: FieldSearch, target: Target, camera: Camera) -> Tracker:
    """Return a tracker of a target as it is drawn, from a camera that is about right."""
    pixels = camera.project(target.point_array)
    rows = np.flatnonzero(in_image(pixels, camera.image_size))
    hints = PointHints(target, rows.astype(np.int32), pixels[rows], np.full(len(rows), SIGMA_PX))
    free = unknown_optics(camera, hints, problem.asked.lengths)
    return Tracker(problem.grey, target, problem.grid.curves, free, reached=problem.reached)


# ---- which way round ------------------------------------------------------------------------------------------------


def _one_way(problem: FieldSearch, distinct: Sequence[FieldLines]) -> SearchResult:
    """Return the one view that agrees with what is known; SeveralWaysError where none does, or several."""
    target, curves = problem.grid.target, problem.grid.curves
    ways = [one.camera.at(one.camera.cam_from_world @ turn) for one in distinct for turn in problem.grid.turns]
    agreeing = _consistent(problem, ways)
    number = agreeing[0] if agreeing else 0
    camera, one = ways[number], distinct[number // len(problem.grid.turns)]
    is_refined = one.built.names and number % len(problem.grid.turns) == 0  # only the unturned view was refined
    followed = one if is_refined else _tracker(problem, one.target, camera).refined_from(camera, one.lacks_wholly)
    if against := objection(problem, followed):
        return SearchResult(None, against, seen=followed)
    if not agreeing:
        raise SeveralWaysError(_contradiction(ways, problem.asked.facing, target, curves), followed)
    if len(agreeing) > 1:
        raise SeveralWaysError(
            f"the field was found, but {len(agreeing)} orientations look the same: "
            f"{_sides([ways[number] for number in agreeing], target, curves)}",
            followed,
        )
    chosen_by = "" if len(ways) == 1 else "facing" if problem.asked.facing else "before"
    return SearchResult(followed, "", len(ways), chosen_by)


def _consistent(problem: FieldSearch, cameras: Sequence[Camera]) -> list[int]:
    """Indices of the cameras that agree with what is known; a single camera need not agree with an old calibration."""
    if problem.asked.facing:
        return agreeing_with_facing(cameras, problem.asked.facing, problem.grid.target, problem.grid.curves)
    if problem.asked.before is not None and len(cameras) > 1:
        return nearest_to_before(cameras, problem.asked.before)
    return list(range(len(cameras)))


def _contradiction(ways: Sequence[Camera], facing: Sequence[Facing], target: Target, curves: Collection[str]) -> str:
    """Message that no view agrees with all of what is known."""
    given = ", ".join(f"{one.feature}={one.side}" for one in facing)
    if len(facing) > 1 and all(agreeing_with_facing(ways, [one], target, curves) for one in facing):
        return f"{given} agree only if the picture is mirrored: mirror it back, or check them"
    return f"{given} contradicts the photograph, in which {_sides(ways, target, curves)}"


def _sides(cameras: Sequence[Camera], target: Target, curves: Collection[str]) -> str:
    """Describe where a feature that distinguishes these cameras lies, and how to say which one is meant."""
    name = distinguishing_feature(target, curves)
    sides = list(dict.fromkeys(side_of(name, camera, target, curves) for camera in cameras))
    if len(sides) < len(cameras):
        heights = ", ".join(f"{camera.position[2]:.1f} m" for camera in cameras)
        return f"the camera is at {heights}, with {name} towards the {' or '.join(sides)}: start from corners instead"
    return (
        f"{name} lies towards the {' or the '.join(sides)} of the picture: "
        f"say which, such as --facing {name}={sides[0]}, or give an old calibration of the station (--start)"
    )
