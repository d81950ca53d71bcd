"""The same work over many items, here or over any `concurrent.futures.Executor`: the same numbers, whatever it is."""

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
    """What a function makes of the items, in their order; one after the other where there is no executor.

    Of processes the function and its arguments have to be picklable: no lambda, nothing defined inside a function.
    """
    if executor is None:
        return map(function, *items)
    futures = [executor.submit(function, *arguments) for arguments in zip(*items, strict=True)]
    return (future.result() for future in futures)


def _begin(jobs: int) -> None:
    """What a process does first: it shares the cores, and ends when its parent does, however that ends."""
    share_cores(jobs)
    threading.Thread(target=_end_with_the_parent, daemon=True).start()


def _end_with_the_parent() -> None:
    """The parent alone holds the other end of a pipe, which the system closes with it."""
    orphaned = 143  # as by SIGTERM; nobody is left to ask
    import multiprocessing

    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(orphaned)


@contextmanager
def processes(jobs: int) -> Iterator[Executor | None]:
    """So many processes that share the cores among them; None for one: then the work is done here. 0 is one a core.

    Whatever ends it early (Ctrl-C, SIGTERM, SIGKILL, an error) ends the processes, too.

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
    import multiprocessing  # with what it brings along, for those who ask for processes
    from concurrent.futures import ProcessPoolExecutor

    fresh = multiprocessing.get_context("spawn")  # a fork has its parent's locks, and none of the threads
    before = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(jobs, fresh, _begin, (jobs,))
    try:
        yield pool
    except BaseException:
        for child in set(multiprocessing.active_children()) - before:
            while child.is_alive():  # what writes its results does not hear the first time
                child.terminate()  # what waits fails with them; to cancel it besides makes Python 3.11 complain
                child.join(asked_again_s)
        raise
    finally:
        pool.shutdown()
