"""Position of an edge, or of a line of known width, across the pixels around a place: a model fitted to raw grey
levels.

The model of a pixel at signed distance t from the place, along the normal, is

    I(t) = b + g t + sum_j h_j Phi((t - c - e_j) / s),

a step of height h_j at each of the edges e_j that move together with c (one for an edge; two, half a width to either
side, for a painted line), blurred by a Gaussian of standard deviation s that stands for lens and pixel together, on a
background of any slope, which may differ between the two sides. With g and the heights free, blur, light and slope do
not bias c: all are symmetric about it. Nothing is interpolated, so the noise of the pixels is as the sensor made it,
and the curvature of the least-squares cost gives the standard deviation of c.

A camera that moves while the shutter is open smears the profile over m along the normal: Phi becomes its mean from t -
m / 2 to t + m / 2. That is symmetric about c, too, and its two ends determine c much better than a Gaussian of the same
width would. A lens with coma also smears it, but more at one end: the weights 1 + q (1 - 2 u), u from 0 to 1 along the
smear, are asymmetric by q from -1 to 1. Then c is the mean of the smear, because only the mean is seen at one place by
lines of every direction.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base import Array, Array32, Frozen, Mask, Rows
from ceres_cal.kernels import profile_equations

LEAST_BLUR_PX, MOST_BLUR_PX = 0.3, 4.0
LEAST_SMEAR_PX, MOST_SMEAR_PX = 0.3, 20.0
_SHAPE_RANGE = (np.log([LEAST_BLUR_PX, 0.4, LEAST_SMEAR_PX]), np.log([MOST_BLUR_PX, 2.5, MOST_SMEAR_PX]))
_SHAPE_SIGMA = np.array([1.0, 0.3, 1.0])  # prior standard deviations of the logarithms of blur, stretch and smear
_HELD = 0.1  # factor on the prior standard deviation of the stretch where coma is fitted
_MOST_STEP_PX = 0.7
# Prior standard deviation of how much brighter one side of a line is than the other, grey levels. For a line much
# narrower than its blur, the pixels alone hardly distinguish such a step from a shift of the line.
_LEVEL_SIGMA = 5.0
_TINY = 1e-9


class Windows(Rows):
    """Pixels around N places.

    Attributes:
        values: (N, K) grey levels.
        distance: (N, K) signed distance, px, along the normal from the (bent) curve through the place.
        inside: (N,) whether all of the window lies in the image; the pixels of other rows have no meaning.
    """

    values: Array
    distance: Array
    inside: Mask


class Profiles(Rows):
    """Best fits to the windows of N places.

    Attributes:
        offset_px: (N,) c, the offset along the normal of the middle of the edges from the place; NaN where no fit
            converged.
        sigma_px: (N,) standard deviation of c, from the scatter of the pixels about the model.
        heights: (N, E) height of each step, grey levels.
        noise: (N,) standard deviation of the pixels about the model, grey levels.
    """

    offset_px: Array
    sigma_px: Array
    heights: Array
    noise: Array


class EdgeShape(Frozen, eq=True):
    """Shape of edges in a picture.

    Attributes:
        blur_px: standard deviation of the Gaussian. stretch: factor on the edges' distances.
        smear_px: length of the smear by a camera that moved, or by coma at the image's corner; 0 without smear.
    """

    blur_px: float
    stretch: float = 1.0
    smear_px: float = 0.0

    @property
    def logarithms(self) -> Array:
        """(2,) logarithms of blur and stretch, or (3,) with the smear's."""
        return np.log([self.blur_px, self.stretch, self.smear_px][: 3 if self.smear_px > 0.0 else 2])


def cut_windows(
    image: Array32, places: Array, normals: Array, curvature: Array, half_length_px: float, half_width_px: int
) -> Windows:
    """Cut out the pixels around places on curves.

    A window is made of whole rows or columns, whichever cross the curve more squarely, and follows its slope.

    Args:
        places: (N, 2) px.
        normals: (N, 2) of length 1.
        curvature: (N,) 1/px, positive where the curve bends towards its normal.
        half_length_px: half length of a window across the curve.
        half_width_px: half width along it.
    """
    height, width = image.shape
    level = np.abs(normals[:, 1]) >= np.abs(normals[:, 0])  # the curve is rather horizontal: columns cross it
    along, across = np.where(level, places.T, places.T[::-1])
    n_along, n_across = np.where(level, normals.T, normals.T[::-1])
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


