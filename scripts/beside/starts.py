"""A first guess of a wide lens, for those that ask for one: the focal length of an equidistant lens, by homographies.

OpenCV's own first guess takes a lens for a pinhole. Where an equidistant lens makes the board much flatter than any
pinhole does, its focal length is handed to each peer that takes one, which helps it.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from benchmarks.peers import Array, Corners

_FLATTER = 0.5  # times what a pinhole leaves, from which down a lens is taken for a wide one
_MOST = 1.4  # rad off the axis up to which a corner is used
_LEAST = 8  # corners of a view


def flat_of(pixels: Array, focal: float, middle: Any) -> Array:
    """(N, 2) where the rays of pixels meet the plane at 1, by an equidistant lens; NaN far off the axis."""
    off = (pixels - middle) / focal
    angle = np.linalg.norm(off, axis=1)
    grown = np.where(angle < _MOST, np.tan(np.minimum(angle, _MOST)) / np.maximum(angle, 1e-12), np.nan)
    return np.asarray(off * grown[:, None])


def _left(corners: Corners, focal: float) -> float:
    """Rms px by which homographies of the board miss the corners straightened by this focal length."""
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
    """Its focal length, px; None where a pinhole does as well."""
    width = float(corners.image_size[0])
    tried = width * np.geomspace(0.2, 1.5, 30)
    left = [_left(corners, focal) for focal in tried.tolist()]
    best = int(np.argmin(left))
    return float(tried[best]) if left[best] < _FLATTER * _left(corners, 50.0 * width) else None


def wide_poses(corners: Corners, focal: float) -> list[Array]:
    """(3, 4) cam_from_board of each view under it."""
    middle, poses = 0.5 * (corners.image_size - 1.0), []
    for board, pixels in zip(*corners.by_frame(), strict=True):
        flat = flat_of(pixels, focal, middle)
        shown = np.isfinite(flat[:, 0])
        _, turn, shift = cv2.solvePnP(board[shown], flat[shown], np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        poses.append(np.column_stack([cv2.Rodrigues(turn)[0], shift.ravel()]).astype(float))
    return poses
