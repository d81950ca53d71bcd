"""One job, what came of it, and the file in which that is remembered; and plans, which say what jobs there are.

Jobs, here or over an executor: each one's outcome as it comes, remembered before it is said.
"""

from __future__ import annotations

import csv
import io
import json
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future, as_completed
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import msgspec

from ceres_cal import observations
from ceres_cal.base import Frozen, __version__, printable, replace
from ceres_cal.base.errors import CalibrationError, InputError, answer_or_reason, attempt, note
from ceres_cal.base.files import convert, parse_json, read_bytes

RESULTS = "results.jsonl"
LEVELS = ("failed", "no", "care", "good")
"""What needs attention first."""


class Job(Frozen, eq=True):
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


class Outcome(Frozen, eq=True):
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
        stream.seek(max(stream.tell() - 1, 0))
        cut_short = stream.read() not in (b"", b"\n")
        stream.write((b"\n" if cut_short else b"") + msgspec.json.encode(outcome) + b"\n")
    note(file)


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


# ---- plans ----------------------------------------------------------------------------------------------------------


_ENDINGS = (".jsonl", ".csv", ".toml")
_OBSERVATIONS = (".json", ".npz")
_NAME = re.compile(r"[\w][\w .+-]*")


class JobSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row: a job's name, its command, and arguments as they are typed; files are named from the plan's folder."""

    name: str
    command: str
    arguments: tuple[str, ...] = ()


def read_plan(path: Path) -> tuple[JobSpec, ...]:
    """The rows of a plan.

    A table has `name`, `command` and `arguments` (one text as it is typed, or a list): a line of JSON each, a CSV with
    these heads, or TOML with [[job]]. Of a folder each file of observations is calibrated, and those in a folder inside
    it are taken together.

    Raises:
        InputError: it cannot be read, is empty, or has a row that is none, or one name twice.
    """
    rows = list(_of_folder(path) if path.is_dir() else _of_table(path))
    if not rows:
        raise InputError(f"{path}: there is no job in it")
    (name, count), *_ = Counter(row.name for row in rows).most_common(1)
    if count > 1:
        raise InputError(f"{path}: {count} jobs are called {name!r}: give each a name of its own")
    return tuple(rows)


def _of_folder(folder: Path) -> Iterator[JobSpec]:
    for place in sorted(folder.iterdir()):
        if place.is_dir():
            files = sorted(file for file in place.iterdir() if _holds_observations(file))
            if files:
                names = tuple(str(file.relative_to(folder)) for file in files)
                yield JobSpec(printable(place.name), "calibrate", names)
        elif _holds_observations(place):
            yield JobSpec(printable(place.stem), "calibrate", (place.name,))


def _holds_observations(file: Path) -> bool:
    """By its ending, and of JSON by its first letters: calibrations and truths lie beside."""
    first = 1000  # bytes
    if file.suffix not in _OBSERVATIONS or not file.is_file():
        return False
    with file.open("rb") as stream:
        return file.suffix == ".npz" or observations.FORMAT.encode() in stream.read(first)


def _of_table(path: Path) -> Iterator[JobSpec]:
    content = read_bytes(path)
    if path.suffix not in _ENDINGS:
        raise InputError(f"{path}: a plan is a folder, or a table in {', '.join(_ENDINGS[:-1])} or {_ENDINGS[-1]}")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text in UTF-8: {error}") from None
    read = {".jsonl": _json_lines, ".csv": _csv, ".toml": _toml}[path.suffix]
    for where, data in read(text, str(path)):
        if isinstance(data, dict) and isinstance(data.get("arguments"), str):
            data["arguments"] = words_of(data["arguments"], f"{where}: arguments")
        row = convert(data, JobSpec, where)
        if not _NAME.fullmatch(row.name):
            raise InputError(f"{where}: a job is called {row.name!r}: files have its name: letters, digits, - and _")
        yield row


def words_of(typed: str, where: str) -> list[str]:
    """Arguments as a shell takes them apart."""
    try:
        return shlex.split(typed)
    except ValueError as error:
        raise InputError(f"{where} {typed!r}: {error}") from None


def _json_lines(text: str, where: str) -> Iterator[tuple[str, Any]]:
    for number, line in enumerate(text.splitlines(), start=1):
        if line.strip():
            place = f"{where}, line {number}"
            yield place, parse_json(line.encode(), place)


def _csv(text: str, where: str) -> Iterator[tuple[str, Any]]:
    try:
        for number, row in enumerate(csv.DictReader(io.StringIO(text), strict=True), start=2):
            if None in row:
                raise InputError(f"{where}, line {number}: more columns than heads: put arguments between quotes")
            yield f"{where}, line {number}", {name: value for name, value in row.items() if value is not None}
    except csv.Error as error:
        raise InputError(f"{where}: no CSV: {error}") from None


def _toml(text: str, where: str) -> Iterator[tuple[str, Any]]:
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: no TOML: {error}") from None
    jobs = data.pop("job", [])
    if data or not isinstance(jobs, list):
        raise InputError(f"{where}: a plan has [[job]] tables and nothing else")
    yield from ((f"{where}, job {number}", row) for number, row in enumerate(jobs, start=1))
