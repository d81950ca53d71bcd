"""The same work on many items, in this process or by any `concurrent.futures.Executor`; results are identical."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Any, TypeVar

from ceres_cal.base.errors import InputError
from ceres_cal.base.threads import share_cores

_T = TypeVar("_T")


def each(function: Callable[..., _T], *items: Iterable[Any], executor: Executor | None = None) -> Iterator[_T]:
    """Yield function(item) for the items, in their order; one after the other if there is no executor.

    For processes the function and its arguments must be picklable: no lambda, nothing defined inside a function.
    """
    if executor is None:
        return map(function, *items)
    futures = [executor.submit(function, *arguments) for arguments in zip(*items, strict=True)]
    return (future.result() for future in futures)


def _begin(jobs: int) -> None:
    """Initialise a process: it shares the cores, and ends when its parent ends for any reason."""
    share_cores(jobs)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    """Wait until the parent ends: it alone holds the other end of a pipe, which the system closes with it."""
    orphaned = 143  # exit code as after SIGTERM; no process is left to read it
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(orphaned)


@contextmanager
def processes(jobs: int) -> Iterator[Executor | None]:
    """Context with `jobs` processes that share the cores; None for one job, which runs in this process. 0 is one per
    core.

    Any early end (Ctrl-C, SIGTERM, SIGKILL, an error) ends the processes, too.

    Raises:
        InputError: fewer than 0.
    """
    asked_again_s = 0.1
    if jobs < 0:
        raise InputError(f"{jobs} jobs at a time: give 1 or more, or 0 for one a core")
    jobs = jobs or os.cpu_count() or 1
    if jobs == 1:
        yield None
        return
    import multiprocessing  # imported here with all that it imports, only if processes are used
    from concurrent.futures import ProcessPoolExecutor

    fresh = multiprocessing.get_context("spawn")  # a forked process has its parent's locks, but none of its threads
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, fresh, _begin, (jobs,))
    try:
        yield pool
    except BaseException:
        for child in set(multiprocessing.active_children()) - before:
            while child.is_alive():  # a process that writes its results may miss the first signal
                child.terminate()  # waiting futures fail with the processes; cancelling them makes Python 3.11 complain
                child.join(asked_again_s)
        raise
    finally:
        pool.shutdown()
