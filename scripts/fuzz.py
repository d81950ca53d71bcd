"""Odd input for every command: scripts/fuzz.py [--runs N | --minutes N] [--seed N] [--keep FOLDER]

Commands run with a small corpus, made from the package's own data, with changes of every kind: numbers, types, sizes,
names and order in JSON, columns, text and pictures; damaged bytes; exchanged, missing and odd files; words and options
of the command line (scripts/faults/). A command must answer, or refuse in one line with a documented exit code. What it
writes must be complete and readable. Failures are: any other exception, warnings, more than one line, incomplete files,
over 20 s of processor time or 300 s elapsed, over 2 GiB of additional memory, and a crash of the process. Exits with 1
when there is one; --keep keeps the folders of failures. Run N of a seed does not depend on other runs: --only N repeats
it alone.
"""

from __future__ import annotations

import argparse
import faulthandler
import importlib
import io
import json
import math
import multiprocessing
import os
import pkgutil
import re
import resource
import shlex
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from faults.fuzz_commands import FORMATS, Case, corpus, make_case

import ceres_cal
from ceres_cal.base.errors import CalibrationError

LONGEST_S, LONGEST_WAIT_S, MOST_MB = 20, 300, 2048
TOGETHER = 20  # commands of one child, since a fork costs as much as a short command
EXIT_CODES = {0, 1, 2, 3}
TRACE = "where.txt"  # where a process was that took too long
FAILURES = ("unexpected", "warning", "half written", "many lines", "exit code", "slow", "died", "memory")
_KEPT = 3  # failures of each kind
_SAID_EVERY = 200


class Outcome(NamedTuple):
    """Outcome of a command, its message, and, for an exception, its place in the package."""

    what: str
    words: str
    where: str = ""


# ---- one command ----------------------------------------------------------------------------------------------------


def outcome(case: Case, place: Path) -> Outcome:
    """Run a command in its folder, and judge its output and its files."""
    out, err = io.StringIO(), io.StringIO()
    before = set(place.rglob("*"))
    with redirect_stdout(out), redirect_stderr(err):
        try:
            with warnings.catch_warnings(record=True) as heard:
                warnings.simplefilter("always")
                code = case.run()
        except CalibrationError as error:  # only for programs in Python: commands print these errors
            code = error.exit_code
            print(f"ceres-cal: {error}", file=err)
        except MemoryError as error:
            return Outcome("memory", repr(error), _place_of(error))
        except BaseException as error:
            return Outcome("unexpected", repr(error)[:300], _place_of(error))
        said = err.getvalue()
        if heard:
            return Outcome("warning", str(heard[0].message), f"{heard[0].filename}:{heard[0].lineno}")
        if "Traceback" in said + out.getvalue() or "out of memory" in said:
            return Outcome("memory" if "out of memory" in said else "unexpected", said[:300])
        if code not in EXIT_CODES:
            return Outcome("exit code", f"{code}: {said[:300]}")
        *progress, last = said.splitlines() or [""]
        if code >= 2 and case.name != "batch" and not last.startswith("ceres-cal: "):
            return Outcome("many lines", said[-300:])
        if any(line.startswith("ceres-cal: ") for line in progress):
            return Outcome("many lines", said[-300:])
        if half := _half_written(place, before):
            return Outcome("half written", half)
    return Outcome(("accepted", "no", "refused", "no solution")[code], said.strip())


