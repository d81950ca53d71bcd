"""Plans: which jobs there are, from a table (JSON lines, CSV, TOML) or from a folder of observations."""

from __future__ import annotations

import csv
import io
import re
import shlex
import tomllib
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import convert, parse_json, read_bytes
from ceres_cal.base.words import printable
from ceres_cal.observations import FORMAT

_ENDINGS = (".jsonl", ".csv", ".toml")
_OBSERVATIONS = (".json", ".npz")
_NAME = re.compile(r"[\w][\w .+-]*")


class Planned(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One row: a job's name, its command, and arguments as they are typed; files are named from the plan's folder."""

    name: str
    command: str
    arguments: tuple[str, ...] = ()


def read_plan(path: Path) -> tuple[Planned, ...]:
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


def _of_folder(folder: Path) -> Iterator[Planned]:
    for place in sorted(folder.iterdir()):
        if place.is_dir():
            files = sorted(file for file in place.iterdir() if _holds_observations(file))
            if files:
                names = tuple(str(file.relative_to(folder)) for file in files)
                yield Planned(printable(place.name), "calibrate", names)
        elif _holds_observations(place):
            yield Planned(printable(place.stem), "calibrate", (place.name,))


def _holds_observations(file: Path) -> bool:
    """By its ending, and of JSON by its first letters: calibrations and truths lie beside."""
    first = 1000  # bytes
    if file.suffix not in _OBSERVATIONS or not file.is_file():
        return False
    with file.open("rb") as stream:
        return file.suffix == ".npz" or FORMAT.encode() in stream.read(first)


def _of_table(path: Path) -> Iterator[Planned]:
    if path.suffix not in _ENDINGS:
        raise InputError(f"{path}: a plan is a folder, or a table in {', '.join(_ENDINGS[:-1])} or {_ENDINGS[-1]}")
    content = read_bytes(path)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: is no text in UTF-8: {error}") from None
    read = {".jsonl": _json_lines, ".csv": _csv, ".toml": _toml}[path.suffix]
    for where, data in read(text, str(path)):
        if isinstance(data, dict) and isinstance(data.get("arguments"), str):
            try:
                data["arguments"] = shlex.split(data["arguments"])
            except ValueError as error:
                raise InputError(f"{where}: arguments {data['arguments']!r}: {error}") from None
        row = convert(data, Planned, where)
        if not _NAME.fullmatch(row.name):
            raise InputError(f"{where}: a job is called {row.name!r}: files have its name: letters, digits, - and _")
        yield row


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
