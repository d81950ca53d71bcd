"""Corners of a chessboard, to a hundredth of a pixel: a model of the picture is fitted around each corner.

Around a corner the picture is a saddle: two dark and two bright squares, separated by two edges that cross in the
corner,

    I(p) = m + g . (p - x) + (a + h . (p - x)) tanh(s d1(p)) tanh(s d2(p)),

with x the corner, d1 and d2 the signed distances to the edges, s their sharpness, and (m, g), (a, h) the mean level and
the contrast of uneven light, to first order. The directions of the edges are free; their curvature (lens distortion
bends them) is that of the grid of neighbouring corners. The eleven numbers are fitted by least squares to all pixels of
a disc around the corner.

The picture is first smoothed a little. That spreads every edge over several pixels, so that its profile, whatever the
camera made of it (sharpening, motion, sharp edges between two pixels), is symmetric and does not bias the corner.
Without smoothing the corners of an image sharpened along its rows were off by 0.1 px, with it by 0.01 px.

A blurred picture of large squares is shrunk first, by at most its blur: a disc of 20 px radius shows little but blur
there. At a blur of 8 px in squares of 120 px, corners are then off by 0.009 px instead of 0.065.

Accuracy measured on rendered boards (lens distortion, tilt, blur of 0.7 px, noise of 2 grey levels at a contrast of
160), rms per coordinate: 0.005 px, where `cv2.cornerSubPix` gives 0.020 px with its best window and
`cv2.findChessboardCornersSB` 0.04 px. What remains is noise, and averages out: in renderings of a real 13-image set the
focal length (700 px) is right to 0.04 px, and 0.4 to 1.0 px too short with `cornerSubPix`, whatever its window. These
figures do not include how flat the board is.
"""

from __future__ import annotations

import cv2
import numpy as np

from ceres_cal import kernels
from ceres_cal.base import AnyArray, Array, Frozen, Mask, medians_known

REACH = 0.6
"""Radius of the disc around a corner, as a share of the distance to the next edges, which it must not contain."""

_SMOOTHING_PX = 0.7
_RADIUS_PX = (3.0, 20.0)
# Largest move of a corner during its fit, as a share of the distance to the next edges: beyond it the fit followed
# something else. Nothing changes from 0.33 to 0.67.
_LOST = 0.5
_ROUGH = 0.6  # radius of the disc in the first fit, as a share of the reach
_WHOLE = 32.0  # px; a cut-out begins at a multiple of this, and no picture is shrunk by as much
# Least contrast, as a share of the usual one: a lower one shows something else, a sticker or a finger. Nothing changes
# from half to double.
_FAINT = 0.2
# Least contrast, as a share of the brightest pixel: in a picture of one grey every contrast is rounding.
_ROUNDING = 1e-6
# Sharpness times standard deviation of a Gaussian blur, for which tanh has the slope of the blurred edge.
_BLUR = 0.8

# Columns of the kernel's fitted parameters.
_ANGLES, _SHARP, _CONTRAST, _LEFT, _FITTED = slice(2, 4), 4, 8, 11, 14


class Saddles(Frozen):
    """Measured corners of one board.

    Attributes:
        grid: (rows, columns, 2) px; NaN where no corner was measured.
        contrast: (rows, columns) grey levels, half the step from dark to bright; positive where the square towards the
            next row and column is dark. Neighbours differ in sign.
        misfit: (rows, columns) root mean square residual of the model, as a share of the contrast.
    """

    grid: Array
    contrast: Array
    misfit: Array

    def without(self, wrong: Mask) -> Saddles:
        """Return the corners with those of a mask (rows, columns) left out."""
        return Saddles(*(np.where(wrong.T, np.nan, values.T).T for values in vars(self).values()))


