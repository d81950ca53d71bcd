"""The inner loops: C++ in the folder `core`, loaded at the first call. They work on what they are handed, fill what is
there for it, and release Python's lock.

Arrays that are read may be laid out in any way: what is not contiguous, or of another kind of number, is copied. Arrays
that are filled must be contiguous and of the right kind. A shape or a row number that does not fit is a TypeError or a
ValueError that says what is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array, Array32, Indices, Mask

IN_ORDER, NO_NORMALS = np.empty(0, dtype=np.int64), np.empty((0, 2))


@cache
def core() -> Any:
    """The module that was compiled for this machine: for every processor of its kind, or for those with AVX2."""
    try:
        every = import_module("ceres_cal.kernels._core")
    except ModuleNotFoundError as error:
        raise ImportError(f"{error}: the kernels are not compiled here: run scripts/setup, or pip install .") from error
    return import_module("ceres_cal.kernels._core_v3") if every.has_avx2() else every


# ---- what they are handed -------------------------------------------------------------------------------------------


class Optics(NamedTuple):
    """A camera's optics.

    Attributes:
        lens: a `scene.lens.Lens` of the camera's kind; only one that is not compiled is asked for anything.
        kind: its name, by which the compiled one is known. form: (F,) what that one is chosen by, see `Lens.form`.
        intrinsics: phi, aspect, cx, cy, scaled coefficients, skew. unit: half the image diagonal, px.
    """

    lens: Any
    kind: str
    form: Array
    intrinsics: Array
    unit: float


BUILT = 10
"""Numbers at most that move an observation on its target: of a point x, y, its board's warp, its height, and
its board's stretches.
"""


class PointColumns(NamedTuple):
    """The point observations of some sights, one sight after the other.

    Attributes:
        bounds: (S + 1,) where each sight's rows begin. places: (N, 3) m, as built. pixels: (N, 2).
        weights: (N,) 1 / (noise scale * sigma).
        slots: (N, BUILT) with bends (N, BUILT - 2): the structure numbers that move each point, -1 for none; empty
            without structure (see `structure.Structure`).
    """

    bounds: Any
    places: Array
    pixels: Array
    weights: Array
    slots: Any
    bends: Array


class CurveColumns(NamedTuple):
    """The curve observations of some sights, one sight after the other.

    Attributes:
        bounds: (S + 1,) where each sight's rows begin. tracks: (T, 3, 3) as built, is_arc: (T,).
        track: (M,) index into tracks. pixels: (M, 2). weights: (M,) 1 / (noise scale * sigma).
        feet: (M,) place on the track, read as a start and left at the foot.
        slots: (T, 3) the structure numbers that move each track, -1 for none; empty without structure.
    """

    bounds: Any
    tracks: Array
    is_arc: Any
    track: Any
    pixels: Array
    weights: Array
    feet: Array
    slots: Any


class Loss(NamedTuple):
    """A robust loss: a LOSS_CODES value and its scale in standard deviations."""

    code: int
    scale: float


class Unknowns(NamedTuple):
    """What is solved for besides poses: places in the intrinsics vector, and how many structure numbers."""

    free: Any
    structure: int


class Blocks(NamedTuple):
    """One array for each of Ceres's parameter blocks of a sight, empty where the block is held."""

    camera: Array
    station: Array
    placement: Array
    structure: Array


class Sweep(NamedTuple):
    """Placements at their best for given shared numbers.

    Attributes:
        poses: (S, 3, 4) [R t] of cam_from_target. gains: (S, 6, shared) how they follow the shared numbers.
        costs: (S,) sum of rho of each sight; infinite where an observation cannot be projected.
        reduced: (shared + 1,) squared, lower triangle: the normal equations that are left, the residual's row last.
    """

    poses: Array
    gains: Array
    costs: Array
    reduced: Array


NOTHING = np.empty(0)
"""A block that is held."""

