"""From a target to its picture: how much of each pixel is paint, or paper, through any lens.

Every pixel is divided into SUBPIXELS x SUBPIXELS squares, and each of these is filled by the share of it that lies
inside the paint (a strip of straight or circular border, within the square a straight one). Nothing is thresholded, so
the picture's lines lie where the model says to some thousandths of a pixel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, Array32, Image8, Indices
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Arc, Curve, Segment, Target, along_track

Canvas = Array32
"""(height, width) times SUBPIXELS: the share of each small square that is paint, or the brightness of paper there."""

SUBPIXELS = 3
SHIFT = 4  # binary digits after the point in OpenCV's drawing coordinates
INK, PAPER = 0.06, 0.9
_PIECES = 400  # of a curve, when the pixels near it are looked for
_STEPS = (np.arange(SUBPIXELS) - 0.5 * (SUBPIXELS - 1)) / SUBPIXELS
_BLOCK = 1 << 16


@dataclass(frozen=True, eq=False)
class _Squares:
    """Small squares on the target's plane z = const.

    Attributes:
        rows, columns: (M,) their places on the canvas. plane: (M, 2) their middles, m.
        along_x, along_y: (M, 2) what a step of one square to the right and down is on the plane, m.
    """

    rows: Indices
    columns: Indices
    plane: Array
    along_x: Array
    along_y: Array

    def step_m(self, direction: Array) -> Array:
        """(M,) how far the place moves along a direction (M, 2) over one square, m."""
        across = np.sum(self.along_x * direction, axis=1), np.sum(self.along_y * direction, axis=1)
        return np.asarray(np.maximum(np.hypot(*across), 1e-12))


def blank_canvas(image_size: tuple[int, int]) -> Canvas:
    """A canvas without paint."""
    return np.zeros((image_size[1] * SUBPIXELS, image_size[0] * SUBPIXELS), dtype=np.float32)


def on_canvas(pixels: Array) -> Array:
    """Pixel coordinates (N, 2) as those of the canvas, (0, 0) being the middle of its first square."""
    return np.asarray((pixels + 0.5) * SUBPIXELS - 0.5)


def averaged(canvas: Canvas | Image8) -> Array32:
    """A canvas (or a stack of them along the last axis) as an image: what falls on each square pixel."""
    size = canvas.shape[1] // SUBPIXELS, canvas.shape[0] // SUBPIXELS
    return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


# ---- painted curves -------------------------------------------------------------------------------------------------


def paint_curves(canvas: Canvas, target: Target, camera: Camera) -> None:
    """Paint a target's curves of a width above 0 onto a canvas.

    A segment's paint ends half a width past its ends, so that lines which meet in a corner fill it.

    Args:
        camera: its cam_from_world is cam_from_target.
    """
    for curve in target.curves.values():
        if curve.width_m <= 0.0:
            continue
        for squares in _squares(_near(curve, camera), camera, _height_m(curve)):
            share = _strip(curve, squares)
            there = squares.rows, squares.columns
            # Where strips overlap their borders are one line or cross: the larger share is the union's.
            canvas[there] = np.maximum(canvas[there], share)


def _height_m(curve: Curve) -> float:
    return curve.start[2] if isinstance(curve, Segment) else curve.centre[2]


def curve_points(curve: Curve, side: int, pieces: int) -> Array:
    """(pieces + 1, 3) m, evenly along a curve."""
    low, high = curve.parameter_range
    return along_track(curve.track(side), isinstance(curve, Arc), np.linspace(low, high, pieces + 1))


def _near(curve: Curve, camera: Camera) -> Image8:
    """The pixels that a curve's paint may touch, as a mask (height, width)."""
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
    """The small squares of a mask's pixels on the plane z = height_m, some at a time."""
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
    """Pixels and their footprints, divided: within half a pixel the lens's map is straight to 1e-4 px."""
    j, i = (index.ravel() for index in np.indices((SUBPIXELS, SUBPIXELS)))
    place = middle[:, None] + _STEPS[i][:, None] * along_x[:, None] + _STEPS[j][:, None] * along_y[:, None]
    times = len(i)
    return _Squares(
        (pixels[:, 1, None] * SUBPIXELS + j).ravel(),
        (pixels[:, 0, None] * SUBPIXELS + i).ravel(),
        place.reshape(-1, 2),
        np.repeat(along_x / SUBPIXELS, times, axis=0),
        np.repeat(along_y / SUBPIXELS, times, axis=0),
    )


