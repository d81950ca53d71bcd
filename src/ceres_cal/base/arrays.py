"""Arrays by the kind of their numbers, once for the whole package; what numbers make of a step that fails; inverses of
matrices that may be singular.

Shapes stand in the docstrings.
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
"""Grey pictures at work, and maps of pixels."""
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]
"""Row numbers, and where each of several runs of rows begins."""
Indices32 = NDArray[np.int32]
"""The same in columns with a row for each observation, as files and kernels have them."""
Codes = NDArray[np.int8]
"""One of a few cases: the side of a line, a reason."""
Image = NDArray[Any]
"""A photograph as read, of any depth."""
Image8 = NDArray[np.uint8]
AnyArray = NDArray[Any]
_Kind = TypeVar("_Kind", bound=np.generic)


# `np.median`, `np.quantile`, and `np.unique` unless it counts, import masked arrays when first called, which takes as
# long as a solve.


def distinct(values: NDArray[_Kind], axis: int | None = None) -> NDArray[_Kind]:
    """The different values in an array, in order; or the different rows along an axis."""
    return np.asarray(np.unique(values, return_counts=True, axis=axis)[0])


def median(values: AnyArray) -> float:
    """The middle of some numbers (N,), or between the two in the middle; NaN where one of them is, or none is there."""
    return float(medians(values))


def dots(a: Array, b: Array) -> Array:
    """(...) sums of products along the last axis of (..., N): of few numbers in a tenth of the time of NumPy's sum."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def medians_known(values: Array) -> Array:
    """(...) those of the numbers along the last axis of (..., N) that are not NaN; NaN where none is there."""
    ordered, count = np.sort(values, axis=-1), np.sum(~np.isnan(values), axis=-1, keepdims=True)
    middle = np.concatenate([np.maximum(count - 1, 0) // 2, count // 2], axis=-1)
    return np.asarray(np.mean(np.take_along_axis(ordered, middle, axis=-1), axis=-1))


def medians(values: AnyArray) -> Array:
    """(...) those of the numbers along the last axis of (..., N)."""
    count = values.shape[-1]
    if not count:
        return np.full(values.shape[:-1], np.nan)
    low, high, last = (count - 1) // 2, count // 2, count - 1
    ordered = np.partition(values, (low, high, last), axis=-1)  # NaN is the last
    largest = ordered[..., last]
    return np.asarray(np.where(np.isnan(largest), largest, 0.5 * (ordered[..., low] + ordered[..., high])))


def quantile(values: AnyArray, share: float) -> float:
    """What a share of some numbers (N,), none of them NaN, are below: between two of them in proportion."""
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
    """Of lengths; infinite where one is unknown, or none is there."""
    off = np.where(np.isfinite(off), off, np.inf)
    return rms(off, np.inf), largest(off, np.inf)


def grid_places(x: Array, y: Array) -> Array:
    """(Y * X, 2) all places of a grid x (X,), y (Y,), row by row."""
    return np.column_stack([np.tile(x, len(y)), np.repeat(y, len(x))])


def is_diagonal(matrix: Array) -> bool:
    """Whether all but the diagonal of a matrix (n, n) is nought."""
    return bool(np.count_nonzero(matrix) == np.count_nonzero(np.diagonal(matrix)))


def numbers_of(names: Iterable[Hashable], known: Iterable[Hashable] | None = None) -> Indices:
    """Which of the known names each one is; without these, of their own in the order in which they appear."""
    every = list(names)
    order = {name: number for number, name in enumerate(dict.fromkeys(every) if known is None else known)}
    return np.array([order[name] for name in every], dtype=np.int64)


def evenly(count: int, most: int) -> Indices:
    """At most so many of `count` numbers from 0 on, that lie evenly, both ends among them."""
    return np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(np.int64)


@contextmanager
def numerical(step: str) -> Iterator[None]:
    """While it lasts, and as a decorator: what fails on its numbers is a SolutionError that names the step.

    NumPy's own warnings say nothing that a user could act on: what comes of a NaN or an infinity is judged where the
    answer is (a failed factorisation here, a failed solve, an unknown number), not where it first appears.
    """
    with np.errstate(all="ignore"):
        try:
            yield
        except (np.linalg.LinAlgError, ArithmeticError) as error:
            raise SolutionError(
                f"{step} failed numerically ({error}): check pixels, sigmas, labels and target dimensions"
            ) from error


# ---- covariances where some directions may be unknown ---------------------------------------------------------------


# A covariance does not exist where nothing is known. Here the finite part and the unknown directions are kept apart, so
# that a number which does not depend on an unknown direction keeps its honest, finite sigma and one which does gets
# infinity: never 0, never a large number that is rounding alone.

NOTHING = 2e-14
"""Eigenvalue of an information matrix with unit diagonal below which a direction counts as unknown: rounding reaches
1e-15 for each ten numbers, and a sigma millions of times larger than what each number would have alone is infinite."""


def _nothing(count: int) -> float:
    return NOTHING * max(1.0, count / 10.0)


def _scaled(information: Array, limits: Array) -> tuple[Array, Array]:
    """Scale (..., n) that makes the diagonal one, and the information (..., n, n) in it."""
    diagonal = np.diagonal(information, axis1=-2, axis2=-1)
    known = diagonal > limits**-2.0
    scale = np.where(known, 1.0 / np.sqrt(np.where(known, diagonal, 1.0)), 1.0)
    # What is not known at all has rounding on its diagonal, which must not be scaled up.
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
    values, vectors = np.linalg.eigh(scaled)
    known = values > _nothing(values.shape[-1])
    kept = np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)
    half = vectors * np.sqrt(kept)[..., None, :] * scale[..., :, None]
    return np.asarray(half @ np.swapaxes(half, -1, -2))


def are_known(information: Array, limits: Array) -> bool:
    """Whether nothing is unknown in any of many matrices (S, n, n), at a glance; False where it takes a closer look."""
    return _regular_inverses(_scaled(information, limits)[1]) is not None


def _regular_inverses(scaled: Array) -> Array | None:
    """Their plain inverses, ten times as fast, where no direction of any of them comes near to being unknown."""
    inverse = _unless_singular(inverse_of, scaled)
    if inverse is None:
        return None
    sizes = np.diagonal(inverse, axis1=-2, axis2=-1)  # of ones on the diagonal no less than one; else it is rounding
    most = 1e8  # the inverse of an eigenvalue near to being unknown; plain inverses are good to 1e-7 there
    regular = np.all(sizes > 0.5) and np.all(sizes.sum(axis=-1) < most)
    return np.asarray(0.5 * (inverse + np.swapaxes(inverse, -1, -2))) if regular else None


_AT_ONCE = 48  # rows of a matrix up to which LAPACK's own inverse takes less time than one by halves


def inverse_of(matrix: Array) -> Array:
    """The inverse (..., n, n) of symmetric matrices whose eigenvalues are positive."""
    if matrix.shape[-1] <= _AT_ONCE:
        return np.asarray(np.linalg.inv(matrix))
    root = inverse_root_of(matrix)
    return np.asarray(np.swapaxes(root, -1, -2) @ root)


def inverse_root_of(matrix: Array) -> Array:
    """Lower triangles W (..., n, n); W^T W are these inverses. Takes a third of the time of LAPACK's inverse."""
    if matrix.shape[-1] <= _AT_ONCE:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(matrix)))
    root, half = np.zeros_like(matrix), matrix.shape[-1] // 2
    first, last = slice(half), slice(half, None)
    root[..., first, first] = upper = inverse_root_of(matrix[..., first, first])
    along = matrix[..., last, first] @ np.swapaxes(upper, -1, -2)
    root[..., last, last] = lower = inverse_root_of(matrix[..., last, last] - along @ np.swapaxes(along, -1, -2))
    root[..., last, first] = -lower @ (along @ upper)
    return root


