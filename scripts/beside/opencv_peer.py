"""OpenCV, and the options with which ROS and Kalibr use its solver and its lenses.

It is called as in https://docs.opencv.org/5.x/dc/dbb/tutorial_py_calibration.html. `released` is calibrateCameraRO,
which also solves for the board (https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html, "a more accurate camera
calibration with imprecise targets"). ROS' camera_calibration calls calibrateCamera with two radial coefficients and
fixed k3 (https://docs.ros.org/en/rolling/p/camera_calibration/, `--k-coefficients 2`). Kalibr's pinhole-equi is the
lens of cv2.fisheye (https://github.com/ethz-asl/kalibr/wiki/supported-models); Kalibr's estimator is not run here.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np
from benchmarks.peers import Array, Corners, solve_opencv

from beside.peer_fit import PeerFit
from beside.starts import wide_focal

NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_BESIDE_DEG = 80.0
_cv: Any = cv2  # its stubs are incomplete, and the values of its flags change between releases
FISHEYE = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")


def brown(places: Array, values: Array) -> Array:
    """(N, 2) px by OpenCV's lens: fx, fy, cx, cy and coefficients in its order; NaN behind the camera."""
    return _shown(places, values, lambda *given: cv2.projectPoints(*given)[0])


def fisheye(places: Array, values: Array) -> Array:
    """The same with the formulas of cv2.fisheye, which also project places beside or behind the camera."""
    fx, fy, cx, cy, *lens = values
    aside = np.linalg.norm(places[:, :2], axis=1)
    angle = np.arctan2(aside, places[:, 2])
    grown = angle * (1.0 + np.sum([k * angle ** (2 * n + 2) for n, k in enumerate(lens)], axis=0))
    return np.asarray(places[:, :2] / np.maximum(aside, 1e-15)[:, None] * grown[:, None] * (fx, fy) + (cx, cy))


def _shown(places: Array, values: Array, project: Callable[..., Any]) -> Array:
    fx, fy, cx, cy, *lens = values
    matrix, zero = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]), np.zeros(3)
    pixels = np.asarray(project(np.ascontiguousarray(places[:, None]), zero, zero, matrix, np.array(lens)))
    pixels = pixels.reshape(-1, 2)
    return np.asarray(np.where(places[:, 2:] > 1e-6, pixels, np.nan))


def numbers_of(matrix: Array, lens: Array, count: int) -> Array:
    """(4 + count,) fx, fy, cx, cy and coefficients."""
    return np.array([matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *lens.ravel()[:count]])


def _fit(flags: int, coefficients: int, fixed: tuple[str, ...], corners: Corners) -> PeerFit:
    objects, images = ([part.astype(np.float32) for part in parts] for parts in corners.by_frame())
    size = tuple(corners.image_size.tolist())
    start = time.perf_counter()
    _, matrix, lens, turns, shifts, sd, *_ = _cv.calibrateCameraExtended(objects, images, size, None, None, flags=flags)
    seconds = time.perf_counter() - start
    values = numbers_of(matrix, lens, coefficients)
    stated = np.asarray(sd, dtype=float).ravel()[: len(values)]
    stated[[NAMES.index(name) for name in fixed]] = 0.0
    left = [
        cv2.projectPoints(o, r, t, matrix, lens)[0].reshape(-1, 2) - i
        for o, i, r, t in zip(objects, images, turns, shifts, strict=True)
    ]
    squares = float(np.sum(np.concatenate(left) ** 2))
    free = 2 * len(corners.view) - len(values) + len(fixed) - 6 * corners.frames
    noise = float(np.sqrt(squares / max(free, 1)))
    return PeerFit(
        NAMES[: len(values)], values, brown, corners.board, noise, stated, seconds=seconds,
        more={"rms_px": float(np.sqrt(squares / len(corners.view)))},
    )  # fmt: skip


def _plain(corners: Corners) -> PeerFit:
    """calibrateCamera, which states no standard deviations; this is timed."""
    found = solve_opencv(corners)
    return PeerFit(NAMES[:9], found.intrinsics, brown, corners.board, seconds=found.seconds)


def _released(flags: int, coefficients: int, corners: Corners) -> PeerFit:
    """Every view must show every corner; the other views are left out."""
    count = len(corners.board)
    objects, images = ([part.astype(np.float32) for part in parts] for parts in corners.by_frame())
    whole = [number for number, one in enumerate(images) if len(one) == count]
    objects, images = [objects[k] for k in whole], [images[k] for k in whole]
    size, fixed = tuple(corners.image_size.tolist()), int(corners.grid[0]) - 1
    start = time.perf_counter()
    _, matrix, lens, _, _, board = _cv.calibrateCameraRO(objects, images, size, fixed, None, None, flags=flags)
    seconds = time.perf_counter() - start
    return PeerFit(
        NAMES[: 4 + coefficients], numbers_of(matrix, lens, coefficients), brown,
        np.asarray(board, dtype=float).reshape(-1, 3), seconds=seconds,
    )  # fmt: skip


def _fisheye(corners: Corners) -> PeerFit:
    """Without an initial estimate, or with a wide lens's focal length. Its initial estimate fails for corners beside
    the camera; where it does, it gets only corners up to 80 degrees from the axis.
    """
    flags = _cv.CALIB_RECOMPUTE_EXTRINSIC | _cv.CALIB_FIX_SKEW
    matrix, focal = None, wide_focal(corners)
    if focal is not None:
        width, height = corners.image_size.tolist()
        matrix = np.array([[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]])
        flags |= _cv.CALIB_USE_INTRINSIC_GUESS
    start = time.perf_counter()
    try:
        found = _by_fisheye(corners, np.ones(len(corners.view), dtype=bool), matrix, flags)
    except cv2.error:
        if focal is None:
            raise
        middle = 0.5 * (corners.image_size - 1.0)
        near = np.linalg.norm(corners.pixels - middle, axis=1) < np.deg2rad(_BESIDE_DEG) * focal
        found = _by_fisheye(corners, near, matrix, flags)
    return PeerFit(FISHEYE, found, fisheye, corners.board, seconds=time.perf_counter() - start)


def _by_fisheye(corners: Corners, rows: Any, matrix: Any, flags: int) -> Array:
    cuts = np.searchsorted(corners.view[rows], np.arange(1, corners.frames))
    objects = [part[None] for part in np.split(corners.board[corners.feature[rows]], cuts)]
    images = [part[None] for part in np.split(corners.pixels[rows], cuts)]
    size, criteria = tuple(corners.image_size.tolist()), (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 200, 1e-9)
    lens = None if matrix is None else np.zeros(4)
    start = None if matrix is None else matrix.copy()
    found = _cv.fisheye.calibrate(objects, images, size, start, lens, None, None, flags, criteria)
    return numbers_of(found[1], found[2], 4)


SETTINGS: dict[str, Callable[[Corners], PeerFit]] = {
    "default": partial(_fit, 0, 5, ()),
    "calibrateCamera": _plain,
    "rational": partial(_fit, cv2.CALIB_RATIONAL_MODEL, 8, ()),
    "released": partial(_released, 0, 5),
    "as ROS": partial(_fit, cv2.CALIB_FIX_K3, 5, ("k3",)),
    "fisheye, as Kalibr's equi": _fisheye,
}
