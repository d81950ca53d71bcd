"""Detection on the command line: Ctrl-C ends it at once, and it takes no longer than was allowed."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable
from typing import TypeVar

from ceres_cal.base.errors import InputError
from ceres_cal.base.native import interruptibly

_T = TypeVar("_T")


def detected(args: Namespace, detect: Callable[[], _T]) -> _T:
    """What `detect` returns; InputError where it takes longer than --timeout."""
    if args.timeout is not None and not args.timeout > 0.0:
        raise InputError(f"--timeout must be above 0 seconds, not {args.timeout:g}")
    try:
        return interruptibly(detect, args.timeout)
    except TimeoutError:
        raise InputError(
            f"--timeout: not done after {args.timeout:g} s, nothing was written: give fewer images, or more time"
        ) from None
