"""By how much a photograph is blurred, and smeared where the camera moved, across the lines in each direction."""

from __future__ import annotations

from itertools import product

import numpy as np

from ceres_cal.base import Array, Indices, Rows, distinct, median, quantile, replace
from ceres_cal.detect.courses import Course
from ceres_cal.detect.profiles import (
    LEAST_BLUR_PX,
    MOST_BLUR_PX,
    MOST_SMEAR_PX,
    EdgeShape,
    Profiles,
    Windows,
    fit_profiles,
    fit_shape,
)

_WINDOWS = 150  # that tell a blur
# Directions that lines run in, of which each has its own blur where the camera moved; windows to tell it by; and
# windows that count as much as no direction having any.
_SECTORS, _FEWEST_IN_SECTOR, _ALIKE = 4, 12, 10.0

# Of what coma draws lines aside, what is left, of all of them alike: with 0.4 errors are 0.8 of what is stated, at most
# 1.5 of 40 pictures.
_OF_COMA = 0.4


class Blur(Rows):
    """What makes the lines wider at N places.

    Attributes:
        blur_px: (N,) standard deviation of a Gaussian, lens and pixel together. smear_px: (N,) how far beside it a
            camera that moved, or coma, smears them. stretch: the paint's width over what the target says. lean: (N,) of
            the smear, to which end it holds more.
    """

    blur_px: Array
    smear_px: Array
    stretch: float
    lean: Array

    @property
    def usual_px(self) -> float:
        """Standard deviation of all that."""
        return float(np.sqrt(np.mean(self.blur_px**2 + self.smear_px**2 / 12.0)))

    def fitted(self, windows: Windows, course: Course) -> Profiles:
        """What fits the windows of these places best."""
        reach_px, edges = 1.5, self.stretch * course.edges
        return fit_profiles(windows, edges, self.blur_px, reach_px, self.smear_px, self.lean)

    def smeared(self, rows: Indices) -> EdgeShape:
        """What these places look like if what is beyond a lens's blur is a smear."""
        in_focus_px = 1.0  # of a lens: what is blurred more in every direction is smeared
        as_smeared = 2.5  # of the Gaussian that suits a smeared line best: the smear that it is
        lens = min(float(np.min(self.blur_px)), in_focus_px)
        here = median(self.blur_px[rows])
        smear = as_smeared * np.sqrt(max(here**2 - lens**2, 0.0))
        return EdgeShape(lens if smear > 0.0 else here, self.stretch, float(smear))


def no_blur(count: int) -> Blur:
    """Of so many places, before any is known."""
    return Blur(np.zeros(count), np.zeros(count), 1.0, np.zeros(count))


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
    edges = course.edges
    if np.any(before.blur_px):
        shapes = [_shape_of(windows, edges, some, before.smeared(some)) for some in own]
        stretch = float(np.exp(np.mean(np.log([one.stretch for one in shapes]))))
    else:
        start = _shape_of(windows, edges, every, EdgeShape(1.0))
        shapes = [_shape_of(windows, edges, some, start) for some in own] if len(own) > 1 else [start]
        stretch = start.stretch
    blur, smear = _between(angle, own, shapes)
    return Blur(blur, smear, stretch, np.zeros(len(blur)))


