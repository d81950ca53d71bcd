"""Jobs of a batch: their outcomes, the file in which outcomes are recorded, and plans, which list the jobs.

Jobs run in this process or in an executor; each outcome is recorded before it is reported.
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
"""Levels, in the order of the attention that they need."""


class Job(Frozen, eq=True):
    """One command of a plan.

    Attributes:
        name: unique in the plan; its files have this name. command: such as "calibrate".
        arguments: as they are typed after the command. inputs: files and folders that it reads. outputs: files that it
            writes.
    """

    name: str
    command: str
    arguments: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    outputs: tuple[Path, ...] = ()

    @property
    def key(self) -> str:
        """Digest of the package's version, the arguments and the content of the inputs.

        Raises:
            InputError: an input cannot be read.
        """
        told = [__version__, self.command, *self.arguments]
        digests = (sha256(read_bytes(file)).hexdigest() for file in _files(self.inputs))
        return sha256(json.dumps([told, list(digests)]).encode()).hexdigest()


def _files(inputs: Iterable[Path]) -> list[Path]:
    """Return the inputs, with folders replaced by their files, sorted by name."""
    inside = (sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path] for path in inputs)
    return [file for files in inside for file in files]


class Outcome(Frozen, eq=True):
    """Outcome of a job.

    Attributes:
        level: "good", "care" or "no", as in verdicts; "failed" where there is no answer.
        line: one line of summary. reasons: further lines.
        worst_mm: largest error or move that is named, if there is one. key: of the job when it ran.
    """

    job: str
    command: str
    level: str
    line: str
    reasons: tuple[str, ...] = ()
    worst_mm: float | None = None
    key: str = ""

    def __post_init__(self) -> None:
        object.__setattr__(self, "line", printable(self.line))  # the line may name a file whose name is not UTF-8
        object.__setattr__(self, "reasons", tuple(map(printable, self.reasons)))

    @property
    def order(self) -> tuple[int, float, str]:
        """Sort key by the attention needed: level, then mm."""
        return LEVELS.index(self.level), -(self.worst_mm or 0.0), self.job


def remembered(folder: Path) -> dict[str, Outcome]:
    """Return the last recorded outcome of each job, by the job's name; a line that is cut short is ignored.

    Raises:
        InputError: the file holds something else.
    """
    file = folder / RESULTS
    if not file.exists():
        return {}
    lines = read_bytes(file).split(b"\n")[:-1]  # every complete line ends with a line break
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
    """Append an outcome to the record, as a whole line."""
    file = folder / RESULTS
    with file.open("ab+") as stream:
        stream.seek(max(stream.tell() - 1, 0))
        cut_short = stream.read() not in (b"", b"\n")
        stream.write((b"\n" if cut_short else b"") + msgspec.json.encode(outcome) + b"\n")
    note(file)


def run_jobs(
    jobs: Sequence[Job], work: Callable[[Job], Outcome], folder: Path, executor: Executor | None = None
) -> Iterator[tuple[Outcome, bool]]:
    """Yield each job's outcome and whether it was recorded before, in order of completion.

    A job is skipped if its key is unchanged, its outputs exist and it had an answer. A job that fails, with any error,
    has an outcome, too. A caller that stops early shuts the executor down itself.

    Args:
        work: function that does a job; picklable if the executor uses processes. folder: where outcomes are recorded.

    Raises:
        InputError: the record cannot be read.
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
    """Return the outcome of a job without an answer."""
    return Outcome(job.name, job.command, "failed", " ".join(why.split()))


# ---- plans ----------------------------------------------------------------------------------------------------------


_ENDINGS = (".jsonl", ".csv", ".toml")
_OBSERVATIONS = (".json", ".npz")
_NAME = re.compile(r"[\w][\w .+-]*")


class JobSpec(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row: a job's name, its command, and its arguments as typed; file names are relative to the plan's folder."""

    name: str
    command: str
    arguments: tuple[str, ...] = ()


def read_plan(path: Path) -> tuple[JobSpec, ...]:
    """Read the rows of a plan.

    A table has `name`, `command` and `arguments` (one text as it is typed, or a list): a line of JSON each, a CSV with
    these heads, or TOML with [[job]]. In a folder each file of observations is calibrated, and those in a subfolder are
    calibrated together.

    Raises:
        InputError: it cannot be read, is empty, or has an invalid row or a duplicate name.
    """
    rows = list(_of_folder(path) if path.is_dir() else _of_table(path))
    if not rows:
        raise InputError(f"{path}: it contains no job")
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
    """Whether a file holds observations, by its ending, and for JSON by its beginning. Calibrations and true values may
    be in the same folder.
    """
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
        raise InputError(f"{path}: not text in UTF-8: {error}") from None
    read = {".jsonl": _json_lines, ".csv": _csv, ".toml": _toml}[path.suffix]
    for where, data in read(text, str(path)):
        if isinstance(data, dict) and isinstance(data.get("arguments"), str):
            data["arguments"] = words_of(data["arguments"], f"{where}: arguments")
        row = convert(data, JobSpec, where)
        if not _NAME.fullmatch(row.name):
            raise InputError(f"{where}: a job is called {row.name!r}: files have its name: letters, digits, - and _")
        yield row


def words_of(typed: str, where: str) -> list[str]:
    """Split arguments as a shell does."""
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