def root_of(matrix: Array) -> Array:
    """(n, n) root with root^T root = matrix, which is symmetric and has no negative eigenvalue but by rounding."""
    lower = _unless_singular(np.linalg.cholesky, matrix)
    if lower is not None:  # in a tenth of the time
        return lower.T
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T)


def _unless_singular(function: Callable[[Any], Any], matrix: Array) -> Array | None:
    try:
        return np.asarray(function(matrix))
    except np.linalg.LinAlgError:  # quiet: eigenvalues are asked instead, and a direction that is unknown stays so
        return None


def without(here: Array, coupling: Array, others: Array, limits: Array) -> Array:
    """(n, n) information about some numbers, the others integrated out: the Schur complement of the whole.

    Args:
        here: (n, n). coupling: (m, n). others: (m, m), their limits (m,) see `Spread.of`.
    """
    residue = 1e-11  # what a Schur complement leaves of a direction that is unknown, relative to what went in
    told = np.flatnonzero(np.diagonal(here) > 0.0)  # of the others nothing is known
    coupling = coupling[:, told]
    left = here[np.ix_(told, told)] - coupling.T @ known_inverses(others, limits) @ coupling
    scale = np.sqrt(np.diagonal(here)[told])
    values, vectors = np.linalg.eigh(0.5 * (left + left.T) / scale[:, None] / scale)
    root = vectors * np.sqrt(np.where(values > residue, values, 0.0)) * scale[:, None]  # the rest is rounding
    whole = np.zeros_like(here)
    whole[np.ix_(told, told)] = root @ root.T
    return whole