def measure_saddles(image: AnyArray, grid: Array, reach: float | Array = REACH) -> Saddles:
    """Measure the corners of a board near where a detector saw them.

    A corner is left out (NaN) where the fit moves away from its start, where the contrast has the wrong sign for its
    place on the board or is far below the others', or where no neighbour gives the direction of its edges. Agreement
    with a camera is never a criterion.

    Args:
        image: (height, width), any depth.
        grid: (rows, columns, 2) px, right-handed (columns x rows > 0 in the image), accurate to a few pixels; NaN where
            nothing was seen.
        reach: radius of the disc around a corner, as a share of the distance to the next edges; one for all, or (rows,
            columns).
    """
    fitted = fit_saddles(image, grid, np.ones(grid.shape[:2], dtype=bool), reach)
    rows, columns = np.indices(fitted.contrast.shape)
    signed = np.where((rows + columns) % 2 == 0, fitted.contrast, -fitted.contrast)
    usual = float(medians_known(signed.ravel()))
    return fitted.without(~(signed * np.sign(usual) > max(_FAINT * np.abs(usual), _ROUNDING * float(np.max(image)))))


def fit_saddles(image: AnyArray, grid: Array, wanted: Mask, reach: float | Array = REACH) -> Saddles:
    """Fit saddles near the wanted corners (rows, columns) of a grid; the other corners only give the directions of
    edges.
    """
    corner, level = _around(image, grid)
    seen, discs, first = grid - corner, (reach, wanted), (_ROUGH * reach, wanted)
    smooth = _smoothed(level)
    edges = _edges(seen)
    fitted = _fit_grid(smooth, seen, edges, seen, first)
    shrink = _shrink(fitted, edges[2], reach)
    start = _started(fitted, seen, wanted)
    if shrink > 1:
        smooth = _smoothed(_shrunk(level, shrink))
        places, seen = ((places + 0.5) / shrink - 0.5 for places in (start[..., :2], seen))
        start = _started(_fit_grid(smooth, places, _edges(places), seen, discs), seen, wanted)
    fitted = _fit_grid(smooth, start, _edges(start[..., :2]), seen, discs)
    contrast = fitted[..., _CONTRAST]
    misfit = fitted[..., _LEFT] / np.maximum(np.abs(contrast), 1e-9)
    return Saddles((fitted[..., :2] + 0.5) * shrink - 0.5 + corner, contrast, misfit)


