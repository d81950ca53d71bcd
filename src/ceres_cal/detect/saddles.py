"""Where the corners of a chessboard are, to a hundredth of a pixel: a model of the picture fitted around each corner.

Around a corner the picture is a saddle: two dark and two bright squares, parted by two edges that cross in the corner,

    I(p) = m + g . (p - x) + (a + h . (p - x)) tanh(s d1(p)) tanh(s d2(p)),

with x the corner, d1 and d2 the signed distances to the edges, s their sharpness, and (m, g), (a, h) the mean level and
the contrast of uneven light, to first order. The directions of the edges are free; their curvature (lens distortion
bends them) is that of the grid of neighbouring corners. The eleven numbers are fitted by least squares to all pixels of
a disc around the corner.

The picture is first smoothed a little. That spreads every edge over several pixels, so that its profile, whatever the
camera made of it (sharpening, motion, sharp edges between two pixels), is symmetric about it and moves nothing. Without
it the corners of an image sharpened along its rows were off by 0.1 px, with it by 0.01 px.

A blurred picture of large squares is shrunk first, by no more than its blur: a disc of 20 px radius sees little else
there. At a blur of 8 px in squares of 120 px corners are then off by 0.009 px instead of 0.065.

Measured on rendered boards (lens distortion, tilt, blur of 0.7 px, noise of 2 grey levels at a contrast of 160), rms
per coordinate: 0.005 px, where `cv2.cornerSubPix` gives 0.020 px with its best window and `cv2.findChessboardCornersSB`
0.04 px. What remains is noise, and averages out: in renderings of a real 13-image set the focal length (700 px) comes
out right to 0.04 px, and 0.4 to 1.0 px short with `cornerSubPix`, whatever its window. The number does not tell how
flat the board is.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from ceres_cal.base.arrays import AnyArray, Array, Mask

REACH = 0.6
"""Radius of the disc around a corner as a part of the distance to the next edges: further, they would be in it."""

_SMOOTHING_PX = 0.7
_RADIUS_PX = (3.0, 20.0)
# A corner that moved further, as a part of that distance, followed something else. Nothing changes from 0.33 to 0.67.
_LOST = 0.5
# A contrast below this part of the usual one shows something else: a sticker, a finger. Nothing changes from half to
# double.
_FAINT = 0.2
_SHARPNESS = (0.05, 3.0)  # 1 / px; the smoothing alone makes it 1.1
_BLUR = 0.8  # sharpness times the standard deviation of a Gaussian blur: tanh then has its slope
_STEPS = 20
_SETTLED_PX = 1e-3  # the steps shrink quadratically: the last one is smaller by far than the noise

# Places in a row of parameters.
_X, _Y, _ANGLE, _SHARP, _MEAN, _MEAN_SLOPE, _CONTRAST, _CONTRAST_SLOPE, _SIZE = 0, 1, 2, 4, 5, 6, 8, 9, 11


@dataclass(frozen=True, eq=False)
class Saddles:
    """Measured corners of one board.

    Attributes:
        grid: (rows, columns, 2) px; NaN where no corner was measured.
        contrast: (rows, columns) grey levels, half the step from dark to bright; positive where the square towards the
            next row and column is dark. Neighbours differ in sign.
        misfit: (rows, columns) root mean square of what the model leaves of the picture, as a part of the contrast.
    """

    grid: Array
    contrast: Array
    misfit: Array


def measure_saddles(image: AnyArray, grid: Array, reach: float = REACH) -> Saddles:
    """The corners of a board near where a detector saw them.

    A corner is left out (NaN) where the fit walks away from its start, where the contrast has the wrong sign for its
    place on the board or is far below the others', or where no neighbour tells the direction of its edges: never by how
    well it suits a camera.

    Args:
        image: (height, width), any depth.
        grid: (rows, columns, 2) px, right-handed (columns x rows > 0 in the image), good to a few pixels; NaN where
            nothing was seen.
        reach: radius of the disc around a corner as a part of the distance to the next edges.
    """
    fitted = fit_saddles(image, grid, np.ones(grid.shape[:2], dtype=bool), reach)
    rows, columns = np.indices(fitted.contrast.shape)
    signed = np.where((rows + columns) % 2 == 0, fitted.contrast, -fitted.contrast)
    usual = np.nanmedian(signed) if np.any(np.isfinite(signed)) else np.nan
    wrong = ~(signed * np.sign(usual) > _FAINT * np.abs(usual))
    contrast, misfit = (np.where(wrong, np.nan, values) for values in (fitted.contrast, fitted.misfit))
    contrast, misfit = (np.where(wrong, np.nan, values) for values in (fitted.contrast, fitted.misfit))
    return Saddles(np.where(wrong[..., None], np.nan, fitted.grid), contrast, misfit)


def fit_saddles(image: AnyArray, grid: Array, wanted: Mask, reach: float = REACH) -> Saddles:
    """The saddles near the wanted places (rows, columns) of a grid; the others say where edges run."""
    level, discs = image.astype(np.float32), (reach, wanted)
    fitted = _fit_grid(level, grid, grid, discs, curved=False)  # where the edges bend is known only after it
    shrink = _shrink(fitted, grid, reach)
    small, seen = _shrunk(level, shrink), (grid + 0.5) / shrink - 0.5
    start = (_started(fitted, grid, wanted) + 0.5) / shrink - 0.5
    if shrink > 1:
        start = _started(_fit_grid(small, start, seen, discs, curved=False), seen, wanted)
    fitted = _fit_grid(small, start, seen, discs, curved=True)
    contrast = fitted[..., _CONTRAST]
    misfit = fitted[..., _SIZE] / np.maximum(np.abs(contrast), 1e-9)
    return Saddles((fitted[..., :2] + 0.5) * shrink - 0.5, contrast, misfit)


def is_begun_dark(contrast: Array) -> bool:
    """Whether the square between a grid's first corner and the next row and column is dark, by all of its contrasts."""
    rows, columns = np.indices(contrast.shape)
    return bool(np.nansum(np.where((rows + columns) % 2 == 0, contrast, -contrast)) > 0.0)


