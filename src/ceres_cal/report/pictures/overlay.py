"""Overlay pictures: models and observations drawn into a photograph, with a legend.

Also: what was seen in a rejected photograph (the best candidate, and which of its lines were missing); where in a
photograph a recommended measurement is; and the model as a photograph should show it, the lines and points of targets
as built, in pixels.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np
from msgspec import Struct

from ceres_cal.base import Array, Image, Image8, Indices32, Mask, Pose, first_of
from ceres_cal.detect.photographs.field_lines import FieldLines
from ceres_cal.detect.strokes import find_strokes
from ceres_cal.diagnostics.advice import Measurement
from ceres_cal.problem import Estimate
from ceres_cal.scene import Camera, Target, along_track, curve_points, in_image

Colour = tuple[int, int, int]
"""Blue, green, red, 0 to 255."""
COLOURS: dict[str, Colour] = {
    # Cyan: colour-blind readers can distinguish it from magenta, and neither occurs in paint or carpet.
    "before": (255, 190, 0),
    "after": (200, 0, 255),
    "lifted": (0, 220, 255),
    "used": (255, 120, 30),
    "taken out": (0, 94, 213),
    "ink": (30, 30, 30),
}
_STYLE = {
    "usual_px": 1600.0,  # diagonal of the image from which on everything is drawn thicker
    "point_px": 6.0,
    "dot_px": 2.2,
    "letter_px": 18.0,
    "pad_px": 8.0,
    "font_px": 22.0,  # height of the font's capitals at scale 1
    "paper": 0.82,  # opacity of the legend's background
}
_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4  # fractional bits in OpenCV's drawing coordinates


class Layer(Struct, frozen=True, eq=False):
    """A model, or observed pixels (N, 2), in one of COLOURS; the label is for the legend.

    Pixels are drawn as dots, or as crosses for outliers.
    """

    shown: Model | Array
    label: str
    colour: str
    crosses: bool = False


def draw_overlay(photograph: Image, layers: Sequence[Layer]) -> Image8:
    """Draw models and pixels into a photograph, the last on top: (height, width, 3) blue, green, red, 8 bit.

    Lines are drawn where the model predicts them, to 1/16 px, for comparison with the paint by eye. Their uncertainty
    is not shown.
    """
    canvas = in_8_bit_colour(photograph)
    thick = max(1.0, float(np.hypot(*canvas.shape[:2])) / _STYLE["usual_px"])
    size = _STYLE["point_px"] * thick
    for layer in layers:
        colour = COLOURS[layer.colour]
        if isinstance(layer.shown, Model):
            for middle, *edges in layer.shown.lines:
                for line in edges or (middle,):
                    _draw_line(canvas, line, colour, round(thick))
            _draw_crosses(canvas, layer.shown.points, size, colour, round(thick), upright=True)
        elif layer.crosses:
            _draw_crosses(canvas, layer.shown, size, colour, round(thick), upright=False)
        else:
            _draw_dots(canvas, layer.shown, _STYLE["dot_px"] * thick, colour)
    return _with_legend(canvas, [(one.label, COLOURS[one.colour]) for one in layers], thick)


def in_8_bit_colour(image: Image) -> Image8:
    """Copy any photograph as (height, width, 3) uint8; deeper ones are stretched to the range of their values."""
    plain = np.array(image)
    if plain.dtype != np.uint8:
        low, high = float(plain.min()), float(plain.max())
        plain = np.clip((plain.astype(np.float32) - low) * (255.0 / max(high - low, 1e-12)), 0.0, 255.0)
    plain = plain.astype(np.uint8)
    return np.asarray(cv2.cvtColor(plain, cv2.COLOR_GRAY2BGR) if plain.ndim == 2 else plain, dtype=np.uint8)


def _draw_line(canvas: Image8, pixels: Array, colour: Colour, thickness: int) -> None:
    pairs = np.stack([pixels[:-1], pixels[1:]], axis=1)
    pairs = pairs[_drawable(pairs.reshape(-1, 2), canvas).reshape(-1, 2).all(axis=1)]
    cv2.polylines(canvas, list(_fixed(pairs)), False, colour, thickness, cv2.LINE_AA, _SHIFT)


def _draw_crosses(canvas: Image8, pixels: Array, size: float, colour: Colour, thickness: int, *, upright: bool) -> None:
    arms = 0.5 * size * (np.eye(2) if upright else np.array([[0.7, 0.7], [0.7, -0.7]]))
    for x in pixels[_drawable(pixels, canvas)]:
        ends = [_fixed(np.array([x - arm, x + arm])) for arm in arms]
        cv2.polylines(canvas, ends, False, colour, thickness, cv2.LINE_AA, _SHIFT)


def _draw_dots(canvas: Image8, pixels: Array, radius: float, colour: Colour) -> None:
    for x, y in _fixed(pixels[_drawable(pixels, canvas)]).tolist():
        cv2.circle(canvas, (x, y), round(radius * (1 << _SHIFT)), colour, -1, cv2.LINE_AA, _SHIFT)


def _drawable(pixels: Array, canvas: Image8) -> Mask:
    """(N,) whether pixels are finite and not so far outside that OpenCV's coordinates overflow."""
    height, width = canvas.shape[:2]
    return np.asarray(np.all(np.abs(pixels - (0.5 * width, 0.5 * height)) < (2.0 * width, 2.0 * height), axis=1))