def fit_profiles(
    windows: Windows,
    edges: Array,
    blur_px: Array | float,
    reach_px: float,
    smear_px: Array | float = 0.0,
    lean: Array | float = 0.0,
) -> Profiles:
    """Fit the model to every window.

    Args:
        edges: (N, E) px, the positions of the steps relative to c.
        blur_px: (N,) or one, the Gaussian's standard deviation.
        reach_px: a fit with c farther from the place than this is rejected.
        smear_px: (N,) or one, length of the smear.
        lean: (N,) or one, q, the smear's asymmetry.
    """
    # Newton steps; after one as small as this the next are below a hundredth of a window's sigma
    most_steps, at_rest_px = 6, 1e-4
    offset = np.zeros(len(windows.values))
    steps = _Steps(edges, *(np.broadcast_to(np.asarray(one, float), offset.shape) for one in (blur_px, smear_px, lean)))
    normal, right = steps.equations(windows, offset, None)
    solution = _solve(normal, right)
    heights, squares = solution[:, 2:], np.sum(windows.values**2, axis=1)
    variance = (squares - np.sum(solution * right, axis=1)) / windows.values.shape[1]
    level = np.zeros(normal.shape[1] + 1)
    level[2:-1] = 1.0 if edges.shape[1] > 1 else 0.0
    known, step, moving = np.outer(level, level) / _LEVEL_SIGMA**2, np.zeros(len(offset)), np.arange(len(offset))
    held = np.empty((len(offset), *known.shape))
    for _ in range(most_steps):
        normal, right = steps.take(moving).equations(windows.take(moving), offset[moving], heights[moving])
        held[moving] = normal + np.maximum(variance[moving], 0.0)[:, None, None] * known
        solution = _solve(held[moving], right)
        variance[moving] = _misfit(squares[moving], normal, right, solution) / windows.values.shape[1]
        step[moving] = np.clip(solution[:, -1], -_MOST_STEP_PX, _MOST_STEP_PX)
        offset[moving] = np.clip(offset[moving] + step[moving], -reach_px - 1.0, reach_px + 1.0)
        heights[moving] = solution[:, 2:-1]
        moving = moving[np.abs(step[moving]) > at_rest_px]
        if not len(moving):
            break
    misfit = np.maximum(variance, 0.0) * (windows.values.shape[1] / (windows.values.shape[1] - len(level)))
    noise = np.sqrt(misfit + 1.0 / 12.0)  # variance of rounding to whole levels
    sigma = noise * np.sqrt(np.maximum(np.linalg.inv(held + _ridge(held))[:, -1, -1], 0.0))
    good = windows.inside & (np.abs(step) < 0.05) & (np.abs(offset) <= reach_px) & np.isfinite(sigma) & (sigma > 0.0)
    return Profiles(np.where(good, offset, np.nan), np.where(good, sigma, np.inf), heights, noise)


def fit_edges(
    image: Array32, places: Array, normals: Array, curvature: Array, half_length_px: float, half_width_px: int
) -> tuple[Mask, Profiles, float]:
    """Fit one edge across each place on curves, see `cut_windows`. Return (N,) whether its window lies in the image,
    the fits, and the blur that all edges share, px.
    """
    windows = cut_windows(image, places, normals, curvature, half_length_px, half_width_px)
    inside, edge, shape = windows.inside, np.zeros((len(places), 1)), EdgeShape(1.0)
    if inside.any():
        shape = fit_shape(windows.take(inside), edge[inside], shape)
    return inside, fit_profiles(windows, edge, shape.blur_px, 0.5 * half_length_px), shape.blur_px


def _misfit(squares: Array, normal: Array, right: Array, solution: Array) -> Array:
    """(N,) sum of squared residuals for any vector, even one that does not solve the normal equations."""
    explained = np.matmul(normal, solution[:, :, None])[:, :, 0]
    return np.asarray(squares - np.sum(solution * (2.0 * right - explained), axis=1))


