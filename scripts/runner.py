"""Common parts of the measuring scripts: figures with their limits, processes, options, and one rule for the exit code.

A script has cases, each of which makes figures from a number of runs; `script` makes its command. A script that has
options or a table of its own starts from `parser` and ends with `measured` or `finished`.
"""

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
    """Within this context, `over` uses so many processes; 0 is one for each core."""
    with processes(jobs) as executor:
        token = _executor.set(executor)
        try:
            yield
        finally:
            _executor.reset(token)


def over(function: Callable[..., _T], *items: Iterable[Any]) -> Iterator[_T]:
    """Results of a function, defined at the top of a module, for each of the items (mostly seeds), in order."""
    return each(function, *items, executor=_executor.get())


# ---- figures --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """One figure. `error` is its standard error, 0 if it is not a mean; it must lie between `least` and `most`."""

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
        """Its fields, without infinite limits, and the verdict."""
        return {name: value for name, value in vars(self).items() if value not in (np.inf, -np.inf)} | {
            "verdict": self.verdict
        }

    def __str__(self) -> str:
        value = f"{self.value:.4g}" + (f" ± {self.error:.2g}" if self.error else "")
        both = (("from", self.least), ("to", self.most))
        limits = [f"{word} {limit:.3g}" for word, limit in both if np.isfinite(limit)]
        return f"{self.case:33}{self.what:42}{value:>18}  {' '.join(limits):20}{self.verdict:6}{self.note}".rstrip()


def mean_and_error(values: Any) -> tuple[float, float]:
    """The mean over runs, and its standard error; 0 for a single run."""
    values = np.asarray(values, dtype=float)
    spread = float(np.std(values, ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
    return float(np.mean(values)), spread


def root_and_error(squares: Any) -> tuple[float, float]:
    """The root mean square over runs from squares, and its standard error."""
    mean, error = mean_and_error(squares)
    return float(np.sqrt(mean)), error / (2.0 * float(np.sqrt(mean)))


def share_error(share: float, count: int) -> float:
    """The standard error of a share of so many."""
    return float(np.sqrt(share * (1.0 - share) / count))


# ---- commands -------------------------------------------------------------------------------------------------------


Cases = Mapping[str, Callable[[int], Iterable[Row]]]


def parser(description: str | None, runs: tuple[int, str], cases: Iterable[str] = ()) -> argparse.ArgumentParser:
    """The options that every measuring script has.

    Args:
        description: the script's docstring; its first line is shown in the help. runs: the default number, and its
        meaning.
    """
    options = argparse.ArgumentParser(description=(description or "").partition("\n")[0], allow_abbrev=False)
    options.add_argument("--runs", type=int, default=runs[0], help=f"{runs[1]} (default {runs[0]})")
    if names := list(cases):
        options.add_argument("--case", nargs="+", action="extend", choices=names, help="only these (default all)")
    options.add_argument("--jobs", type=int, default=1, help="processes, 0: one per core (default 1): the same figures")
    options.add_argument("--json", nargs="?", const="-", metavar="FILE", help="write figures to FILE, or print them")
    return options


def measured(
    cases: Cases, given: argparse.Namespace, over_all: Callable[[Sequence[Row]], Iterable[Row]] = lambda rows: ()
) -> int:
    """Measure the requested cases, print each figure and the time of each case; returns the exit code."""
    rows: list[Row] = []
    quiet = given.json == "-"

    def told(some: Iterable[Row]) -> Iterator[Row]:
        for row in some:
            if not quiet:
                print(row, flush=True)
            yield row

    with over_processes(given.jobs):
        for name in given.case or cases:
            start = time.perf_counter()
            rows += told(cases[name](given.runs))
            if not quiet:
                print(f"  {name}: {time.perf_counter() - start:.0f} s", flush=True)
    return finished([*rows, *told(over_all(rows))], given)


def finished(rows: Sequence[Row], given: argparse.Namespace) -> int:
    """Write the figures where --json says; returns 1 when a figure is missed."""
    if given.json:
        text = json.dumps([row.to_json() for row in rows], indent=1)
        if given.json == "-":
            print(text)
        else:
            Path(given.json).write_text(text, encoding="utf-8")
    return int(any(row.verdict == "no" for row in rows))


def script(
    cases: Cases,
    description: str | None,
    runs: tuple[int, str],
    least_runs: int = 1,
    over_all: Callable[[Sequence[Row]], Iterable[Row]] = lambda rows: (),
) -> Callable[[Sequence[str] | None], int]:
    """The `main` of a script without options of its own; see `parser` and `measured`.

    Args:
        least_runs: 2 where a spread is needed. over_all: makes figures of all figures together.
    """

    def main(arguments: Sequence[str] | None = None) -> int:
        options = parser(description, runs, cases)
        given = options.parse_args(arguments)
        if given.runs < least_runs:
            options.error(f"--runs must be {least_runs} or more: fewer have no spread")
        return measured(cases, given, over_all)

    return main
