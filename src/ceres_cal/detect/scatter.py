"""Precision of measured board corners, estimated from the pictures themselves."""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, median
from ceres_cal.base.frozen import Frozen

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
    picture = smooth_picture(board[seen], grid[seen])
    # The homography has used some of the equations, too.
    if picture is None or picture.degree < 2 or picture.spare < _FEWEST_SPARE:
        return None
    return float(np.sqrt(np.sum((grid[seen] - picture(board[seen])) ** 2) / picture.spare))


class SmoothPicture(Frozen):
    """A map from places on a board to pixels: a homography, and a polynomial of the places.

    Attributes:
        degree: of the polynomial.
        spare: degrees of freedom left.
    """

    homography: Array
    middle: Array
    size: float
    degree: int
    coefficients: Array
    spare: int

    def __call__(self, places: Array) -> Array:
        """Return the pixels (N, 2) of places (N, 2) on the board."""
        flat = cv2.perspectiveTransform(places[None], self.homography)[0]
        terms = _terms((places - self.middle) / self.size, self.degree)
        return np.asarray(flat + terms @ self.coefficients)


def smooth_picture(places: Array, pixels: Array) -> SmoothPicture | None:
    """Fit a smooth map to places (N, 2) on a board and their pixels (N, 2); None where they have no homography."""
    homography, _ = cv2.findHomography(places, pixels)
    if homography is None:
        return None
    middle, size = places.mean(axis=0), float(np.ptp(places, axis=0).max())
    degree = next(d for d in range(_MOST_DEGREES, -1, -1) if (d + 1) * (d + 2) <= 2.0 * _SHARE * len(places))
    terms = _terms((places - middle) / size, degree)
    flat = cv2.perspectiveTransform(places[None], homography)[0]
    coefficients, _, rank, _ = np.linalg.lstsq(terms, pixels - flat, rcond=None)
    return SmoothPicture(
        np.asarray(homography, dtype=float), middle, size, degree, coefficients, 2 * (len(places) - int(rank))
    )


def _terms(places: Array, degree: int) -> Array:
    x, y = places.T
    return np.column_stack([x**i * y**j for i in range(degree + 1) for j in range(degree + 1 - i)])
