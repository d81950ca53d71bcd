"""Measures by which any calibration is judged: a camera to project with, a board, and the stated uncertainties.

Needs only NumPy and OpenCV, nothing of this package, since it runs in each peer's own Python.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from benchmarks.peers import Array, Corners

_STEP = 1e-5
_AHEAD = 0.17  # cosine of the largest angle from the axis for the initial estimate of a pose
_ROUNDS = 30
_WARPED = 0.002


@dataclass(frozen=True, eq=False)
class PeerFit:
    """A calibrated camera.

    Attributes:
        values: (K,) solved numbers of the camera in the peer's own parametrisation, with these `names`.
        project: (N, 3) in the camera's frame and values (K,) -> (N, 2) px. board: (M, 3) m as drawn or as solved for.
        sd: (K,) stated standard deviations. covariance: (K, K) stated. variance: places (N, 3), at_infinity -> (N,)
            px^2, the stated variance of a projection there, sum of both coordinates. noise_px: stated standard
            deviation of a corner's coordinate. Each is None or NaN where the peer states none.
        said: the peer's messages. taken_out: number of corners that it removed. seconds: of the solve.
    """

    names: tuple[str, ...]
    values: Array
    project: Callable[[Array, Array], Array]
    board: Array
    noise_px: float = float("nan")
    sd: Array | None = None
    covariance: Array | None = None
    variance: Callable[..., Array] | None = None
    said: tuple[str, ...] = ()
    taken_out: int = 0
    seconds: float = float("nan")
    more: dict[str, Any] = field(default_factory=dict)

    def seen(self, places: Array) -> Array:
        """(N, 2) px of places (N, 3) in the camera's frame."""
        return self.project(places, self.values)

    def rays(self, pixels: Array) -> Array:
        """(N, 3) unit rays of pixels (N, 2), by Gauss-Newton on `project`; NaN where it does not converge."""
        scale = max(float(self.values[0]), 1.0)
        middle = self.seen(np.array([[0.0, 0.0, 1.0]]))[0]
        off = (pixels - middle) / scale
        angle = np.minimum(np.linalg.norm(off, axis=1), 1.5)
        turn = off / np.maximum(np.linalg.norm(off, axis=1), 1e-12)[:, None] * angle[:, None]  # as an equidistant lens
        for _ in range(_ROUNDS):
            there = self.seen(_of_turns(turn)) - pixels
            slopes = np.stack([(self.seen(_of_turns(turn + d)) - pixels - there) / 1e-6 for d in 1e-6 * np.eye(2)], -1)
            with np.errstate(all="ignore"):
                step = np.linalg.solve(np.nan_to_num(slopes) + 1e-9 * np.eye(2), there[:, :, None])[:, :, 0]
            turn = turn - np.clip(np.nan_to_num(step), -0.2, 0.2)
            if np.max(np.abs(np.nan_to_num(step))) < 1e-10:
                break
        rays = _of_turns(turn)
        rays[~(np.linalg.norm(self.seen(rays) - pixels, axis=1) < 1e-3)] = np.nan
        return rays

    def slopes(self, places: Array) -> Array:
        """(2 N, K) derivatives of the pixels of places with respect to the values, px per unit of each."""
        usual = _STEP * np.maximum(np.abs(self.values), 1e-2)
        steps = usual if self.sd is None else np.where(self.sd > 0.0, 0.03 * self.sd, usual)
        columns = []
        for number, size in enumerate(steps):
            step = size * np.eye(len(steps))[number]
            ahead, behind = (self.project(places, self.values + s).ravel() for s in (step, -step))
            columns.append((ahead - behind) / (2.0 * size))
        return np.column_stack(columns)

    def stated_squares(self, rays: Array, basis: Array, *, at_infinity: bool) -> Array | None:
        """(N,) px^2, the stated variance of the pixels of rays, sum of both coordinates. The columns of a basis (2 N,
        k) are projected out of a stated covariance. None where nothing is stated.
        """
        if self.variance is not None:
            return self.variance(rays, at_infinity=at_infinity)
        if self.covariance is None:
            return None
        slopes = self.slopes(rays)
        slopes -= basis @ (basis.T @ slopes)
        return np.asarray(np.einsum("ni,ij,nj->n", slopes, self.covariance, slopes).reshape(-1, 2).sum(axis=1))


def warp_said(board: Array) -> list[str]:
    """A message for a solved board that deviates from its plane by more than a five-hundredth of its size."""
    deep, wide = float(np.ptp(board[:, 2])), float(np.ptp(board[:, :2], axis=0).max())
    return [f"the board is warped by {1e3 * deep:.2f} mm"] if deep > _WARPED * wide else []


def _of_turns(turn: Array) -> Array:
    """(N, 3) unit rays that leave the axis by an angle |turn| in its direction."""
    angle = np.linalg.norm(turn, axis=1)
    return np.column_stack([turn * np.sinc(angle / np.pi)[:, None], np.cos(angle)])


def turn_basis(fitted: PeerFit, rays: Array) -> Array:
    """(2 N, 3) orthonormal basis of the pixel displacements of rays under rotations of the camera."""
    columns = [(fitted.seen(rays + _STEP * np.cross(a, rays)) - fitted.seen(rays)).ravel() for a in np.eye(3)]
    return np.asarray(np.linalg.qr(np.column_stack(columns))[0])


def grid_of(corners: Corners, step: int = 12) -> Array:
    """(N, 2) a grid of pixels in the convex hull of the corners of all views."""
    width, height = corners.image_size.tolist()
    size = max(width, height) / step
    x, y = (np.arange(0.5 * size, most, size) for most in (width, height))
    hull = cv2.convexHull(corners.pixels.astype(np.float32))
    every = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return every[[cv2.pointPolygonTest(hull, (float(a), float(b)), False) > 0.0 for a, b in every]]


