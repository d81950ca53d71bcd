"""Where shares of very many observations are asked: here, by a thread each, or on workers that Dask has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from operator import add
from typing import Any, Protocol, TypeVar

from ceres_cal.base.errors import SolutionError
from ceres_cal.base.threads import at_most, available, single_threaded_blas
from ceres_cal.solve.shares import Share

_A = TypeVar("_A")
_RETRIES = 3  # of what a worker that was lost had to do


class Engine(Protocol):
    """Where shares are asked."""

    def ask(self, answer: Callable[..., _A], *request: Any) -> _A:
        """The sum of answer(share, *request) over all shares."""


class InProcess:
    """Shares that this process asks, a thread each."""

    def __init__(self, shares: Sequence[Share]) -> None:
        self._shares = shares

    def ask(self, answer: Callable[..., _A], *request: Any) -> _A:
        """The sum of answer(share, *request) over all shares."""
        return asked_of(self._shares, answer, request, available())


def asked_of(shares: Sequence[Share], answer: Callable[..., _A], request: Sequence[Any], threads: int) -> _A:
    """The sum of answer(share, *request) over some shares, by so many threads."""

    def one(share: Share) -> _A:
        with at_most(1):
            return answer(share, *request)

    if threads == 1:
        return reduce(add, map(one, shares))
    with ThreadPoolExecutor(threads) as pool:
        try:
            return reduce(add, pool.map(one, shares))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


class OnWorkers:
    """Shares that the workers of a `distributed.Client` keep, one after the other each; one that is lost is made again.

    Raises:
        SolutionError: when asked: a worker ran out of memory or was lost again and again.
    """

    def __init__(self, client: Any, shares: Sequence[Share]) -> None:
        self._client = client
        workers = sorted(client.scheduler_info(n_workers=-1)["workers"])
        if not workers:
            raise SolutionError("the scheduler has no workers: start some with `dask worker ADDRESS`")
        count = len(workers)
        # In tasks, not scattered: what a lost worker had is made again from them.
        self._kept = [
            client.submit(_kept, shares[len(shares) * n // count : len(shares) * (n + 1) // count], workers=[worker],
                          allow_other_workers=True, pure=False, retries=_RETRIES)
            for n, worker in enumerate(workers)
        ]  # fmt: skip
        self._workers = workers

    def ask(self, answer: Callable[..., _A], *request: Any) -> _A:
        """The sum of answer(share, *request) over all shares."""
        asked = [
            self._client.submit(_answered, kept, answer, request, workers=[worker], allow_other_workers=True,
                                pure=False, retries=_RETRIES)
            for kept, worker in zip(self._kept, self._workers, strict=True)
        ]  # fmt: skip
        try:
            answers: list[_A] = self._client.gather(asked)
            return reduce(add, answers)
        except MemoryError:
            raise SolutionError("a worker ran out of memory: give it more, or start more workers") from None
        except Exception as error:
            if type(error).__name__ not in ("KilledWorker", "FutureCancelledError", "CancelledError"):
                raise
            raise SolutionError("workers were lost again and again: have they enough memory?") from None
        finally:
            for one in asked:
                one.release()


def _kept(shares: Sequence[Share]) -> Sequence[Share]:
    """What a worker keeps."""
    return shares


def _answered(shares: Sequence[Share], answer: Callable[..., _A], request: Sequence[Any]) -> _A:
    """The sum of what a worker's shares answer."""
    with single_threaded_blas():
        return asked_of(shares, answer, request, 1)
