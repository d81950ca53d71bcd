"""The inner loops, in C++ in the folder `core`, which is loaded at the first call. They work on the arrays that they
are given, fill others, and release Python's lock.

Arrays that are read may have any layout: those that are not contiguous, or have another type of numbers, are copied.
Arrays that are filled must be contiguous and of the right type. A shape or a row number that does not fit is a
TypeError or a ValueError that says what is needed.
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
    """The module compiled for this machine: for every processor of its kind, or for those with AVX2."""
    try:
        every = import_module("ceres_cal.kernels._core")
    except ModuleNotFoundError as error:
        raise ImportError(f"{error}: the kernels are not compiled here: run scripts/setup, or pip install .") from error
    return import_module("ceres_cal.kernels._core_v3") if every.has_avx2() else every


# ---- arguments ------------------------------------------------------------------------------------------------------


class Optics(NamedTuple):
    """A camera's optics.

    Attributes:
        lens: a `scene.lens.Lens` of the camera's kind; it is called only if its kind is not compiled.
        kind: the name of the compiled lens. form: (F,) numbers that select its variant, see `Lens.form`.
        intrinsics: phi, aspect, cx, cy, scaled coefficients, skew. unit: half the image diagonal, px.
    """

    lens: Any
    kind: str
    form: Array
    intrinsics: Array
    unit: float


BUILT = 10
"""Largest number of offsets that move an observation on its target: for a point x, y, its board's warp, its height, and
its board's stretches.
"""


class PointColumns(NamedTuple):
    """The point observations of some sights, ordered by sight.

    Attributes:
        bounds: (S + 1,) where each sight's rows begin. places: (N, 3) m, as built. pixels: (N, 2).
        weights: (N,) 1 / (noise scale * sigma).
        slots: (N, BUILT) structure numbers that move each point, -1 for none, with bends (N, BUILT - 2); empty without
            structure (see `structure.Structure`).
    """

    bounds: Any
    places: Array
    pixels: Array
    weights: Array
    slots: Any
    bends: Array


class CurveColumns(NamedTuple):
    """The curve observations of some sights, ordered by sight.

    Attributes:
        bounds: (S + 1,) where each sight's rows begin. tracks: (T, 3, 3) as built, is_arc: (T,).
        track: (M,) index into tracks. pixels: (M, 2). weights: (M,) 1 / (noise scale * sigma).
        feet: (M,) parameter on the track: the start of the search on input, the foot on output.
        slots: (T, 3) structure numbers that move each track, -1 for none; empty without structure.
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
    """The unknowns besides poses: indices into the intrinsics vector, and the number of structure numbers."""

    free: Any
    structure: int


class Blocks(NamedTuple):
    """One array for each of Ceres's parameter blocks of a sight, empty where the block is held."""

    camera: Array
    station: Array
    placement: Array
    structure: Array


class Sweep(NamedTuple):
    """Placements solved for at given shared numbers.

    Attributes:
        poses: (S, 3, 4) [R t] of cam_from_target. gains: (S, 6, shared) how poses follow the shared numbers.
        costs: (S,) sum of rho of each sight; infinite where an observation cannot be projected.
        reduced: (shared + 1,) squared, lower triangle: the remaining normal equations, with the residual's row last.
    """

    poses: Array
    gains: Array
    costs: Array
    reduced: Array


NOTHING = np.empty(0)
"""An empty array, for a block that is held."""

LOSS_CODES = {"trivial": 0, "huber": 1, "soft_l1": 2, "cauchy": 3, "tukey": 4}

ROUNDING = 1e-9  # relative, of a cost


# ---- lenses ---------------------------------------------------------------------------------------------------------


def lens_images(optics: Optics, rays: Array, images: Array) -> None:
    """Compute offsets of rays (N, 3) from the principal point on square pixels, px, and their derivatives by the ray's
    x, y and z, into `images` (2, 4, N); also where the map has folded, so that the ray has no image.
    """
    core().lens_images(optics, rays, images)


def lens_rays(optics: Optics, offsets: Array, longest: float, rays: Array) -> None:
    """Find the rays of offsets (N, 2) from the principal point on square pixels, px, by Newton's method. `rays` (N, 3)
    are nearby unit vectors on input and the result on output; steps are at most `longest` rad; NaN without convergence.
    """
    core().lens_rays(optics, offsets, longest, rays)


def inverse_of_growing(above: Array, width: float, below: Array, limit: float, targets: Array, places: Array) -> None:
    """Invert a map that grows from 0: find where it equals `targets` (N,), into `places` (N,); NaN if not up to
    `limit`.

    Args:
        above: (K, T) polynomials, lowest power first, for consecutive intervals of length `width`, each of the position
            in its interval from 0 to 1; the last one continues. below: (Q,) polynomial by which the map is divided;
            empty for none.
    """
    core().inverse_of_growing(above, width, below, limit, targets, places)


# ---- the initial estimate -------------------------------------------------------------------------------------------


