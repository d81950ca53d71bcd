"""One job, what came of it, and the file in which that is remembered.

Jobs, here or over an executor: each one's outcome as it comes, remembered before it is said.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, as_completed
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path

import msgspec

from ceres_cal.base.errors import CalibrationError, InputError, answer_or_reason, attempt
from ceres_cal.base.files import convert, read_bytes
from ceres_cal.base.version import __version__
from ceres_cal.base.words import printable
from ceres_cal.base.written import note

RESULTS = "results.jsonl"
LEVELS = ("failed", "no", "care", "good")
"""What needs attention first."""


@dataclass(frozen=True)
class Job:
    """One command of a plan.

    Attributes:
        name: of its own in the plan; its files are called so. command: such as "calibrate". arguments: as they are
            typed after it. inputs: files, and folders, that it reads. outputs: files that it writes.
    """

    name: str
    command: str
    arguments: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    outputs: tuple[Path, ...] = ()

    @property
    def key(self) -> str:
        """Changes with the package's version, the arguments and what the inputs hold.

        Raises:
            InputError: an input cannot be read.
        """
        told = [__version__, self.command, *self.arguments]
        digests = (sha256(read_bytes(file)).hexdigest() for file in _files(self.inputs))
        return sha256(json.dumps([told, list(digests)]).encode()).hexdigest()


def _files(inputs: Iterable[Path]) -> list[Path]:
    """The inputs, and those in a folder, in the order of their names."""
    inside = (sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path] for path in inputs)
    return [file for files in inside for file in files]


@dataclass(frozen=True)
class Outcome:
    """What came of a job.

    Attributes:
        level: "good", "care" or "no", as verdicts have it; "failed" where there is no answer. line: one line that says
            it. reasons: further lines. worst_mm: the largest error or move that is named, where there is one.
        key: of the job as it was then.
    """

    job: str
    command: str
    level: str
    line: str
    reasons: tuple[str, ...] = ()
    worst_mm: float | None = None
    key: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "line", printable(self.line))  # which may name a file that is not called in UTF-8
        object.__setattr__(self, "reasons", tuple(map(printable, self.reasons)))

    @property
    def order(self) -> tuple[int, float, str]:
        """What needs attention first: by level, then by mm."""
        return LEVELS.index(self.level), -(self.worst_mm or 0.0), self.job


def remembered(folder: Path) -> dict[str, Outcome]:
    """The last outcome of each job, by the job's name; a line that was cut short is none.

    Raises:
        InputError: the file holds something else.
    """
    file = folder / RESULTS
    if not file.exists():
        return {}
    lines = read_bytes(file).split(b"\n")[:-1]  # each ends with its own end
    found = [_outcome(line, f"{file}, line {number}") for number, line in enumerate(lines, start=1) if line.strip()]
    return {one.job: one for one in found}


def _outcome(line: bytes, where: str) -> Outcome:
    try:
        data = msgspec.json.decode(line)
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise InputError(f"{where}: no result of a job: remove the line, or name another folder") from None
    one = convert(data, Outcome, where)
    if one.level not in LEVELS:
        raise InputError(f"{where}: level {one.level!r} is none of {', '.join(LEVELS)}")
    return one


def remember(outcome: Outcome, folder: Path) -> None:
    """Add an outcome to what is remembered, as a whole line."""
    file = folder / RESULTS
    with file.open("ab+") as stream:
        cut_short = stream.tell() and not _ends_a_line(file)
        stream.write((b"\n" if cut_short else b"") + msgspec.json.encode(outcome) + b"\n")
    note(file)


def _ends_a_line(file: Path) -> bool:
    with file.open("rb") as stream:
        stream.seek(-1, 2)
        return stream.read(1) == b"\n"


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
