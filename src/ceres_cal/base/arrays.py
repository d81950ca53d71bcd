"""Types of arrays for the whole package, medians and other statistics, numerical failures as errors, and inverses of
matrices that may be singular.

Shapes are stated in the docstrings.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from ceres_cal.base.errors import SolutionError

Array = NDArray[np.float64]
Array32 = NDArray[np.float32]
"""Grey pictures during processing, and maps of pixels."""
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
"""Row numbers, and where each of several runs of rows begins."""
Indices32 = NDArray[np.int32]
"""Row numbers in columns with a row for each observation, as in files and kernels."""
Codes = NDArray[np.int8]
"""Codes of a few cases: the side of a line, a reason."""
Image = NDArray[Any]
"""A photograph as read, of any bit depth."""
Image8 = NDArray[np.uint8]
AnyArray = NDArray[Any]
_Kind = TypeVar("_Kind", bound=np.generic)


# `np.median`, `np.quantile`, and `np.unique` unless it counts, import masked arrays when first called, which takes as
# long as a solve.


def distinct(values: NDArray[_Kind], axis: int | None = None) -> NDArray[_Kind]:
    """The distinct values of an array, ascending; or its distinct rows along an axis."""
    return np.asarray(np.unique(values, return_counts=True, axis=axis)[0])


def median(values: AnyArray) -> float:
    """Median of some numbers (N,); NaN where one of them is NaN, or there are none."""
    return float(medians(values))


def dots(a: Array, b: Array) -> Array:
    """(...) sums of products along the last axis of (..., N); for short axes in a tenth of the time of NumPy's sum."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def medians_known(values: Array) -> Array:
    """(...) medians along the last axis of (..., N) of the numbers that are not NaN; NaN where there are none."""
    ordered, count = np.sort(values, axis=-1), np.sum(~np.isnan(values), axis=-1, keepdims=True)
    middle = np.concatenate([np.maximum(count - 1, 0) // 2, count // 2], axis=-1)
    return np.asarray(np.mean(np.take_along_axis(ordered, middle, axis=-1), axis=-1))


def medians(values: AnyArray) -> Array:
    """(...) medians along the last axis of (..., N)."""
    count = values.shape[-1]
    if not count:
        return np.full(values.shape[:-1], np.nan)
    low, high, last = (count - 1) // 2, count // 2, count - 1
    ordered = np.partition(values, (low, high, last), axis=-1)  # NaN is sorted last
    largest = ordered[..., last]
    return np.asarray(np.where(np.isnan(largest), largest, 0.5 * (ordered[..., low] + ordered[..., high])))


def quantile(values: AnyArray, share: float) -> float:
    """Quantile of some numbers (N,), none of them NaN, with linear interpolation between two of them."""
    last = len(values) - 1
    if last < 0:
        return np.nan
    low, high = int(share * last), min(int(share * last) + 1, last)
    first, second = np.partition(values, (low, high))[[low, high]]
    part = share * last - low
    return float(first + part * (second - first) if part < 0.5 else second - (1.0 - part) * (second - first))


def rms(values: Array, nothing: float = np.nan) -> float:
    """Root mean square of the values that are not NaN; `nothing` where there are none."""
    known = values[~np.isnan(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else nothing


def largest(values: Array, nothing: float = np.nan) -> float:
    """The largest of the values that are not NaN; `nothing` where there are none."""
    known = values[~np.isnan(values)]
    return float(np.max(known)) if len(known) else nothing


def rms_and_largest(off: Array) -> tuple[float, float]:
    """Root mean square and maximum of lengths; infinite where one is not finite, or there are none."""
    off = np.where(np.isfinite(off), off, np.inf)
    return rms(off, np.inf), largest(off, np.inf)


def grid_places(x: Array, y: Array) -> Array:
    """(Y * X, 2) all places of a grid with x (X,) and y (Y,), row by row."""
    return np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x))])


def is_diagonal(matrix: Array) -> bool:
    """Whether all elements of a matrix (n, n) off the diagonal are 0."""
    return bool(np.count_nonzero(matrix) == np.count_nonzero(np.diagonal(matrix)))