def plane_homographies(
    bounds: Indices, plane: Array, offsets: Array, profile: Array, unit: float, wrong: float, homographies: Array,
    errors: Array,
) -> None:  # fmt: skip
    """Compute H (S, 3, 3) of each sight with q ~ H (x, y, 1), with the sign of most of its points, and errors (N,).

    Args:
        bounds: (S + 1,) where each sight begins. plane: (N, 2) m. offsets: (N, 2) px. unit: px.
        profile: c_k of w = 1 + sum c_k r^2k, with q = (p, w); p and r are offsets and their lengths over `unit`.
        wrong: multiple of the median error above which an error is a wrong label's.
    """
    core().plane_homographies(bounds, plane, offsets, profile, unit, wrong, homographies, errors)


def radial_alignment(
    bounds: Indices, plane: Array, offsets: Array, unit: float, rounds: int, profile: Array, errors: Array, usual: Array
) -> None:
    """Fit the profile (terms,) under which sights of points are pictures of planes.

    Args:
        bounds: (S + 1,) where each sight begins. plane: (N, 2) m. offsets: (N, 2) px. unit: px.
        errors: (N,) of each point, over `unit`. usual: (N,) the usual error at that distance from the centre.
    """
    core().radial_alignment(bounds, plane, offsets, unit, rounds, profile, errors, usual)


# ---- residuals and their derivatives --------------------------------------------------------------------------------


def point_residuals(
    first: int, last: int, optics: Optics, poses: Array, points: PointColumns, rows: Indices, residuals: Array
) -> None:
    """Compute project(X) - p in px for the sights first to last at poses (S, 3, 4), into `rows` of `residuals`; NaN
    where there is no image.
    """
    core().point_residuals(first, last, optics, poses, points, rows, residuals)


def curve_residuals(optics: Optics, poses: Array, curves: CurveColumns, residuals: Array) -> None:
    """Compute signed distances (M,) px from pixels to their curves, and move s to the feet; NaN where there is none."""
    core().curve_residuals(0, len(poses), optics, poses, curves, IN_ORDER, residuals[:, None])


def point_rows(optics: Optics, poses: Array, points: PointColumns, rows: Array) -> None:
    """Compute d project(X) / d [intrinsics | 6 pose | offsets on the target] into `rows` (N, 2, intrinsics + 6 +
    BUILT); NaN for points that cannot be projected.

    Args:
        See `point_residuals`. The pose columns are left perturbations in the camera frame: (dw x R X) + dt.
    """
    core().point_rows(optics, poses, points, rows, NO_NORMALS)


def curve_rows(optics: Optics, poses: Array, curves: CurveColumns, rows: Array, normals: Array) -> bool:
    """Compute derivatives of the signed distance to the curve into `rows` (M, intrinsics + 6 + BUILT), by the envelope
    theorem; the last columns are those of a segment's offset to the left, or of an arc's x, y and radius, and 0.
    Returns False where a curve cannot be projected.

    Args:
        See `curve_residuals`; s is moved to the foot. normals: (M, 2), filled with the image normal there: the foot is
        at the pixel plus the signed distance along it.
    """
    return bool(core().curve_rows(optics, poses, curves, rows[:, None], normals))


def loss_weights(loss: Loss, squared: Array, weights: Array) -> None:
    """Compute rho' of each squared residual, the weight of an observation in the solve, into `weights` (N,)."""
    core().loss_weights(loss, squared, weights)


# ---- statistics -----------------------------------------------------------------------------------------------------


def normal_cdf(x: ArrayLike) -> Array:
    """The probability that a standard normal variable is smaller, for each x."""
    shares = np.empty(np.shape(x))
    core().normal_cdf(np.ravel(x), shares.reshape(-1))
    return shares


def mixture_above(weights: Array, means: Array, scales: Array, places: Array, columns: Indices) -> Array:
    """(K,) the probability above a place, for K mixtures of normal distributions.

    Args:
        weights: (F,). means, scales: (F, N) of each component of N mixtures; a scale is 1 / standard deviation.
        places: (K,). columns: (K,) numbers of the mixtures.
    """
    above = np.empty(len(columns))
    core().mixture_above(weights, means, scales, columns, places, above)
    return above


# ---- photographs ----------------------------------------------------------------------------------------------------


