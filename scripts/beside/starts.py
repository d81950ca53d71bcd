"""Initial focal length of a wide lens, for peers that need one: that of an equidistant lens, by homographies.

OpenCV's own initial estimate assumes a pinhole. Where an equidistant lens explains the board much better than any
pinhole, its focal length is given to each peer that accepts one, to the peer's advantage.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from benchmarks.peers import Array, Corners

_FLATTER = 0.5  # times the residuals of a pinhole; with smaller ones a lens is wide
_MOST = 1.4  # rad, largest angle from the axis of a corner that is used
_LEAST = 8  # corners of a view


def flat_of(pixels: Array, focal: float, middle: Any) -> Array:
    """(N, 2) where the rays of pixels meet the plane z = 1 for an equidistant lens; NaN far from the axis."""
    off = (pixels - middle) / focal
    angle = np.linalg.norm(off, axis=1)
    grown = np.where(angle < _MOST, np.tan(np.minimum(angle, _MOST)) / np.maximum(angle, 1e-12), np.nan)
    return np.asarray(off * grown[:, None])


def _left(corners: Corners, focal: float) -> float:
    """Rms px of the residuals of homographies to the corners, rectified with this focal length."""
    middle, squares = 0.5 * (corners.image_size - 1.0), []
    for board, pixels in zip(*corners.by_frame(), strict=True):
        flat = flat_of(pixels, focal, middle)
        shown = np.isfinite(flat[:, 0])
        if np.count_nonzero(shown) < _LEAST:
            return float("inf")
        matrix, _ = cv2.findHomography(board[shown, :2], flat[shown])
        if matrix is None:
            return float("inf")
        there = cv2.perspectiveTransform(np.ascontiguousarray(board[shown, None, :2]), matrix)[:, 0]
        angle = np.arctan(np.linalg.norm(flat[shown], axis=1))
        squares.append(np.sum((there - flat[shown]) ** 2, axis=1) * (focal * np.cos(angle) ** 2) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))


def wide_focal(corners: Corners) -> float | None:
    """Focal length of a wide lens, px; None where a pinhole fits as well."""
    width = float(corners.image_size[0])
    tried = width * np.geomspace(0.2, 1.5, 30)
    left = [_left(corners, focal) for focal in tried.tolist()]
    best = int(np.argmin(left))
    return float(tried[best]) if left[best] < _FLATTER * _left(corners, 50.0 * width) else None


def wide_poses(corners: Corners, focal: float) -> list[Array]:
    """(3, 4) cam_from_board of each view with this focal length."""
    middle, poses = 0.5 * (corners.image_size - 1.0), []
    for board, pixels in zip(*corners.by_frame(), strict=True):
        flat = flat_of(pixels, focal, middle)
        shown = np.isfinite(flat[:, 0])
        _, turn, shift = cv2.solvePnP(board[shown], flat[shown], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        poses.append(np.column_stack([cv2.Rodrigues(turn)[0], shift.ravel()]).astype(float))
    return poses
