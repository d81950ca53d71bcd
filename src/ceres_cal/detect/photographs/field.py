"""Observations of a field's painted lines, arcs, corners and crossings, from photographs of one station."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from itertools import takewhile
from pathlib import Path

import numpy as np

from ceres_cal.base import (
    Array32,
    Frozen,
    Mask,
    distinct,
    for_small_matrices,
    frame_of,
    median,
    numerical,
    replace,
)
from ceres_cal.base.errors import (
    CalibrationError,
    ImageProgress,
    InputError,
    NothingShownError,
    SolutionError,
    attempt,
    naming,
    or_none,
)
from ceres_cal.detect.crossings import find_crossings
from ceres_cal.detect.images import filled, negative, read_colour, read_light
from ceres_cal.detect.lines import Lines
from ceres_cal.detect.median import MOST_PICTURES, merged
from ceres_cal.detect.photographs.by_hand import STRETCH, Clicks, starts_from_clicks
from ceres_cal.detect.photographs.candidates import Auto, prepare_search
from ceres_cal.detect.photographs.field_lines import FieldLines
from ceres_cal.detect.photographs.follow import follow
from ceres_cal.detect.photographs.judgement import is_shown, why_missed
from ceres_cal.detect.photographs.refit import FreeIntrinsics
from ceres_cal.detect.photographs.search import OTHER, SearchResult, SeveralWaysError, search
from ceres_cal.detect.strokes import Strokes, strokes_of_signs
from ceres_cal.detect.video import turned_words
from ceres_cal.observations import COMA, NO_POINTS, Curves, Observations, Prior, View, combine, joined
from ceres_cal.problem.structure import features_of
from ceres_cal.robust.as_built import drawn_as_stated
from ceres_cal.scene import Camera, Target, require_features
from ceres_cal.scene.targets import others_of_kind

TARGET_NAME = "field"
Start = Camera | Clicks | Auto
# Largest standard deviation of a length while lines are followed, as a share of it: it keeps lengths that few lines
# determine from diverging.
_ABOUT = 0.15
# Largest distance of a field's lines from its origin, m: the largest fields end at 150 m, the smallest in millimetres
# reaches 750.
_FIELD_M = 500.0
# Largest median distance between the field's lines in two pictures, px: if it is larger, the camera did not stand
# still.
_SAME_PLACE_PX = 3.0


class FieldDetections(Frozen):
    """Result of `detect_field`.

    Attributes:
        observations: one view per image that shows the field.
        found: path -> the camera that predicts the lines, and the measured lines.
        missed: path and reason of every other image.
        searched: path -> result of the search, for images in which the field was found without an initial estimate.
    """

    observations: Observations
    found: dict[str, FieldLines]
    missed: tuple[tuple[str, str], ...]
    searched: dict[str, SearchResult]


class FieldOptions(Frozen, eq=True):
    """Which observations of a field are made.

    Attributes:
        camera, station: names in the observations; by default the station has the camera's name.
        points: whether corners and crossings are observed, too. They are extrapolated from places on lines, which
            determine a camera better.
        edges: both edges of the paint are observed instead of its middle.
        left_out: (height, width) mask of pixels that show nothing of the field: hall, walls, people.
        keep_start: nothing farther than 12 px from the start is searched.
        lengths: priors on dimensions of the target (named "field") that are to be estimated from the photographs.
        refused: called with the path of each image that does not show the field, and what was seen there instead.
    """

    camera: str = "camera"
    station: str | None = None
    points: bool = False
    edges: bool = False
    left_out: Mask | None = None
    keep_start: bool = False
    lengths: tuple[Prior, ...] = ()
    refused: Callable[[Path, SearchResult], None] | None = None


@for_small_matrices()
def detect_field(
    images: Sequence[Path],
    target: Target,
    start: Start,
    curves: Collection[str] | None = None,
    options: FieldOptions | None = None,
    progress: ImageProgress | None = None,
) -> FieldDetections:
    """Detect a field's painted lines and arcs, and optionally corners and crossings, in photographs of one camera at
    one station.

    Curve observations are of the paint's middle, at places whose windows share no pixel; `sigma_px` comes from the
    pixels of each window, times a factor estimated from the scatter between places. A point is where measured curves
    meet; the places used for it are not curve observations as well.

    Args:
        images: files of any kind OpenCV reads, all of one size.
        target: the field.
        start: the station's camera before it was moved (by up to 130 px, or 5 degrees), points that a user showed, or
            `Auto()` to find the field without either (see `search`). Later images start from the last result.
        curves: names of the painted curves; None for all of the target that have a width.
        options: which observations are made; see `FieldOptions`.
        progress: called after each image.

    Raises:
        InputError: an image cannot be read or has another size than the camera, a name that the target does not have, a
            length that no painted line shows, or it cannot be determined which way round the field is.
        NothingShownError: no image shows the field.
    """
    options = options or FieldOptions()
    refused = options.refused or (lambda path, result: None)
    painted = require_findable(target, curves, options.lengths)
    paths, drawn = [Path(path) for path in images], drawn_as_stated({TARGET_NAME: target}, options.lengths)[TARGET_NAME]
    results: dict[str, SearchResult] = {}
    places: list[SearchResult] = []  # one result for each place of the camera, the latest first
    elsewhere = isinstance(start, Auto)  # whether an image is also searched without a start; one failure is enough

    def looked_for(path: Path, grey: Array32, starts: Sequence[Start | SearchResult]) -> SearchResult:
        with naming(path):
            try:
                with numerical("the search"):
                    return _looked_for(_without(grey, options.left_out), drawn, painted, starts, options)
            except SolutionError as error:  # reads: "no field in any of ... images; ...", or which were missed
                return SearchResult(None, str(error))
            except SeveralWaysError as error:
                refused(path, SearchResult(None, str(error), seen=error.seen))
                if path.is_file() and (turned := turned_words(path)):
                    raise InputError(f"{error}; {turned}") from None
                raise

    for number, path in enumerate(paths, start=1):
        grey = read_light(path)
        result = looked_for(path, grey, places or [start])
        if result.followed is None and places and elsewhere:
            # reads: "its lines were not found ...", where others show them
            other = attempt(partial(looked_for, path, grey, [start]), InputError)
            elsewhere = isinstance(other, SearchResult) and other.followed is not None
            result = other if isinstance(other, SearchResult) and elsewhere else result
        results[str(path)] = result
        if result.followed is not None:
            places = [result, *(one for one in places if _apart_px(one, result) > _SAME_PLACE_PX)]
        if progress is not None:
            progress(number, len(paths), path.name)
    for path in takewhile(lambda path: results[str(path)].followed is None, paths if places else ()):
        results[str(path)] = looked_for(path, read_light(path), places)  # with the place that later images showed
    if not places and len(paths) > 1:
        # reads: "no field in any of ... images"
        together = attempt(partial(_together, paths, partial(looked_for, starts=[start])), InputError)
        results = results if isinstance(together, CalibrationError) else together
    results = _of_one_place(results)
    for name, result in results.items():
        if result.followed is None:
            refused(Path(name), result)
    return _detections(results, target, options)


def _detections(results: Mapping[str, SearchResult], target: Target, options: FieldOptions) -> FieldDetections:
    """Collect the observations of the images that show the field.

    Raises:
        NothingShownError: none does.
    """
    followed = {path: result.followed for path, result in results.items() if result.followed is not None}
    missed = tuple((path, result.reason) for path, result in results.items() if result.followed is None)
    if not followed:
        raise NothingShownError(f"no field in any of {len(results)} images; {missed[0][0]}: {missed[0][1]}", missed)
    parts = [_observations(frame_of(path), one, target, options) for path, one in followed.items()]
    searched = {path: result for path, result in results.items() if result.followed is not None and result.ways}
    every = combine(parts)
    seen = {target.curve_names[number] for number in distinct(every.curves.feature)}
    seen |= {target.point_names[number] for number in distinct(every.points.feature)}
    lengths = [_found(one, next(iter(followed.values()))) for one in options.lengths]
    lengths = [one for one in lengths if features_of(target, one.quantity) & seen]  # others remain as drawn
    priors = {(one.name, one.quantity): one for one in sorted((*every.priors, *lengths), key=lambda one: one.sigma)}
    return FieldDetections(replace(every, priors=tuple(priors.values())), followed, missed, searched)


def _apart_px(one: SearchResult, other: SearchResult) -> float:
    """Median distance, px, between the lines' places in one picture and where another picture's camera projects the
    same floor.
    """
    if one.followed is None or other.followed is None:
        return np.inf
    pixels = other.followed.lines.pixels[other.followed.lines.found]
    floor = other.followed.camera.locate(pixels)
    there = one.followed.camera.project(np.column_stack([floor, np.zeros(len(floor))]))
    return median(np.nan_to_num(np.linalg.norm(there - pixels, axis=1), nan=np.inf))


def _of_one_place(results: Mapping[str, SearchResult]) -> dict[str, SearchResult]:
    """Remove pictures that show the field at another place than most of them do."""
    groups: list[list[str]] = []
    for path, result in results.items():
        near = [own for own in groups if _apart_px(results[own[0]], result) < _SAME_PLACE_PX]
        if result.followed is not None:
            near[0].append(path) if near else groups.append([path])
    most = max(groups, key=len, default=[])
    said = "{:.0f} px from where {} {} it: another camera took it, or the camera was moved: detect it separately"
    kept = dict(results)
    for path in (path for own in groups if own is not most for path in own):
        away, shown = _apart_px(results[most[0]], results[path]), "shows" if len(most) == 1 else "show"
        reason = f"it shows the field {said.format(away, Path(most[0]).name if len(most) == 1 else len(most), shown)}"
        kept[path] = SearchResult(None, reason, seen=results[path].followed)
    return kept


def _together(paths: Sequence[Path], looked_for: Callable[[Path, Array32], SearchResult]) -> dict[str, SearchResult]:
    """Search for the field in one picture made of all of them, each of which shows too little of it.

    Raises:
        InputError: they cannot be combined, or the combined picture shows no field either.
    """
    one = merged((str(path), read_colour(path)) for path in paths[:: -(-len(paths) // MOST_PICTURES)])
    name = f"{one.used[0]} and {len(one.used) - 1} more, combined"
    result = looked_for(Path(name), one.picture * np.float32(255.0 / one.white))
    if result.followed is None:
        raise InputError(result.reason)
    return {name: result, **{path: SearchResult(None, reason) for path, reason in one.left_out}}


def _signs(grey: Array32, *, is_near: bool) -> Iterator[tuple[bool, Strokes | None]]:
    """Yield whether a photograph's lines are darker than its floor, and the strokes of that sign if they were searched:
    the more likely sign first, then the other where it is possible, too.
    """
    nearly = 0.5  # least ratio of the strokes' lengths: seams and cables may be longer than the lines
    if is_near:
        yield False, None  # from a start that is near, light lines are found sooner than strokes
    strokes = strokes_of_signs(grey)
    light, dark = (float(np.sum(one.length_px)) for one in strokes)
    if not is_near:
        yield dark > light, strokes[dark > light]
    if (dark > light) if is_near else min(dark, light) > nearly * max(dark, light):
        yield is_near or dark <= light, strokes[is_near or dark <= light]


def _found(prior: Prior, followed: FieldLines) -> Prior:
    """Return the prior on a length; where nothing is known, a calibration starts from the value found."""
    return replace(prior, value=(followed.target.dimensions[prior.quantity],)) if prior.is_open else prior


def _tracked(lengths: tuple[Prior, ...]) -> tuple[Prior, ...]:
    """Limit the sigmas of the priors for following lines: a field is about as large as stated."""
    return tuple(replace(one, sigma=(min(one.sigma[0], _ABOUT * one.value[0]),)) for one in lengths)


def require_findable(
    target: Target, curves: Collection[str] | None = None, lengths: Sequence[Prior] = ()
) -> tuple[str, ...]:
    """Return the names of the painted curves that photographs may show, all of a target's or those given.

    Raises:
        InputError: a name that the target does not have, no painted curve, a target in another unit, or a length that
            no painted line shows.
    """
    require_features(target, curves=curves or ())
    painted = tuple(name for name in target.painted if curves is None or name in curves)
    if not painted:
        raise InputError(
            "the target has no painted curve: a line to be found needs a width; boards and markers are found by "
            "`detect board`, or `run --board 9x6x25mm`"
        )
    if target.reach_m > _FIELD_M:
        raise InputError(f"the field reaches {target.reach_m:.0f} m from its origin: give its dimensions in metres")
    for prior in lengths:
        if not features_of(target, prior.quantity) & set(painted):
            raise InputError(f"no painted line depends on {prior.quantity}: it cannot be found, leave it out")
    return painted


def _without(grey: Array32, left_out: Mask | None) -> Array32:
    """Fill the masked part of a photograph with what is around it."""
    if left_out is None:
        return grey
    if left_out.shape != grey.shape:
        size = f"{left_out.shape[1]} x {left_out.shape[0]}"
        raise InputError(f"{grey.shape[1]} x {grey.shape[0]} px, but the mask has {size}: draw it on this one")
    return filled(grey, left_out)


def _looked_for(
    grey: Array32,
    target: Target,
    painted: tuple[str, ...],
    starts: Sequence[Start | SearchResult],
    options: FieldOptions,
) -> SearchResult:
    """Search for the field by lines that are lighter or darker than the floor, from the first start that leads to it.

    Args:
        starts: results of earlier pictures, or the start that was given.
    """
    tried: list[SearchResult] = []
    for start in starts:
        at = start.followed if isinstance(start, SearchResult) else start
        before = [(start.darker, None)] if isinstance(start, SearchResult) else None
        for dark, strokes in before or _signs(grey, is_near=isinstance(start, Camera)):
            one = _looked_from(negative(grey) if dark else grey, target, painted, at, options, strokes)
            tried.append(replace(one, darker=dark))
            if one.followed is not None or one.shows:
                return tried[-1]
    return tried[0]


def _looked_from(
    grey: Array32,
    target: Target,
    painted: tuple[str, ...],
    start: Start | FieldLines | None,
    options: FieldOptions,
    strokes: Strokes | None,
) -> SearchResult:
    """Search for the field from where another image showed it, from the start that was given, or without a start."""
    lengths = _tracked(options.lengths)
    if isinstance(start, Auto):
        return search(grey, target, painted, replace(start, lengths=lengths), strokes)
    assert start is not None  # a result that shows the field
    target = start.target if isinstance(start, FieldLines) else target
    starts, free = _starts(start, target, (int(grey.shape[1]), int(grey.shape[0])), lengths)
    followed = follow(grey, target, starts, painted, replace(free, keep=options.keep_start))
    if not followed.built.is_other and (followed.holds or _is_worn(grey, followed)):
        return SearchResult(followed)
    if followed.holds and not followed.is_decided and not options.keep_start:
        # The field may be near, with a lens that was misleading: the search starts from other lenses.
        auto = Auto(before=followed.camera, lengths=lengths)
        # reads: "the field length is ... larger", as it was followed
        other = attempt(partial(search, grey, target, painted, auto), InputError)
        if isinstance(other, SearchResult) and other.followed is not None:
            return SearchResult(other.followed)
    for name, another in others_of_kind(target).items() if isinstance(start, Clicks) else ():
        starts, free = _starts(start, another, (int(grey.shape[1]), int(grey.shape[0])), ())
        there = follow(grey, another, starts, another.painted, free)
        if there.is_field and not there.built.dimensions:
            return SearchResult(None, OTHER.format(name), seen=followed, shows=name)
    return SearchResult(None, why_missed(followed, target, started=True), seen=followed)


@or_none  # reads: "its lines were not found ..."
def _is_worn(grey: Array32, followed: FieldLines) -> bool:
    """Whether this is the field with lines worn to dashes; always False for a target without a grid of lines."""
    return followed.may_be_worn and is_shown(prepare_search(grey, followed.target, followed.curves, Auto()), followed)


def _starts(
    start: Camera | Clicks | FieldLines, target: Target, size: tuple[int, int], lengths: tuple[Prior, ...]
) -> tuple[list[Camera], FreeIntrinsics]:
    """Return the cameras to start from: the last image's, the one given, or those that are consistent with the clicks.

    Args:
        lengths: priors on the target's dimensions.
    """
    if isinstance(start, Clicks):
        return starts_from_clicks(start, target, size, lengths)
    camera = start.camera if isinstance(start, FieldLines) else start
    if camera.image_size != size:
        width, height = camera.image_size
        other = f"but the camera has {width} x {height}: start from a calibration of this camera"
        if isinstance(start, FieldLines):
            other = "unlike the images before: detect it separately"
        raise InputError(f"{size[0]} x {size[1]} px, {other}")
    return [camera], FreeIntrinsics(priors=lengths)


def _observations(frame: str, followed: FieldLines, target: Target, options: FieldOptions) -> Observations:
    """Return one image's view: observations of its lines and crossings, each pixel used once.

    Misplaced curves are straight and round nevertheless: they help to determine the lens, with an offset each.
    """
    camera, lines = followed.camera, followed.lines
    points, used = NO_POINTS, np.zeros(len(lines.found), dtype=bool)
    built = followed.built
    if options.points:
        points, used = find_crossings(followed.target, camera, lines)
    if built.scatter_m:
        laid = target.point_array[points.feature] + built.scatter_m * np.eye(3)[:2, None]
        laid_px = np.linalg.norm(camera.project(laid.reshape(-1, 3)).reshape(2, -1, 2) - points.pixels, axis=2)
        points = replace(points, sigma_px=np.hypot(points.sigma_px, laid_px.mean(axis=0)))
    curves, beside = _curves(lines, lines.found & ~used, options.edges), followed.beside
    if beside is not None:
        aside = _curves(beside, beside.found, options.edges)
        curves = joined([curves, aside])
    priors = [Prior.of_offset(TARGET_NAME, name, sigma_m) for name, sigma_m in built.laid_m.items()]
    # Dimensions may differ, or seem to because of a lens that no model here describes. Where lines are misplaced, the
    # whole field may be, too. A calibration reports a contradiction beyond the usual amount.
    extent_m = float(np.max(np.ptp(target.box, axis=0)))
    for name, drawn_m in built.drawn.items():
        off_m = abs(built.dimensions.get(name, drawn_m) - drawn_m)
        is_long = drawn_m > 0.5 * extent_m and bool(features_of(target, name) & set(built.names))
        if off_m := off_m or (np.inf if built.scatter_m and is_long else 0.0):
            priors.append(Prior("target", TARGET_NAME, name, (drawn_m,), (min(off_m, 0.5 * built.usual_m),)))
    if lines.coma_px:
        priors.append(Prior("camera", options.camera, COMA, (0.0,), (lines.coma_px,)))
    if camera.aspect != 1.0:  # otherwise the camera is solved for with square pixels
        priors.append(Prior("camera", options.camera, "aspect", (camera.aspect,), (STRETCH,)))
    return Observations(
        {TARGET_NAME: target},
        {options.camera: camera.image_size},
        (View(frame, options.camera, options.station or options.camera, TARGET_NAME),),
        points,
        curves,
        tuple(priors),
    )


def _curves(lines: Lines, taken: Mask, edges: bool) -> Curves:
    rows = np.flatnonzero(taken)
    sides = (1, -1) if edges else (0,)
    pixels = [lines.edge(side) if edges else lines.pixels for side in sides]
    return Curves(
        np.zeros(len(sides) * len(rows), np.int32),
        np.tile(lines.course.curve[rows], len(sides)),
        np.concatenate([places[rows] for places in pixels]),
        np.tile(np.sqrt(len(sides)) * lines.sigma_px[rows], len(sides)),
        np.repeat(np.array(sides, np.int8), len(rows)),
    )
