"""Precision of measured board corners, estimated from the pictures themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, median

USUAL_PX = 0.1
_MOST_DEGREES = 6
_SHARE = 2.0 / 3.0  # largest number of terms of the polynomial, as a share of the number of corners
_FEWEST_SPARE = 8  # least number of degrees of freedom for which a board gives an estimate
_LEAST_PX = 1e-3


def scatter_px(grids: Iterable[Array], places: Array) -> float:
    """Standard deviation (px) of each coordinate of boards' corners about a smooth picture of their board.

    A lens and a bent board displace neighbouring corners alike. A homography and a polynomial absorb that, of the
    highest degree that two thirds of the corners can determine. The residual is the precision of the corners, together
    with an unevenly printed board; a wrong lens model is not part of it.

    Args:
        grids: each (rows, columns, 2) px, NaN where a corner was not seen.
        places: (rows, columns, 2) where the corners are on the board, in any unit.

    Returns:
        The median over the boards; USUAL_PX where none has enough corners.
    """
    scatters = [one for grid in grids if (one := _of_board(grid, places)) is not None]
    return max(median(np.array(scatters)), _LEAST_PX) if scatters else USUAL_PX


def _of_board(grid: Array, board: Array) -> float | None:
    seen = ~np.isnan(grid[..., 0])
    fitted = smooth_picture(board[seen], grid[seen])
    if fitted is None:
        return None
    picture, degree, spare = fitted
    if degree < 2 or spare < _FEWEST_SPARE:  # the homography has used some of the equations, too
        return None
    return float(np.sqrt(np.sum((grid[seen] - picture(board[seen])) ** 2) / spare))


def smooth_picture(places: Array, pixels: Array) -> tuple[Callable[[Array], Array], int, int] | None:
    """Fit a smooth map to places (N, 2) on a board and their pixels (N, 2): a homography, and a polynomial of places.

    Returns:
        The map from any places (M, 2) to pixels (M, 2), the polynomial's degree, and the degrees of freedom left; None
        where the places have no homography.
    """
    homography, _ = cv2.findHomography(places, pixels)
    if homography is None:
        return None
    middle, size = places.mean(axis=0), float(np.ptp(places, axis=0).max())
    degree = next(d for d in range(_MOST_DEGREES, -1, -1) if (d + 1) * (d + 2) <= 2.0 * _SHARE * len(places))

    def flat(there: Array) -> Array:
        return np.asarray(cv2.perspectiveTransform(there[None], homography)[0])

    def terms(there: Array) -> Array:
        x, y = ((there - middle) / size).T
        return np.column_stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])

    coefficients, _, rank, _ = np.linalg.lstsq(terms(places), pixels - flat(places), rcond=None)
    return lambda there: flat(there) + terms(there) @ coefficients, degree, 2 * (len(places) - int(rank))
