"""Where an edge, or a line of known width, crosses the pixels around a place: a model fitted to raw grey levels.

The model of a pixel at signed distance t from the place, along the normal, is

    I(t) = b + g t + sum_j h_j Phi((t - c - e_j) / s),

a step of height h_j at each of the edges e_j that move together with c (one for an edge, two, half a width to either
side, for a painted line), blurred by a Gaussian of standard deviation s that stands for lens and pixel together, on a
background of any slope that may differ from one side to the other. With g and the heights free, neither blur nor light
nor slope pulls c aside: all are even about it. Nothing is interpolated, so the noise of the pixels is as the sensor
made it, and the curvature of the least squares tells the standard deviation of c.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Array32, Mask

LEAST_BLUR_PX, MOST_BLUR_PX = 0.3, 4.0
_SHAPE_RANGE = (np.log([LEAST_BLUR_PX, 0.4]), np.log([MOST_BLUR_PX, 2.5]))
_SHAPE_SIGMA = np.array([1.0, 0.3])  # of the logarithms of blur and stretch, beforehand
_MOST_STEP_PX = 0.7
# Grey levels: how much brighter one side of a line is than the other, beforehand. Of a line much narrower than its blur
# the pixels alone tell such a step and the line's place hardly apart.
_LEVEL_SIGMA = 5.0
_STEPS = 6
_TINY = 1e-9


@dataclass(frozen=True, eq=False)
class Windows:
    """Pixels around N places.

    Attributes:
        values: (N, K) grey levels. distance: (N, K) signed distance along the normal from the curve through the
            place, px; curves bend. inside: (N,) whether all of the window lies in the image; other rows hold no pixels
            of any meaning.
    """

    values: Array
    distance: Array
    inside: Mask


@dataclass(frozen=True, eq=False)
class Profiles:
    """What fits the windows of N places best.

    Attributes:
        offset_px: (N,) c, how far along the normal the middle of the edges lies from the place; NaN where no fit came
            to rest.
        sigma_px: (N,) standard deviation of it, from the scatter of the pixels about the model.
        heights: (N, E) grey levels of each step. noise: (N,) standard deviation of the pixels about the model.
    """

    offset_px: Array
    sigma_px: Array
    heights: Array
    noise: Array


def cut_windows(
    image: Array32, places: Array, normals: Array, curvature: Array, half_length_px: float, half_width_px: int
) -> Windows:
    """The pixels around places on curves.

    A window is made of whole rows or columns, whichever cross the curve more squarely, and follows its slope.

    Args:
        places: (N, 2) px. normals: (N, 2) of length 1. curvature: (N,) 1/px, positive where the curve bends towards
            its normal.
        half_length_px: across the curve. half_width_px: along it.
    """
    height, width = image.shape
    level = np.abs(normals[:, 1]) >= np.abs(normals[:, 0])  # the curve is rather level: columns cross it
    along = np.where(level, places[:, 0], places[:, 1])
    across = np.where(level, places[:, 1], places[:, 0])
    n_along = np.where(level, normals[:, 0], normals[:, 1])
    n_across = np.where(level, normals[:, 1], normals[:, 0])
    u = np.round(along)[:, None] + np.arange(-half_width_px, half_width_px + 1)  # (N, U)
    middle = np.round(across[:, None] - (u - along[:, None]) * (n_along / n_across)[:, None])
    reach = int(np.ceil(1.2 * half_length_px))  # a slanted line is longer along the column
    v = middle[:, :, None] + np.arange(-reach, reach + 1)  # (N, U, V)
    u = np.broadcast_to(u[:, :, None], v.shape)
    du, dv = u - along[:, None, None], v - across[:, None, None]
    a, b = n_along[:, None, None], n_across[:, None, None]
    sideways = du * b - dv * a
    distance = du * a + dv * b - 0.5 * curvature[:, None, None] * sideways**2
    x, y = np.where(level[:, None, None], (u, v), (v, u))
    inside = ((x >= 0) & (x < width) & (y >= 0) & (y < height)).reshape(len(places), -1).all(axis=1)
    x, y = np.clip(x, 0, width - 1).astype(np.intp), np.clip(y, 0, height - 1).astype(np.intp)
    shape = len(places), -1
    return Windows(image[y, x].reshape(shape).astype(float), distance.reshape(shape), inside)


def fit_profiles(windows: Windows, edges: Array, blur_px: Array | float, reach_px: float) -> Profiles:
    """Fit the model to every window.

    Args:
        edges: (N, E) px: where the steps are, relative to c. blur_px: (N,) or one, the Gaussian's standard deviation.
        reach_px: a c farther from the place than this is none.
    """
    offset = np.zeros(len(windows.values))
    blur = np.broadcast_to(np.asarray(blur_px, dtype=float), offset.shape)
    normal, right = _linear(windows, edges, blur, offset)
    heights = _solve(normal, right)[:, 2:]
    squares = np.sum(windows.values**2, axis=1)
    variance = (squares - np.sum(_solve(normal, right) * right, axis=1)) / windows.values.shape[1]
    level = np.zeros(normal.shape[1] + 1)
    level[2:-1] = 1.0 if edges.shape[1] > 1 else 0.0
    for _ in range(_STEPS):
        known = np.maximum(variance, 0.0)[:, None, None] * np.outer(level, level) / _LEVEL_SIGMA**2
        columns = _columns(windows, edges, blur, offset, heights)
        normal, right = _normal(columns, windows.values)
        solution = _solve(normal + known, right)
        variance = _misfit(squares, normal, right, solution) / windows.values.shape[1]
        step = np.clip(solution[:, -1], -_MOST_STEP_PX, _MOST_STEP_PX)
        offset, heights = np.clip(offset + step, -reach_px - 1.0, reach_px + 1.0), solution[:, 2:-1]
        if np.all(np.abs(step) < 1e-3):
            break
    freedom = windows.values.shape[1] - columns.shape[1]
    misfit = np.maximum(_misfit(squares, normal, right, solution), 0.0)
    noise = np.sqrt(misfit / freedom + 1.0 / 12.0)  # what rounding to whole levels hides
    sigma = noise * np.sqrt(np.maximum(_last_of_inverse(normal + known), 0.0))
    good = windows.inside & (np.abs(step) < 0.05) & (np.abs(offset) <= reach_px) & np.isfinite(sigma) & (sigma > 0.0)
    return Profiles(np.where(good, offset, np.nan), np.where(good, sigma, np.inf), heights, noise)


def _misfit(squares: Array, normal: Array, right: Array, solution: Array) -> Array:
    """(N,) squared residuals of any solution of the normal equations, or of none of them."""
    return np.asarray(
        squares - np.sum(solution * (2.0 * right - np.matmul(normal, solution[:, :, None])[:, :, 0]), axis=1)
    )


def fit_shape(
    windows: Windows, edges: Array, blur_px: float, stretch: float = 1.0, rounds: int = 8
) -> tuple[float, float]:
    """The blur that all windows share, and the factor on the edges' distances that suits them best.

    Both are pulled towards where they start, by as much as one window in good light would outweigh: of a line that is
    narrower than its blur no picture tells the width.

    Args:
        blur_px, stretch: where to start.
    """
    start = np.log([blur_px, stretch])
    shape, offset = start.copy(), np.zeros(len(windows.values))
    heights = None
    for _ in range(rounds):
        blur, apart = np.full(len(offset), np.exp(shape[0])), edges * np.exp(shape[1])
        if heights is None:
            heights = _solve(*_linear(windows, apart, blur, offset))[:, 2:]
        columns = _columns(windows, apart, blur, offset, heights, shape=True)
        normal, right = _normal(columns, windows.values)
        own, squares = normal[:, :-2, :-2], np.sum(windows.values**2, axis=1)
        solution = _solve(own, right[:, :-2])
        noise = np.maximum(squares - np.sum(solution * right[:, :-2], axis=1), 1.0) / windows.values.shape[1]
        cross = normal[:, :-2, -2:]
        away = np.linalg.solve(own + _ridge(own), cross)
        schur = np.sum((normal[:, -2:, -2:] - np.matmul(np.swapaxes(cross, 1, 2), away)) / noise[:, None, None], axis=0)
        left = right[:, -2:] - np.einsum("npq,np->nq", cross, solution)
        pull = np.diag(1.0 / _SHAPE_SIGMA**2)
        change = np.linalg.solve(schur + pull, np.sum(left / noise[:, None], axis=0) + pull @ (start - shape))
        shape = np.clip(shape + np.clip(change, -0.3, 0.3), *_SHAPE_RANGE)
        offset = offset + np.clip(solution[:, -1], -_MOST_STEP_PX, _MOST_STEP_PX)
        heights = solution[:, 2:-1]
        if np.all(np.abs(change) < 1e-3):
            break
    return float(np.exp(shape[0])), float(np.exp(shape[1]))


def normal_step(x: Array) -> tuple[Array, Array]:
    """The normal distribution's Phi(x), to 1e-7 (Abramowitz and Stegun 7.1.26), and its density."""
    t = 1.0 / (1.0 + 0.3275911 * np.sqrt(0.5) * np.abs(x))
    bell = np.exp(-0.5 * x * x)
    series = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))))
    tail = 0.5 * series * bell
    return np.where(x > 0.0, 1.0 - tail, tail), bell * (1.0 / np.sqrt(2.0 * np.pi))


