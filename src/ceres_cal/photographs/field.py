"""A field's painted lines, arcs, corners and crossings from photographs of one station, as observations."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ceres_cal.base.arrays import Array32, Mask
from ceres_cal.base.errors import InputError, NothingShownError
from ceres_cal.detect.boards import read_grey
from ceres_cal.detect.crossings import Crossings, find_crossings
from ceres_cal.detect.lines import Lines
from ceres_cal.observations import Curves, Observations, Points, View, combine
from ceres_cal.photographs.clicks import Clicks, starts_from_clicks
from ceres_cal.photographs.follow import Followed, Freedom, follow
from ceres_cal.photographs.judgement import why_missed
from ceres_cal.photographs.search import Auto, Searched, search
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target

TARGET_NAME = "field"


@dataclass(frozen=True, eq=False)
class FieldDetections:
    """What `detect_field` found.

    Attributes:
        observations: one view per image that shows the field.
        found: path -> the camera that predicts its lines, and what was measured.
        missed: path and reason of every other image.
        searched: what came of those images in which the field was found without a start.
    """

    observations: Observations
    found: dict[str, Followed]
    missed: tuple[tuple[str, str], ...]
    searched: dict[str, Searched]


def detect_field(
    images: Sequence[Path],
    target: Target,
    start: Camera | Clicks | Auto,
    curves: Collection[str] | None = None,
    camera: str = "camera",
    station: str | None = None,
    with_points: bool = True,
    edges: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> FieldDetections:
    """Painted lines, arcs, corners and crossings of a field in photographs that one camera took at one station.

    Curve observations are of the paint's middle, at places whose windows share no pixel; `sigma_px` comes from the
    pixels of each window, times a factor that the scatter from place to place tells. A point is where measured curves
    meet; the places that told it are no curve observations besides.

    Args:
        images: files of any kind OpenCV reads, all of one size.
        start: the station's camera before it was moved (by up to 130 px, or 5 degrees), points that somebody showed, or
            `Auto()`: the field is found without any (see `search`). Later images start from what the last one told.
        curves: names of those that are painted; None: all of the target with a width.
        with_points: else curve observations only. edges: both edges of the paint instead of its middle.
        progress: called after each image with (images done, images in all, file name).

    Raises:
        InputError: an image cannot be read or has another size than the camera, a name that the target does not have,
            or it cannot be told which way round the field is.
        NothingShownError: no image shows the field.
    """
    painted = _painted(target, curves)
    paths = [Path(path) for path in images]
    found: dict[str, Followed] = {}
    crossings: dict[str, Crossings | None] = {}
    missed: list[tuple[str, str]] = []
    searched: dict[str, Searched] = {}
    before: Followed | None = None
    for number, path in enumerate(paths, start=1):
        grey = read_grey(path).astype(np.float32)
        outcome = _looked_for(grey, target, painted, start, before, path)
        if outcome.followed is None:
            missed.append((str(path), outcome.reason))
        else:
            found[str(path)] = before = outcome.followed
            crossings[str(path)] = find_crossings(target, before.camera, before.lines) if with_points else None
            if outcome.ways:
                searched[str(path)] = outcome
        if progress is not None:
            progress(number, len(paths), path.name)
    if not found:
        first = f"{missed[0][0]}: {missed[0][1]}"
        raise NothingShownError(f"no field in any of {len(paths)} images; {first}", tuple(missed))
    parts = [
        _observations(path, one, crossings[path], target, (camera, station or camera), edges)
        for path, one in found.items()
    ]
    return FieldDetections(combine(parts), found, tuple(missed), searched)


def _painted(target: Target, curves: Collection[str] | None) -> tuple[str, ...]:
    for name in curves or ():
        if name not in target.curves:
            raise InputError(f"curve {name!r} is not one of the target's: `ceres-cal targets` lists the names")
    painted = tuple(n for n, curve in target.curves.items() if curve.width_m > 0.0 and (curves is None or n in curves))
    if not painted:
        raise InputError("the target has no painted curve: a line to be found needs a width")
    return painted


def _looked_for(
    grey: Array32,
    target: Target,
    painted: tuple[str, ...],
    start: Camera | Clicks | Auto,
    before: Followed | None,
    path: Path,
) -> Searched:
    """The field from where the last image showed it, or from the start that was given, or from none."""
    size = (int(grey.shape[1]), int(grey.shape[0]))
    if before is None and isinstance(start, Auto):
        try:
            return search(grey, target, painted, start)
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
    starts, freedom = _starts(start, before, target, size, path)
    followed = follow(grey, target, starts, painted, freedom)
    return Searched(followed) if followed.holds else Searched(None, why_missed(followed, target, started=True))


def _starts(
    start: Camera | Clicks | Auto, before: Followed | None, target: Target, size: tuple[int, int], path: Path
) -> tuple[list[Camera], Freedom]:
    """The cameras to start from: the last image's, or the one given, or those that the clicks may belong to."""
    if isinstance(start, Camera) and start.image_size != size:
        raise InputError(
            f"{path}: {size[0]} x {size[1]} px, but the camera has {start.image_size[0]} x {start.image_size[1]}: "
            "start from a calibration of this camera"
        )
    if before is not None:
        if before.camera.image_size != size:
            raise InputError(f"{path}: {size[0]} x {size[1]} px, unlike the images before: give it on its own")
        return [before.camera], Freedom()
    if isinstance(start, Clicks):
        return starts_from_clicks(start, target, size)
    assert isinstance(start, Camera)
    return [start], Freedom()


def _observations(
    path: str, followed: Followed, met: Crossings | None, target: Target, names: tuple[str, str], edges: bool
) -> Observations:
    """One image's view: what its lines and crossings are, each pixel counted once."""
    camera, station = names
    none = np.empty(0, np.int32)
    points = Points(none, none, np.empty((0, 2)), np.empty(0))
    if met is not None:
        points = Points(np.zeros(len(met.feature), np.int32), met.feature, met.pixels, met.sigma_px)
    return Observations(
        {TARGET_NAME: target},
        {camera: followed.camera.image_size},
        (View(Path(path).stem, camera, station, TARGET_NAME),),
        points,
        _curves(followed.lines, np.zeros(len(followed.lines.found), dtype=bool) if met is None else met.used, edges),
    )


def _curves(lines: Lines, used: Mask, edges: bool) -> Curves:
    """The middles of the paint, or both its edges, where they were found and are not used elsewhere."""
    rows = np.flatnonzero(lines.found & ~used)
    sides = (1, -1) if edges else (0,)
    pixels = [lines.edge(side) if edges else lines.pixels for side in sides]
    return Curves(
        np.zeros(len(sides) * len(rows), np.int32),
        np.tile(lines.course.curve[rows], len(sides)),
        np.concatenate([places[rows] for places in pixels]),
        np.tile(np.sqrt(len(sides)) * lines.sigma_px[rows], len(sides)),
        np.repeat(np.array(sides, np.int8), len(rows)),
    )
