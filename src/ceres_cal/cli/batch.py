"""`ceres-cal batch`: many calibrations, checks and refits in several processes, each by its own command."""

from __future__ import annotations

import glob
import math
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ceres_cal import base, cli, report
from ceres_cal.base import DASH, InputError, counted, mm, plural, printable
from ceres_cal.cli.arguments import output_option
from ceres_cal.cli.command import COMMANDS, QuietArguments, argument, command, option, switch, whole
from ceres_cal.report.document import Card, Chapter, Document, Piece, Section, Table, Text, Tile

_COMMANDS = ("calibrate", "check", "refit")
_READ = ("observations", "calibration", "inputs", "images")  # arguments that are names of files
_OWN = {"-o", "--output", "--report", "--json"}
_SUMMARY = "summary.html"
_EXIT_CODES = {"failed": 3, "no": 1}
_WORDS = {"failed": "failed", "no": "not to be trusted, or moved", "care": "usable with limits", "good": "good"}
_LEVELS = {"failed": "no"}
"""Levels that the page colours differently."""
_MOST_REASONS = 4


@command(
    "batch",
    "many calibrations, checks and refits, resumable, with one page that ranks them",
    "plan.toml -o results/ --jobs 4",
    "rooms/ -o results/ --options '--lens auto --prior height_m=4.02:20mm' --reports",
)
def _run(
    args: QuietArguments,
    plan: Path = argument(
        "PLAN",
        "a table (.jsonl, .csv, .toml) with name, command (calibrate, check or refit) and arguments of each job, "
        "files named from its folder; or a folder: each file of observations in it is calibrated, those of a folder "
        "inside it together",
    ),
    output: Path = output_option(
        f"results.jsonl, what jobs write, and {_SUMMARY}; made if missing. Jobs with a result there, "
        "and unchanged inputs, are not done again",
        metavar="DIR",
    ),
    options: str = option("additional arguments for every calibrate job", "'...'", ""),
    jobs: int = option("jobs at a time; default: 0, one a core", "N", 0, read=whole(0), elsewhere=("threads",)),
    reports: bool = switch("a report of each calibrate and refit, too", elsewhere=("report",)),
) -> Document:
    planned = plan_jobs(plan, output, options, reports=reports)
    base.make_folder(output)
    outcomes, again = [], 0
    with base.processes(jobs if len(planned) > 1 else 1) as executor:
        for outcome, is_old in cli.run_jobs(planned, work, output, executor):
            outcomes.append(outcome)
            again += is_old
            if not args.silent:
                print(_line(outcome, len(outcomes), len(planned), is_old), file=sys.stdout, flush=True)
    pages = {job.name: file.name for job in planned for file in job.outputs if file.suffix == ".html" and file.exists()}
    page = output / _SUMMARY
    base.write_bytes(page, summary_page(printable(plan.resolve().name), outcomes, pages).encode())
    worst = min(outcomes, key=lambda one: one.order).level
    return Document(_sections(str(page), outcomes, again), _EXIT_CODES.get(worst, 0))


# ---- jobs -----------------------------------------------------------------------------------------------------------


def plan_jobs(plan: Path, to: Path, options: str = "", *, reports: bool = False) -> list[cli.Job]:
    """Return the jobs of a plan, with all that `work` needs; their outputs go into the folder `to`.

    Args:
        options: further options of every calibrate job. reports: whether calibrate and refit write a report.

    Raises:
        InputError: the plan cannot be read, or a row is wrong usage of its command; the message says which.
    """
    base = plan if plan.is_dir() else plan.parent
    of_all, jobs = cli.words_of(options, "--options"), []
    for row in cli.read_plan(plan):
        more = of_all if row.command == "calibrate" else []
        try:
            jobs.append(_job(row.name, row.command, [*row.arguments, *more], base, to, reports))
        except InputError as error:
            raise InputError(f"{plan}, job {row.name!r}: {error}") from None
    return jobs


def _job(name: str, command: str, arguments: Sequence[str], base: Path, to: Path, reports: bool) -> cli.Job:
    if command not in _COMMANDS:
        raise InputError(f"there is no command {command!r} for a batch: {', '.join(_COMMANDS)}")
    if not _OWN.isdisjoint(argument.partition("=")[0] for argument in arguments):
        raise InputError(f"leave out {', '.join(sorted(_OWN))}: what jobs write goes into the folder of the batch")
    outputs = () if command == "check" else (to / f"{name}.json", *([to / f"{name}.html"] if reports else []))
    parsed = COMMANDS[command].parse([*arguments, *_written(outputs)])
    values = (getattr(parsed, what, None) for what in _READ)
    named = [str(one) for value in values if value for one in (value if isinstance(value, tuple) else (value,))]
    placed = tuple(str(base / one) if one in named else one for one in arguments)
    return cli.Job(name, command, placed, tuple(file for one in named for file in _files(base / one)), outputs)


def _written(outputs: Sequence[Path]) -> Iterator[str]:
    """Yield the options for what a job writes: a calibration and possibly a report."""
    for name, file in zip(("-o", "--report"), outputs, strict=False):
        yield from (name, str(file))


