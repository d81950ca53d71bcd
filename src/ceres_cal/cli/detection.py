"""Detection on the command line: Ctrl-C ends it at once, and it takes no longer than was allowed."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from ceres_cal.base.errors import InputError
from ceres_cal.base.native import interruptibly

_T = TypeVar("_T")


def detected(timeout: float | None, detect: Callable[[], _T]) -> _T:
    """What `detect` returns; InputError where it takes longer than --timeout."""
    if timeout is not None and not timeout > 0.0:
        raise InputError(f"--timeout must be above 0 seconds, not {timeout:g}")
    try:
        return interruptibly(detect, timeout)
    except TimeoutError:
        raise InputError(
            f"--timeout: not done after {timeout:g} s, nothing was written: give fewer images, or more time"
        ) from None