def _fixed(pixels: Array) -> Indices32:
    return np.round((1 << _SHIFT) * pixels).astype(np.int32)


def _with_legend(canvas: Image8, entries: Sequence[tuple[str, Colour]], thick: float) -> Image8:
    letter, pad = _STYLE["letter_px"] * thick, _STYLE["pad_px"] * thick
    scale, row = letter / _STYLE["font_px"] / 1.4, 1.3 * letter
    stroke = max(1, round(thick))
    texts = [label.encode("ascii", "replace").decode() for label, _ in entries]  # the font has ASCII letters only
    widest = max((cv2.getTextSize(text, _FONT, scale, stroke)[0][0] for text in texts), default=0)
    sample = 2.0 * row
    top, right = int(canvas.shape[0] - row * len(texts) - 2.0 * pad), int(3.0 * pad + sample + widest)
    ground = canvas[max(top, 0) :, :right]
    ground[:] = np.round((1.0 - _STYLE["paper"]) * ground + _STYLE["paper"] * 255.0)
    for number, (text, (_, colour)) in enumerate(zip(texts, entries, strict=True)):
        middle = top + pad + (number + 0.5) * row
        ends = _fixed(np.array([[pad, middle], [pad + sample, middle]]))
        cv2.line(canvas, ends[0].tolist(), ends[1].tolist(), colour, 2 * stroke, cv2.LINE_AA, _SHIFT)
        place = (int(2.0 * pad + sample), int(middle + 0.35 * letter))
        cv2.putText(canvas, text, place, _FONT, scale, COLOURS["ink"], stroke, cv2.LINE_AA)
    return canvas


def draw_seen(photograph: Image, seen: FieldLines | None, target: Target) -> Image8:
    """Draw into a photograph the lines found in it, and where paint of the best candidate was found and where not."""
    grey = in_8_bit_colour(photograph).mean(axis=2).astype(np.float32)
    layers = [Layer(find_strokes(grey).ends.reshape(-1, 2), "lines seen", "before")]
    if seen is not None:
        lines = seen.lines
        missing = [target.curve_names[number] for number in seen.absent]
        absent = f"best candidate: no paint{f', all along {first_of(missing, 4)}' if missing else ''}"
        layers += [
            Layer(lines.pixels[lines.found], "best candidate: paint", "after"),
            Layer(lines.course.pixels[~lines.found], absent, "taken out", crosses=True),
        ]
    return draw_overlay(photograph, layers)


def places_in_picture(
    measurement: Measurement, targets: Mapping[str, Target], camera: Camera
) -> Iterator[tuple[str, Array]]:
    """Yield what is drawn for a measurement, with a label, (N, 2) px each: the outline of a board, a pole from its foot
    to its top, a line, or the place beneath a camera whose height is to be measured.
    """
    pieces = 30
    if measurement.kind == "tape":
        yield "measure the height here", camera.project((camera.position * (1.0, 1.0, 0.0))[None])
    for view in measurement.views:
        target = {**targets, **measurement.targets}[view.target]
        if measurement.kind == "board" and view.placement is not None and target.grid is not None:
            rows = target.point_array.reshape(target.grid.rows, target.grid.columns, 3)
            edge = np.array([rows[0, 0], rows[0, -1], rows[-1, -1], rows[-1, 0], rows[0, 0]])
            yield "a board here", camera.project(measurement.placements[view.placement].transform(edge))
        elif measurement.kind == "pole":
            top = target.point_array[0]
            yield "a pole here", camera.project(np.array([top * (1.0, 1.0, 0.0), top]))
        elif measurement.kind == "line":
            for name in view.curves or ():
                yield "this line", camera.project(curve_points(target.curves[name], 0, pieces))


