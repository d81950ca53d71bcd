"""Observations from what detectors give: pixels by frame, and what they show."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.observations.columns import NO_CURVES, Points, View
from ceres_cal.observations.files import Content
from ceres_cal.scene.targets import Target


def gathered(
    pixels: ArrayLike | Sequence[ArrayLike] | Mapping[str, ArrayLike],
    shown: Target | ArrayLike,
    image_size: tuple[int, int],
    camera: str,
    sigma_px: float,
    moves: bool | None,
) -> Content:
    """See `Observations.from_points`."""
    target = shown if isinstance(shown, Target) else _points_target(shown)
    frames = _frames(pixels)
    movable = target.movable if moves is None else moves
    views, rows = [], []
    for number, (frame, values) in enumerate(frames.items()):
        seen = _pixels(values, frame)
        if len(seen) != len(target.points):
            raise InputError(
                f"frame {frame!r}: {len(seen)} pixels for {len(target.points)} points: give one for each, NaN where it "
                "was not seen"
            )
        views.append(View(frame, camera, camera, "target", frame if movable else None))
        found = np.flatnonzero(np.isfinite(seen).all(axis=1))
        rows.append((np.full(len(found), number), found, seen[found]))
    if not rows:
        raise InputError("no frame was given: pixels are needed")
    view, feature, where = (np.concatenate(part) for part in zip(*rows, strict=True))
    points = Points(view, feature, where, np.full(len(view), float(sigma_px)))
    width, height = (int(size) for size in image_size)
    return Content({"target": target}, {camera: (width, height)}, tuple(views), points, NO_CURVES)


def _points_target(places: Any) -> Target:
    """A target of points (N, 3) or (N, 2) m, named by their numbers."""
    from ceres_cal.scene.targets import custom

    given = np.asarray(places, dtype=float)
    if given.ndim != 2 or given.shape[1] not in (2, 3):
        raise InputError(f"points must have shape (N, 3) or (N, 2), in metres, not {given.shape}")
    whole = np.column_stack([given, np.zeros((len(given), 3 - given.shape[1]))])
    return custom({str(number): (x, y, z) for number, (x, y, z) in enumerate(whole.tolist())})


def _frames(pixels: Any) -> dict[str, Any]:
    """By name of the frame; numbers where there are no names."""
    if isinstance(pixels, Mapping):
        return {str(frame): values for frame, values in pixels.items()}
    if isinstance(pixels, np.ndarray) and (pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[1] == 1)):
        return {"0": pixels}
    return {str(number): values for number, values in enumerate(pixels)}


def _pixels(values: Any, frame: str) -> Array:
    """(N, 2), from that or OpenCV's (N, 1, 2)."""
    seen = np.asarray(values, dtype=float)
    if seen.ndim == 3 and seen.shape[1] == 1:
        seen = seen[:, 0]
    if seen.ndim != 2 or seen.shape[1] != 2:
        raise InputError(f"frame {frame!r}: pixels must have shape (N, 2) or OpenCV's (N, 1, 2), not {seen.shape}")
    return seen
