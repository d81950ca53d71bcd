"""From a target to its picture: how much of each pixel is paint, or paper, through any lens.

Every pixel is divided into SUBPIXELS x SUBPIXELS squares. Each square is filled by its share inside the paint, whose
border is taken as straight within the square. Nothing is thresholded, so that the lines of the picture agree with the
model to some thousandths of a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, Array32, Image8, Indices
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import Arc, Curve, Segment, curve_points
from ceres_cal.scene.targets import Target
from ceres_cal.scene.targets.target import Paper
from rendering.paper import Footprints, dark_share, share_inside

Canvas = Array32
"""(height, width) times SUBPIXELS: the share of paint in each small square, or the brightness of paper there."""

SUBPIXELS = 3
SHIFT = 4  # fractional bits of OpenCV's drawing coordinates
INK, PAPER = 0.06, 0.9
_PIECES = 400  # of a curve, in the search for the pixels near it
_STEPS = (np.arange(SUBPIXELS) - 0.5 * (SUBPIXELS - 1)) / SUBPIXELS
_BLOCK = 1 << 16


@dataclass(frozen=True, eq=False)
class _Squares(Footprints):
    """Small squares on the target's plane z = const; `rows`, `columns` (M,) are their places on the canvas."""

    rows: Indices
    columns: Indices


def blank_canvas(image_size: tuple[int, int]) -> Canvas:
    """A canvas without paint."""
    return np.zeros((image_size[1] * SUBPIXELS, image_size[0] * SUBPIXELS), dtype=np.float32)


def on_canvas(pixels: Array) -> Array:
    """Pixel coordinates (N, 2) as coordinates of the canvas, where (0, 0) is the centre of its first square."""
    return np.asarray((pixels + 0.5) * SUBPIXELS - 0.5)


def averaged(canvas: Canvas | Image8) -> Array32:
    """A canvas (or a stack of them along the last axis) as an image: the mean over each pixel."""
    size = canvas.shape[1] // SUBPIXELS, canvas.shape[0] // SUBPIXELS
    return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


# ---- painted curves -------------------------------------------------------------------------------------------------


def paint_curves(canvas: Canvas, target: Target, camera: Camera) -> None:
    """Paint a target's curves with a width above 0 onto a canvas.

    The paint of a segment ends half a width beyond its ends, so that lines that meet in a corner fill it.

    Args:
        camera: its cam_from_world is cam_from_target.
    """
    for curve in target.curves.values():
        if curve.width_m <= 0.0:
            continue
        height_m = curve.start[2] if isinstance(curve, Segment) else curve.centre[2]
        for squares in _squares(_near(curve, camera), camera, height_m):
            share = _strip(curve, squares)
            there = squares.rows, squares.columns
            # Overlapping strips share a border or cross, so the larger share is that of their union.
            canvas[there] = np.maximum(canvas[there], share)


def _near(curve: Curve, camera: Camera) -> Image8:
    """The pixels that a curve's paint may cover, as a mask (height, width)."""
    width, height = camera.image_size
    mask = np.zeros((height, width), np.uint8)
    left, middle, right = (camera.project(curve_points(curve, side, _PIECES)) for side in (1, 0, -1))
    with np.errstate(invalid="ignore"):
        near = np.all(np.abs(middle - (0.5 * width, 0.5 * height)) < (width, height), axis=1)  # False for NaN
    if not np.any(near):
        return mask
    wide = float(np.nanmax(np.linalg.norm((left - right)[near], axis=1), initial=0.0))
    thickness = int(np.ceil(wide)) + 5
    pairs = np.stack([middle[:-1], middle[1:]], axis=1)[near[:-1] & near[1:]]
    cv2.polylines(mask, list(np.round(pairs).astype(np.int32)), False, 1, min(thickness, 32767))
    return mask


def _squares(mask: Image8, camera: Camera, height_m: float) -> Iterator[_Squares]:
    """The small squares of a mask's pixels on the plane z = height_m, in blocks."""
    y, x = np.nonzero(mask)
    for first in range(0, len(x), _BLOCK):
        block = slice(first, first + _BLOCK)
        pixels = np.column_stack([x[block], y[block]]).astype(float)
        middle = camera.locate(pixels, height_m)
        half = 0.5 * np.eye(2)
        along_x, along_y = (
            (camera.locate(pixels + step, height_m) - camera.locate(pixels - step, height_m)) for step in half
        )
        seen = np.flatnonzero(np.isfinite(middle + along_x + along_y).all(axis=1))
        yield _divided(pixels[seen].astype(np.intp), middle[seen], along_x[seen], along_y[seen])


