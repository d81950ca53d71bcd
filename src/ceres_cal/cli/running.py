"""Jobs, here or over an executor: each one's outcome as it comes, remembered before it is said."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import replace
from functools import partial
from pathlib import Path

from ceres_cal.base.errors import CalibrationError, answer_or_reason, attempt
from ceres_cal.cli.jobs import Job, Outcome, remember, remembered


def run_jobs(
    jobs: Sequence[Job], work: Callable[[Job], Outcome], folder: Path, executor: Executor | None = None
) -> Iterator[tuple[Outcome, bool]]:
    """Each job's outcome and whether it is remembered from before, in the order in which they are there.

    A job is not done again where its key is the same, its outputs are there and it had an answer. One that fails, with
    whatever error, is an outcome like the others. Who stops early shuts the executor down: it is the caller's.

    Args:
        work: what a job is done by; picklable, where the executor is of processes. folder: where outcomes are
            remembered.

    Raises:
        InputError: what is remembered cannot be read.
    """
    known, todo = remembered(folder), []
    for job in jobs:
        key = attempt(partial(getattr, job, "key"))  # reads: "failed ... NAME: ..." and the reason
        if isinstance(key, CalibrationError):
            yield failed(job, str(key)), False
            continue
        old = known.get(job.name)
        if old is not None and old.key == key and old.level != "failed" and all(map(Path.exists, job.outputs)):
            yield old, True
        else:
            todo.append((job, key))
    for outcome in _done(todo, work, executor):
        remember(outcome, folder)
        yield outcome, False


def _done(
    todo: Sequence[tuple[Job, str]], work: Callable[[Job], Outcome], executor: Executor | None
) -> Iterator[Outcome]:
    if executor is None:
        yield from (replace(_tried(work, job), key=key) for job, key in todo)
        return
    futures: dict[Future[Outcome], tuple[Job, str]] = {
        executor.submit(_tried, work, job): (job, key) for job, key in todo
    }
    for future in as_completed(futures):
        job, key = futures[future]
        error = future.exception()
        yield replace(future.result() if error is None else failed(job, f"its process ended: {error}"), key=key)


def _tried(work: Callable[[Job], Outcome], job: Job) -> Outcome:
    outcome, why = answer_or_reason(lambda: work(job))  # reads: "failed ... NAME: ..." and the reason; the others go on
    return outcome or failed(job, why)


def failed(job: Job, why: str) -> Outcome:
    """The outcome of a job without an answer."""
    return Outcome(job.name, job.command, "failed", " ".join(why.split()))