# ---- the model ------------------------------------------------------------------------------------------------------


class Model(Struct, frozen=True, eq=False):
    """Lines, and points (N, 2) px, to draw into a photograph of `image_size`. Each line consists of its middle (S, 2)
    px, NaN where the camera does not show it, followed by both edges if the paint is wide.
    """

    image_size: tuple[int, int]
    lines: tuple[tuple[Array, ...], ...]
    points: Array

    @property
    def in_view(self) -> int:
        """Number of lines and points that the photograph shows, at least in part."""
        lines = sum(bool(np.any(self._inside(middle))) for middle, *_ in self.lines)
        return lines + int(np.count_nonzero(self._inside(self.points)))

    def apart_px(self, other: Model) -> tuple[float, float]:
        """Median and largest distance, px, to the places of another model of the same things.

        NaN where the photograph shows no place of both.
        """
        pairs = [(a[0], b[0]) for a, b in zip(self.lines, other.lines, strict=True)]
        pairs.append((self.points, other.points))
        apart = np.concatenate([np.linalg.norm(a - b, axis=1)[self._inside(a)] for a, b in pairs])
        apart = apart[np.isfinite(apart)]
        return (float(np.median(apart)), float(np.max(apart))) if len(apart) else (np.nan, np.nan)

    def _inside(self, pixels: Array) -> Mask:
        return in_image(pixels, self.image_size)


def model_seen(
    estimate: Estimate,
    targets: Mapping[str, Target],
    station: str,
    shown: Sequence[tuple[str, str | None]],
    height_m: float = 0.0,
) -> Model:
    """Return the model of what a station sees.

    Args:
        estimate: cameras, poses and targets as built. targets: the nominal targets that it was made for.
        shown: target and placement of each thing; placement None for a target in the world.
        height_m: height by which everything is lifted along its target's z.
    """
    built = estimate.structure.built(targets)
    lift = Pose(np.eye(3), np.array([0.0, 0.0, height_m]))
    lines: list[tuple[Array, ...]] = []
    points = [np.empty((0, 2))]
    for name, placement in shown:
        camera = estimate.camera_at(station, placement)
        camera = camera.at(camera.cam_from_world @ lift)
        lines += _lines(targets[name], *built[name], camera)
        points.append(camera.project(built[name][0]))
    return Model(estimate.camera_at(station).image_size, tuple(lines), np.concatenate(points))


def _lines(target: Target, points: Array, tracks: Array, camera: Camera) -> Iterator[tuple[Array, ...]]:
    wide_px = 5.0  # width from which on paint is drawn by its two edges, so that it remains visible
    steps = 240  # number of places along a curve
    for number, curve in enumerate(target.curves.values()):
        s, is_arc = np.linspace(*curve.parameter_range, steps), bool(target.is_arc[number])
        middle, left, right = (camera.project(along_track(tracks[side, number], is_arc, s)) for side in (0, 1, -1))
        width = np.linalg.norm(left - right, axis=1)[in_image(middle, camera.image_size)]
        wide = len(width) > 0 and float(np.median(width)) >= wide_px
        yield (middle, left, right) if wide else (middle,)
    if target.grid is not None:
        grid = points.reshape(target.grid.rows, -1, 3)
        yield from ((camera.project(_between(row)),) for row in (*grid, *grid.swapaxes(0, 1)))


def _between(corners: Array) -> Array:
    """Corners (C, 3) and places on the straight lines between consecutive ones."""
    between = 12  # number of steps from one corner of a board to the next
    at = np.linspace(0.0, len(corners) - 1.0, between * (len(corners) - 1) + 1)
    return np.column_stack([np.interp(at, np.arange(len(corners)), axis) for axis in corners.T])
