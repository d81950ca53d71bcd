"""Blur of a photograph, and smear where the camera moved, across the lines in each direction."""

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

_WINDOWS = 150  # number of windows from which a blur is estimated
# Lines are grouped into 4 sectors of direction, because the blur differs between directions where the camera moved. A
# sector needs 12 windows for a blur of its own. _ALIKE is the weight, in windows, of the assumption that blur does not
# depend on direction.
_SECTORS, _FEWEST_IN_SECTOR, _ALIKE = 4, 12, 10.0

# Share of the displacement by coma that may remain after its correction, common to all lines. With 0.4, errors are 0.8
# times the stated standard deviation, and at most 1.5 times in 40 pictures.
_OF_COMA = 0.4


class Blur(Rows):
    """The blur of the lines at N places, and the width of their paint.

    Attributes:
        blur_px: (N,) standard deviation of a Gaussian that stands for lens and pixel together.
        smear_px: (N,) length of the additional smear, by camera motion or coma.
        stretch: ratio of the paint's width to the width that the target states.
        lean: (N,) asymmetry of the smear, from -1 to 1; its sign gives the end with more light.
    """

    blur_px: Array
    smear_px: Array
    stretch: float
    lean: Array

    @property
    def usual_px(self) -> float:
        """Root mean square over all places of the standard deviation of blur and smear together, px."""
        return float(np.sqrt(np.mean(self.blur_px**2 + self.smear_px**2 / 12.0)))

    def fitted(self, windows: Windows, course: Course) -> Profiles:
        """Fit the profile model to the windows of these places."""
        reach_px, edges = 1.5, self.stretch * course.edges
        return fit_profiles(windows, edges, self.blur_px, reach_px, self.smear_px, self.lean)

    def smeared(self, rows: Indices) -> EdgeShape:
        """Return the shape of these places under the assumption that all blur beyond the lens's own is smear."""
        # Largest blur of a lens in focus, px: a larger blur in every direction is taken for smear.
        in_focus_px = 1.0
        # Ratio of the length of a smear to the standard deviation of the Gaussian that fits the smeared line best.
        as_smeared = 2.5
        lens = min(float(np.min(self.blur_px)), in_focus_px)
        here = median(self.blur_px[rows])
        smear = as_smeared * np.sqrt(max(here**2 - lens**2, 0.0))
        return EdgeShape(lens if smear > 0.0 else here, self.stretch, float(smear))


def no_blur(count: int) -> Blur:
    """Return the blur of so many places before it has been estimated: 0 everywhere."""
    return Blur(np.zeros(count), np.zeros(count), 1.0, np.zeros(count))


def blur_of(windows: Windows, course: Course, bright: Array, before: Blur) -> Blur:
    """Estimate the blur that windows of one direction share, and interpolate between directions.

    Args:
        bright: (N,) how much brighter than its surroundings each place is, grey levels.
        before: the result with Gaussians alone, from which a smear is estimated; `no_blur` to estimate the Gaussians.
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
    """Return the blur of a lens with coma, and the share of the displacement by coma that may remain; None without
    coma.

    Coma smears light more and more towards the picture's rim. The share is 1 where the direction of the asymmetry
    cannot be determined. The smear leans outwards or inwards, and the windows must show which, since a blur that merely
    grows towards the rim fits either way equally well. Then two shapes are tried, each growing with the radius or its
    square: a smear along the radius alone, as by lateral colour, and coma's own, for which lines in all directions have
    the third moment of a shift along the radius.

    Args:
        fits: fits with a symmetric blur.
        size: height and width of the picture, px.
    """
    # `surely`, in standard deviations: dark pictures without coma reach 2.6, coma starts at 6.7. `outer` is a share of
    # half the diagonal, `few` the number of windows for a first estimate of the smear's length. A smear shorter than
    # `least_px` is not worth modelling.
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
    """Return (N,) the distance of places from the picture's middle along their normals, and (N,) in all, in half
    diagonals.
    """
    offsets = (course.pixels - 0.5 * (np.array(size[::-1]) - 1.0)) / (0.5 * np.hypot(*size))
    return np.asarray(np.sum(offsets * course.normals, axis=1)), np.asarray(np.linalg.norm(offsets, axis=1))


def _sigmas(differences: Array) -> float:
    """Return the mean of the differences in units of its standard deviation."""
    return float(np.mean(differences) / max(float(np.std(differences)), 1e-9) * np.sqrt(len(differences)))


def _drawn_out(windows: Windows, course: Course, blur: Blur, rows: Indices, along: Array) -> tuple[Blur, Array]:
    """Fit a smear of length and direction proportional to `along` (N,); return it and the log noise (R,) of `rows`."""
    drawn, _ = _coma_shape(windows, course, blur, rows, along)
    return drawn, np.log(drawn.take(rows).fitted(windows.take(rows), course.take(rows)).noise)


def _coma_shape(windows: Windows, course: Course, blur: Blur, rows: Indices, along: Array) -> tuple[Blur, float]:
    """Fit a smear proportional to `along` (N,) to `rows`; return the blur and the longest smear, px."""
    start = EdgeShape(min(blur.usual_px, 1.0), blur.stretch, 3.0)
    shape = fit_shape(windows.take(rows), course.edges[rows], start, along=along[rows])
    smear = shape.smear_px * np.abs(along)
    return Blur(np.full(len(along), shape.blur_px), smear, shape.stretch, np.sign(along)), float(np.max(smear[rows]))


def _by_direction(angle: Array, bright: Array, rows: Indices) -> list[Indices]:
    """Group the rows that are surely on paint by direction; return groups with enough rows, or none if only one has."""
    sector = np.floor(angle[rows] / np.pi * _SECTORS + 0.5) % _SECTORS
    own = [_brightest(bright, rows[sector == number]) for number in distinct(sector)]
    own = [some for some in own if len(some) >= _FEWEST_IN_SECTOR]
    return own if len(own) > 1 else []


def _between(angle: Array, own: list[Indices], shapes: list[EdgeShape]) -> tuple[Array, Array]:
    """Interpolate blur and smear (N,) to all angles t. Their squares are a + b cos 2t + c sin 2t, as the extent of an
    ellipse or of a motion is across a line in direction t.
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
    """Return those of the rows that are surely on paint; what a moving camera smears is fainter in one direction. In a
    photograph without any bright place these are the brightest fifth: half of a negative quantile would exceed all of
    them.
    """
    fifth = quantile(bright[rows], 0.8)
    return rows[bright[rows] >= min(0.5 * fifth, fifth)]


def _doubled(angle: Array) -> Array:
    return np.column_stack([np.cos(2.0 * angle), np.sin(2.0 * angle)])


def _shape_of(windows: Windows, edges: Array, rows: Indices, start: EdgeShape) -> EdgeShape:
    rows = _some(rows)
    return fit_shape(windows.take(rows), edges[rows], start)


def _some(rows: Indices, most: int = _WINDOWS) -> Indices:
    """Return an evenly spread subset of the rows, `most` at most."""
    return np.asarray(rows[np.linspace(0, len(rows) - 1, min(len(rows), most)).astype(int)])
