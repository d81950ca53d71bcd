"""Predicted images of a target's painted curves: places along them, evenly spaced in the image."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ceres_cal.base import Array, Indices32, Rows, dots
from ceres_cal.scene import Arc, Camera, Target, along_curve, along_track, curve_points, nearest_on_curve


class Course(Rows):
    """N places on painted curves as the camera should see them, curve by curve and in order along each.

    Attributes:
        curve: (N,) index among the target's curves. s: (N,) parameter on the curve.
        pixels: (N, 2) places in the image, px. normals: (N, 2) of length 1, towards the curve's left. curvature: (N,)
            1/px, positive towards the normal. width_px: (N,) width of the paint along the normal.
    """

    curve: Indices32
    s: Array
    pixels: Array
    normals: Array
    curvature: Array
    width_px: Array

    @property
    def edges(self) -> Array:
        """(N, 2) distances of the paint's two edges from its middle along the normal, px."""
        return np.column_stack([-0.5 * self.width_px, 0.5 * self.width_px])


def predict(
    target: Target, camera: Camera, curves: Collection[str], spacing_px: float, margin_px: float = 0.0
) -> Course:
    """Return places about every `spacing_px` on those painted curves with these names that fall into the image.

    Args:
        camera: camera whose cam_from_world is cam_from_target.
        margin_px: how far inside the image the places must lie.
    """
    widest_px = 100.0
    painted = [i for i, (name, curve) in enumerate(target.curves.items()) if name in curves and curve.width_m > 0.0]
    number, s = _places(target, camera, np.array(painted, dtype=np.int32), spacing_px, margin_px)
    course = course_at(target, camera, number, s)
    # Where the lens folds over, only one edge of the paint may be visible. The search is not made for paint wider than
    # `widest_px`.
    whole = np.isfinite(course.curvature + dots(course.pixels, course.normals))
    return course.take(whole & (course.width_px < widest_px))


def _places(
    target: Target, camera: Camera, curves: Indices32, spacing_px: float, margin_px: float
) -> tuple[Indices32, Array]:
    """Return curve (N,) and parameter (N,) of the places. All of them are projected in one call, which saves most of
    the time.
    """
    s, places = (one[curves] for one in target.evenly)
    x, y = camera.project(places.reshape(-1, 3)).T.reshape(2, *s.shape)
    size = np.array(camera.image_size)
    with np.errstate(invalid="ignore"):
        near = (x > -0.5 * size[0]) & (x < 1.5 * size[0]) & (y > -0.5 * size[1]) & (y < 1.5 * size[1])
        step = np.where(near[:, 1:] & near[:, :-1], np.sqrt(np.diff(x) ** 2 + np.diff(y) ** 2), 0.0)
    length = np.concatenate([np.zeros((len(s), 1)), np.cumsum(step, axis=1)], axis=1)
    counts = (length[:, -1] / spacing_px).astype(int)
    chosen = [
        np.interp((np.arange(count) + 0.5) * (along[-1] / count), along, places)
        for count, along, places in zip(counts, length, s, strict=True)
        if count
    ]
    number, s = np.repeat(curves, counts), np.concatenate([np.empty(0), *chosen])
    there = camera.project(along_track(target.tracks[0][number], target.is_arc[number], s))
    with np.errstate(invalid="ignore"):
        inside = np.all((there > margin_px - 0.5) & (there < size - 0.5 - margin_px), axis=1)
    return number[inside], s[inside]


def course_at(target: Target, camera: Camera, number: Indices32, s: Array) -> Course:
    """Return the course through places that are given by curve (N,) and parameter (N,)."""
    every = target.evenly[0]
    span = (every[:, -1] - every[:, 0])[number]
    steps = np.array([-2e-3, 0.0, 2e-3, 0.0, 0.0])[:, None] * span
    tracks = np.stack([target.tracks[side][number] for side in (0, 0, 0, 1, -1)]).reshape(-1, 3, 3)
    places = along_track(tracks, np.tile(target.is_arc[number], 5), (s + steps).ravel())
    before, pixels, after, left, right = camera.project(places).reshape(5, -1, 2)
    tangent = after - before
    length = np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-9)
    tangent = tangent / length
    normals = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    normals *= np.where(dots(left - right, normals) < 0.0, -1.0, 1.0)[:, None]
    width = dots(left - right, normals)
    bend = dots(before - 2.0 * pixels + after, normals) / (0.5 * length[:, 0]) ** 2
    return Course(number, s, pixels, normals, bend, width)


def clear_px(target: Target, camera: Camera, course: Course, curves: Collection[str]) -> Array:
    """(N,) px from each place to the middle of the nearest other painted curve, or to the end of its own curve."""
    number, s, pixels = course.curve, course.s, course.pixels
    places = along_track(target.tracks[0][number], target.is_arc[number], s)
    clear = np.full(len(places), np.inf)
    rows, others = [np.empty(0, dtype=np.int64)], [np.empty((0, 3))]
    for other, (name, curve) in enumerate(target.curves.items()):
        own = number == other
        if not isinstance(curve, Arc):
            for end in curve_points(curve, 0, 1):
                rows.append(np.flatnonzero(own))
                others.append(np.broadcast_to(end, (len(rows[-1]), 3)))
        if name in curves and curve.width_m > 0.0:
            rows.append(np.flatnonzero(~own))
            others.append(along_curve(curve, nearest_on_curve(curve, places[rows[-1]])))
    at = np.concatenate(rows)
    np.fmin.at(clear, at, np.linalg.norm(pixels[at] - camera.project(np.concatenate(others)), axis=1))
    return clear