# ---- least squares over many small problems -------------------------------------------------------------------------


def _linear(windows: Windows, edges: Array, blur: Array, offset: Array) -> tuple[Array, Array]:
    """Normal equations of background, slope and heights, c being held."""
    columns = _columns(windows, edges, blur, offset, None)
    return _normal(columns, windows.values)


def _columns(
    windows: Windows, edges: Array, blur: Array, offset: Array, heights: Array | None, *, shape: bool = False
) -> Array:
    """(N, P, K) derivatives of the model: by b, g, each height; with heights by c too; with `shape` by ln s and the
    logarithm of the edges' stretch.
    """
    count, pixels = windows.distance.shape
    steps = edges.shape[1]
    extra = 0 if heights is None else 3 if shape else 1
    columns = np.zeros((count, 2 + steps + extra, pixels))
    columns[:, 0], columns[:, 1] = 1.0, windows.distance - offset[:, None]
    for j in range(steps):
        x = (windows.distance - (offset + edges[:, j])[:, None]) / blur[:, None]
        columns[:, 2 + j], bell = normal_step(x)
        if heights is None:
            continue
        by_place = -(heights[:, j] / blur)[:, None] * bell
        columns[:, 2 + steps] += by_place
        if shape:
            columns[:, 3 + steps] += by_place * x * blur[:, None]
            columns[:, 4 + steps] += by_place * edges[:, j, None]
    return columns


def _normal(columns: Array, values: Array) -> tuple[Array, Array]:
    return np.matmul(columns, np.swapaxes(columns, 1, 2)), np.matmul(columns, values[:, :, None])[:, :, 0]


def _ridge(normal: Array) -> Array:
    """Next to nothing on each diagonal, so that a window without any contrast has a solution."""
    size = normal.shape[1]
    scale = np.maximum(np.einsum("npp->np", normal), _TINY)
    return np.asarray(np.eye(size) * (1e-9 * scale + _TINY)[:, :, None])


def _solve(normal: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(normal + _ridge(normal), right[:, :, None])[:, :, 0])


def _last_of_inverse(normal: Array) -> Array:
    unit = np.zeros(normal.shape[1])
    unit[-1] = 1.0
    return _solve(normal, np.broadcast_to(unit, normal.shape[:2]))[:, -1]