def _files(path: Path) -> list[Path]:
    """Return a file or folder, or the files that match a pattern; the job itself reports missing files."""
    return [path] if path.exists() else [Path(one) for one in sorted(glob.glob(str(path)))] or [path]  # noqa: PTH207


def work(job: cli.Job) -> cli.Outcome:
    """Do one job, by its command.

    Raises:
        CalibrationError: as raised by the command.
    """
    data = COMMANDS[job.command].answer([*job.arguments, *_written(job.outputs)], quiet=True).data
    return _of_check(job, data) if job.command == "check" else _of_calibration(job, data)


def _of_calibration(job: cli.Job, data: Mapping[str, Any]) -> cli.Outcome:
    import numpy as np

    verdict, known = data["verdict"], data["uncertainty"] or {"maps": {}}
    radii = [float(np.nanmax(one["radius_95_mm"], initial=0.0)) for maps in known["maps"].values() for one in maps]
    finite = [radius for radius in radii if np.isfinite(radius)]
    reasons = [one["text"] for level in ("no", "care") for one in verdict["reasons"] if one["level"] == level]
    worst = max(finite) if finite else None
    unmade = [f"no {what}: {why}" for what, why in data.get("not_made", {}).items()]
    level = "care" if unmade and verdict["level"] == "good" else verdict["level"]
    told = (*unmade, *reasons)[:_MOST_REASONS]
    return cli.Outcome(job.name, job.command, level, verdict["headline"], told, worst)


def _of_check(job: cli.Job, data: Mapping[str, Any]) -> cli.Outcome:
    stations = data["stations"]
    said = [f"{name} {one['words']}" for name, one in stations.items() if not one["holds"]]
    moved = [one["moved_mm"] for one in stations.values() if math.isfinite(one["moved_mm"])]
    line = said[0] if said else f"{', '.join(stations)}: as calibrated"
    level, worst = "good" if data["holds"] else "no", max(moved) if moved else None
    return cli.Outcome(job.name, job.command, level, line, tuple(said[1:][:_MOST_REASONS]), worst)


# ---- what is said ---------------------------------------------------------------------------------------------------


def _line(outcome: cli.Outcome, number: int, total: int, is_old: bool) -> str:
    width = len(str(total))
    before = " (from before)" if is_old else ""
    return f"{outcome.level:10}{number:{width}} of {total}  {outcome.job}: {outcome.line}{before}"


def _sections(page: str, outcomes: Sequence[cli.Outcome], again: int) -> tuple[Section, ...]:
    count = Counter(one.level for one in outcomes)
    levels = ", ".join(f"{count[level]} {level}" for level in ("good", "care", "no", "failed") if count[level])
    before = f"; {again} from before" if again else ""
    ranked = sorted(outcomes, key=lambda one: one.order)
    said = f"{plural(len(outcomes), 'job')}: {levels}{before}"
    return (
        Section("jobs", [said], {"jobs": ranked, "from_before": again}),
        Section("written", [page], {"output": page}),
    )


# ---- the page: what needs attention first ----------------------------------------------------------------------------


def summary_page(title: str, outcomes: Sequence[cli.Outcome], links: dict[str, str]) -> str:
    """Return the page.

    Args:
        links: name of a job -> file beside the page.
    """
    most_cards = 40

    ranked = sorted(outcomes, key=lambda one: one.order)
    attention = [one for one in ranked if one.level != "good"]
    count = Counter(one.level for one in outcomes)
    level = _LEVELS.get(ranked[0].level, ranked[0].level)
    how = f"{counted(len(attention), 'job')} of {len(ranked)} to look at" if attention else "Nothing to look at"
    tiles = tuple(Tile(_WORDS[name], str(count[name]), "", "", _LEVELS.get(name, name)) for name in cli.LEVELS)
    chapters = [Chapter("verdict", f"{how}.", (tiles,), level)]
    if attention:
        cards: list[Piece] = [_card(one, links.get(one.job, "")) for one in attention[:most_cards]]
        if len(attention) > most_cards:
            cards.append(Text(f"And {len(attention) - most_cards} more, in the table."))
        chapters.append(Chapter("attention", "What needs attention, the worst first", tuple(cards)))
    rows = tuple(
        (one.job, one.command, one.level, DASH if one.worst_mm is None else mm(one.worst_mm), one.line)
        for one in ranked
    )
    table = Table(("job", "command", "level", "worst", "what it says"), rows, stacked=True, most=len(rows))
    chapters.append(Chapter("jobs", "All jobs", (table,)))
    return report.page.page(
        title, counted(len(ranked), "job"), chapters, "Written by ceres-cal batch.", "Batch summary"
    )


def _card(one: cli.Outcome, link: str) -> Card:
    facts = [one.command, one.level] + ([] if one.worst_mm is None else [f"worst {mm(one.worst_mm)}"])
    reasons = " ".join(one.reasons)
    return Card(_LEVELS.get(one.level, one.level), f"{one.job}: {one.line}", reasons, tuple(facts), link)
