"""Cameras that may have taken a photograph of a target, estimated from its strokes of paint alone."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import product
from time import thread_time

import numpy as np

from ceres_cal.base import Array, Array32, Frozen, Mask, Pose, chained, field, inverted, replace
from ceres_cal.detect.photographs.field_lines import FieldLines
from ceres_cal.detect.photographs.grid import Facing, LineGrid, grid_of, offsets_of
from ceres_cal.detect.photographs.matching import CROWDED, FloorLines, StrokeMap, lines_seen, match
from ceres_cal.detect.photographs.painted import likelihoods_of_places
from ceres_cal.detect.photographs.upright import Upright, best_score, find_upright
from ceres_cal.detect.registration import nearness_to
from ceres_cal.detect.strokes import Strokes, drawn, find_narrow_strokes, find_strokes
from ceres_cal.observations import Prior
from ceres_cal.problem.structure import redrawn
from ceres_cal.scene import Camera, Radial, Target, curve_points

_UPRIGHTS = 4  # largest number of solutions for lens and tilt that are matched
# Score of a match after which no other lens and tilt is tried, to save time. Nothing changes from 0.79 to 0.94.
_SURE = 0.88
_POWERS = (2, 3, 4, 5)
# Least score as a share of the best match's: of another candidate, and of another view of the same picture. Nothing
# changes from 0.6 to 0.86.
_COMPARABLE, _ALIKE = 0.3, 0.9
# Least likelihood of a candidate that is followed, as a share of the best one's. In 17 disturbed pictures others had
# 0.38 at most.
_LIKELY = 0.5
_MOST, _MOST_ALIKE = 4, 60
# Step, as a share of an unknown length, by which it is drawn longer and shorter, too: a match is nearly as good up to
# half a step away.
_LENGTH_STEP = 0.06
BUDGET_S = 60.0
"""Processor time for one photograph, s: ten times what one takes that shows the field (6 s on two cores). Without it
the search for another field, whose lines fit in ever more places, took more than 200 s.
"""
_SAME_PLACE, _SAME_TURN = 0.08, 0.1  # limits within which two cameras are the same, in camera heights and rad


class Auto(Frozen, eq=True):
    """No initial estimate: the field is to be found in the photograph.

    Attributes:
        facing: which way round the field is, where it looks the same when turned.
        before: alternatively, the station's camera before it was moved; the view with the least rotation from it is
            taken.
        lengths: priors on dimensions of the target that are to be estimated from the photograph.
    """

    facing: tuple[Facing, ...] = ()
    before: Camera | None = None
    lengths: tuple[Prior, ...] = ()


class FieldSearch(Frozen):
    """A photograph and the target that it may show.

    Attributes:
        grey: the photograph. stroke_map: its strokes. grid: the target's lines.
        asked: what is known of the field. others: the target drawn with other lengths, where some are unknown.
        until_s: processor time of this thread after which no further camera is tried, s.
        cameras: cameras of candidates so far. reached: results of following lines. refused: those results that are
            surely not the field.
    """

    grey: Array32
    stroke_map: StrokeMap
    grid: LineGrid
    asked: Auto
    others: tuple[LineGrid, ...] = ()
    until_s: float = np.inf
    cameras: list[Camera] = field(default_factory=list)
    reached: list[FieldLines] = field(default_factory=list)
    refused: list[FieldLines] = field(default_factory=list)

    @property
    def is_out_of_time(self) -> bool:
        return thread_time() > self.until_s


def prepare_search(
    grey: Array32, target: Target, curves: Collection[str], asked: Auto, strokes: Strokes | None = None
) -> FieldSearch:
    """Prepare a search: the strokes of a photograph and the lines that they may be.

    Args:
        strokes: the photograph's strokes if they are known already.

    Raises:
        InputError: the target has too few straight lines.
    """
    grid, *others = (grid_of(drawn, curves) for drawn in _drawings(target, curves, asked.lengths))
    until_s = thread_time() + BUDGET_S
    return FieldSearch(grey, _stroke_map(grey, strokes or find_strokes(grey)), grid, asked, tuple(others), until_s)


def narrowed(search: FieldSearch) -> FieldSearch:
    """Return the search with only the strokes of narrow paint: where nothing else was found, stripes may have hidden
    it.
    """
    strokes = find_narrow_strokes(search.grey, CROWDED * search.stroke_map.unit_px)
    return replace(search, stroke_map=_stroke_map(search.grey, strokes))


def off_centre(search: FieldSearch) -> FieldSearch:
    """Return the search with the lens centred in that quarter of the picture about which strokes are clearly straighter
    than about its middle, as in a picture that is a part of a sensor; unchanged if there is none.
    """
    # Distance of the centres from the middle, as a share of the picture; least gain in score.
    share, better = 0.22, 0.05
    middle, size = search.stroke_map, np.array(search.stroke_map.image_size)
    maps = [middle, *(replace(middle, centre=size * one) for one in product((0.5 - share, 0.5 + share), repeat=2))]
    scores = [best_score(one.ends, one.weights, search.grid.least_share) for one in maps]
    best = int(np.argmax(scores))
    return replace(search, stroke_map=maps[best]) if scores[best] > scores[0] + better else search


def _stroke_map(grey: Array32, strokes: Strokes) -> StrokeMap:
    size = (int(grey.shape[1]), int(grey.shape[0]))
    return StrokeMap(strokes, nearness_to(drawn(strokes, size)), size, 0.5 * (np.array(size) - 1.0))


def _drawings(target: Target, curves: Collection[str], lengths: Sequence[Prior]) -> Iterator[Target]:
    """Yield the target, then the target drawn with steps to either side in two lengths: those that move most paint."""
    yield target
    moved: dict[float, str] = {}
    for prior in lengths:
        if prior.sigma[0] > 0.5 * _LENGTH_STEP * prior.value[0]:
            other = redrawn(target, {prior.quantity: (1.0 + _LENGTH_STEP) * prior.value[0]})
            ways = [curve_points(one.curves[name], 0, 20) for name in curves for one in (target, other)]
            paint = sum(
                float(np.mean(np.linalg.norm(here - there, axis=1))) * target.curves[name].length_m
                for name, here, there in zip(curves, ways[::2], ways[1::2], strict=True)
            )
            moved[paint] = prior.quantity
    names = [moved[paint] for paint in sorted(moved, reverse=True)[:2]]
    for steps in product((0.0, -_LENGTH_STEP, _LENGTH_STEP), repeat=len(names)):
        if any(steps):
            yield redrawn(target, {n: (1.0 + s) * target.dimensions[n] for n, s in zip(names, steps, strict=True)})


def candidates(search: FieldSearch) -> list[tuple[Camera, LineGrid]]:
    """Return cameras that may have taken the photograph, the best first, and how the target was drawn for each. Turns
    of the target count as one camera, and cameras that an earlier search among other strokes returned are omitted.
    """
    scored: list[tuple[float, Camera]] = []
    drawn: dict[int, LineGrid] = {}
    ends, weights = search.stroke_map.ends, search.stroke_map.weights
    for upright in find_upright(ends, weights, _UPRIGHTS, search.grid.least_share):
        optics = _optics(upright, search.stroke_map)
        seen = lines_seen(upright, search.stroke_map)
        for grid in (search.grid, *search.others):
            matched = match(upright, search.stroke_map, grid, seen, _COMPARABLE)
            found = [(score, optics.at(pose)) for score, pose in matched]
            drawn |= {id(camera): grid for _, camera in found}
            scored += found
        if scored and max(score for score, _ in scored) > _SURE:
            break
    distinct = _distinct(sorted(scored, key=lambda one: -one[0]), search.grid.turns, _COMPARABLE)
    likely = _likely(search, [(camera, drawn[id(camera)]) for camera in distinct])
    before = _poses(search.cameras)
    new = [one for one in likely if not np.any(_same_place(one[0].cam_from_world.matrix, before, search.grid.turns))]
    search.cameras.extend(camera for camera, _ in new)
    return new


def alike(search: FieldSearch, camera: Camera, detected: Collection[str]) -> list[Camera]:
    """Return other cameras with similar optics that may have taken the photograph, too: turned by quarters, moved,
    higher or lower.

    Args:
        camera: a camera that may have taken it.
        detected: names of the curves that were found with it.
    """
    stroke_map = replace(search.stroke_map, centre=np.array(camera.principal_point))
    upright = _upright_of(camera, search)
    x, y = camera.position[:2] @ search.grid.turn
    along, across = offsets_of(search.grid.target, detected, search.grid.turn)
    lines = FloorLines((across - x) / camera.position[2], (along - y) / camera.position[2])
    optics = _optics(upright, stroke_map)
    matched = match(upright, stroke_map, search.grid, lines, _ALIKE)
    others = [(score, optics.at(pose)) for score, pose in matched]
    distinct = [camera, *_distinct(others, search.grid.turns, _ALIKE, camera)]
    likely = _likely(search, [(one, search.grid) for one in distinct])
    return [one for one, _ in likely if one is not camera]


def _likely(search: FieldSearch, cameras: Sequence[tuple[Camera, LineGrid]]) -> list[tuple[Camera, LineGrid]]:
    """Return, the best first, the cameras whose predicted lines are seen in the picture about as well as the best
    one's, and the first camera of those given.
    """
    # After the time limit the rest is left out, which the caller reports.
    in_time = ((grid.target, camera) for camera, grid in cameras if not search.is_out_of_time)
    likelihood = likelihoods_of_places(search.grey, in_time, search.grid.curves)
    order = np.argsort(-np.array(likelihood), kind="stable")[:_MOST].tolist()
    best = likelihood[order[0]] if likelihood else 0.0
    likely = [row for row in order if likelihood[row] >= min(_LIKELY * best, best)]
    # The best match of strokes is always followed: boxes on the floor may cover one line and leave another.
    return [cameras[row] for row in dict.fromkeys([*likely, *range(len(cameras))[:1]])]


# ---- one coefficient and lenses -------------------------------------------------------------------------------------


def _optics(upright: Upright, stroke_map: StrokeMap) -> Camera:
    """Return a camera with the polynomial that is nearest to the one coefficient, over the image."""
    share = np.linspace(0.0, 1.02, 60)  # radius in units of half the image's diagonal
    ideal = share / (1.0 + upright.bend * share**2)
    values = np.linalg.lstsq(share[:, None] ** np.array(_POWERS), ideal - share, rcond=None)[0]
    lens = Radial(tuple(values / stroke_map.unit_px ** (np.array(_POWERS) - 1.0)), _POWERS)
    x, y = stroke_map.centre
    return Camera(stroke_map.image_size, upright.phi * stroke_map.unit_px, (float(x), float(y)), lens)


def _upright_of(camera: Camera, search: FieldSearch) -> Upright:
    share, unit = np.linspace(0.1, 1.0, 30), search.stroke_map.unit_px
    rays = camera.lens.undistort(np.column_stack([share * unit, np.zeros(30)]), camera.phi)
    ahead = np.isfinite(rays[:, 2]) & (rays[:, 2] > 0.0)
    stretch = share[ahead] * unit * rays[ahead, 2] / (camera.phi * rays[ahead, 0]) - 1.0  # c p^2
    bend = float(stretch @ share[ahead] ** 2 / np.sum(share[ahead] ** 4))
    turn = np.eye(3)
    turn[:2, :2] = search.grid.turn
    return Upright(bend, camera.phi / unit, camera.cam_from_world.rotation @ turn, 1.0)


# ---- one and the same -----------------------------------------------------------------------------------------------


def _distinct(
    scored: Sequence[tuple[float, Camera]], turns: Sequence[Pose], least: float, known: Camera | None = None
) -> list[Camera]:
    """Return, the best first, the best of the cameras that place the target differently, whatever its turn, and not as
    `known` does.
    """
    given = [] if known is None else [known]
    cameras = [*given, *(camera for score, camera in scored if score >= least * scored[0][0])]
    left, chosen = np.arange(len(cameras)), list[Camera]()
    poses = _poses(cameras)
    while len(left) and len(chosen) <= _MOST_ALIKE:
        chosen.append(cameras[left[0]])
        left = left[~_same_place(poses[left[0]], poses[left], turns)]
    return chosen[len(given) :]


def _poses(cameras: Sequence[Camera]) -> Array:
    """(N, 3, 4) the cameras' [R t]."""
    return np.reshape([camera.cam_from_world.matrix for camera in cameras], (-1, 3, 4))


def _same_place(pose: Array, others: Array, turns: Sequence[Pose]) -> Mask:
    """(N,) which of the other poses (N, 3, 4) are close to the one (3, 4), possibly after a turn of the target."""
    ways, back = chained(pose, np.array([turn.matrix for turn in turns])), inverted(others)
    between = chained(ways[:, None], back)
    height = np.maximum(-pose[:, 2] @ pose[:, 3], back[:, 2, 3])
    near = np.linalg.norm(between[..., 3], axis=2) < _SAME_PLACE * height
    cosine = 0.5 * (np.trace(between[..., :3], axis1=2, axis2=3) - 1.0)
    return np.asarray(np.any(near & (cosine > np.cos(_SAME_TURN)), axis=0))