def with_coma(
    windows: Windows, course: Course, blur: Blur, fits: Profiles, size: tuple[int, int]
) -> tuple[Blur, float] | None:
    """The same of a lens with coma, whose light is drawn out ever farther towards the picture's rim, and the share of
    what that draws lines aside that may remain, 1 where it is not told to which side; None of others.

    It leans outwards, or inwards: windows must say which, since what is only blurred more at the rim suits either as
    well. Then two shapes are tried, that grow with the radius or its square: what is drawn out along the radius alone,
    as by lateral colour, and coma's own, of which lines in all directions have the third moment of a shift along it.

    Args:
        fits: by an even blur. size: of the picture, height and width.
    """
    # Standard deviations, in the dark up to 2.6 and of coma from 6.7; of half the diagonal; windows that tell whether
    # it is worth while, and the length that is.
    surely, outer, few, least_px = 4.5, 0.2, 50, 1.6
    across, radius = from_middle(course, size)
    rows = _some(np.flatnonzero(np.isfinite(fits.offset_px) & (np.abs(across) > outer)))
    if len(rows) < _FEWEST_IN_SECTOR or _coma_shape(windows, course, blur, _some(rows, few), across)[1] < least_px:
        return None
    inwards, outwards = (_drawn_out(windows, course, blur, rows, lean * across) for lean in (-1.0, 1.0))
    told, even = _sigmas(inwards[1] - outwards[1]), np.log(fits.noise[rows])
    if abs(told) < surely:
        return (outwards[0], 1.0) if _sigmas(even - outwards[1]) > surely else None
    out = np.copysign(1.0, told)
    shapes = product((across, np.cbrt(across * radius**2)), (0.0, 1.0))
    every = [_drawn_out(windows, course, blur, rows, out * shape * radius**power) for shape, power in shapes]
    left = [float(np.mean(one)) for _, one in every]
    best = int(np.argmin(left))
    return (every[best][0], _OF_COMA) if left[best] < float(np.mean(even)) else None


def from_middle(course: Course, size: tuple[int, int]) -> tuple[Array, Array]:
    """(N,) how far from the picture's middle places are along their normals, and in all, in half diagonals."""
    offsets = (course.pixels - 0.5 * (np.array(size[::-1]) - 1.0)) / (0.5 * np.hypot(*size))
    return np.asarray(np.sum(offsets * course.normals, axis=1)), np.asarray(np.linalg.norm(offsets, axis=1))


def _sigmas(differences: Array) -> float:
    """How many of its standard deviations a mean is above 0."""
    return float(np.mean(differences) / max(float(np.std(differences)), 1e-9) * np.sqrt(len(differences)))


def _drawn_out(windows: Windows, course: Course, blur: Blur, rows: Indices, along: Array) -> tuple[Blur, Array]:
    """What is drawn out by as much and to where `along` (N,) says, and the logarithms (R,) of what it leaves."""
    drawn, _ = _coma_shape(windows, course, blur, rows, along)
    return drawn, np.log(drawn.take(rows).fitted(windows.take(rows), course.take(rows)).noise)


def _coma_shape(windows: Windows, course: Course, blur: Blur, rows: Indices, along: Array) -> tuple[Blur, float]:
    """The same, and how far the farthest is drawn out, px."""
    start = EdgeShape(min(blur.usual_px, 1.0), blur.stretch, 3.0)
    shape = fit_shape(windows.take(rows), course.edges[rows], start, along=along[rows])
    smear = shape.smear_px * np.abs(along)
    return Blur(np.full(len(along), shape.blur_px), smear, shape.stretch, np.sign(along)), float(np.max(smear[rows]))


def _by_direction(angle: Array, bright: Array, rows: Indices) -> list[Indices]:
    """Of these rows those that are surely on paint, sorted by direction, of those that have enough; none of one."""
    sector = np.floor(angle[rows] / np.pi * _SECTORS + 0.5) % _SECTORS
    own = [_brightest(bright, rows[sector == number]) for number in distinct(sector)]
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
    fifth = quantile(bright[rows], 0.8)
    return rows[bright[rows] >= min(0.5 * fifth, fifth)]


def _doubled(angle: Array) -> Array:
    return np.column_stack([np.cos(2.0 * angle), np.sin(2.0 * angle)])


def _shape_of(windows: Windows, edges: Array, rows: Indices, start: EdgeShape) -> EdgeShape:
    rows = _some(rows)
    return fit_shape(windows.take(rows), edges[rows], start)


def _some(rows: Indices, most: int = _WINDOWS) -> Indices:
    """Of many rows as many as tell a blur, evenly."""
    return np.asarray(rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)])