def _started(fitted: Array, seen: Array, wanted: Mask) -> Array:
    """Where the next fit begins: what was not wanted is where it was seen."""
    return np.where(wanted[..., None], fitted[..., :2], seen)


def _shrink(fitted: Array, grid: Array, reach: float) -> int:
    """By how much the picture is shrunk for the last fit: as far as its blur allows, where a disc of the most pixels
    would see but a part of each square, or nothing but blur.
    """
    sharp, distance = fitted[..., _SHARP], _distances(grid)[2]
    if not np.any(np.isfinite(sharp + distance)):
        return 1
    blur_px, radius_px = _BLUR / np.nanmedian(sharp), reach * np.nanmedian(distance)
    return int(2 ** max(0.0, np.floor(np.log2(min(blur_px, 2.0 * radius_px / _RADIUS_PX[1])))))


def _shrunk(level: AnyArray, factor: int) -> AnyArray:
    height, width = (size // factor for size in level.shape)
    return cv2.resize(level[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)


def _fit_grid(level: AnyArray, start: Array, seen: Array, discs: tuple[float, Mask], curved: bool) -> Array:
    """Parameters of one fit from `start` and the root mean square of what it leaves, (rows, columns, 12); NaN where a
    corner got lost on its way from where it was `seen`. `discs`: their reach, and which corners are wanted.
    """
    reach, wanted = discs
    (along_row, row_bend), (along_column, column_bend), distance = _distances(start)
    height, width = level.shape
    x, y = np.moveaxis(start, -1, 0)
    known = wanted & np.isfinite(distance) & (x > -0.5) & (y > -0.5) & (x < width - 0.5) & (y < height - 0.5)
    fitted = np.full((*distance.shape, _SIZE + 1), np.nan)
    if not np.any(known):
        return fitted
    bends = np.stack([row_bend[known], column_bend[known]], axis=1) * curved
    smooth = cv2.GaussianBlur(level, (0, 0), _SMOOTHING_PX)
    patches = _Patches.cut(smooth, start[known], np.clip(reach * distance[known], *_RADIUS_PX), bends)
    params = _fit(patches, _first_guess(patches, start[known], along_row[known], along_column[known]))
    moved = np.linalg.norm(params[:, :2] - seen[known], axis=1)
    fitted[known] = np.where((moved < _LOST * distance[known])[:, None], params, np.nan)
    return fitted


def _distances(grid: Array) -> tuple[tuple[Array, Array], tuple[Array, Array], Array]:
    """Tangent and curvature of the edge along each row and along each column, and how far (px) the next edges are."""
    along_row, row_bend, row_step = _line_geometry(grid, axis=1)
    along_column, column_bend, column_step = _line_geometry(grid, axis=0)
    turn = _cross(along_row, along_column)  # sine of the angle between the edges
    distance = np.minimum(row_step, column_step) * np.abs(turn)
    return (along_row, row_bend), (along_column, column_bend), distance


def _line_geometry(grid: Array, axis: int) -> tuple[Array, Array, Array]:
    """Unit tangent (.., 2), curvature (1 / px) and distance to the next corner (px) of the lines along `axis`."""
    line = np.moveaxis(grid, axis, 0)
    gap = np.full((1, *line.shape[1:]), np.nan)
    ahead = np.concatenate([np.diff(line, axis=0), gap])
    behind = np.concatenate([gap, np.diff(line, axis=0)])
    alone_ahead, alone_behind = np.isnan(behind), np.isnan(ahead)
    chord = np.where(alone_ahead, ahead, np.where(alone_behind, behind, 0.5 * (ahead + behind)))
    length = np.linalg.norm(chord, axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):  # where two are foreseen at one place
        tangent = chord / length[..., None]
        bend = _cross(tangent, ahead - behind) / length**2
    # At the ends of a line the next corner's curvature serves; where nothing is known the line is straight.
    after, before = np.concatenate([bend[1:], gap[..., 0]]), np.concatenate([gap[..., 0], bend[:-1]])
    for other in (after, before, np.zeros_like(bend)):
        bend = np.where(np.isnan(bend), other, bend)
    step = np.fmin(np.linalg.norm(ahead, axis=-1), np.linalg.norm(behind, axis=-1))
    return np.moveaxis(tangent, 0, axis), np.moveaxis(bend, 0, axis), np.moveaxis(step, 0, axis)


def _cross(a: Array, b: Array) -> Array:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


@dataclass(frozen=True, eq=False)
class _Patches:
    """The pixels around n corners: columns, rows, grey levels and weights (n, pixels), and the edges' bends (n, 2)."""

    x: Array
    y: Array
    values: Array
    weights: Array
    bends: Array

    @classmethod
    def cut(cls, image: AnyArray, corners: Array, radius: Array, bends: Array) -> _Patches:
        height, width = image.shape
        half = int(np.ceil(radius.max()))
        dy, dx = (d.ravel() for d in np.mgrid[-half : half + 1, -half : half + 1])
        middle = np.rint(corners).astype(int)
        x, y = middle[:, :1] + dx, middle[:, 1:] + dy
        inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        near = (x - corners[:, :1]) ** 2 + (y - corners[:, 1:]) ** 2 <= radius[:, None] ** 2
        values = image[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)].astype(float)
        return cls(x.astype(float), y.astype(float), values, (inside & near).astype(float), bends)

    def take(self, which: Mask) -> _Patches:
        """The pixels around some of the corners."""
        return _Patches(*(values[which] for values in (self.x, self.y, self.values, self.weights, self.bends)))


def _first_guess(patches: _Patches, corners: Array, along_row: Array, along_column: Array) -> Array:
    params = np.zeros((len(corners), _SIZE))
    params[:, :2] = corners
    for i, tangent in enumerate((along_row, along_column)):
        params[:, _ANGLE + i] = np.arctan2(tangent[:, 1], tangent[:, 0])
    params[:, _SHARP] = 0.7
    weights, values = patches.weights, patches.values
    params[:, _MEAN] = np.sum(weights * values, axis=1) / np.sum(weights, axis=1)
    shape = _model(params, patches)[1][..., _CONTRAST]
    above = weights * (values - params[:, _MEAN, None]) * shape
    params[:, _CONTRAST] = np.sum(above, axis=1) / np.sum(weights * shape**2, axis=1)
    return params


def _model(params: Array, patches: _Patches) -> tuple[Array, Array]:
    """Grey levels (n, pixels) and their derivatives (n, pixels, 11) by the parameters (n, 11)."""
    dx, dy = patches.x - params[:, _X, None], patches.y - params[:, _Y, None]
    sharp = params[:, _SHARP, None]
    contrast = _plane(params, _CONTRAST, dx, dy)
    edges = [_edge(params[:, _ANGLE + i, None], sharp, patches.bends[:, i, None], dx, dy) for i in (0, 1)]
    steps = [np.tanh(sharp * distance) for distance, _ in edges]
    shape = steps[0] * steps[1]
    jacobian = np.zeros((*dx.shape, _SIZE))
    for i, (distance, by_place) in enumerate(edges):
        slope = contrast * steps[1 - i] * (1.0 - steps[i] ** 2)
        jacobian[..., _X] += slope * by_place[0]
        jacobian[..., _Y] += slope * by_place[1]
        jacobian[..., _ANGLE + i] = slope * by_place[2]
        jacobian[..., _SHARP] += slope * distance
    for first, factor in ((_MEAN, np.ones_like(dx)), (_CONTRAST, shape)):
        jacobian[..., first], jacobian[..., first + 1], jacobian[..., first + 2] = factor, factor * dx, factor * dy
        jacobian[..., _X] -= params[:, first + 1, None] * factor
        jacobian[..., _Y] -= params[:, first + 2, None] * factor
    return _plane(params, _MEAN, dx, dy) + contrast * shape, jacobian


def _plane(params: Array, first: int, dx: Array, dy: Array) -> Array:
    level, by_x, by_y = (params[:, first + i, None] for i in range(3))
    return np.asarray(level + by_x * dx + by_y * dy)


def _edge(angle: Array, sharp: Array, bend: Array, dx: Array, dy: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    """Signed distance (px) of each pixel to a bent edge, and sharpness times its derivatives by x, y and angle."""
    cosine, sine = np.cos(angle), np.sin(angle)
    along, across = cosine * dx + sine * dy, cosine * dy - sine * dx
    turn = bend * along
    by_place = (sharp * (sine + turn * cosine), sharp * (turn * sine - cosine), -sharp * (along + turn * across))
    return across - 0.5 * turn * along, by_place


def _fit(patches: _Patches, params: Array) -> Array:
    """Levenberg-Marquardt on all corners side by side, each with its own damping, until it rests: parameters, and the
    root mean square of what is left.
    """
    settled = np.column_stack([params, np.zeros(len(params))])
    moving, damping = np.arange(len(params)), np.full(len(params), 1e-3)
    model, jacobian = _model(params, patches)
    cost = np.sum(patches.weights * (patches.values - model) ** 2, axis=1)
    for _ in range(_STEPS):
        step = _steps(patches, model, jacobian, damping)
        trial = params + step
        trial[:, _SHARP] = np.clip(trial[:, _SHARP], *_SHARPNESS)
        trial_model, trial_jacobian = _model(trial, patches)
        trial_cost = np.sum(patches.weights * (patches.values - trial_model) ** 2, axis=1)
        better = trial_cost < cost
        params = np.where(better[:, None], trial, params)
        model, cost = np.where(better[:, None], trial_model, model), np.where(better, trial_cost, cost)
        jacobian = np.where(better[:, None, None], trial_jacobian, jacobian)
        damping = np.where(better, np.maximum(0.1 * damping, 1e-9), 10.0 * damping)
        settled[moving] = np.column_stack([params, np.sqrt(cost / np.sum(patches.weights, axis=1))])
        far = np.any(np.abs(step[:, :2]) >= _SETTLED_PX, axis=1)
        if not np.any(far):
            break
        moving, patches = moving[far], patches.take(far)
        params, model, jacobian, cost, damping = (a[far] for a in (params, model, jacobian, cost, damping))
    return settled


def _steps(patches: _Patches, model: Array, jacobian: Array, damping: Array) -> Array:
    """(n, 11) the damped Gauss-Newton step of each corner."""
    weighted = (jacobian * patches.weights[..., None]).transpose(0, 2, 1)
    normal = weighted @ jacobian
    # The last term keeps a patch without any contrast solvable; it then stays where it is.
    scale = damping[:, None] * np.einsum("nii->ni", normal) + 1e-12
    off = weighted @ (patches.values - model)[..., None]
    return np.asarray(np.linalg.solve(normal + scale[..., None] * np.eye(_SIZE), off)[..., 0])