def eigh(matrix: Array) -> tuple[Array, Array]:
    """Return eigenvalues (..., n), in rising order, and vectors (..., n, n) of symmetric matrices (..., n, n).

    LAPACK's `dsyevd` may not converge where eigenvalues repeat, as with many frames from one pose (numpy issues 6002
    and 12738); then singular values of the matrix give them, moved such that none is negative.
    """
    try:
        values, vectors = np.linalg.eigh(matrix)
    except np.linalg.LinAlgError:  # quiet: the values are found otherwise, or this raises the same
        most = float(np.max(np.linalg.norm(matrix, axis=(-2, -1))))
        turned, sizes, _ = np.linalg.svd(matrix + most * np.eye(matrix.shape[-1]))
        return np.asarray(sizes[..., ::-1] - most), np.asarray(turned[..., ::-1])
    return np.asarray(values), np.asarray(vectors)


def numbers_of(names: Iterable[Hashable], known: Iterable[Hashable] | None = None) -> Indices:
    """Index of each name among the known names; without these, among the names in order of first appearance."""
    every = list(names)
    order = {name: number for number, name in enumerate(dict.fromkeys(every) if known is None else known)}
    return np.array([order[name] for name in every], dtype=np.int64)


def evenly(count: int, most: int) -> Indices:
    """At most `most` evenly spaced numbers from 0 to count - 1, including both ends."""
    return np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64)


@contextmanager
def numerical(step: str) -> Iterator[None]:
    """Context and decorator in which a numerical failure becomes a SolutionError that names the step.

    NumPy's own warnings are silenced, since a user could not act on them: a NaN or an infinity is judged in the result
    (a failed factorisation here, a failed solve, an unknown number), not where it first appears.
    """
    with np.errstate(all="ignore"):
        try:
            yield
        except (np.linalg.LinAlgError, ArithmeticError) as error:
            raise SolutionError(
                f"{step} failed numerically ({error}): check pixels, sigmas, labels and target dimensions"
            ) from error


# ---- covariances where some directions may be unknown ---------------------------------------------------------------


# A covariance does not exist where nothing is known. Here the finite part and the unknown directions are kept apart: a
# number that does not depend on an unknown direction keeps its finite sigma, and one that does gets infinity. It never
# gets 0, nor a large number that is only rounding.

NOTHING = 2e-14
"""Eigenvalue of an information matrix with unit diagonal below which a direction counts as unknown. Rounding reaches
1e-15 for each ten numbers, and a sigma millions of times larger than each number would have alone counts as infinite.
"""


def _nothing(count: int) -> float:
    return NOTHING * max(1.0, count / 10.0)


def _scaled(information: Array, limits: Array) -> tuple[Array, Array]:
    """Return the scale (..., n) that makes the diagonal one, and the information (..., n, n) scaled by it."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    known = diagonal > limits**-2.0
    scale = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 1.0)
    # A number that is not known at all has rounding on its diagonal, which must not be scaled up.
    information = np.where(known[..., :, None] & known[..., None, :], information, 0.0)
    return scale, information * scale[..., :, None] * scale[..., None, :]


def known_inverses(information: Array, limits: Array) -> Array:
    """Inverses (..., n, n) of information matrices over what is known; unknown directions are left out.

    Args:
        limits: (n,) or (..., n), see `Spread.of`.
    """
    scale, scaled = _scaled(information, limits)
    inverse = _regular_inverses(scaled)
    if inverse is not None:
        return np.asarray(inverse * scale[..., :, None] * scale[..., None, :])
    values, vectors = eigh(scaled)
    known = values > _nothing(values.shape[-1])
    kept = np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)
    half = vectors * np.sqrt(kept)[..., None, :] * scale[..., :, None]
    return np.asarray(half @ np.swapaxes(half, -1, -2))


def are_known(information: Array, limits: Array) -> bool:
    """Whether no direction is unknown in any of many matrices (S, n, n), by a fast test; False where that cannot
    decide.
    """
    return _regular_inverses(_scaled(information, limits)[1]) is not None


def _regular_inverses(scaled: Array) -> Array | None:
    """Plain inverses, which are ten times as fast; None where a direction of any matrix is nearly unknown."""
    inverse = _unless_singular(inverse_of, scaled)
    if inverse is None:
        return None
    sizes = np.diagonal(inverse, axis1=-2, axis2=-1)  # at least 1 for a unit diagonal, except for rounding
    most = 1e8  # inverse of an eigenvalue that is nearly unknown; plain inverses are accurate to 1e-7 there
    regular = np.all(sizes > 0.5) and np.all(sizes.sum(axis=-1) < most)
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, -1, -2))) if regular else None


_AT_ONCE = 48  # number of rows up to which LAPACK's own inverse is faster than one by halves


def inverse_of(matrix: Array) -> Array:
    """Inverses (..., n, n) of symmetric matrices with positive eigenvalues."""
    if matrix.shape[-1] <= _AT_ONCE:
        return np.asarray(np.linalg.inv(matrix))
    root = inverse_root_of(matrix)
    return np.asarray(np.swapaxes(root, -1, -2) @ root)


def inverse_root_of(matrix: Array) -> Array:
    """Lower triangles W (..., n, n) for which W^T W are the inverses, in a third of the time of LAPACK's inverse."""
    if matrix.shape[-1] <= _AT_ONCE:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(matrix)))
    root, half = np.zeros_like(matrix), matrix.shape[-1] // 2
    first, last = slice(half), slice(half, None)
    root[..., first, first] = upper = inverse_root_of(matrix[..., first, first])
    along = matrix[..., last, first] @ np.swapaxes(upper, -1, -2)
    root[..., last, last] = lower = inverse_root_of(matrix[..., last, last] - along @ np.swapaxes(along, -1, -2))
    root[..., last, first] = -lower @ (along @ upper)
    return root