def _inside(distance: Array, step: Array) -> Array:
    """The share of a square that lies on the positive side of a straight border, from the middle's distance to it."""
    return np.clip(distance / step + 0.5, 0.0, 1.0)


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
        within = _inside(ends - np.abs(lengthwise), end_steps)
    else:
        away = squares.plane - curve.centre[:2]
        radius = np.maximum(np.hypot(away[:, 0], away[:, 1]), 1e-12)
        across, steps = radius - curve.radius_m, squares.step_m(away / radius[:, None])
        within = _within_arc(curve, away)
    share = _inside(across + half, steps) - _inside(across - half, steps)
    return np.asarray(share * within)


def _within_arc(arc: Arc, away: Array) -> Array:
    span = arc.to_rad - arc.from_rad
    if span >= 2.0 * np.pi - 1e-9:
        return np.ones(len(away))
    turned = np.mod(np.arctan2(away[:, 1], away[:, 0]) - arc.from_rad, 2.0 * np.pi)
    return (turned <= span).astype(float)


# ---- boards and sheets of rings -------------------------------------------------------------------------------------


def is_sheet(target: Target) -> bool:
    """Whether a target is printed on paper, which hides the floor, and not painted on the floor."""
    return target.kind in ("checkerboard", "rings")


def sheet_outline(target: Target) -> Array:
    """(N, 3) m: the border of the rectangular paper, white or dark beyond the last square or ring."""
    if target.kind == "checkerboard":
        square, columns, rows = (target.spec[name] for name in ("square_m", "columns", "rows"))
        low, high = np.full(2, -2.0 * square), np.array([columns + 1, rows + 1]) * square
    else:
        high = np.full(2, 1.05 * target.spec["radii_m"][-1])
        low = -high
    corners = np.array([low, (high[0], low[1]), high, (low[0], high[1])])
    share = np.linspace(0.0, 1.0, 50, endpoint=False)[None, :, None]
    border = (corners[:, None] * (1.0 - share) + np.roll(corners, -1, axis=0)[:, None] * share).reshape(-1, 2)
    return np.column_stack([border, np.zeros(len(border))])


def print_sheet(canvas: Canvas, target: Target, camera: Camera) -> Image8:
    """Print a board or a sheet of rings onto a canvas, and the mask (height, width) of the pixels it covers.

    The disc inside the first ring is dark, and from then on every other ring. The square between a board's corners
    "0,0" and "1,1" is dark.
    """
    width, height = camera.image_size
    mask = np.zeros((height, width), np.uint8)
    border = camera.project(sheet_outline(target))
    if not np.all(np.isfinite(border)):
        return mask
    fill(mask, border)
    for squares in _squares(mask, camera, 0.0):
        dark = _dark_squares(target, squares) if target.kind == "checkerboard" else _dark_rings(target, squares)
        canvas[squares.rows, squares.columns] = PAPER + (INK - PAPER) * dark
    return mask


def fill(mask: Image8, outline: Array, value: int | Sequence[int] = 1) -> None:
    """Fill a polygon (N, 2), in the coordinates of `mask` (height, width) or (height, width, channels)."""
    limit = 4 * max(mask.shape)
    rounded = np.round(np.clip(outline, -limit, limit) * 2**SHIFT).astype(np.int32)
    cv2.fillPoly(mask, [rounded], value, cv2.LINE_8, SHIFT)


def _dark_rings(target: Target, squares: _Squares) -> Array:
    radii = np.array(target.spec["radii_m"])
    away = np.maximum(np.hypot(squares.plane[:, 0], squares.plane[:, 1]), 1e-12)
    step = squares.step_m(squares.plane / away[:, None])
    inner = np.searchsorted(0.5 * (radii[1:] + radii[:-1]), away)  # the nearest edge
    outside = _inside(away - radii[inner], step)
    return np.where(inner % 2 == 0, 1.0 - outside, outside)


def _dark_squares(target: Target, squares: _Squares) -> Array:
    square = float(target.spec["square_m"])
    sign, within = np.full(len(squares.plane), 1.0), np.full(len(squares.plane), 1.0)
    for axis, count in enumerate((target.spec["columns"], target.spec["rows"])):
        place = squares.plane[:, axis] / square
        step = np.hypot(squares.along_x[:, axis], squares.along_y[:, axis]) / square
        line = np.round(place)
        wave = 2.0 * _inside(place - line, step) - 1.0
        sign *= np.where(line % 2 == 0, wave, -wave)
        within *= _inside(place + 1.0, step) * _inside(count - place, step)
    return np.asarray(within * (0.5 + 0.5 * sign))