def _place_of(error: BaseException) -> str:
    """Places in the package, the innermost first."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "ceres_cal" in f.filename]
    return " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in reversed(frames[-4:]))


def _half_written(place: Path, before: set[Path]) -> str:
    """What is wrong with a new file; "" where all are complete."""
    for path in sorted(set(place.rglob("*")) - before):
        if path.name.endswith(".part") or (path.is_file() and path.stat().st_size == 0):
            return f"{path.name} is left"
        try:
            if path.suffix == ".json" and path.is_file():
                data = json.loads(path.read_bytes())
                stated = data.get("format") if isinstance(data, dict) else None
                if stated in FORMATS:
                    FORMATS[stated](path)
            elif path.suffix == ".npz":
                with np.load(path, allow_pickle=False) as archive:
                    _ = [archive[name] for name in archive.files]
        except (CalibrationError, ValueError, OSError) as error:
            return f"{path.name} cannot be read: {error}"
    return ""


# ---- children -------------------------------------------------------------------------------------------------------


def work(folder: Path, seed: int, numbers: Sequence[int], answers: Any) -> None:
    """Runs these numbers; each answer is (number, name, outcome, seconds, MB)."""
    os.setpgid(0, 0)  # so that its children can be ended with it
    for descriptor in (1, 2):
        os.dup2(os.open(os.devnull, os.O_WRONLY), descriptor)  # output of libraries
    os.environ["CERES_CAL_DEBUG"] = "1"  # unexpected errors are raised, not printed
    trace = (folder / TRACE).open("w")
    for told in (signal.SIGUSR1, signal.SIGPROF):
        faulthandler.register(told, trace, all_threads=True, chain=True)
    place = Path(tempfile.mkdtemp(dir=folder, prefix="run"))
    os.chdir(place)
    before_mb = _peak_mb()  # a fork starts with its parent's peak
    for number in numbers:
        _emptied(place)
        case = make_case(folder / "good", place, _rng(seed, number))
        answers.send((number, case.name, Outcome("begun", _line_of(case)), 0.0, 0.0))
        signal.setitimer(signal.ITIMER_PROF, LONGEST_S + 5)  # ends this process, even within native code
        begin = time.process_time()
        found = outcome(case, place)
        seconds = time.process_time() - begin
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        peak_mb = _peak_mb() - before_mb
        if peak_mb > MOST_MB:
            found = found._replace(what="memory")
        elif seconds > LONGEST_S:
            found = found._replace(what="slow")
        answers.send((number, case.name, found, seconds, peak_mb))
        if peak_mb > MOST_MB / 4:  # the peak of all later runs would be at least this
            return


def _emptied(place: Path) -> None:
    for path in place.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink()


def _line_of(case: Case) -> str:
    return shlex.join([case.program or "ceres-cal", *case.words]) + f"  # {', '.join(case.changes)}"


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _rng(seed: int, number: int) -> np.random.Generator:
    return np.random.default_rng((seed, number))


# ---- all runs -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Goal:
    """Which runs of a seed, and until what time."""

    numbers: range
    end: float = math.inf


class Counts(Counter[tuple[str, str]]):
    """How often each command had each outcome; and each failure by its place."""

    def __init__(self) -> None:
        super().__init__()
        self.failures: Counter[tuple[str, str, str]] = Counter()
        self.slowest_s = self.peak_mb = 0.0

    def add(self, name: str, found: Outcome, seconds: float, megabytes: float) -> int:
        """Counts it; returns, for a failure, how many of its kind there are."""
        self[name, found.what] += 1
        self.slowest_s, self.peak_mb = max(self.slowest_s, seconds), max(self.peak_mb, megabytes)
        if found.what not in FAILURES:
            return 0
        key = (found.what, name if not found.where else "", found.where or re.sub(r"[0-9]+", "0", found.words[:60]))
        self.failures[key] += 1
        return self.failures[key]


def fuzz(folder: Path, goal: Goal, seed: int, keep: Path | None = None) -> Counts:
    """Run all numbers of the goal with the corpus in folder/good."""
    counts, left = Counts(), goal.numbers
    context = multiprocessing.get_context("fork")
    while left and time.time() < goal.end:
        answers, theirs = context.Pipe(duplex=False)
        worker = context.Process(target=work, args=(folder, seed, left[:TOGETHER], theirs))
        worker.start()
        theirs.close()
        for number, name, found, seconds, megabytes in _answers(worker, answers, folder):
            left = goal.numbers[goal.numbers.index(number) + 1 :]
            if number % _SAID_EVERY == 0:
                print(f"at run {number}, {time.process_time():.0f} s", file=sys.stderr, flush=True)
            how_many = counts.add(name, found, seconds, megabytes)
            if 0 < how_many <= _KEPT:
                line = put_aside(folder, keep, found, seed, number)
                print(f"{number}: {found.what}: {line}\n    {found.words[:300]}\n    {found.where}", flush=True)
    return counts


def _answers(worker: Any, answers: Any, folder: Path) -> Iterator[tuple[int, str, Outcome, float, float]]:
    """The results of a child, including a result for a run in which it died."""
    begun: tuple[int, str] | None = None
    with suppress(EOFError):
        while answers.poll(LONGEST_WAIT_S) or _ended(worker):
            number, name, found, seconds, megabytes = answers.recv()
            begun = (number, name) if found.what == "begun" else None
            if begun is None:
                yield number, name, found, seconds, megabytes
    worker.join()
    if begun is not None:
        where = (folder / TRACE).read_text()
        what = "slow" if worker.exitcode in (-signal.SIGPROF, -signal.SIGUSR1, -signal.SIGKILL) else "died"
        lines = [line.split(", in ")[0] for line in where.splitlines() if "ceres_cal" in line][:4]
        yield *begun, Outcome(what, f"exit code {worker.exitcode}", " < ".join(_last(line) for line in lines)), 0.0, 0.0
    elif worker.exitcode:
        raise SystemExit(f"a child ended with exit code {worker.exitcode} between its runs")


def _last(line: str) -> str:
    """FILE:LINE of a line of a trace."""
    return re.sub(r'.*/([^/]*)", line ([0-9]+).*', r"\1:\2", line)


def _ended(worker: Any) -> bool:
    """End a child that no longer answers, and its children, after its trace is written. True: all it sent is there."""
    with suppress(ProcessLookupError):
        os.kill(worker.pid, signal.SIGUSR1)
        worker.join(2.0)
        os.killpg(worker.pid, signal.SIGKILL)
    return True


def put_aside(folder: Path, keep: Path | None, found: Outcome, seed: int, number: int) -> str:
    """Make a run's folder again, to be kept; returns its command line."""
    place = Path(tempfile.mkdtemp(dir=folder))
    if keep is not None:
        place = keep / f"{found.what} {seed} {number}".replace(" ", "-")
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir(parents=True)
    line = _line_of(make_case(folder / "good", place, _rng(seed, number)))
    if keep is not None:
        text = f"{line}\n{found.what}: {found.words}\n{found.where}\n"
        (place / "fuzz.txt").write_text(text, errors="surrogateescape")
    return line.encode(errors="backslashreplace").decode()


