"""By how much a photograph is blurred, and smeared where the camera moved, across the lines in each direction."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.detect.courses import Course
from ceres_cal.detect.profiles import LEAST_BLUR_PX, MOST_BLUR_PX, MOST_SMEAR_PX, EdgeShape, Windows, fit_shape

_WINDOWS = 150  # that tell a blur
# Directions that lines run in, of which each has its own blur where the camera moved; windows to tell it by; and
# windows that count as much as no direction having any.
_SECTORS, _FEWEST_IN_SECTOR, _ALIKE = 4, 12, 10.0


@dataclass(frozen=True, eq=False)
class Blur:
    """What makes the lines wider at N places.

    Attributes:
        blur_px: (N,) standard deviation of a Gaussian, lens and pixel together. smear_px: (N,) how far beside it a
            camera that moved smears them. stretch: the paint's width over what the target says.
    """

    blur_px: Array
    smear_px: Array
    stretch: float = 1.0

    @property
    def usual_px(self) -> float:
        """Standard deviation of all that."""
        return float(np.sqrt(np.mean(self.blur_px**2 + self.smear_px**2 / 12.0)))

    def take(self, rows: Mask) -> Blur:
        """At these places only."""
        return replace(self, blur_px=self.blur_px[rows], smear_px=self.smear_px[rows])

    def smeared(self, rows: Indices) -> EdgeShape:
        """What these places look like if what is beyond a lens's blur is a smear."""
        in_focus_px = 1.0  # of a lens: what is blurred more in every direction is smeared
        as_smeared = 2.5  # of the Gaussian that suits a smeared line best: the smear that it is
        lens = min(float(np.min(self.blur_px)), in_focus_px)
        here = float(np.median(self.blur_px[rows]))
        smear = as_smeared * np.sqrt(max(here**2 - lens**2, 0.0))
        return EdgeShape(lens if smear > 0.0 else here, self.stretch, float(smear))


def no_blur(count: int) -> Blur:
    """Of so many places, before any is known."""
    return Blur(np.zeros(count), np.zeros(count))


def blur_of(windows: Windows, course: Course, bright: Array, before: Blur) -> Blur:
    """What all windows of a direction share, and what lies between directions.

    Args:
        bright: (N,) how much brighter than its surroundings each place is. before: as Gaussians alone have it, where a
            smear is to be told from them; `no_blur` where they are to be told.
    """
    angle = np.mod(np.arctan2(course.normals[:, 1], course.normals[:, 0]), np.pi)
    rows = np.flatnonzero(windows.inside)
    if not len(rows):
        return replace(no_blur(len(course)), blur_px=np.ones(len(course)))
    every = _brightest(bright, rows)
    own = _by_direction(angle, bright, rows) or [every]
    edges = np.column_stack([-0.5 * course.width_px, 0.5 * course.width_px])
    if np.any(before.blur_px):
        shapes = [_shape_of(windows, edges, some, before.smeared(some)) for some in own]
        stretch = float(np.exp(np.mean(np.log([one.stretch for one in shapes]))))
    else:
        start = _shape_of(windows, edges, every, EdgeShape(1.0))
        shapes = [_shape_of(windows, edges, some, start) for some in own] if len(own) > 1 else [start]
        stretch = start.stretch
    blur, smear = _between(angle, own, shapes)
    return Blur(blur, smear, stretch)


def _by_direction(angle: Array, bright: Array, rows: Indices) -> list[Indices]:
    """Of these rows those that are surely on paint, sorted by direction, of those that have enough; none of one."""
    sector = np.floor(angle[rows] / np.pi * _SECTORS + 0.5) % _SECTORS
    own = [_brightest(bright, rows[sector == number]) for number in np.unique(sector)]
    own = [some for some in own if len(some) >= _FEWEST_IN_SECTOR]
    return own if len(own) > 1 else []


def _between(angle: Array, own: list[Indices], shapes: list[EdgeShape]) -> tuple[Array, Array]:
    """Blur and smear (N,) at all angles: squared they are a + b cos 2t + c sin 2t, as ellipses and ways are across a
    line in direction t.
    """
    count = np.array([float(min(len(some), _WINDOWS)) for some in own])
    squares = np.array([(one.blur_px, one.smear_px) for one in shapes]) ** 2
    columns = np.column_stack([np.ones(len(own)), [np.mean(_doubled(angle[some]), axis=0) for some in own]])
    normal = columns.T @ (count[:, None] * columns) + np.diag([0.0, _ALIKE, _ALIKE])
    terms = np.linalg.solve(normal, columns.T @ (count[:, None] * squares))
    across = np.clip(
        terms[0] + _doubled(angle) @ terms[1:], (LEAST_BLUR_PX**2, 0.0), (MOST_BLUR_PX**2, MOST_SMEAR_PX**2)
    )
    return np.sqrt(across[:, 0]), np.sqrt(across[:, 1])


def _brightest(bright: Array, rows: Indices) -> Indices:
    """Of these rows, those that are surely on paint: what a moved camera smears is fainter in one direction. Where the
    photograph has no bright place, the brightest fifth: half of a negative quantile would be above all of them.
    """
    fifth = np.quantile(bright[rows], 0.8)
    return rows[bright[rows] >= min(0.5 * fifth, fifth)]


def _doubled(angle: Array) -> Array:
    return np.column_stack([np.cos(2.0 * angle), np.sin(2.0 * angle)])


def _shape_of(windows: Windows, edges: Array, rows: Indices, start: EdgeShape) -> EdgeShape:
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _WINDOWS)).astype(int)]
    some = Windows(windows.values[rows], windows.distance[rows], windows.inside[rows])
    return fit_shape(some, edges[rows], start)
