"""Judgement of whether followed lines are the field: objections, likelihood, and when two results are the same."""

from __future__ import annotations

import numpy as np

from ceres_cal.base import Array, Frozen, Mask, median, replace
from ceres_cal.detect.courses import predict
from ceres_cal.detect.photographs.candidates import FieldSearch
from ceres_cal.detect.photographs.field_lines import LEAST_SHARE, FieldLines
from ceres_cal.detect.photographs.matching import divergence
from ceres_cal.detect.photographs.painted import BY_CHANCE
from ceres_cal.problem.quantities import is_lens
from ceres_cal.scene import Arc, Target

# Largest distance of a stroke that lies on the target, px: the edge of wide paint is that far from its middle. Nothing
# changes from half to double.
_NEAR_PX = 6.0
# Least share of strokes on the target, among those that could be its lines. On photographs with cables, seams and
# stripes of sun it is 0.83 or more, for other fields 0.6 at most.
_EXPLAINED = 0.75
# Least share of strokes on the target among all strokes, including those beside it, where walls and boundary lines run:
# first if some of the target's lines are absent, then if all are there. The share is 0.61 or more where the target is
# seen whole, and less where a wider boundary line shows more strokes than the target's lines do.
_OF_ALL, _OF_ALL_IF_WHOLE = 0.55, 0.4
# _LAID: number of straight lines that a camera can place on any others by position, size and bend. The other limits are
# of the negative log of the chance that the remaining lines lie on strokes by coincidence. From _NO_CHANCE on,
# unexplained strokes are accepted as other lines (13 where such lines are, 7 for other fields); from _IF_AS_DRAWN on
# where each line is seen to lie as drawn, to millimetres. Below _BY_ANY a corner may be any corner, so _IF_ANY of the
# strokes must be explained: 0.92 are, for other fields 0.88.
_LAID, _NO_CHANCE, _IF_AS_DRAWN, _BY_ANY, _IF_ANY = 5, 9.0, 4.0, 2.0, 0.9
# Largest sine of the angle between a stroke and the lines: 4 degrees. Least strength of another line, as a share of the
# usual strength of strokes on the lines.
_PARALLEL, _AS_STRONG = 0.07, 0.5
# Least number of places found on a curve, and of curves with so many: fewer could be any lines. Nothing changes from
# half to double.
_FEWEST_PLACES, _FEWEST_CURVES = 5, 3
# Least cosine of the tilt: 78 degrees, 8 more than is promised. At double, 65 degrees, a third of the photographs are
# missed that are taken by hand beside a field.
_LEAST_UPRIGHT = 0.21
# Distance, as a share of the extent of what is seen, within which two cameras give it the same names. Nothing changes
# from half to double.
_SAME_FLOOR = 0.1


def why_missed(followed: FieldLines, target: Target, *, started: bool) -> str:
    """Return why followed lines are not the target's, for a result that does not hold.

    Args:
        started: whether a start was given.
    """
    if followed.built.is_other:
        asked = ",".join(name.removesuffix("_m") for name in followed.built.dimensions)
        help_ = f": correct the target, or estimate it (--estimate {asked})" if asked else ""
        return "; ".join(followed.built.words()) + help_
    if followed.share >= LEAST_SHARE:
        names = ", ".join(target.curve_names[number] for number in followed.absent)
        return f"{names} were not found at their places: say which lines are not painted, or check the dimensions"
    share = f" (paint at {100.0 * followed.share:.0f} % of where this start, refined, predicts it)" if started else ""
    elsewhere = "start from other points" if started else "start from corners"
    return f"its lines were not found{share}: check the target's dimensions and which lines are painted, or {elsewhere}"