LOSS_CODES = {"trivial": 0, "huber": 1, "soft_l1": 2, "cauchy": 3, "tukey": 4}

ROUNDING = 1e-9  # of a cost


# ---- lenses ---------------------------------------------------------------------------------------------------------


def lens_images(optics: Optics, rays: Array, images: Array) -> None:
    """Offsets of rays (N, 3) from the principal point on square pixels, px, and their derivatives by the ray's x, y and
    z, to `images` (2, 4, N): also where the map has folded, and there is no answer.
    """
    core().lens_images(optics, rays, images)


def lens_rays(optics: Optics, offsets: Array, longest: float, rays: Array) -> None:
    """Where offsets (N, 2) from the principal point on square pixels, px, come from, by Newton's method from `rays`
    (N, 3), unit vectors near there that are moved, by steps of `longest` rad at most; NaN where it does not get there.
    """
    core().lens_rays(optics, offsets, longest, rays)


def inverse_of_growing(above: Array, width: float, below: Array, limit: float, targets: Array, places: Array) -> None:
    """Where a map that grows from 0 is as large as `targets` (N,), to `places` (N,); NaN where it is not up to `limit`.

    Args:
        above: (K, T) polynomials, lowest power first, of stretches `width` wide side by side, each by the share of its
            own; the last one goes on. below: (Q,) a polynomial that it is divided by; empty for none.
    """
    core().inverse_of_growing(above, width, below, limit, targets, places)


# ---- the start ------------------------------------------------------------------------------------------------------


def plane_homographies(
    bounds: Indices, plane: Array, offsets: Array, profile: Array, unit: float, wrong: float, homographies: Array,
    errors: Array,
) -> None:  # fmt: skip
    """H (S, 3, 3) of each sight with q ~ H (x, y, 1), sign by most of its points, and each point's error (N,).

    Args:
        bounds: (S + 1,) where each sight begins. plane: (N, 2) m. offsets: (N, 2) px. unit: px.
        profile: c_k of w = 1 + sum c_k r^2k, which makes q = (p, w); p and r are offsets and their lengths over `unit`.
        wrong: of the median error, how much more than it no clean point has.
    """
    core().plane_homographies(bounds, plane, offsets, profile, unit, wrong, homographies, errors)


def radial_alignment(
    bounds: Indices, plane: Array, offsets: Array, unit: float, rounds: int, profile: Array, errors: Array, usual: Array
) -> None:
    """Coefficients (terms,) of the profile under which sights of points are pictures of planes.

    Args:
        bounds: (S + 1,) where each sight begins. plane: (N, 2) m. offsets: (N, 2) px. unit: px.
        errors: (N,) of each point, over `unit`. usual: (N,) what is usual at that distance from the centre.
    """
    core().radial_alignment(bounds, plane, offsets, unit, rounds, profile, errors, usual)


# ---- residuals and their derivatives --------------------------------------------------------------------------------


def point_residuals(
    first: int, last: int, optics: Optics, poses: Array, points: PointColumns, rows: Indices, residuals: Array
) -> None:
    """project(X) - p in px of the sights first to last at poses (S, 3, 4), to `rows` of `residuals`; NaN where there is
    none.
    """
    core().point_residuals(first, last, optics, poses, points, rows, residuals)


def curve_residuals(optics: Optics, poses: Array, curves: CurveColumns, residuals: Array) -> None:
    """Signed distance from each pixel to its curve in px, (M,), and s moved to the foot; NaN where there is none."""
    core().curve_residuals(0, len(poses), optics, poses, curves, IN_ORDER, residuals[:, None])


def point_rows(optics: Optics, poses: Array, points: PointColumns, rows: Array) -> None:
    """d project(X) / d [intrinsics | 6 pose | what moves it on its target] into `rows` (N, 2, intrinsics + 6 + BUILT);
    NaN of those that cannot be projected.

    Args:
        See `point_residuals`. The pose columns are left perturbations in the camera frame: (dw x R X) + dt.
    """
    core().point_rows(optics, poses, points, rows, NO_NORMALS)