def ridged_root_of(matrix: Array, ridge: float) -> Array:
    """(n, n) root W for which W^T W is the inverse of a matrix plus `ridge` times the unit matrix; the matrix is
    symmetric and positive semidefinite except for rounding.
    """
    lower = _unless_singular(inverse_root_of, matrix + ridge * np.eye(len(matrix)))
    if lower is not None:
        return lower
    values, vectors = eigh(matrix)
    return np.asarray((vectors / np.sqrt(np.maximum(values, 0.0) + ridge)).T)


def root_of(matrix: Array) -> Array:
    """(n, n) root with root^T root = matrix; the matrix is symmetric and positive semidefinite except for rounding."""
    lower = _unless_singular(np.linalg.cholesky, matrix)
    if lower is not None:  # takes a tenth of the time
        return lower.T
    values, vectors = eigh(matrix)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)


def _unless_singular(function: Callable[[Any], Any], matrix: Array) -> Array | None:
    try:
        return np.asarray(function(matrix))
    except np.linalg.LinAlgError:  # quiet: eigenvalues are asked instead, and a direction that is unknown stays so
        return None


def without(here: Array, coupling: Array, others: Array, limits: Array) -> Array:
    """(n, n) information about some numbers with the others integrated out: the Schur complement.

    Args:
        here: (n, n) information about them.
        coupling: (m, n) between the others and them.
        others: (m, m) information about the others. limits: (m,) of the others, see `Spread.of`.
    """
    residue = 1e-11  # what the difference below leaves of an unknown direction, relative to the input
    told = np.flatnonzero(np.diagonal(here) > 0.0)  # nothing is known of the rest
    own, coupling = here[np.ix_(told, told)], coupling[:, told]
    size, scaled = _scaled(others, limits)
    inverse = _regular_inverses(scaled)
    if inverse is None:
        root = _root_without(own, coupling, others, limits)
    else:
        left = own - coupling.T @ (inverse * size[:, None] * size) @ coupling
        scale = np.sqrt(np.diagonal(own))
        values, vectors = eigh(0.5 * (left + left.T) / scale[:, None] / scale)
        root = vectors * np.sqrt(np.where(values > residue, values, 0.0)) * scale[:, None]  # the rest is rounding
    whole = np.zeros_like(here)
    whole[np.ix_(told, told)] = root @ root.T
    return whole


def _root_without(here: Array, coupling: Array, others: Array, limits: Array) -> Array:
    """(n, R) root of the Schur complement: of a root of the whole matrix, with the rows of the others projected out.

    Where a direction of the others is nearly unknown, the difference of the matrices themselves is mostly rounding: of
    a rig with an undetermined camera, another camera's height seemed known to 0.05 m instead of 0.46 m.
    """
    count = len(here)
    whole = np.block([[here, coupling.T], [coupling, others]])
    scale, scaled = _scaled(whole, np.concatenate([np.full(count, np.inf), limits]))
    values, vectors = eigh(scaled)
    root = vectors * np.sqrt(np.where(values > _nothing(len(values)), values, 0.0))
    _, sizes, along = np.linalg.svd(root[count:], full_matrices=False)
    along = along[sizes**2 > _nothing(len(values))]
    return np.asarray((root[:count] - root[:count] @ along.T @ along) / scale[:count, None])