def _around(image: AnyArray, grid: Array) -> tuple[Array, AnyArray]:
    """Return x and y of the first pixel of the part of a picture that discs around a grid can reach, and that part."""
    margin = np.fmax.reduce(steps_px(grid), initial=_RADIUS_PX[1]) + _RADIUS_PX[1]
    known = grid[np.isfinite(grid).all(axis=-1)]
    if not len(known):
        return np.zeros(2), image.astype(np.float32)
    low = np.maximum((known.min(axis=0) - margin) // _WHOLE * _WHOLE, 0.0)
    high = np.maximum(known.max(axis=0) + margin, low)
    (x, y), (right, below) = (
        ends.clip(0.0, np.array(image.shape[::-1]) - 1.0).astype(int).tolist() for ends in (low, high)
    )
    return np.array([x, y], dtype=float), image[y : below + 1, x : right + 1].astype(np.float32)


def steps_px(grid: Array) -> Array:
    """(K,) distances, px, between neighbouring corners, NaN where one of them is not seen."""
    steps = np.concatenate([np.diff(grid, axis=axis).reshape(-1, 2) for axis in (0, 1)])
    return np.asarray(np.linalg.norm(steps, axis=1))


def _smoothed(level: AnyArray) -> AnyArray:
    return np.asarray(cv2.GaussianBlur(level, (0, 0), _SMOOTHING_PX))


def is_begun_dark(contrast: Array) -> bool:
    """Whether the square between a grid's first corner and the next row and column is dark, judged by all contrasts."""
    rows, columns = np.indices(contrast.shape)
    return bool(np.nansum(np.where((rows + columns) % 2 == 0, contrast, -contrast)) > 0.0)


def _started(fitted: Array, seen: Array, wanted: Mask) -> Array:
    """Return the start of the next fit, (rows, columns, _LEFT); unwanted corners stay where they were seen."""
    start = np.where(wanted[..., None], fitted[..., :_LEFT], np.nan)
    start[~wanted, :2] = seen[~wanted]
    return start


def _shrink(fitted: Array, distance: Array, reach: float | Array) -> int:
    """Return the factor by which the picture is shrunk for the last fit. It is as large as the blur allows, and larger
    than 1 only where a disc of the most pixels would see only a part of each square, or nothing but blur.
    """
    sharp = fitted[..., _SHARP]
    if not np.any(np.isfinite(sharp + distance)):
        return 1
    blur_px, radius_px = (float(medians_known(each.ravel())) for each in (_BLUR / sharp, reach * distance))
    return int(2 ** max(0.0, np.floor(np.log2(min(blur_px, 2.0 * radius_px / _RADIUS_PX[1])))))


def _shrunk(level: AnyArray, factor: int) -> AnyArray:
    height, width = (size // factor for size in level.shape)
    return cv2.resize(level[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)


def _fit_grid(smooth: AnyArray, start: Array, edges: _Edges, seen: Array, discs: tuple[float | Array, Mask]) -> Array:
    """Fit the wanted corners once; return (rows, columns, _FITTED), NaN where one moved too far from where it was
    `seen`. `start`: places, for a rough fit with straight edges, or the result of such a fit. `edges`: geometry of the
    edges at the start. `discs`: their reach, and the mask of the wanted corners.
    """
    reach, wanted = discs
    (along_row, row_bend), (along_column, column_bend), distance = edges
    known = wanted & np.isfinite(distance) & np.isfinite(start[..., :2]).all(axis=-1)
    fitted = np.full((*distance.shape, _FITTED), np.nan)
    if not np.any(known):
        return fitted
    begun = np.full((np.count_nonzero(known), _FITTED), np.nan)
    begun[:, : start.shape[-1]] = start[known]
    if start.shape[-1] == _LEFT:
        begun[:, _LEFT:-1] = np.column_stack([row_bend[known], column_bend[known]])
    else:
        along = np.stack([along_row[known], along_column[known]], axis=1)
        begun[:, _ANGLES], begun[:, _LEFT:-1] = np.arctan2(along[..., 1], along[..., 0]), 0.0
    begun[:, -1] = np.clip((reach * distance)[known], *_RADIUS_PX)
    params = np.empty_like(begun)
    kernels.fit_saddles(smooth, begun, params)
    moved = np.linalg.norm(params[:, :2] - seen[known], axis=1)
    fitted[known] = np.where((moved < _LOST * distance[known])[:, None], params, np.nan)
    return fitted


_Edges = tuple[tuple[Array, Array], tuple[Array, Array], Array]


def _edges(grid: Array) -> _Edges:
    """Tangent and curvature of the edge along each row and along each column, and distance (px) to the next edges."""
    along_row, row_bend, row_step = _line_geometry(grid, axis=1)
    along_column, column_bend, column_step = _line_geometry(grid, axis=0)
    turn = _cross(along_row, along_column)  # sine of the angle between the edges
    distance = np.minimum(row_step, column_step) * np.abs(turn)
    return (along_row, row_bend), (along_column, column_bend), distance


def _line_geometry(grid: Array, axis: int) -> tuple[Array, Array, Array]:
    """Unit tangent (.., 2), curvature (1 / px) and distance to the next corner (px) of the lines along `axis`."""
    line = grid.swapaxes(0, axis)
    gap = np.full((1, *line.shape[1:]), np.nan)
    steps = np.diff(line, axis=0)
    ahead, behind = np.concatenate([steps, gap]), np.concatenate([gap, steps])
    chord = np.where(np.isnan(behind), ahead, np.where(np.isnan(ahead), behind, 0.5 * (ahead + behind)))
    length = np.hypot(chord[..., 0], chord[..., 1])
    with np.errstate(divide="ignore", invalid="ignore"):  # where two corners are predicted at one place
        tangent = chord / length[..., None]
        bend = _cross(tangent, ahead - behind) / length**2
    # At the ends of a line the next corner's curvature is used; without any, the line is straight.
    after, before = np.concatenate([bend[1:], gap[..., 0]]), np.concatenate([gap[..., 0], bend[:-1]])
    for other in (after, before, np.zeros_like(bend)):
        bend = np.where(np.isnan(bend), other, bend)
    size = np.hypot(steps[..., 0], steps[..., 1])
    step = np.fmin(np.concatenate([size, gap[..., 0]]), np.concatenate([gap[..., 0], size]))
    return tangent.swapaxes(0, axis), bend.swapaxes(0, axis), step.swapaxes(0, axis)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