def curve_rows(optics: Optics, poses: Array, curves: CurveColumns, rows: Array, normals: Array) -> bool:
    """The same of the signed distance to the curve, into `rows` (M, intrinsics + 6 + BUILT), by the envelope theorem;
    the last columns are of a segment's offset to the left, or of an arc's x, y and radius, and 0. False where a curve
    cannot be projected.

    Args:
        See `curve_residuals`; s is moved to the foot. normals: (M, 2), filled with the image normal there: the foot
            lies at the pixel plus the signed distance along it.
    """
    return bool(core().curve_rows(optics, poses, curves, rows[:, None], normals))


def loss_weights(loss: Loss, squared: Array, weights: Array) -> None:
    """rho' at each squared residual, to `weights` (N,): what an observation has in the solve."""
    core().loss_weights(loss, squared, weights)


# ---- statistics -----------------------------------------------------------------------------------------------------


def normal_cdf(x: ArrayLike) -> Array:
    """Probability that a standard normal variable is smaller, of each x."""
    shares = np.empty(np.shape(x))
    core().normal_cdf(np.ravel(x), shares.reshape(-1))
    return shares


def mixture_above(weights: Array, means: Array, scales: Array, places: Array, columns: Indices) -> Array:
    """(K,) how much of mixtures of normal distributions lies above a place each.

    Args:
        weights: (F,). means, scales: (F, N) of each component of N mixtures, scales one over its standard deviation.
        places: (K,) a place of each. columns: (K,) which mixtures.
    """
    above = np.empty(len(columns))
    core().mixture_above(weights, means, scales, columns, places, above)
    return above


# ---- photographs ----------------------------------------------------------------------------------------------------


def fit_saddles(levels: Array32, starts: Array, fitted: Array) -> None:
    """The saddle of `detect.saddles` around each of N corners, least squares over the pixels of a disc.

    Args:
        levels: (height, width) grey levels. starts: (N, 14) the model's eleven numbers, of which those after x, y and
            the angles of both edges are NaN where it is fitted roughly first; then the edges' bends (1 / px), and the
            disc's radius, px.
        fitted: (N, 14), filled: the model's eleven numbers, the root mean square of what they leave, and the standard
            deviations of x and y for one of 1 in each pixel; NaN where a disc's middle is not in the picture.
    """
    core().fit_saddles(levels, starts, fitted)


def profile_equations(
    distance: Array,
    values: Array,
    edges: Array,
    shapes: Array,
    heights: Array,
    free: int,
    normals: Array,
    rights: Array,
) -> None:
    """The normal equations of `detect.profiles` in each of N windows, by the numbers of its model.

    Args:
        distance, values: (N, K) of the pixels: how far along the normal, px, and grey levels. edges: (N, E) px.
        shapes: (N, 4) blur, smear, how that leans, and c, px. heights: (N, E) of each step, or (0, E) where c is held.
        free: how many of the logarithms of blur, stretch and smear are asked for besides.
        normals, rights: (N, P, P) and (N, P), filled: by b, g and each height, by c, and by these.
    """
    core().profile_equations(distance, values, edges, shapes, heights, free, normals, rights)


def shares_along(planes: Array32, weights: Array32, axes: Array32, least: float, shares: Array) -> None:
    """The share of N strokes that run along either of two axes of a floor, to `shares` (B,); none where no more than
    `least` run along one of them.

    Args:
        planes: (3, N) normals of the strokes' planes, over the sine by which one may be off. weights: (N,) in all 1.
        axes: (B, 2, 3) in the camera's frame.
    """
    core().shares_along(planes, weights, axes, least, shares)


