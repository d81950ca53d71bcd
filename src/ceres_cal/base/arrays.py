"""Arrays by the kind of their numbers, once for the whole package; what numbers make of a step that fails.

Shapes stand in the docstrings.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import numpy as np
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


# `np.median`, and `np.unique` unless it counts, import masked arrays when first called, which takes as long as a solve.


def distinct(values: NDArray[_Kind], axis: int | None = None) -> NDArray[_Kind]:
    """The different values in an array, in order; or the different rows along an axis."""
    return np.asarray(np.unique(values, return_counts=True, axis=axis)[0])


def median(values: Array) -> float:
    """The middle of some numbers (N,), or between the two in the middle; NaN where one of them is, or none is there."""
    return float(medians(values))


def medians_known(values: Array) -> Array:
    """(...) those of the numbers along the last axis of (..., N) that are not NaN; NaN where none is there."""
    ordered, count = np.sort(values, axis=-1), np.sum(~np.isnan(values), axis=-1, keepdims=True)
    middle = np.concatenate([np.maximum(count - 1, 0) // 2, count // 2], axis=-1)
    return np.asarray(np.mean(np.take_along_axis(ordered, middle, axis=-1), axis=-1))


def medians(values: Array) -> Array:
    """(...) those of the numbers along the last axis of (..., N)."""
    count = values.shape[-1]
    if not count:
        return np.full(values.shape[:-1], np.nan)
    low, high, last = (count - 1) // 2, count // 2, count - 1
    ordered = np.partition(values, (low, high, last), axis=-1)  # NaN is the last
    largest = ordered[..., last]
    return np.asarray(np.where(np.isnan(largest), largest, 0.5 * (ordered[..., low] + ordered[..., high])))


def rms(values: Array, nothing: float = np.nan) -> float:
    """Root mean square of the values that are not NaN; `nothing` where there are none."""
    known = values[~np.isnan(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else nothing


def numbers_of(names: Iterable[Hashable], known: Iterable[Hashable]) -> Indices:
    """Which of the known names each one is."""
    order = {name: number for number, name in enumerate(known)}
    return np.array([order[name] for name in names], dtype=np.int64)


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