def fit_saddles(levels: Array32, starts: Array, fitted: Array) -> None:
    """Fit the saddle of `detect.saddles` around each of N corners, by least squares over the pixels of a disc.

    Args:
        levels: (height, width) grey levels. starts: (N, 14) the model's eleven numbers, of which those after x, y and
            the angles of both edges are NaN if a rough fit comes first; then the edges' bends (1 / px), and the disc's
            radius, px.
        fitted: (N, 14), filled: the model's eleven numbers, the root mean square of the remaining residuals, and the
            standard deviations of x and y for noise of 1 in each pixel; NaN where the centre of a disc is outside the
            picture.
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
    """Compute the normal equations of `detect.profiles` in each of N windows, by the numbers of its model.

    Args:
        distance, values: (N, K) of the pixels: distance along the normal, px, and grey levels. edges: (N, E) px.
        shapes: (N, 4) blur, smear, the lean of the smear, and c, px. heights: (N, E) of each step, or (0, E) if c is
            held.
        free: number of the logarithms of blur, stretch and smear that are unknowns besides.
        normals, rights: (N, P, P) and (N, P), filled: by b, g and each height, by c, and by these.
    """
    core().profile_equations(distance, values, edges, shapes, heights, free, normals, rights)


def shares_along(planes: Array32, weights: Array32, axes: Array32, least: float, shares: Array) -> None:
    """Compute the share of N strokes that run along either of two axes of a floor, into `shares` (B,); 0 where no more
    than `least` run along one of the axes.

    Args:
        planes: (3, N) normals of the strokes' planes, divided by the sine of their tolerance. weights: (N,), of sum 1.
        axes: (B, 2, 3) in the camera's frame.
    """
    core().shares_along(planes, weights, axes, least, shares)


def lines_near(
    plane: Array32, reduced: int, optics: Sequence[float], along: Array32, joined: Mask, feet: Array32, sums: Array
) -> None:
    """Compute the length (px) of lines that is near strokes, the length that is shown, and the share of their places in
    view, into `sums` (K, 3).

    Args:
        plane: (H, W) nearness, `reduced` times smaller than the picture. optics: bend and phi of an `Upright`, the
            length in px that is their unit, and the centre and size of the picture, px.
        along: (3, P) places on the lines, in the axes of the camera. joined: (P,) whether to the place before it.
        feet: (K, 3) positions of the camera, in the same axes.
    """
    core().lines_near(plane, reduced, np.array(optics, np.float32), along, joined, feet, sums)


# ---- the solve ------------------------------------------------------------------------------------------------------


def cholesky(normal: Array, upper: Array) -> None:
    """Compute U with U^T U = A from A's lower triangle; where A is singular, the row of U is zero."""
    core().cholesky(normal, upper)


def evaluate_block(
    optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss, at: Blocks,
    residuals: Array, jacobians: Blocks,
) -> bool:  # fmt: skip
    """Evaluate the block of one sight for Ceres (design, section 6). Returns False if an observation cannot be
    projected.

    Args:
        optics: `at.camera` replaces the free entries of its intrinsics. points, curves: of this sight only.
        at: the free intrinsics, and the 6-vectors of cam_from_world and world_from_target; its structure is already in
            the columns.
        residuals: (free + structure + 7,): the rows of U, then what is missing from the robust cost.
        jacobians: row-major, number of residuals x size of the block.
    """
    return bool(core().evaluate_block(optics, unknowns, points, curves, loss, at, residuals, jacobians))


def eliminate_placements(
    first: int, last: int, optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss,
    newton: bool, tolerance: float, change: Array, sweep: Sweep,
) -> None:  # fmt: skip
    """Solve for the poses of the sights first to last, and add up their normal equations of the free intrinsics.

    Args:
        newton: whether the equations include rho'', for a step, or only rho'.
        tolerance: share of a sight's cost that a step of its pose may still gain when it is left to the complement. If
            it is infinite, poses follow the change, and nothing else is done.
        change: (free + structure,) change of these since the poses and gains of `sweep` were made.
        sweep: poses, moved (unchanged where an observation cannot be projected), gains, renewed, costs, filled, and
            reduced, to which the complement is added.
    """
    core().eliminate_placements(
        first, last, optics, unknowns, points, curves, loss, newton, tolerance, change, sweep
    )  # fmt: skip


def sight_normals(
    first: int, last: int, optics: Optics, unknowns: Unknowns, points: PointColumns, curves: CurveColumns, loss: Loss,
    poses: Array, units: Array, normals: Array,
) -> bool:  # fmt: skip
    """Compute J^T W J of each of the sights first to last. Returns False if an observation cannot be projected.

    Args:
        poses: (S, 3, 4) [R t] of cam_from_frame.
        normals: (last - first, n, n) with n = free + structure + 7: free intrinsics, structure, left perturbation of
            the pose and residual, each multiplied by its entry of `units` (n,); observations have robust weights rho'.
    """
    costs = np.empty(last - first)
    core().sight_normals(first, last, optics, unknowns, points, curves, loss, False, poses, units, costs, normals)
    return bool(np.isfinite(costs).all())


# ---- correlated errors ----------------------------------------------------------------------------------------------


def strands_left(
    values: Array, bounds: Indices, group: Indices, rows: Array, shares: Array, logs: Array, left: Array
) -> int:
    """Compute sums over strands of observations with a share a of correlated variance: R = (1 - a) 1 + a K.

    Args:
        values: (D, M) eigenvalues of each shape's K. bounds: (D + 1,) where the strands of each shape begin.
        rows: (M, S, Z) along the eigenvectors: six of private placements, those of shared numbers, the residual.
        group: (S,) number of the private placement. shares: (A,).
        logs: (A,) to which the log determinants of all R and of the information on private placements are added.
        left: (A, Z - 6, Z - 6) sum of X^T R^-1 X without the columns of private placements, whose elimination is then
            subtracted from it.

    Returns:
        How many numbers were eliminated.
    """
    return int(core().strands_left(values, bounds, group, rows, shares, logs, left))
