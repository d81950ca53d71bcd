"""Observations from arrays as detectors return them: pixels by frame or by line, and what they show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import Array, InputError, no_such, numbers_in, rows, size_in
from ceres_cal.observations.columns import NO_CURVES, NO_POINTS, Curves, Points, View
from ceres_cal.observations.files import Content
from ceres_cal.scene import SIDES, Target


def points_by_frame(
    pixels: Any,
    points: Target | ArrayLike,
    image_size: tuple[int, int],
    camera: str,
    sigma_px: float,
    moves: bool | None,
) -> Content:
    """See `Observations.from_points`."""
    target = points if isinstance(points, Target) else _points_target(points, bool(moves))
    frames = _frames(pixels)
    movable = target.movable if moves is None else moves
    views, seen_rows, name = [], [], _name(target) if isinstance(points, Target) else "target"
    unseen = np.full((len(target.points), 2), np.nan)
    for number, (frame, values) in enumerate(frames.items()):
        seen = unseen if values is None else _pixels(values, f"frame {frame!r}")
        if len(seen) != len(target.points):
            raise InputError(
                f"frame {frame!r}: {len(seen)} pixels for {len(target.points)} points: give one for each, NaN "
                "where it was not seen"
            )
        views.append(View(frame, camera, camera, name, frame if movable else None))
        found = np.flatnonzero(np.isfinite(seen).all(axis=1))
        seen_rows.append((np.full(len(found), number), found, seen[found]))
    if not seen_rows:
        raise InputError("pixels must hold at least one frame")
    view, feature, where = (np.concatenate(part) for part in zip(*seen_rows, strict=True))
    if not len(view):
        raise InputError("no frame shows the target: pixels of all frames are None or NaN")
    every = Points(view, feature, where, np.full(len(view), float(sigma_px)))
    return Content({name: target}, {camera: size_in(image_size)}, tuple(views), every, NO_CURVES)


def pixels_by_curve(
    pixels: Mapping[str, ArrayLike],
    target: Target,
    image_size: tuple[int, int],
    camera: str,
    frame: str,
    sigma_px: float,
    side: str,
) -> Content:
    """See `Observations.from_curves`."""
    if side not in SIDES:
        raise InputError(no_such("side", side, SIDES))
    if not pixels:
        raise InputError("pixels must hold at least one line")
    for curve in pixels:
        if curve not in target.curves:
            raise InputError(f"pixels: {no_such('line', curve, target.curves)}")
    seen = [_pixels(values, f"line {curve!r}") for curve, values in pixels.items()]
    feature = np.repeat([target.curve_index[curve] for curve in pixels], [len(one) for one in seen])
    count, name = len(feature), _name(target)
    curves = Curves(
        np.zeros(count, np.int32),
        feature.astype(np.int32),
        np.concatenate(seen),
        np.full(count, float(sigma_px)),
        np.full(count, SIDES[side], np.int8),
    )
    view = View(frame, camera, camera, name, frame if target.movable else None)
    return Content({name: target}, {camera: size_in(image_size)}, (view,), NO_POINTS, curves)


def _name(target: Target) -> str:
    """Name of a target, the same as for detected targets."""
    return "board" if target.movable else "field"


def _points_target(places: Any, moves: bool) -> Target:
    """Make a target of points (N, 3) or (N, 2) m, named by their numbers."""
    from ceres_cal.scene.targets import of_places

    given = numbers_in(places, "points")
    if given.ndim != 2 or given.shape[1] not in (2, 3):
        raise InputError(f"points must have shape (N, 3) or (N, 2), in metres, not {given.shape}")
    whole = np.column_stack([given, np.zeros((len(given), 3 - given.shape[1]))])
    return of_places({str(number): (x, y, z) for number, (x, y, z) in enumerate(whole.tolist())}, moves=moves)


def _frames(pixels: Any) -> Mapping[str, Any]:
    """Return the pixels by name of the frame; frames without names are numbered."""
    if isinstance(pixels, Mapping):
        return {str(frame): values for frame, values in pixels.items()}
    if isinstance(pixels, np.ndarray) and (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[1] == 1)):
        return {"0": pixels}
    if not isinstance(pixels, Sequence | np.ndarray) or isinstance(pixels, str):
        raise InputError(f"pixels must be an array (N, 2), or a list or dict of them, not {type(pixels).__name__}")
    if len(pixels) and _is_pixel(pixels[0]):
        return {"0": pixels}
    return {str(number): values for number, values in enumerate(pixels)}


def _is_pixel(value: Any) -> bool:
    """Whether the value is one pixel of a frame's list rather than a frame."""
    is_flat = value.ndim == 1 if isinstance(value, np.ndarray) else isinstance(value, Sequence)
    return is_flat and len(value) == 2 and all(np.isscalar(one) for one in value)


def _pixels(values: Any, where: str) -> Array:
    """Return pixels (N, 2), given so or as OpenCV's (N, 1, 2)."""
    seen = numbers_in(values, "pixels")
    return rows(seen[:, 0] if seen.ndim == 3 and seen.shape[1] == 1 else seen, 2, f"{where}: pixels")
