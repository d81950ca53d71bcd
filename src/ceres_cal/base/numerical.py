"""Numerical failure as an error of ours: numbers that a factorisation, a division or a power can make nothing of."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from ceres_cal.base.errors import SolutionError


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
