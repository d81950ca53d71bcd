"""Engines that query shares of very many observations: in this process, with a thread each, or on Dask's workers.

The solve and its information see a cost function and normal equations: sums of the answers of the shares.
"""

from __future__ import annotations

import errno
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import reduce
from operator import add
from typing import Any, TypeVar

import numpy as np

from ceres_cal.base import Array, CalibrationError, Frozen, InputError, Poses, SolutionError, replace
from ceres_cal.base.threads import at_most, available, for_small_matrices
from ceres_cal.observations.sights import Owner, SightKey
from ceres_cal.problem.costs import CachedCost, CostValue, Run
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.shares import Share, ShareRequest

_A = TypeVar("_A")
_RETRIES = 3  # repetitions of the work of a lost worker
_PAUSE_S = 0.05  # before the work of a lost worker is repeated, four times as long each time
_NO_ROOM = "a worker's disk is full: make room, or start it with another --local-directory"
_NO_MEMORY = "a worker ran out of memory: give it more, or start more workers"


class InProcess:
    """Shares in this process, with a thread for each group."""

    def __init__(self, shares: Sequence[Share]) -> None:
        self._groups = _groups_of(shares)

    def ask(self, answer: Callable[..., _A], *request: Any) -> _A:
        """The sum of answer(share, *request) over all shares."""
        return reduce(add, asked_of(self._groups, answer, request, available()))

    def close(self) -> None:
        """Release the shares."""
        self._groups = []