def thin_root(information: Array, sd: Array) -> Array:
    """(R, n) with root^T root = information (n, n), but for what tells next to nothing of numbers that are known to sd
    (n,): a Cholesky factor, the row that tells most first.
    """
    negligible = 1e-9  # of what is known of a number
    left, rows, variances = np.diagonal(information).copy(), np.empty((len(sd), len(sd))), sd**2
    for count in range(len(sd)):
        most = int(np.argmax(left * variances))
        if left[most] * variances[most] <= negligible:
            return rows[:count]
        rows[count] = (information[most] - rows[:count, most] @ rows[:count]) / np.sqrt(left[most])
        left -= rows[count] ** 2
    return rows


class Spread(Struct, frozen=True, eq=False):
    """What is known of n numbers.

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
        """Of an information matrix (n, n), symmetric, not necessarily of full rank.

        Args:
            limits: (n,) a number whose sigma would be larger even if all others were known is not known at all.
        """
        scale, scaled = _scaled(np.asarray(information, dtype=float), limits)
        # A file has the lower triangle, and says the same to the last digit.
        inverse = _regular_inverses(np.tril(scaled) + np.tril(scaled, -1).T)
        if inverse is not None:
            return cls(inverse * scale[:, None] * scale, np.empty((len(scale), 0)), scale)
        values, vectors = np.linalg.eigh(scaled)
        lost = values <= _nothing(len(values))
        half = vectors[:, ~lost] / np.sqrt(values[~lost]) * scale[:, None]
        return cls(half @ half.T, vectors[:, lost] * scale[:, None], scale)

    def depends(self, jacobian: Array) -> Mask:
        """(..., m) whether functions with derivatives (..., m, n) depend on an unknown direction."""
        if not self.unknown.shape[1]:
            return np.zeros(jacobian.shape[:-1], dtype=bool)
        size = np.linalg.norm(jacobian * self.scale, axis=-1)
        # What leaks through below the root adds no more than the sigma that the function has with all else known.
        return np.asarray(np.linalg.norm(jacobian @ self.unknown, axis=-1) > np.sqrt(_nothing(len(self.scale))) * size)

    def through(self, jacobian: Array) -> Array:
        """Covariances (..., m, m) of functions with derivatives (..., m, n); infinite variance where they depend on an
        unknown direction, NaN as their covariance with others.
        """
        # In one product of matrices: many of a few rows each take up to four times as long.
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
        """(n, n) covariance of the numbers themselves, with infinity and NaN as `through` gives them."""
        return self._marked(self.covariance, self.depends(np.eye(len(self.scale))))

    @property
    def sd(self) -> Array:
        """(n,) standard deviations, infinite where a number depends on an unknown direction."""
        return np.asarray(np.sqrt(np.diagonal(self.matrix)))
