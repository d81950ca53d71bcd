"""Work in parts, one per thread where that saves time, since the kernels release Python's lock (design, section 3).
Also what native libraries do to the process that loads them, and how long they may block it.
"""

from __future__ import annotations

import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar, copy_context
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

from ceres_cal.base.errors import InputError

if TYPE_CHECKING:
    from concurrent.futures import Future, ThreadPoolExecutor

    from threadpoolctl import ThreadpoolController


_allowed: ContextVar[int] = ContextVar("allowed", default=0)
_T = TypeVar("_T")
_Item = TypeVar("_Item")


@cache
def _pool() -> ThreadPoolExecutor:
    """Thread pool for the parts that the caller's own thread does not process."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(thread_name_prefix="ceres_cal")


os.register_at_fork(after_in_child=_pool.cache_clear)  # a forked child has the pool, but none of its threads


@cache
def _cores() -> int:
    most = 8
    return min(os.cpu_count() or 1, most)


@cache
def _controller() -> ThreadpoolController:
    import numpy as np  # noqa: F401 its BLAS is what the controller looks for
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def at_most(threads: int) -> Iterator[None]:
    """Context in which this thread's work is split into at most so many parts; 0 does not change the limit."""
    token = _allowed.set(threads or _allowed.get())
    try:
        yield
    finally:
        _allowed.reset(token)


def share_cores(processes: int) -> None:
    """Limit this thread to its share of the cores from now on, and leave Ctrl-C to the parent process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _allowed.set(max(_cores() // processes, 1))


@contextmanager
def for_small_matrices() -> Iterator[None]:
    """Context in which BLAS uses only the calling thread, for the whole process, and freed memory is kept.

    OpenBLAS's other threads do not speed up matrices as small as these, but spin for milliseconds after each call on
    the cores that the package's own parts need.
    """
    _keep_freed_memory()
    has_none = os.environ.get("OPENBLAS_NUM_THREADS") == "1"  # set by the commands; finding BLAS takes 3 ms
    with nullcontext() if has_none else _controller().limit(limits=1, user_api="blas"):
        yield


def available() -> int:
    """Number of threads that may be used."""
    return _allowed.get() or _cores()


def parts_of(items: int, rows: int, row_ns: float) -> list[int]:
    """Return where each part of `items` items begins, and where the last one ends.

    Args:
        rows: number of rows in all items. row_ns: approximate time for a row, ns.
    """
    later_us = 100.0  # delay with which another thread begins
    worth_us = 400.0  # least work in a part: with half of it a thread saves no elapsed time and costs a tenth more
    work_us = 1e-3 * row_ns * rows
    count = max(1, min(available(), int(work_us / worth_us)))
    ahead = items * later_us / work_us if count > 1 else 0.0
    return [0, *(int(ahead + (items - ahead) * number / count) for number in range(1, count)), items]


def meanwhile(function: Callable[[], _T]) -> Future[_T]:
    """Call a function in another thread from now on; return the future of its result."""
    return _pool().submit(function)


def run_parts(function: Callable[[int, int], _T], parts: Sequence[int]) -> list[_T]:
    """Return function(first, last) for every part; the parts run concurrently."""
    others = [_pool().submit(function, *parts[i : i + 2]) for i in range(1, len(parts) - 1)]
    return [function(*parts[:2]), *(other.result() for other in others)]


def in_turn(function: Callable[[_Item], _T], items: Iterable[_Item]) -> Iterator[_T]:
    """Yield function(item) for each item, in order; as many run concurrently as threads are available, and a few items
    ahead.
    """
    most = available()
    if most == 1:
        yield from map(function, items)
        return
    from concurrent.futures import ThreadPoolExecutor

    waiting: deque[Future[_T]] = deque()
    own = ThreadPoolExecutor(most, thread_name_prefix="ceres_cal")
    try:
        for item in items:
            waiting.append(own.submit(function, item))
            if len(waiting) > 2 * most:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:  # work in progress that is no longer wanted is not waited for
        own.shutdown(wait=False, cancel_futures=True)


_unfinished: list[threading.Thread] = []


@contextmanager
def kept_signals() -> Iterator[None]:
    """Restore the handler of SIGTERM after loading a library that replaces it (glog prints a stack and aborts)."""
    yield
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


@cache
def _keep_freed_memory() -> None:
    """Make glibc's allocator keep up to 64 MiB of freed memory for reuse from now on; no effect with other C libraries.

    Otherwise arrays are allocated by the system again and again: that takes a third of the time of sums over many rows
    in Dask's workers, and an eighth of the calibration of a thousand frames.
    """
    trim, mapped = (-1, 1 << 26), (-3, 1 << 25)  # parameters and values of glibc's mallopt
    import ctypes

    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        library.mallopt(*trim)
        library.mallopt(*mapped)


class _DetachedThread(threading.Thread):
    """Thread that may be abandoned by the one that waits for it.

    Attributes:
        is_left: whether it was abandoned, so that it must write no file.
        is_writing: whether it is writing a file, which is completed.
    """

    is_left = is_writing = False


@contextmanager
def writing() -> Iterator[None]:
    """Context for writing a file; InputError if the thread was abandoned."""
    thread = threading.current_thread()
    if not isinstance(thread, _DetachedThread):
        yield
        return
    thread.is_writing = True  # set before is_left is read: the abandoning thread sets that before it waits
    try:
        if thread.is_left:
            raise InputError("interrupted: not written")
        yield
    finally:
        thread.is_writing = False


def interruptibly(function: Callable[[], _T], timeout_s: float | None = None) -> _T:
    """Call a function with native work that would otherwise delay Ctrl-C until it is done; return its result.

    It runs in a thread of its own, which is abandoned when this one is interrupted or has waited long enough. A file
    that it is writing at that moment is completed first; it writes no other.

    Raises:
        TimeoutError: it takes longer than `timeout_s`.
    """
    look_s = 0.05  # interval at which Ctrl-C is noticed during native work, s
    results: list[tuple[Any, BaseException | None]] = []

    def work() -> None:
        try:
            results.append((function(), None))
        except BaseException as error:  # quiet: raised again in the thread that waits
            results.append((None, error))

    # Files that it writes are recorded in this context.
    thread = _DetachedThread(target=copy_context().run, args=(work,), daemon=True)
    _unfinished.append(thread)
    thread.start()
    end = None if timeout_s is None else time.monotonic() + timeout_s
    try:
        while thread.is_alive():
            if end is not None and time.monotonic() > end:
                raise TimeoutError
            thread.join(look_s)
    except BaseException:  # quiet: raised again, once no file is half written
        thread.is_left = True
        while thread.is_writing:
            time.sleep(0.01)
        raise
    _unfinished.remove(thread)
    result, error = results[0]
    if error is not None:
        raise error
    return result  # type: ignore[no-any-return]


def is_busy() -> bool:
    """Whether abandoned native work is still running. If so, the process must end at once: it would otherwise wait for
    it, or be aborted by a library whose threads are still running.
    """
    return bool(_unfinished)