def thin_root(information: Array, sd: Array) -> Array:
    """(R, n) root with root^T root = information (n, n), except for negligible parts: a Cholesky factor whose rows are
    in descending order of information about numbers that have standard deviations `sd` (n,).
    """
    negligible = 1e-9  # relative to the information that sd (n,) implies
    left, rows, variances = np.diagonal(information).copy(), np.empty((len(sd), len(sd))), sd**2
    for count in range(len(sd)):
        most = int(np.argmax(left * variances))
        if left[most] * variances[most] <= negligible:
            return rows[:count]
        rows[count] = (information[most] - rows[:count, most] @ rows[:count]) / np.sqrt(left[most])
        left -= rows[count] ** 2
    return rows


class Spread(Struct, frozen=True, eq=False):
    """Covariance of n numbers, of which some directions may be unknown.

    Attributes:
        covariance: (n, n) finite; of the numbers with their unknown directions held.
        unknown: (n, k) directions about which nothing is known, in units of `scale`.
        scale: (n,) sigma of each number if all the others were known.
    """

    covariance: Array
    unknown: Array
    scale: Array

    @classmethod
    def of(cls, information: Array, limits: Array) -> Spread:
        """Make the spread of an information matrix (n, n), which is symmetric and may be singular.

        Args:
            limits: (n,) largest sigmas: a number whose sigma would be larger even if all others were known is unknown.
        """
        scale, scaled = _scaled(np.asarray(information, dtype=float), limits)
        # A file holds the lower triangle only, so that only this is used: results agree to the last digit.
        inverse = _regular_inverses(np.tril(scaled) + np.tril(scaled, -1).T)
        if inverse is not None:
            return cls(inverse * scale[:, None] * scale, np.empty((len(scale), 0)), scale)
        values, vectors = eigh(scaled)
        lost = values <= _nothing(len(values))
        half = vectors[:, ~lost] / np.sqrt(values[~lost]) * scale[:, None]
        return cls(half @ half.T, vectors[:, lost] * scale[:, None], scale)

    def depends(self, jacobian: Array) -> Mask:
        """(..., m) whether functions with derivatives (..., m, n) depend on an unknown direction."""
        if not self.unknown.shape[1]:
            return np.zeros(jacobian.shape[:-1], dtype=bool)
        size = np.linalg.norm(jacobian * self.scale, axis=-1)
        # A dependence below the root adds at most the sigma that the function has if all else is known.
        return np.asarray(np.linalg.norm(jacobian @ self.unknown, axis=-1) > np.sqrt(_nothing(len(self.scale))) * size)

    def through(self, jacobian: Array) -> Array:
        """Covariances (..., m, m) of functions with derivatives (..., m, n). Functions that depend on an unknown
        direction have infinite variance, and NaN as their covariance with others.
        """
        # One product of matrices: many products of a few rows each take up to four times as long.
        along = np.tensordot(jacobian, self.covariance, axes=1)
        return self._marked(along @ np.swapaxes(jacobian, -1, -2), self.depends(jacobian))

    @staticmethod
    def _marked(covariances: Array, lost: Mask) -> Array:
        """Covariances (..., m, m) with infinity and NaN where functions (..., m) depend on an unknown direction."""
        if np.any(lost):
            variances = np.where(lost, np.inf, np.diagonal(covariances, axis1=-2, axis2=-1))
            covariances = np.where(np.logical_or(lost[..., :, None], lost[..., None, :]), np.nan, covariances)
            diagonal = np.arange(covariances.shape[-1])
            covariances[..., diagonal, diagonal] = variances
        return np.asarray(covariances)

    @property
    def matrix(self) -> Array:
        """(n, n) covariance of the numbers themselves, with infinity and NaN as in `through`."""
        return self._marked(self.covariance, self.depends(np.eye(len(self.scale))))

    @property
    def sd(self) -> Array:
        """(n,) standard deviations, infinite where a number depends on an unknown direction."""
        return np.asarray(np.sqrt(np.diagonal(self.matrix)))