def lines_near(
    plane: Array32, reduced: int, optics: Sequence[float], along: Array32, joined: Mask, feet: Array32, sums: Array
) -> None:
    """How many px of lines are near strokes, and shown, and the share of the places on them in view, to `sums` (K, 3).

    Args:
        plane: (H, W) nearness, `reduced` times smaller than the picture. optics: bend and phi of an `Upright`, the
            length that these are in, px, and the centre and size of the picture, px.
        along: (3, P) places on the lines, in axes that the camera has. joined: (P,) to the place before it.
        feet: (K, 3) where the camera is, in the same axes.
    """
    core().lines_near(plane, reduced, np.array(optics, np.float32), along, joined, feet, sums)


# ---- the solve ------------------------------------------------------------------------------------------------------


def cholesky(normal: Array, upper: Array) -> None:
    """U with U^T U = A from A's lower triangle; where A is singular the row of U is zero."""
    core().cholesky(normal, upper)


def evaluate_block(
    optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss, at: Blocks,
    residuals: Array, jacobians: Blocks,
) -> bool:  # fmt: skip
    """What Ceres asks of the block of one sight (design, section 6); False where an observation cannot be projected.

    Args:
        optics: `at.camera` replaces the free entries of its intrinsics. points, curves: of this sight alone.
        at: the free intrinsics, and the 6-vectors of cam_from_world and world_from_target; its structure is already in
            the columns.
        residuals: (free + structure + 7,): the rows of U, then what is missing from the robust cost.
        jacobians: row-major, as many rows x the block's size.
    """
    return bool(core().evaluate_block(optics, unknowns, points, curves, loss, at, residuals, jacobians))


def eliminate_placements(
    first: int, last: int, optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss,
    newton: bool, tolerance: float, change: Array, sweep: Sweep,
) -> None:  # fmt: skip
    """The sights first to last at their best poses: their costs, and what they say of the free intrinsics.

    Args:
        newton: whether the equations take rho'' along, for a step, or rho' alone.
        tolerance: how much of a sight's cost a step of its pose may still promise when it is left to the complement;
            infinite: poses follow the change, and nothing else is done.
        change: (free + structure,) by how much these have moved since the poses and gains of `sweep` were made.
        sweep: poses, moved (left alone where an observation cannot be projected), gains, renewed, costs, filled, and
            reduced, the complement, added up.
    """
    core().eliminate_placements(
        first, last, optics, unknowns, points, curves, loss, newton, tolerance, change, sweep
    )  # fmt: skip


def sight_normals(
    first: int, last: int, optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss,
    poses: Array, units: Array, normals: Array,
) -> bool:  # fmt: skip
    """False where an observation cannot be projected; else J^T W J of the sights first to last, each by itself.

    Args:
        poses: (S, 3, 4) [R t] of cam_from_frame.
        normals: (last - first, n, n) with n = free + structure + 7: free intrinsics, structure, left perturbation of
            the pose and residual, each multiplied with its one of `units` (n,); an observation has its robust weight
            rho'.
    """
    costs = np.empty(last - first)
    core().sight_normals(first, last, optics, unknowns, points, curves, loss, False, poses, units, costs, normals)
    return bool(np.isfinite(costs).all())


# ---- errors that go together ----------------------------------------------------------------------------------------


def strands_left(
    values: Array, bounds: Indices, group: Indices, rows: Array, shares: Array, logs: Array, left: Array
) -> int:
    """What strands of observations leave where a share a of their variance goes together: of R = (1 - a) 1 + a K.

    Args:
        values: (D, M) eigenvalues of each shape's K; bounds: (D + 1,) where its strands begin.
        rows: (M, S, Z) along the eigenvectors: six of private placements, those of what is shared, the residual.
        group: (S,) whose private placement it is. shares: (A,).
        logs: (A,) the determinants of all R and of what private placements are known by, added up.
        left: (A, Z - 6, Z - 6) sum of X^T R^-1 X of all but these, which are then eliminated from it.

    Returns:
        How many numbers were eliminated.
    """
    return int(core().strands_left(values, bounds, group, rows, shares, logs, left))