def _divided(pixels: Indices, middle: Array, along_x: Array, along_y: Array) -> _Squares:
    """Pixels and their footprints, divided; within half a pixel the lens's map is linear to 1e-4 px."""
    j, i = (index.ravel() for index in np.indices((SUBPIXELS, SUBPIXELS)))
    place = middle[:, None] + _STEPS[i][:, None] * along_x[:, None] + _STEPS[j][:, None] * along_y[:, None]
    times = len(i)
    return _Squares(
        place.reshape(-1, 2),
        np.repeat(along_x / SUBPIXELS, times, axis=0),
        np.repeat(along_y / SUBPIXELS, times, axis=0),
        (pixels[:, 1, None] * SUBPIXELS + j).ravel(),
        (pixels[:, 0, None] * SUBPIXELS + i).ravel(),
    )


def _strip(curve: Curve, squares: _Squares) -> Array:
    """(M,) the share of each square within a curve's paint."""
    half = 0.5 * curve.width_m
    if isinstance(curve, Segment):
        start, along = np.array(curve.start[:2]), np.subtract(curve.end, curve.start)[:2]
        length = float(np.hypot(*along))
        unit = along / length
        away = squares.plane - start
        across = away @ np.array([-unit[1], unit[0]])
        lengthwise = away @ unit - 0.5 * length
        steps = squares.step_m(np.broadcast_to([-unit[1], unit[0]], away.shape))
        ends, end_steps = 0.5 * length + half, squares.step_m(np.broadcast_to(unit, away.shape))
        within = share_inside(ends - np.abs(lengthwise), end_steps)
    else:
        away = squares.plane - curve.centre[:2]
        radius = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-12)
        across, steps = radius - curve.radius_m, squares.step_m(away / radius[:, None])
        within = _within_arc(curve, away)
    share = share_inside(across + half, steps) - share_inside(across - half, steps)
    return np.asarray(share * within)


def _within_arc(arc: Arc, away: Array) -> Array:
    span = arc.to_rad - arc.from_rad
    if span >= 2.0 * np.pi - 1e-9:
        return np.ones(len(away))
    turned = np.mod(np.arctan2(away[:, 1], away[:, 0]) - arc.from_rad, 2.0 * np.pi)
    return (turned <= span).astype(float)


# ---- printed sheets -------------------------------------------------------------------------------------------------


def sheet_outline(paper: Paper) -> Array:
    """(N, 3) m: the border of the rectangular paper."""
    (left, bottom), (right, top) = paper.low_m, paper.high_m
    corners = np.array([(left, bottom), (right, bottom), (right, top), (left, top)])
    share = np.linspace(0.0, 1.0, 50, endpoint=False)[None, :, None]
    border = (corners[:, None] * (1.0 - share) + np.roll(corners, -1, axis=0)[:, None] * share).reshape(-1, 2)
    return np.column_stack([border, np.zeros(len(border))])


def print_sheet(canvas: Canvas, target: Target, camera: Camera) -> Image8:
    """Print a target's sheet onto a canvas; returns the mask (height, width) of the pixels it covers."""
    width, height = camera.image_size
    mask = np.zeros((height, width), np.uint8)
    assert target.paper is not None
    border = camera.project(sheet_outline(target.paper))
    if not np.all(np.isfinite(border)):
        return mask
    fill(mask, border)
    for squares in _squares(mask, camera, 0.0):
        canvas[squares.rows, squares.columns] = PAPER + (INK - PAPER) * dark_share(target, squares)
    return mask


def fill(mask: Image8, outline: Array, value: int | Sequence[int] = 1) -> None:
    """Fill a polygon (N, 2), in the coordinates of `mask` (height, width) or (height, width, channels)."""
    limit = 4 * max(mask.shape)
    rounded = np.round(np.clip(outline, -limit, limit) * 2**SHIFT).astype(np.int32)
    cv2.fillPoly(mask, [rounded], value, cv2.LINE_8, SHIFT)