def objection(search: FieldSearch, followed: FieldLines) -> str:
    """Return what speaks against taking the followed lines for the field, or ""."""
    lowest = 0.01  # height as a share of the field's extent: below, its middle is seen at an angle of a degree
    if not is_shown(search, followed) or followed.built.is_other:
        return why_missed(followed, search.grid.target, started=False)
    names = detected_curves(search, followed)
    if len(names) < _FEWEST_CURVES or not _in_two_directions(search, names):
        return f"only {', '.join(names)} would be in the picture, too few lines to find a field: start from corners"
    upright = -followed.camera.cam_from_world.rotation[2, 2]
    extent_m = float(np.max(np.ptp(followed.target.box, axis=0)))
    is_above = upright > _LEAST_UPRIGHT and followed.camera.position[2] > lowest * extent_m
    if not (is_above and is_lens(followed.camera)):
        return "its lines were not found in any view from above: start from corners"
    share, of_all = explained(search, followed)
    told, as_drawn = coincidence(search, followed), followed.built.names and not followed.built.dimensions
    enough = _EXPLAINED, _OF_ALL if followed.absent else _OF_ALL_IF_WHOLE
    needed = _IF_ANY if told < _BY_ANY else enough
    if told < (_IF_AS_DRAWN if as_drawn else _NO_CHANCE) and np.any(np.less((share, of_all), needed)):
        share = min(share, of_all)
        return (
            f"only {100.0 * share:.0f} % of the bright lines in the area of the field belong to it: "
            "check the target's dimensions and which lines are painted, or start from corners"
        )
    return ""


def is_shown(search: FieldSearch, followed: FieldLines) -> bool:
    """Whether paint is found at enough places. A worn field may have fewer, if there are no other strokes, and if paint
    is on more than half of its curves: a few cables lie on some curves of any field.
    """
    # Least share of explained strokes for a field whose paint is found at fewer than half of the places; lines worn to
    # dashes have 1.
    explained_if_worn = 0.9
    if followed.holds or not followed.may_be_worn:
        return followed.holds
    if 2 * len({*detected_curves(search, followed), *followed.visible}) <= len(search.grid.curves):
        return False
    inside, everywhere = explained(search, followed)
    return everywhere > _EXPLAINED and inside > explained_if_worn


def likelihood(followed: FieldLines) -> float:
    """Log-likelihood ratio of the paint that was found for the target being there against lines laid anywhere.

    It counts places with paint: a grid that is shifted by a line has fewer of them.
    """
    return float(followed.places * divergence(max(followed.share, BY_CHANCE), BY_CHANCE))


