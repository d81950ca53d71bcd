"""What the measuring scripts share: figures beside what they must keep to, and the command that prints them by case."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ceres_cal.base.executing import each, processes

_T = TypeVar("_T")
_executor: ContextVar[Executor | None] = ContextVar("executor", default=None)


@contextmanager
def over_processes(jobs: int) -> Iterator[None]:
    """While it lasts, what `over` does goes over so many processes; 0 is one a core."""
    with processes(jobs) as executor:
        token = _executor.set(executor)
        try:
            yield
        finally:
            _executor.reset(token)


def over(function: Callable[..., _T], *items: Iterable[Any]) -> Iterator[_T]:
    """What a function, defined at the top of a module, makes of each of the items, in order: of seeds, mostly."""
    return each(function, *items, executor=_executor.get())


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """The option --jobs."""
    parser.add_argument("--jobs", type=int, default=1, help="processes; 0 is one a core (default 1): the same figures")


@dataclass(frozen=True)
class Row:
    """One figure. `error` is its standard error, 0 where it is no mean; it must lie between `least` and `most`."""

    case: str
    what: str
    value: float
    error: float = 0.0
    least: float = -np.inf
    most: float = np.inf
    note: str = ""

    @property
    def verdict(self) -> str:
        missed = max(self.least - self.value, self.value - self.most)
        if np.isinf(missed) and missed < 0.0:
            return ""
        return "yes" if missed <= 0.0 else "open" if missed <= 2.0 * self.error else "no"

    def to_json(self) -> dict[str, Any]:
        """Its fields, without limits that it does not have, and the verdict."""
        return {name: value for name, value in vars(self).items() if value not in (np.inf, -np.inf)} | {
            "verdict": self.verdict
        }

    def __str__(self) -> str:
        value = f"{self.value:.4g}" + (f" ± {self.error:.2g}" if self.error else "")
        both = (("from", self.least), ("to", self.most))
        limits = [f"{word} {limit:.3g}" for word, limit in both if np.isfinite(limit)]
        return f"{self.case:33}{self.what:42}{value:>18}  {' '.join(limits):20}{self.verdict:6}{self.note}".rstrip()


def printed(rows: Iterable[Row]) -> Iterator[Row]:
    """The same rows, each printed as soon as it is known."""
    for row in rows:
        print(row, flush=True)
        yield row


def json_text(rows: Iterable[Row]) -> str:
    """For other programs."""
    return json.dumps([row.to_json() for row in rows], indent=1)


def exit_code(rows: Iterable[Row]) -> int:
    """1 when a figure is missed."""
    return int(any(row.verdict == "no" for row in rows))


def run(
    cases: Mapping[str, Callable[[int], Iterable[Row]]],
    arguments: Sequence[str],
    description: str,
    runs: tuple[int, str],
    least_runs: int = 1,
    over_all: Callable[[Sequence[Row]], Iterable[Row]] = lambda rows: (),
) -> int:
    """The command of a script: measure the cases asked for, print each figure and what each case took.

    Args:
        cases: what makes the figures of a case from the number of runs. description: the script's own; its first line
            goes into the help. runs: the default number, and of what. over_all: what is said of all figures together.
    Returns: the exit code.
    """
    parser = argparse.ArgumentParser(description=description.partition("\n")[0], allow_abbrev=False)
    parser.add_argument("--runs", type=int, default=runs[0], help=f"{runs[1]} (default {runs[0]})")
    parser.add_argument("--case", nargs="+", choices=cases, default=list(cases), help="only these")
    parser.add_argument("--json", type=Path, help="write the figures there, too")
    add_jobs(parser)
    given = parser.parse_args(arguments)
    if given.runs < least_runs:
        parser.error(f"--runs must be {least_runs} or more: one run has no spread")
    rows: list[Row] = []
    with over_processes(given.jobs):
        for name in given.case:
            start = time.perf_counter()
            rows += printed(cases[name](given.runs))
            print(f"  {name}: {time.perf_counter() - start:.0f} s", flush=True)
    rows = [*rows, *printed(over_all(rows))]
    if given.json:
        given.json.write_text(json_text(rows), encoding="utf-8")
    return exit_code(rows)
