"""Lines beside which something lies on one side only: the seam of a carpet, a shadow's border, worn paint.

Each window sees little of it, but all windows along the line see the same, so that they displace the line together. The
profile model of `profiles` allows for some asymmetry: other light, another slope and another step on each side. Where
the mean of all windows shows more than that, narrow stripes at every distance are tried as its cause. They explain it
about equally well and displace the line differently; how far they do is the standard deviation of the line as a whole.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Array, distinct
from ceres_cal.detect.courses import Course
from ceres_cal.detect.profiles import Windows
from ceres_cal.kernels import normal_cdf

# Distances from a line's middle at which its mean profile is taken, and the step between them.
_AWAY_PX = np.linspace(0.25, 5.75, 12)
_STEP_PX = float(_AWAY_PX[1] - _AWAY_PX[0])


def drawn_together(
    windows: Windows, course: Course, middle_px: Array, contrast: Array, half_px: Array, blur_px: Array
) -> Array:
    """Return (N,) px standard deviation of the displacement by what lies on one side of a line, 0 where nothing does.

    It is enlarged, so that the middle of a line gets the right one although its places are treated as independent.

    Args:
        middle_px: (N,) where in its window the line's middle was measured, NaN where it was not.
        contrast: (N,) how much brighter than its surroundings the paint is, grey levels.
        half_px: (N,) half of the paint's width.
        blur_px: (N,) standard deviation of the blur.
    """
    fewest = 8  # windows of a line, whose scatter tells how well their mean is known
    found, sigma = np.flatnonzero(np.isfinite(middle_px)), np.zeros(len(course))
    left = _left(windows.take(found), middle_px[found], half_px[found], blur_px[found])
    for number in distinct(course.curve[found]):
        own = course.curve[found] == number
        rows = found[own]
        if len(rows) >= fewest:
            bright, half, blur = (float(np.mean(one[rows])) for one in (contrast, half_px, blur_px))
            to_px = blur * np.sqrt(2.0 * np.pi) / bright
            sigma[rows] = to_px * _shift(left[own], bright, half, blur) * np.sqrt(len(rows))
    return sigma


def _left(windows: Windows, middle_px: Array, half_px: Array, blur_px: Array) -> Array:
    """(N, S, 2) what the profile model leaves of each window's light, in steps away from the middle on either side."""
    away = windows.distance - middle_px[:, None]
    edges = (normal_cdf((away + sign * half_px[:, None]) / blur_px[:, None]) for sign in (1.0, -1.0))
    columns = np.stack([np.ones_like(away), away, *edges], axis=2)
    turned = np.swapaxes(columns, 1, 2)
    normal = turned @ columns + 1e-6 * np.eye(4)  # negligible beside the number of pixels
    left = windows.values - (columns @ np.linalg.solve(normal, turned @ windows.values[..., None]))[..., 0]
    step = np.floor(np.abs(away) / _STEP_PX).astype(np.intp)
    near = step < len(_AWAY_PX)
    index = (2 * (np.arange(len(away))[:, None] * len(_AWAY_PX) + step) + (away > 0.0))[near]
    count, total = (np.bincount(index, one, 2 * len(_AWAY_PX) * len(away)) for one in (None, left[near]))
    with np.errstate(invalid="ignore"):
        return np.asarray((total / count).reshape(-1, len(_AWAY_PX), 2))


def _shift(left: Array, contrast: float, half_px: float, blur_px: float) -> float:
    """Return the standard deviation of the shift, as a multiple of the last column of `_allowed`, that stripes beside a
    line make the profile model find, from what it leaves of the line's windows (M, S, 2).
    """
    # `chance`: the 99.9 % quantile of chi-square per degree of freedom where nothing lies beside a line; 4 of 260 lines
    # in 20 pictures without seams have more. `one_sided`: what lies on one side leaves as much that is odd as that is
    # even. With less than this share the model lacks a shape that both sides have: 0.33 for overexposed paint, most
    # often 0.5 to 1.7 for seams. `usual`: standard deviation of a stripe's brightness, of the paint's.
    fewest, chance, one_sided, usual, tiny = 5, 3.1, 0.45, 0.35, 1e-12
    count = np.count_nonzero(np.isfinite(left), axis=0)
    reach = np.all(count >= fewest, axis=1)
    away = _AWAY_PX[reach]
    allowed = _allowed(away, half_px, blur_px)
    free = len(away) - allowed.shape[1] - 1
    if free < 1:
        return 0.0
    left, count = left[:, reach], count[reach]
    sides = np.nansum(left, axis=0) / count
    scatter = 0.25 * np.sum(np.nansum((left - sides) ** 2, axis=0) / count**2, axis=1)
    mean, even = 0.5 * (sides[:, 1] - sides[:, 0]), 0.5 * (sides[:, 1] + sides[:, 0])
    root = 1.0 / np.sqrt(scatter + tiny)
    values, columns = mean * root, allowed * root[:, None]
    places = np.arange(_STEP_PX, away[-1] + 1.0, 0.5 * _STEP_PX)
    widths = (blur_px, np.hypot(blur_px, 1.0))  # of a stripe much narrower than a pixel, and of one of 3 px
    stripes = np.column_stack([_either_side(away[:, None], places, width) for width in widths]) * root[:, None]
    both = np.column_stack([values, stripes])
    taken_up = np.linalg.lstsq(columns, both, rcond=None)[0]
    beyond = both - columns @ taken_up
    chi_square = float(beyond[:, 0] @ beyond[:, 0])
    if chi_square < chance * (free + 1) or mean @ mean < one_sided**2 * (even @ even):
        return 0.0
    squares = np.sum(beyond[:, 1:] ** 2, axis=0) + (usual * contrast) ** -2
    brightness = beyond[:, 1:].T @ beyond[:, 0] / squares
    misfit = chi_square - brightness**2 * squares
    weight = np.exp(-0.5 * (misfit - np.min(misfit)) / max(float(np.min(misfit)) / free, 1.0))
    return float(np.sqrt(weight @ (brightness * taken_up[-1, 1:]) ** 2 / np.sum(weight)))


def _allowed(away: Array, half_px: float, blur_px: float) -> Array:
    """(S, 3) what the profile model takes up of a difference: a slope, unequal steps, and a shift of the middle."""
    steps = normal_cdf((away - half_px) / blur_px) + normal_cdf((away + half_px) / blur_px) - 1.0
    return np.column_stack([away, steps, _either_side(away, half_px, blur_px)])


def _either_side(away: Array, place: Array | float, blur_px: float) -> Array:
    """Half of the difference in light between both sides, by a narrow stripe of brightness 2 at that place."""
    return np.asarray(np.exp(-0.5 * ((away - place) / blur_px) ** 2) - np.exp(-0.5 * ((away + place) / blur_px) ** 2))
