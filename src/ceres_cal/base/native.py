"""What native libraries do to the process that loads them, and how long they may keep it."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

_T = TypeVar("_T")
_unfinished: list[threading.Thread] = []


@contextmanager
def kept_signals() -> Iterator[None]:
    """While a library is loaded that takes SIGTERM (glog prints a stack and aborts): who had the signal keeps it."""
    yield
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


def keep_freed_memory() -> None:
    """From now on freed memory stays at hand for what comes next, 64 MiB of it, where the C library is glibc.

    It does by itself, but not where a process was told otherwise, as Dask's workers are: there each array is had from
    the system anew, which is a third of the time of sums over many rows.
    """
    # Of glibc's mallopt: what it comes to by itself, at most, once a process has freed something large.
    trim, mapped = (-1, 1 << 26), (-3, 1 << 25)
    import ctypes

    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        library.mallopt(*trim)
        library.mallopt(*mapped)


def interruptibly(function: Callable[[], _T], timeout_s: float | None = None) -> _T:
    """What a function returns whose native work would hold back Ctrl-C until it is done.

    It works in a thread of its own, which is left to itself when this one is interrupted or has waited long enough.

    Raises:
        TimeoutError: it takes longer than `timeout_s`.
    """
    look_s = 0.05  # how often Python looks up from native work, for Ctrl-C
    results: list[tuple[Any, BaseException | None]] = []

    def work() -> None:
        try:
            results.append((function(), None))
        except BaseException as error:  # quiet: raised again in the thread that waits
            results.append((None, error))

    thread = threading.Thread(target=work, daemon=True)
    _unfinished.append(thread)
    thread.start()
    end = None if timeout_s is None else time.monotonic() + timeout_s
    while thread.is_alive():
        if end is not None and time.monotonic() > end:
            raise TimeoutError
        thread.join(look_s)
    _unfinished.remove(thread)
    result, error = results[0]
    if error is not None:
        raise error
    return result  # type: ignore[no-any-return]


def is_busy() -> bool:
    """Whether native work was left to itself: a process then ends at once, not when that is done, or by an abort of a
    library whose threads were still at it.
    """
    return bool(_unfinished)