def _groups_of(shares: Sequence[Share], workers: int = 1) -> list[Sequence[Share]]:
    """Groups of consecutive shares, each summed by itself in one place. They are the same for up to `groups` workers,
    and so are all sums, to the last bit.
    """
    groups = 16  # workers up to which sums are the same to the last bit; the data sent for each answer grow with it
    count = min(len(shares), max(groups, workers))
    return [shares[len(shares) * n // count : len(shares) * (n + 1) // count] for n in range(count)]


def asked_of(
    groups: Sequence[Sequence[Share]], answer: Callable[..., _A], request: Sequence[Any], threads: int
) -> list[_A]:
    """The sum of answer(share, *request) over the shares of each group, with the given number of threads."""

    def one(group: Sequence[Share]) -> _A:
        with at_most(1):
            return reduce(add, (answer(share, *request) for share in group))

    if threads == 1:
        return list(map(one, groups))
    with ThreadPoolExecutor(threads) as pool:
        try:
            return list(pool.map(one, groups))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


class OnWorkers:
    """Shares kept by the workers of a `distributed.Client`, which each go through theirs one by one; lost ones are
    remade.

    They are kept by tasks, which Dask repeats elsewhere if a worker is lost. Requests bypass its scheduler, which would
    take ten milliseconds for each.

    Raises:
        SolutionError: a worker ran out of memory or disk, or workers were lost repeatedly; it is named.
    """

    def __init__(self, client: Any, shares: Sequence[Share]) -> None:
        self._client = client
        # scheduler_info() cannot be used: the client's own poll may empty its result before it is read.
        workers = sorted(client.nthreads())
        if not workers:
            raise SolutionError("the scheduler has no workers: start some with `dask worker ADDRESS`")
        groups = _groups_of(shares, len(workers))
        count = min(len(workers), len(groups))
        self._kept = [
            client.submit(_kept, group, workers=[workers[n * count // len(groups)]], allow_other_workers=True,
                          pure=False, retries=_RETRIES)
            for n, group in enumerate(groups)
        ]  # fmt: skip
        self._places = self._found()
        # From now on any worker may keep a group: a task bound to a worker that is gone would wait for ever.
        client.sync(client.scheduler.set_restrictions, worker={one.key: None for one in self._kept})

    def _found(self) -> dict[str, list[int]]:
        """The numbers of the groups that each worker keeps, once all are kept."""
        for one in self._kept:
            if (error := one.exception()) is not None:
                raise _in_words(error)
        places: dict[str, list[int]] = {}
        held = self._client.who_has(self._kept)
        for number, one in enumerate(self._kept):
            for worker in held.get(one.key, ())[:1]:
                places.setdefault(worker, []).append(number)
        return places

    def ask(self, answer: Callable[..., _A], *request: Any) -> _A:
        """The sum of answer(share, *request) over all shares."""
        answers: dict[int, _A] = {}
        last = ""
        for again in range(_RETRIES + 1):
            if again:
                time.sleep(_PAUSE_S * 4**again)
                self._places = self._found()
            asked = {
                worker: {n: self._kept[n].key for n in numbers if n not in answers}
                for worker, numbers in self._places.items()
            }
            workers = [worker for worker, keys in asked.items() if keys]
            replies = self._client.run(_answered, asked, answer, request, workers=workers, on_error="return")
            for worker, reply in replies.items():
                if isinstance(reply, dict):
                    answers |= reply
                elif not isinstance(reply, (OSError, KeyError)):  # these mean that the worker or its group is lost
                    raise _in_words(reply)
                else:
                    last = worker
            if len(answers) == len(self._kept):
                return reduce(add, (answers[number] for number in range(len(self._kept))))
        raise _lost(last)

    def close(self) -> None:
        """Release the shares."""
        for one in self._kept:
            one.release()


def _kept(group: Sequence[Share]) -> Sequence[Share]:
    """The task by which a worker keeps a group."""
    return group


async def _answered(
    asked: Mapping[str, Mapping[int, str]], answer: Callable[..., _A], request: Sequence[Any], dask_worker: Any
) -> dict[int, _A] | CalibrationError:
    """The answers of this worker's groups, by number; or the error that stopped it, with its name."""
    keys = asked[dask_worker.address]
    groups = [dask_worker.data[key] for key in keys.values()]

    def all_of_them() -> list[_A]:
        with for_small_matrices():
            return asked_of(groups, answer, request, 1)

    here = dask_worker.address
    try:
        answers = await dask_worker.loop.run_in_executor(dask_worker.executor, all_of_them)
    except (MemoryError, InputError, OSError) as error:  # quiet: who asked raises it
        return _named(error, here, dask_worker.local_directory)
    return dict(zip(keys, answers, strict=True))


def _named(error: Exception, worker: str, folder: str) -> CalibrationError:
    """A worker's error, with the worker's name."""
    if isinstance(error, InputError):  # raised when a file is read
        return InputError(f"{error} (worker {worker})")
    if isinstance(error, OSError):
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        what = _NO_ROOM if full else error.strerror
        return SolutionError(f"{error.filename or folder}: {what} (worker {worker})")
    return SolutionError(f"{_NO_MEMORY} ({worker})")


def _in_words(error: BaseException) -> BaseException:
    """An error raised by a worker, as one line where its cause is known."""
    if isinstance(error, MemoryError):
        return SolutionError(_NO_MEMORY)
    if type(error).__name__ in ("KilledWorker", "FutureCancelledError", "CancelledError"):
        last = getattr(getattr(error, "last_worker", None), "address", "")
        return _lost(last)
    return error


def _lost(last: str) -> SolutionError:
    return SolutionError("workers were lost again and again: have they enough memory?" + f" ({last})" * bool(last))


class SharedObservations(Frozen):
    """The observations in an engine's shares, judged at an estimate; see `problem.RemoteObservations`."""

    engine: InProcess | OnWorkers
    keys: tuple[SightKey, ...]
    equations: int
    judged_at: tuple[str, Estimate]
    bounds: tuple[float, float]
    feet_along: tuple[tuple[str, Estimate], ...]

    def asked(self, problem: Problem, estimate: Estimate) -> ShareRequest:
        """The request to the shares about a problem at an estimate."""
        return ShareRequest(
            of_world(estimate), problem.layout, problem.weighting, self.judged_at, self.bounds, self.feet_along
        )

    def cost(self, run: Run, problem: Problem, estimate: Estimate) -> SharedCost:
        """Their cost function for Ceres."""
        return SharedCost(run, self, problem, estimate)

    def normals(self, problem: Problem, estimate: Estimate) -> Mapping[tuple[SightKey, int], Array]:
        """Their normal equations by sight and kind."""
        return self.engine.ask(Share.normals, self.asked(problem, estimate)).of or {}


class SharedCost(CachedCost):
    """The compressed blocks of all sights of the shares, with one round trip for each evaluation by Ceres."""

    def __init__(self, run: Run, judged: SharedObservations, problem: Problem, estimate: Estimate) -> None:
        super().__init__(run)
        self._judged, self._asked = judged, judged.asked(problem, estimate)
        layout, sizes, count = problem.layout, dict[Owner, int](), len(estimate.structure.values)
        for key in judged.keys:
            every = len(layout.free[key.camera]), 6 * (key.station in layout.stations), 0, count
            sizes |= {owner: size for owner, size in zip(key.owners, every, strict=True) if size}
        ends = np.cumsum([0, *sizes.values()])
        self._columns = {owner: np.arange(*ends[n : n + 2]) for n, owner in enumerate(sizes)}
        each = {key: [self._columns[owner] for owner in key.owners if owner in sizes] for key in judged.keys}
        self._of = {key: np.concatenate([np.empty(0, np.int64), *own]) for key, own in each.items()}
        rows = sum(1 + len(columns) for columns in self._of.values())
        self._shape = rows, int(ends[-1])
        self._take(sizes, rows)

    def evaluated(self, at: Array, parameters: Sequence[Array]) -> CostValue | None:
        numbers = {owner: at[columns] for owner, columns in self._columns.items()}
        blocks = self._judged.engine.ask(Share.blocks, self._asked, numbers).of
        if blocks is None:
            return None
        residuals, jacobian, row = np.zeros(self._shape[0]), np.zeros(self._shape), 0
        for key, block in blocks.items():
            columns, rows = self._of[key], slice(row, row + len(block))
            jacobian[rows, columns], residuals[rows], row = block[:, :-1], block[:, -1], row + len(block)
        return CostValue(at, residuals, [jacobian[:, columns].reshape(-1) for columns in self._columns.values()])


def of_world(estimate: Estimate) -> Estimate:
    """The estimate without placements, which the shares do not show."""
    return replace(estimate, placements=Poses.of({}))