def explained(search: FieldSearch, followed: FieldLines) -> tuple[float, float]:
    """Return the share of strokes that lie on the target's lines, among strokes inside its outline and among all
    strokes.

    Only strokes that could be its lines count: those parallel or perpendicular to them and as strong as those on them.
    Cables, seams, shadows and stripes of sun in other directions, or fainter ones, are no objection.
    """
    course_px = 3.0
    strokes, parallel = search.stroke_map.strokes, _parallel(search, followed)
    line = predict(followed.target, followed.camera, search.grid.curves, course_px).pixels
    everywhere, (low, high) = parallel.along | parallel.across, parallel.outline
    with np.errstate(invalid="ignore"):
        inside = everywhere & np.all((parallel.middle > low) & (parallel.middle < high), axis=1)
    middle, length_px = strokes.ends.mean(axis=1), strokes.length_px
    away = np.sum(line**2, axis=1)
    parts = np.array_split(middle, 1 + len(middle) // 128)  # each part fits into the processor's cache
    apart = [np.min(away - 2.0 * some @ line.T, axis=1, initial=np.inf) for some in parts]
    near = np.sum(middle**2, axis=1) + np.concatenate(apart) < _NEAR_PX**2

    def share(among: Mask) -> float:
        if not np.any(among & near):
            return 0.0
        strong = among & (strokes.strength > _AS_STRONG * median(strokes.strength[among & near]))
        return float(np.average(near[strong], weights=length_px[strong]))

    return share(inside), share(everywhere)


class _Parallel(Frozen):
    """The N strokes on the floor, in the grid: their middles (N, 2) m, half a pixel there (N,) m, whether they are
    parallel to its lines or perpendicular, (N,) each, and the corners (2, 2) m of the target's outline.
    """

    middle: Array
    pixel_m: Array
    along: Mask
    across: Mask
    outline: Array


def _parallel(search: FieldSearch, followed: FieldLines) -> _Parallel:
    rim = 0.02  # as a share of the target's size
    strokes = search.stroke_map.strokes
    ends = np.stack([followed.camera.locate(strokes.ends[:, end]) @ search.grid.turn for end in (0, 1)])
    x, y = np.abs(ends[1] - ends[0]).T
    places = replace(search.grid, target=followed.target).outline
    margin = rim * np.ptp(places, axis=0)
    outline = np.array([places.min(axis=0) - margin, places.max(axis=0) + margin])
    with np.errstate(invalid="ignore"):
        pixel_m = np.hypot(x, y) / np.maximum(strokes.length_px, 1.0)
        return _Parallel(ends.mean(axis=0), pixel_m, y < _PARALLEL * x, x < _PARALLEL * y, outline)


def coincidence(search: FieldSearch, followed: FieldLines) -> float:
    """Negative log of the chance that lines of something else lie where all of the target's do.

    The chance for each straight line is the share of positions beside it, all over the field, that have as many strokes
    as its own. Where strokes are everywhere, as on striped floors, this decides nothing; and a camera can place a few
    lines on any others.
    """
    tried, as_many, near_px = 300, 0.8, 2.0
    parallel, turn, target = _parallel(search, followed), search.grid.turn, followed.target
    chances = [1.0] * _LAID
    for name in followed.curves:
        curve = target.curves[name]
        if isinstance(curve, Arc):
            continue
        ends = np.array([curve.start[:2], curve.end[:2]]) @ turn
        axis = int(np.argmax(np.ptp(ends, axis=0)))
        middle, (low, high) = parallel.middle[:, axis], np.sort(ends[:, axis])
        with np.errstate(invalid="ignore"):
            rows = (parallel.along, parallel.across)[axis] & (middle > low) & (middle < high)
        first, last = parallel.outline[:, 1 - axis]
        places = np.append(ends[0, 1 - axis], np.linspace(first, last, tried))
        near = np.abs(parallel.middle[rows, 1 - axis] - places[:, None]) < near_px * parallel.pixel_m[rows]
        covered = near @ (search.stroke_map.strokes.length_px * parallel.pixel_m)[rows]
        chances.append(float(np.mean(covered >= as_many * covered[0])))
    return -float(np.sum(np.log(np.sort(chances)[_LAID:])))


def same_labels(search: FieldSearch, one: FieldLines, other: FieldLines) -> bool:
    """Whether two results place what is seen at the same places of the target, whatever its turn."""
    pixels = one.lines.pixels[one.lines.found]
    here, there = (np.column_stack([c.locate(pixels), np.zeros(len(pixels))]) for c in (one.camera, other.camera))
    extent = float(np.max(np.ptp(here, axis=0)))
    away = [np.linalg.norm(turn.inverse.transform(here) - there, axis=1) for turn in search.grid.turns]
    return min(median(np.nan_to_num(one, nan=np.inf)) for one in away) < _SAME_FLOOR * extent


def detected_curves(search: FieldSearch, followed: FieldLines) -> list[str]:
    """Return the names of the curves that were found."""
    numbers, places = np.unique(followed.lines.course.curve[followed.lines.found], return_counts=True)
    return [search.grid.target.curve_names[number] for number in numbers[places >= _FEWEST_PLACES]]


def _in_two_directions(search: FieldSearch, names: list[str]) -> bool:
    """Whether these curves have more than one direction."""
    numbers = [search.grid.target.curve_names.index(name) for name in names]
    tracks, is_arc = search.grid.target.tracks[0, numbers], search.grid.target.is_arc[numbers]
    ways = tracks[~is_arc, 1, :2]
    parallel = np.abs(ways[:, 0] * ways[:1, 1] - ways[:, 1] * ways[:1, 0]) < 1e-6 * np.linalg.norm(ways, axis=1)
    return bool(np.any(is_arc) or not np.all(parallel))
