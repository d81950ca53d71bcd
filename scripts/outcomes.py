"""The figures that a change must not make worse, in one table: python scripts/outcomes.py [--help]

Runs the commands that measure them, one after the other, and prints one row for each key figure. `-o` stores all
figures as JSON. `--against` compares with a stored table and marks differences beyond the sampling error. `--checkout`
measures another checkout of the repository with its own Python and its own scripts. Exits with 1 when a command gives
no figures, or when a figure differs from the stored one.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
MOST_ERRORS = 2.0  # standard errors of a difference: one figure in twenty is marked by chance
ALIKE = 0.05  # relative, for figures without a standard error: times, and results of a single photograph
NONE_YET = 1.0  # standard error of a count of 0, equal to that of a Poisson count of 1
SHARED = {"CERES_CAL_REAL": "shared/real", "CERES_CAL_SHARED": "shared"}  # beside the repository

# ---- figures --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Figure:
    """One figure of a command.

    Attributes:
        error: its standard error, 0 where it has none. verdict: "no" where the command reports that it is missed.
        key: whether the table always shows it, or only where it differs. seconds: time of the whole command.
    """

    command: str
    name: str
    value: float
    error: float = 0.0
    verdict: str = ""
    key: bool = True
    seconds: float = 0.0

    def differs(self, old: Figure) -> str:
        """The kind of difference from a stored figure, "" for none."""
        if old.verdict in ("yes", "open") and self.verdict == "no":
            return "missed now"
        if self.value == old.value or (math.isnan(self.value) and math.isnan(old.value)):
            return ""
        if not (math.isfinite(self.value) and math.isfinite(old.value)):
            return "other"
        step, error = self.value - old.value, math.hypot(self.error, old.error)
        least = MOST_ERRORS * error if error else ALIKE * max(abs(self.value), abs(old.value))
        return "" if abs(step) <= least else "higher" if step > 0.0 else "lower"


def _count(command: str, name: str, count: float, most: float = math.inf) -> Figure:
    verdict = "" if math.isinf(most) else "yes" if count <= most else "no"
    return Figure(command, name, count, math.sqrt(max(count, NONE_YET)), verdict)


# ---- parsers of outputs ---------------------------------------------------------------------------------------------

Parser = Callable[[str, str], Iterator[Figure]]


def rows(group: Callable[[str, str], str]) -> Parser:
    """Rows of scripts that judge them: each row, and as key figures their means (for counts, sums) by group."""

    def parse(command: str, text: str) -> Iterator[Figure]:
        groups: dict[str, list[Mapping[str, Any]]] = defaultdict(list)
        found = json.loads(text)
        for row in found:
            name = f"{row['case']}: {row['what']}"
            error = row["error"] or (_count("", "", row["value"]).error if _is_count(row) else 0.0)
            own = group(row["case"], row["what"])
            yield Figure(command, name, row["value"], error, row["verdict"], not own)
            if own:
                groups[own].append(row)
        for name, members in groups.items():
            values = [row["value"] for row in members if math.isfinite(row["value"])]
            if all(map(_is_count, members)):
                yield replace(_count(command, f"{name}, in all", sum(values)), verdict=_worst(members))
            elif values:
                error = math.hypot(*(row["error"] for row in members)) / len(members)
                yield Figure(command, f"{name}, mean", sum(values) / len(values), error)
        yield _count(command, "figures missed", sum(row["verdict"] == "no" for row in found))

    return parse


def _is_count(row: Mapping[str, Any]) -> bool:
    return row.get("most") == 0.0


def _worst(members: Iterable[Mapping[str, Any]]) -> str:
    verdicts = {str(row["verdict"]) for row in members}
    return next((verdict for verdict in ("no", "open", "yes") if verdict in verdicts), "")


def _what(case: str, what: str) -> str:
    return what


def _what_of_halves(case: str, what: str) -> str:
    kinds = [kind for kind in ("control", "by defaults") if kind in case]
    return ", ".join([what, *kinds])


def _promise(case: str, what: str) -> str:
    return what.rpartition(": ")[2] if case != "everything" else ""


def _how(case: str, what: str) -> str:
    return f"{case.rpartition(', ')[2]}: {what}"


def _each(case: str, what: str) -> str:
    return ""


def odd_scenes(command: str, text: str) -> Iterator[Figure]:
    """Its table: scenes, refusals and errors, for each kind and for all."""
    kinds = re.findall(r"^  (\S.*?) +(\d+) +(\d+) +(\d+) +(\d+)$", text, re.MULTILINE)
    counts = [sum(int(kind[at]) for kind in kinds) for at in range(1, 5)]
    if not counts[0]:
        raise ValueError("no table of scenes")
    yield Figure(command, "scenes", counts[0])
    yield _count(command, "refused", counts[1])
    yield _count(command, "known numbers over 5 sd off", counts[2], 0.0)
    yield _count(command, "places over 2.5 radii off", counts[3], 2.0)
    for name, _, *of_kind in kinds:
        for what, count in zip(("refused", "known > 5 sd", "places > 2.5"), of_kind, strict=True):
            yield replace(_count(command, f"{name}: {what}", int(count)), key=False)


def false_alarms(command: str, text: str) -> Iterator[Figure]:
    """Its table: false alarms of correct scenes, faults named, and false alarms beside them."""
    pattern = r"^(.+?) +(\d+) scenes +(?:named in (\d+), +)?(\d+) false alarms +(yes|no)"
    found = re.findall(pattern, text, re.MULTILINE)
    scenes = [(name, int(count), named, int(alarms), verdict) for name, count, named, alarms, verdict in found]
    if not scenes:
        raise ValueError("no scenes")
    for name, count, named, alarms, verdict in scenes:
        total = name.startswith("all clean")
        yield replace(_count(command, f"{name}: false alarms", alarms), verdict=verdict, key=total)
        if named:
            yield replace(_share(command, f"{name}: named", int(named), count), verdict=verdict, key=False)
    faults = [scene for scene in scenes if scene[2]]
    if faults:
        count = sum(scene[1] for scene in faults)
        yield _share(command, "faults named", sum(int(scene[2]) for scene in faults), count)
        yield _count(command, "false alarms beside faults", sum(scene[3] for scene in faults))


def _share(command: str, name: str, count: int, of: int) -> Figure:
    share = count / of
    least = NONE_YET / of  # even a share of 0 or 1 has an error of one case
    return Figure(command, f"{name}, share", share, max(math.sqrt(share * (1.0 - share) / of), least))


def benchmark(command: str, text: str) -> Iterator[Figure]:
    """Its report: our seconds, the ratio to the fastest other solver, memory, errors."""
    report = json.loads(text)
    yield Figure(command, "import, s", report["import_seconds"]["ceres-cal"])
    yield Figure(command, "first calibration of a process takes longer by, s", report["first_call_seconds"])
    for compared in report["comparison"]:
        size, ours = f"{compared['frames']} frames", compared["solvers"]["ceres-cal"]
        yield Figure(command, f"{size}, s", ours["total_seconds"])
        if compared["fastest_peer_times_ours"] is not None:
            yield Figure(command, f"{size}, the fastest other takes times ours", compared["fastest_peer_times_ours"])
        yield Figure(command, f"{size}, rms px", ours["rms_px"], key=False)
        yield _count(command, f"{size}, mirrored", ours["mirrored"], 0.0)
    yield Figure(command, "standard deviations of everything add, share", report["uncertainty_share"])
    for kind in ("frames", "field"):
        for row in report.get(kind, ()):
            size = f"growth, {row['size']} {'line points' if kind == 'field' else kind}"
            yield Figure(command, f"{size}, s", row["seconds"])
            if "peak_mib" in row:
                yield Figure(command, f"{size}, MiB", row["peak_mib"])
    for row in report["pixels"]:
        for what in ("locate", "project"):
            yield Figure(command, f"{what} a million pixels, {row['lens']}, s", row[what], key=False)


def benchmark_lenses(command: str, text: str) -> Iterator[Figure]:
    """Its report: seconds for each lens, and for the automatic choice."""
    for row in json.loads(text)["lenses"]:
        for what in ("brown", "spline", "auto"):
            yield Figure(command, f"{row['frames']} frames, {what}, s", row[what])
        yield Figure(command, f"{row['frames']} frames, auto adds, %", row["auto_adds"])


# ---- commands -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Command:
    """A script that measures.

    Attributes:
        script: its name, anywhere below scripts/. parse: makes figures of its output.
        quick: arguments for small runs. full: other arguments, with `runs` as --runs where it has this option.
        json: how the script writes its figures: to a "file", to "stdout", or not, "".
        jobs: whether it has --jobs.
    """

    script: str
    parse: Parser
    quick: tuple[str, ...]
    runs: int = 0
    full: tuple[str, ...] = ()
    json: str = "file"
    jobs: bool = True


COMMANDS: dict[str, Command] = {
    "odd_scenes": Command("odd_scenes", odd_scenes, ("--runs", "24"), 2000, json="", jobs=False),
    "intervals": Command("intervals", rows(_what), ("--runs", "2"), 500),
    "halves": Command("halves", rows(_what_of_halves), ("--runs", "2", "--case", "sony", "opencv left"), 20),
    "false_alarms": Command("false_alarms", false_alarms, ("--runs", "1", "--faults", "1"), 50, json=""),
    "checks": Command("checks", rows(_each), ("--runs", "8", "--case", "false"), 400),
    "moves": Command("moves", rows(_each), ("--runs", "4", "--case", "moves", "bound", "again"), 1000),
    "advice": Command("advice", rows(_promise), ("--runs", "2", "--case", "whole field, 8 deg"), 100),
    "photographs": Command(
        "photographs", rows(_how), ("--case", "lines", "--runs", "2"), 0, ("--case", "shared"), "stdout", False
    ),
    "benchmark": Command("benchmark", benchmark, ("--quick",), jobs=False),
    "lenses": Command(
        "benchmark", benchmark_lenses, ("--lenses", "--frames", "20", "--repeat", "1"), 0, ("--lenses",), jobs=False
    ),
}
"""By their names in the table."""


class NoFiguresError(Exception):
    """A command ended without its figures."""


def measured(name: str, checkout: Path, chosen: argparse.Namespace) -> list[Figure]:
    """All figures of a command.

    Raises: NoFiguresError.
    """
    command = COMMANDS[name]
    script = next((checkout / "scripts").rglob(f"{command.script}.py"), None)
    if script is None:
        raise NoFiguresError(f"{checkout / 'scripts'} has no {command.script}.py")
    own = checkout / ".venv" / "bin" / "python"
    python = own if checkout != ROOT or own.is_file() else Path(sys.executable)
    arguments = [*(command.quick if chosen.quick else command.full)]
    if command.runs and not chosen.quick:
        arguments += ["--runs", str(max(round(chosen.share * command.runs), 2))]
    if command.jobs and chosen.jobs != 1:
        arguments += ["--jobs", str(chosen.jobs)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "figures.json"
        arguments += {"file": ["--json", str(path)], "stdout": ["--json"], "": []}[command.json]
        start = time.perf_counter()
        try:
            named = [script] if script.parent.name == "scripts" else [checkout / "scripts" / "run.py", command.script]
            line = [str(python), *map(str, named), *arguments]
            done = subprocess.run(line, cwd=checkout, env=_environment(), stdout=subprocess.PIPE, text=True)
        except OSError as error:
            raise NoFiguresError(f"{python} does not start: {error.strerror}") from None
        seconds = time.perf_counter() - start
        try:
            text = path.read_text(encoding="utf-8") if command.json == "file" else done.stdout
            return [replace(figure, seconds=seconds) for figure in command.parse(name, text)]
        except (OSError, ValueError, KeyError) as error:
            why = f"exit code {done.returncode}; {error!r}"
            raise NoFiguresError(f"{script.name} {' '.join(arguments)}: no figures to be read: {why}") from error


def _environment() -> dict[str, str]:
    """Photographs outside of the repository are those beside this checkout, also for another checkout."""
    beside = {name: str(ROOT.parent / place) for name, place in SHARED.items() if (ROOT.parent / place).is_dir()}
    return {**beside, **os.environ}


# ---- the table ------------------------------------------------------------------------------------------------------


Setting = Mapping[str, Any]  # must be the same for two tables that are compared


def load(path: Path, setting: Setting) -> dict[tuple[str, str], Figure]:
    """A stored table, measured with this setting.

    Raises: SystemExit.
    """
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        figures = [Figure(**row) for row in stored["figures"]]
        then = stored["setting"]
    except OSError as error:
        raise SystemExit(f"{path}: {error.strerror}") from None
    except (ValueError, KeyError, TypeError):
        raise SystemExit(f"{path}: this is no table of outcomes: scripts/outcomes.py -o makes one") from None
    if then != setting:
        raise SystemExit(f"{path}: measured with {then}, now with {setting}: give the same --quick and --share")
    return {(figure.command, figure.name): figure for figure in figures}


def save(path: Path, commit: str, setting: Setting, figures: Sequence[Figure]) -> None:
    """Store a table, completely or not at all."""
    part = path.with_name(f"{path.name}.part")
    table = {"commit": commit, "setting": setting, "figures": [asdict(each) for each in figures]}
    part.write_text(json.dumps(table, indent=1), encoding="utf-8")
    part.replace(path)


def shown(figure: Figure, old: Figure | None, compares: bool) -> str:
    """A row of the table."""
    words = [f"{figure.command:13}{figure.name:70}{_value(figure):>20}{figure.seconds:8.0f} s  {figure.verdict:4}"]
    if compares:
        mark = "is new" if old is None else figure.differs(old)
        words.append(f"{'-' if old is None else _value(old):>20}  {mark}")
    return "".join(words).rstrip()


def _value(figure: Figure) -> str:
    return f"{figure.value:.4g}" + (f" ± {figure.error:.2g}" if figure.error else "")


def arguments_of(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The parsed arguments."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0], allow_abbrev=False)
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=list(COMMANDS), help="only these commands")
    parser.add_argument("--quick", action="store_true", help="few runs of each: does it work? Figures say little")
    parser.add_argument("--share", type=float, default=1.0, help="of each command's runs (default 1)")
    parser.add_argument("--jobs", type=int, default=1, help="processes of each command; 0 is one a core (default 1)")
    parser.add_argument("--checkout", type=Path, default=ROOT, help="measure this checkout (default: this one)")
    parser.add_argument("--all", action="store_true", help="print every figure, not the key figures alone")
    parser.add_argument("--against", type=Path, metavar="FILE", help="compare with a stored table")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="store all figures there, command by command")
    chosen = parser.parse_args(arguments)
    if not chosen.share > 0.0:
        parser.error("--share must be more than 0")
    if not (chosen.checkout / "scripts").is_dir():
        parser.error(f"{chosen.checkout}: this is no checkout, it has no scripts/")
    return chosen


def main(arguments: Sequence[str] | None = None) -> int:
    chosen = arguments_of(arguments)
    checkout = chosen.checkout.resolve()
    setting = {"quick": chosen.quick, "share": chosen.share}
    stored = load(chosen.against, setting) if chosen.against else {}
    commit = subprocess.run(["git", "-C", checkout, "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip()
    figures: list[Figure] = []
    code = 0
    for name in chosen.only:
        try:
            found = measured(name, checkout, chosen)
        except NoFiguresError as error:
            print(f"{name:13}{error}", flush=True)
            code = 1
            continue
        figures += found
        for figure in found:
            old = stored.get((figure.command, figure.name))
            mark = old is not None and bool(figure.differs(old))
            code |= mark
            if figure.key or mark or chosen.all:
                print(shown(figure, old, bool(stored)), flush=True)
        if chosen.output:
            save(chosen.output, commit, setting, figures)
    own = {(figure.command, figure.name) for figure in figures}
    commands = {figure.command for figure in figures}
    for figure in stored.values():
        if figure.command in commands and (figure.command, figure.name) not in own:
            print(f"{figure.command:13}{figure.name:70}{'not measured now, before ' + _value(figure):>20}")
            code = 1
    return code


if __name__ == "__main__":
    sys.exit(main())