# ---- two calibrations of one camera ---------------------------------------------------------------------------------


def agreement(first: PeerFit, second: PeerFit, pixels: Array) -> dict[str, float]:
    """Mean squares of the differences of two calibrations from different pictures over what both state: of each number,
    and of projections after the best-fitting rotation between the two. Values that are not stated are missing.
    """
    found: dict[str, float] = {}
    if first.sd is not None and second.sd is not None and first.names == second.names:
        sd = np.hypot(first.sd, second.sd)
        free = sd > 0.0
        found["numbers"] = float(np.mean(((first.values - second.values)[free] / sd[free]) ** 2))
    rays = first.rays(pixels)
    kept = np.isfinite(rays[:, 0])
    kept[kept] &= np.isfinite(second.seen(rays[kept])[:, 0])
    rays, pixels = rays[kept], pixels[kept]
    basis = turn_basis(first, rays)
    off = (second.seen(rays) - pixels).ravel()
    off -= basis @ (basis.T @ off)
    squares = np.sum(off.reshape(-1, 2) ** 2, axis=1)
    found["apart_px"] = float(np.mean(squares))
    stated = [one.stated_squares(rays, basis, at_infinity=True) for one in (first, second)]
    if stated[0] is not None and stated[1] is not None:
        found["projections"] = float(np.mean(squares / (stated[0] + stated[1])))
        found["stated_px"] = float(np.mean(stated[0] + stated[1]))
    return found


# ---- held-out views -------------------------------------------------------------------------------------------------


def held_out(fitted: PeerFit, corners: Corners) -> tuple[Array, Array]:
    """(N,) px, residuals of new views for which only the poses are solved; and (N,) px^2, their predicted squares, NaN
    where the peer states no noise.
    """
    lengths, expected = [], []
    cuts = np.searchsorted(corners.view, np.arange(1, corners.frames))
    for feature, pixels in zip(np.split(corners.feature, cuts), np.split(corners.pixels, cuts), strict=True):
        board = fitted.board[feature]
        pose, left, slopes = _posed(fitted, board, pixels)
        lengths.append(np.linalg.norm(left.reshape(-1, 2), axis=1))
        basis = np.linalg.qr(slopes)[0]
        lost = np.sum(basis.reshape(-1, 2, 6) ** 2, axis=(1, 2))
        square = fitted.noise_px**2 * (2.0 - lost)
        own = fitted.stated_squares(_moved(pose, board), basis, at_infinity=False)
        expected.append(square if own is None else square + own)
    return np.concatenate(lengths), np.concatenate(expected)


def _moved(pose: Array, board: Array) -> Array:
    return np.asarray(board @ cv2.Rodrigues(pose[:3])[0].T + pose[3:])


def _posed(fitted: PeerFit, board: Array, pixels: Array) -> tuple[Array, Array, Array]:
    """Least squares for one pose without corners far beyond the others: pose (6,), residuals (2 N,) and their
    derivatives (2 N, 6). It is the better one of the two poses that the picture of a plane allows.
    """

    def left_at(pose: Array) -> Array:
        return np.nan_to_num((fitted.seen(_moved(pose, board)) - pixels).ravel(), nan=1e3)

    found = [_refined(pose, left_at) for pose in _first_poses(fitted, board, pixels)]
    pose = min(found, key=lambda pose: float(np.median(np.linalg.norm(left_at(pose).reshape(-1, 2), axis=1))))
    left = left_at(pose)
    return pose, left, _slopes(pose, left, left_at)


def _slopes(pose: Array, left: Array, left_at: Callable[[Array], Array]) -> Array:
    return np.column_stack([(left_at(pose + step) - left) / 1e-6 for step in 1e-6 * np.eye(6)])


def _refined(pose: Array, left_at: Callable[[Array], Array]) -> Array:
    left, damping = left_at(pose), 1e-4
    for _ in range(_ROUNDS):
        lengths = np.linalg.norm(left.reshape(-1, 2), axis=1)
        inside = np.repeat(lengths <= 8.0 * np.median(lengths) + 1e-6, 2)
        slopes = _slopes(pose, left, left_at)[inside]
        normal = slopes.T @ slopes
        damped = normal + damping * np.diag(np.diag(normal)) + 1e-9 * np.eye(6)
        step = np.linalg.solve(damped, slopes.T @ left[inside])
        trial = left_at(pose - step)
        if (gain := float(np.sum(left[inside] ** 2) - np.sum(trial[inside] ** 2))) >= 0.0:
            pose, left, damping = pose - step, trial, damping * 0.1
            if gain < 1e-9:
                break
        else:
            damping *= 10.0
    return pose


def _first_poses(fitted: PeerFit, board: Array, pixels: Array) -> list[Array]:
    rays = fitted.rays(pixels)
    ahead = np.isfinite(rays[:, 2]) & (rays[:, 2] > _AHEAD)
    if np.count_nonzero(ahead) < 4:
        raise ValueError("a view has no pose under this lens: fewer than four corners are seen ahead of it")
    normal = rays[ahead, :2] / rays[ahead, 2:]
    flat = board[ahead] * (1.0, 1.0, 0.0)
    _, turns, shifts, _ = cv2.solvePnPGeneric(flat, normal, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
    return [np.concatenate([turn.ravel(), shift.ravel()]) for turn, shift in zip(turns, shifts, strict=True)]