def prepare(folder: Path) -> Path:
    """Make the corpus in folder/good, and import the whole package, so that forks share it and the kernels."""
    for module in pkgutil.walk_packages(ceres_cal.__path__, "ceres_cal."):
        importlib.import_module(module.name)
    (folder / "good").mkdir()
    corpus(folder / "good")
    return folder


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    how_many = parser.add_mutually_exclusive_group()
    how_many.add_argument("--minutes", type=float, default=1.0)
    how_many.add_argument("--runs", type=int, metavar="N", help="so many, however long it takes")
    how_many.add_argument("--only", type=int, metavar="NUMBER", help="this run of the seed alone")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="for what was not handled well")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        goal = Goal(range(sys.maxsize), time.time() + 60.0 * given.minutes)
        if given.runs is not None:
            goal = Goal(range(given.runs))
        if given.only is not None:
            goal = Goal(range(given.only, given.only + 1))
        counts = fuzz(folder, goal, given.seed, given.keep)
    failed = sum(count for (_, what), count in counts.items() if what in FAILURES)
    if given.json:
        print(json.dumps({f"{name}: {what}": count for (name, what), count in sorted(counts.items())}))
    else:
        for (name, what), count in sorted(counts.items()):
            print(f"{name:18} {what:12} {count:8}")
        for (what, name, where), count in counts.failures.most_common():
            print(f"{count:6} {what}: {name} {where}")
    print(
        f"slowest {counts.slowest_s:.2f} s of processor, peak {counts.peak_mb:.0f} MB more than before", file=sys.stderr
    )
    print(f"{sum(counts.values())} commands, {failed} failures", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