def fit_shape(
    windows: Windows, edges: Array, start: EdgeShape, rounds: int = 8, along: Array | None = None
) -> EdgeShape:
    """Estimate what all windows share: the blur, the factor on the edges' distances, and the smear.

    Each has a prior at its starting value, with the weight of less than one window in good light: no picture determines
    the width of a line that is narrower than its blur.

    Args:
        start: starting values; without a smear none is fitted.
        along: (N,) -1 to 1, for coma: length of each window's smear relative to the shape's, and the sign of its
            asymmetry. The edges' distances are then held, since an asymmetric smear can be taken for width.
    """
    begin, sigma = start.logarithms, _SHAPE_SIGMA * (1.0, 1.0 if along is None else _HELD, 1.0)
    ones = np.ones(len(windows.values))
    length, lean = (ones, 0.0 * ones) if along is None else (np.abs(along), np.sign(along))
    shape, offset, free = begin.copy(), np.zeros(len(windows.values)), len(begin)
    heights, squares = None, np.sum(windows.values**2, axis=1)
    for _ in range(rounds):
        now = np.exp(shape)
        steps = _Steps(edges * now[1], now[0] * ones, (now[2] if free > 2 else 0.0) * length, lean)
        if heights is None:
            heights = _solve(*steps.equations(windows, offset, None))[:, 2:]
        normal, right = steps.equations(windows, offset, heights, free=free)
        own, cross = normal[:, :-free, :-free], normal[:, :-free, -free:]
        both = np.linalg.solve(own + _ridge(own), np.concatenate([right[:, :-free, None], cross], axis=2))
        solution, away = both[:, :, 0], both[:, :, 1:]
        noise = np.maximum(squares - np.sum(solution * right[:, :-free], axis=1), 1.0) / windows.values.shape[1]
        schur = normal[:, -free:, -free:] - np.matmul(np.swapaxes(cross, 1, 2), away)
        left = right[:, -free:] - np.einsum("npq,np->nq", cross, solution)
        pull = np.diag(1.0 / sigma[:free] ** 2)
        change = np.linalg.solve(
            np.sum(schur / noise[:, None, None], axis=0) + pull,
            np.sum(left / noise[:, None], axis=0) + pull @ (begin - shape),
        )
        change = np.clip(change, -0.3, 0.3)
        before, solution = shape, solution - away @ change
        shape = np.clip(shape + change, *(limit[:free] for limit in _SHAPE_RANGE))
        offset = offset + np.clip(solution[:, -1], -_MOST_STEP_PX, _MOST_STEP_PX)
        heights = solution[:, 2:-1]
        if np.all(np.abs(shape - before) < 1e-3):
            break
    return EdgeShape(*np.exp(shape).tolist())


# ---- least squares over many small problems -------------------------------------------------------------------------


class _Steps(Rows):
    """Steps at `edges` (N, E) beside each c, with `blur` (N,) px and a `smear` (N,) px of asymmetry `lean` (N,)."""

    edges: Array
    blur: Array
    smear: Array
    lean: Array

    def equations(
        self, windows: Windows, offset: Array, heights: Array | None, *, free: int = 0
    ) -> tuple[Array, Array]:
        """Return the normal equations (N, P, P) and (N, P) of the model. Unknowns are b, g and each height; if heights
        are given also c, and the first `free` of the logarithms of blur, the edges' stretch and smear.
        """
        count, edges = self.edges.shape
        smear = np.maximum(self.smear, LEAST_SMEAR_PX) if np.any(self.smear) else self.smear
        shapes = np.column_stack([self.blur, smear, self.lean, offset])
        size = 2 + edges + (0 if heights is None else 1 + free)
        normals, rights = np.empty((count, size, size)), np.empty((count, size))
        steps = np.empty((0, edges)) if heights is None else heights
        profile_equations(windows.distance, windows.values, self.edges, shapes, steps, free, normals, rights)
        return normals, rights


def _ridge(normal: Array) -> Array:
    """Negligible diagonal terms with which a window without any contrast has a solution."""
    size = normal.shape[1]
    scale = np.maximum(np.einsum("npp->np", normal), _TINY)
    return np.asarray(np.eye(size) * (1e-9 * scale + _TINY)[:, :, None])


def _solve(normal: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(normal + _ridge(normal), right[:, :, None])[:, :, 0])
