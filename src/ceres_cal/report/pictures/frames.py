"""Frames of photographs: which photograph shows what, and what was observed there.

Photographs are read from image files, and pictures are encoded as image files.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from ceres_cal.base import Frozen, Image, InputError, Mask, frame_of
from ceres_cal.calibration import Calibration
from ceres_cal.detect.images import encoded, read_colour
from ceres_cal.observations import Columns, Observations
from ceres_cal.report.pictures.overlay import Layer, Model, in_8_bit_colour, model_seen

Shown = tuple[tuple[str, str | None], ...]
"""Target and placement of each thing that a frame shows."""


class Frame(Frozen, eq=True):
    """One photograph: name of the frame, station that took it, what it shows, and numbers of its views."""

    name: str
    station: str
    shown: Shown
    views: tuple[int, ...] = ()


def frames_of(observations: Observations) -> tuple[Frame, ...]:
    """Return the frames of each station, in the order of their views."""
    views, rows_of = observations.views, dict[tuple[str, str], list[int]]()
    for number, view in enumerate(views):
        rows_of.setdefault((view.frame, view.station), []).append(number)
    return tuple(
        Frame(*names, tuple((views[row].target, views[row].placement) for row in rows), tuple(rows))
        for names, rows in rows_of.items()
    )


def frame_by_name(calibration: Calibration, station: str, name: str) -> Frame:
    """Return what a photograph shows according to the calibration alone: targets in the world, and the board or rings
    whose placement has the photograph's name.

    Raises:
        InputError: there is neither.
    """
    movable = [target for target, one in calibration.targets.items() if one.movable]
    shown: list[tuple[str, str | None]] = [(target, None) for target in calibration.targets if target not in movable]
    if name in calibration.placements and len(movable) == 1:
        shown.append((movable[0], name))
    if not shown:
        raise InputError(
            f"nothing can be drawn into {name!r}: the calibration has no field and no single board with that name: "
            "give the observations, which say what each frame shows"
        )
    return Frame(name, station, tuple(shown))


def photographs_of(images: Iterable[Path], observations: Observations) -> dict[tuple[str, str], Path]:
    """Return the image file of each frame and station, which has the frame's name. If folders are named like stations
    or cameras, each uses its own folder.

    Raises:
        InputError: two images for one frame of a station.
    """
    known, every = dict[tuple[str, str], Path](), list(images)
    owners = {view.station: {view.station, view.camera} for view in observations.views}
    for view in observations.views:
        for path in (one for one in every if frame_of(one) == view.frame):
            named = set(path.parent.parts).intersection(*[set().union(*owners.values())])
            if named and not named & owners[view.station]:
                continue
            if known.setdefault((view.frame, view.station), path) != path:
                other = known[view.frame, view.station]
                raise InputError(
                    f"{path}: has the same name as {other}: rename or remove one, or give the images of one folder, "
                    "or of one for each camera that is called like it"
                )
    return known


def model_of(calibration: Calibration, frame: Frame, height_m: float = 0.0) -> Model:
    """Return the calibration's model of a frame.

    Raises:
        InputError: the calibration does not know the frame's station, or a target or placement of it.
    """
    known: tuple[tuple[str, Mapping[str, object], Sequence[str | None]], ...] = (
        ("station", calibration.stations, [frame.station]),
        ("target", calibration.targets, [target for target, _ in frame.shown]),
        ("placement", calibration.placements, [placement for _, placement in frame.shown]),
    )
    for kind, names, wanted in known:
        for name in wanted:
            if name is not None and name not in names:
                raise InputError(f"frame {frame.name!r}: the calibration has no {kind} {name!r}")
    return model_seen(calibration.estimate, calibration.targets, frame.station, frame.shown, height_m)


def marks_of(calibration: Calibration, observations: Observations, frame: Frame) -> Iterator[Layer]:
    """Yield the observations in a frame: inliers and, if the calibration was made from these observations, outliers."""
    both: tuple[Columns, Columns] = observations.points, observations.curves
    inliers: Sequence[Mask] = [np.ones(len(columns), dtype=bool) for columns in both]
    if observations.digest == calibration.digest:
        inliers = calibration.inlier_masks(observations)
    here = [np.isin(columns.view, frame.views) for columns in both]
    pixels = np.concatenate([columns.pixels[rows] for columns, rows in zip(both, here, strict=True)])
    used = np.concatenate([mask[rows] for mask, rows in zip(inliers, here, strict=True)])
    if np.any(used):
        yield Layer(pixels[used], "observed", "used")
    if not np.all(used):
        yield Layer(pixels[~used], "taken out", "taken out", crosses=True)


def read_photograph(path: Path, image_size: tuple[int, int], camera: str) -> Image:
    """Read a camera's photograph as (height, width) or (height, width, 3), pixels as stored.

    Raises:
        InputError: no image, or of another size than the camera's.
    """
    image = read_colour(path)
    size = (image.shape[1], image.shape[0])
    if size != image_size:
        raise InputError(
            f"{path}: {size[0]} x {size[1]} px, but camera {camera!r} has {image_size[0]} x {image_size[1]}: "
            "give photographs of the size that was calibrated"
        )
    return image


def jpeg_of_at_most(picture: Image, widest_px: int, most_bytes: int) -> bytes:
    """Encode a JPEG no wider than `widest_px`, with the best quality that fits into `most_bytes`."""
    qualities = (90, 80, 70, 55, 40, 25)
    width, height = picture.shape[1], picture.shape[0]
    if width > widest_px:
        size = (widest_px, max(1, round(height * widest_px / width)))
        picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    for quality in qualities:
        content = encoded(in_8_bit_colour(picture), ".jpg", quality)
        if len(content) <= most_bytes:
            break
    return content
