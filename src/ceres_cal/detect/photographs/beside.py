"""Choice among parallel lines where a target has one, such as a boundary line beside a touch line.

The nearer or the brighter line is often the wrong one, and a camera bends until that fits, too. All curves together
decide: a camera is solved for with every choice, and hardly more than one choice fits.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import product

import numpy as np

from ceres_cal.base.arrays import Array, Array32, Indices, Mask, distinct, median
from ceres_cal.detect.courses import Course, predict
from ceres_cal.detect.lines import peaks
from ceres_cal.detect.photographs.refit import FreeIntrinsics, misfit, observations_of, refit_camera
from ceres_cal.scene import Camera, Target

# How far to either side other lines are searched, as a share of half the image's diagonal.
_REACH = 0.06
_FAINT = 0.4  # least brightness of a line, as a share of the usual one
_LEAST = 0.35  # least share of a curve's places on a line that runs along it
_MOST_BESIDE, _MOST_CHOICES = 3, 48


_PaintLine = tuple[Indices, Array]
"""Paint that runs along a curve: rows of the course, and the paint's offset from there along the normal, px."""


def among_others(
    grey: Array32, target: Target, camera: Camera, curves: Collection[str], free: FreeIntrinsics
) -> tuple[Camera, Target] | None:
    """Return the camera and target for which some curves are other lines than the nearest; None if the nearest fit
    best.
    """
    sigma_px = 0.5  # standard deviation of a peak's position
    spacing_px = 12.0
    course = predict(target, camera, curves, spacing_px, 2.0)
    best, least = None, np.inf
    for nearest, chosen in _choices(_lines_beside(grey, course, _REACH * 0.5 * float(np.hypot(*camera.image_size)))):
        rows, offset = (np.concatenate(parts) for parts in zip(*chosen, strict=True))
        places = course.pixels[rows] + offset[:, None] * course.normals[rows]
        sigma = np.full(len(rows), sigma_px)
        seen = observations_of(target, camera.image_size, course.curve[rows], places, sigma)
        there = refit_camera(camera, seen, free.names, free.priors)
        left = np.inf if there is None else misfit(there[0], seen)
        if left < least:
            best, least = None if nearest else there, left
    return best


def _choices(beside: Sequence[Sequence[_PaintLine]]) -> Iterator[tuple[bool, list[_PaintLine]]]:
    """Yield every choice of a line for each curve, the nearest lines first, and whether all are the nearest. Nothing is
    yielded where there is no alternative.

    If more curves have alternatives than can be tried, only some take part.
    """
    ordered = sorted(beside, key=lambda lines: (len(lines) > 1, -len(lines[0][0])))
    taking_part, count = [], 1
    for lines in ordered:
        if count * len(lines) <= _MOST_CHOICES:
            taking_part.append(lines)
            count *= len(lines)
    if count > 1:
        for number, chosen in enumerate(product(*taking_part)):
            yield number == 0, list(chosen)


def _lines_beside(grey: Array32, course: Course, reach_px: float) -> list[list[_PaintLine]]:
    """Return the lines that each curve may be, the nearest first, for the curves along which paint runs."""
    if not len(course):
        return []
    steps, bright = peaks(grey, course, reach_px)
    seen = bright > _FAINT * median(np.max(bright, axis=1))
    beside = []
    for number in distinct(course.curve):
        rows = np.flatnonzero(course.curve == number)
        lines = [one for one in _joined(rows, steps, seen) if len(one[0]) >= _LEAST * len(rows)]
        lines.sort(key=lambda line: abs(median(line[1])))
        if lines:
            beside.append(lines[:_MOST_BESIDE])
    return beside


def _joined(rows: Indices, steps: Array, seen: Mask) -> list[_PaintLine]:
    """Join peaks at neighbouring rows with similar offsets into lines."""
    # Largest gap in a line, in places, and its largest bend from one place to the next, px.
    gap, bend_px = 4, 1.2
    lines: list[list[tuple[int, float]]] = []
    for row in rows.tolist():
        for offset in steps[seen[row]].tolist():
            before = [
                line
                for line in lines
                if 0 < row - line[-1][0] <= gap and abs(line[-1][1] - offset) < bend_px * (row - line[-1][0]) ** 0.5
            ]
            if before:
                min(before, key=lambda line: abs(line[-1][1] - offset)).append((row, offset))
            else:
                lines.append([(row, offset)])
    return [(np.array([row for row, _ in line]), np.array([offset for _, offset in line])) for line in lines]
