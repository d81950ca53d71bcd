"""Work in parts, a thread each where that pays: the kernels release Python's lock (design, section 3); and what native
libraries do to the process that loads them, and how long they may keep it.
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
    """For the parts that the caller's own thread does not take."""
    from concurrent.futures import ThreadPoolExecutor

    return ThreadPoolExecutor(thread_name_prefix="ceres_cal")


os.register_at_fork(after_in_child=_pool.cache_clear)  # a child has the pool, but none of its threads


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
    """While it lasts this thread's work is cut into so many parts at most; 0 leaves it as it is."""
    token = _allowed.set(threads or _allowed.get())
    try:
        yield
    finally:
        _allowed.reset(token)


def share_cores(processes: int) -> None:
    """From now on this thread takes no more than its share of the cores, and Ctrl-C is for who started the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _allowed.set(max(_cores() // processes, 1))


@contextmanager
def for_small_matrices() -> Iterator[None]:
    """While it lasts BLAS works in the calling thread alone, in the whole process; freed memory stays at hand.

    OpenBLAS's other threads bring nothing to matrices as small as ours, but spin for milliseconds after each call, on
    the cores that our own parts need.
    """
    _keep_freed_memory()
    has_none = os.environ.get("OPENBLAS_NUM_THREADS") == "1"  # as commands have it; finding BLAS takes 3 ms
    with nullcontext() if has_none else _controller().limit(limits=1, user_api="blas"):
        yield


def available() -> int:
    """How many threads may work."""
    return _allowed.get() or _cores()


def parts_of(items: int, rows: int, row_ns: float) -> list[int]:
    """Where each part of so many items begins, and where the last one ends.

    Args:
        rows: how many they hold in all. row_ns: about how long one of them takes.
    """
    later_us = 100.0  # that another thread begins after this one
    worth_us = 400.0  # of work in a part; of half of that a thread brings nothing by the clock, and costs a tenth
    work_us = 1e-3 * row_ns * rows
    count = max(1, min(available(), int(work_us / worth_us)))
    ahead = items * later_us / work_us if count > 1 else 0.0
    return [0, *(int(ahead + (items - ahead) * number / count) for number in range(1, count)), items]


def meanwhile(function: Callable[[], _T]) -> Future[_T]:
    """What a function returns that another thread calls from now on."""
    return _pool().submit(function)


def run_parts(function: Callable[[int, int], _T], parts: Sequence[int]) -> list[_T]:
    """function(first, last) of every part, at the same time."""
    others = [_pool().submit(function, *parts[i : i + 2]) for i in range(1, len(parts) - 1)]
    return [function(*parts[:2]), *(other.result() for other in others)]


def in_turn(function: Callable[[_Item], _T], items: Iterable[_Item]) -> Iterator[_T]:
    """function(item) of each, in their order; as many at the same time as threads may work, and a few items ahead."""
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
    finally:  # what is at work when it is no longer wanted is left to itself
        own.shutdown(wait=False, cancel_futures=True)


_unfinished: list[threading.Thread] = []


@contextmanager
def kept_signals() -> Iterator[None]:
    """While a library is loaded that takes SIGTERM (glog prints a stack and aborts): who had the signal keeps it."""
    yield
    handler = signal.getsignal(signal.SIGTERM)
    if handler is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, handler)


@cache
def _keep_freed_memory() -> None:
    """From now on freed memory stays at hand for what comes next, 64 MiB of it, where the C library is glibc.

    Else arrays are had from the system anew, again and again: a third of the time of sums over many rows in Dask's
    workers, an eighth of the calibration of a thousand frames.
    """
    trim, mapped = (-1, 1 << 26), (-3, 1 << 25)  # of glibc's mallopt
    import ctypes

    library = ctypes.CDLL(None)
    if hasattr(library, "mallopt"):
        library.mallopt(*trim)
        library.mallopt(*mapped)


class _DetachedThread(threading.Thread):
    """Work that may be left to itself.

    Attributes:
        is_left: nobody waits for it any more, so that it writes no file. is_writing: a file, which will be whole.
    """

    is_left = is_writing = False


@contextmanager
def writing() -> Iterator[None]:
    """While a file is written; InputError where the thread was left to itself."""
    thread = threading.current_thread()
    if not isinstance(thread, _DetachedThread):
        yield
        return
    thread.is_writing = True  # before it looks, as whoever leaves it says so before waiting
    try:
        if thread.is_left:
            raise InputError("interrupted: not written")
        yield
    finally:
        thread.is_writing = False


def interruptibly(function: Callable[[], _T], timeout_s: float | None = None) -> _T:
    """What a function returns whose native work would hold back Ctrl-C until it is done.

    It works in a thread of its own, which is left to itself when this one is interrupted or has waited long enough; but
    for a file that it writes just then, and it writes no other.

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

    thread = _DetachedThread(target=copy_context().run, args=(work,), daemon=True)  # and what it writes is noted here
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
    """Whether native work was left to itself: a process then ends at once, not when that is done, or by an abort of a
    library whose threads were still at it.
    """
    return bool(_unfinished)
