"""Findings of the diagnostics for correct scenes and for scenes with one fault: python scripts/run.py false_alarms

Every finding for a correct scene is a false alarm; their share of the scenes must keep to the stated rate. For a scene
with one fault, the largest finding must name it; any other finding is counted too. Exits with 1 when the rate is
exceeded by more than chance allows, or a fault is not named. --time measures `ceres-cal diagnose` with 100 000
observations instead, as a whole process.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from runner import Row, finished, measured, over, over_processes, parser

from accuracy.diagnostic_scenes import CLEAN, FAULTS, NOISE, USUAL, Problem, held_boards
from ceres_cal.base.tails import log_binomial_tail
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.diagnostics import FALSE_ALARM_RATE, Diagnosis, Finding, diagnose
from ceres_cal.problem.parameters import Options
from ceres_cal.simulate import simulate

MOST_SECONDS = 5.0
SURE = 0.001  # with a smaller probability of so many false alarms, the stated rate is exceeded


@dataclass(frozen=True)
class Tally:
    """One kind of scene: number of scenes, number of scenes with a (false) finding, and the kinds of the findings."""

    name: str
    scenes: int
    alarms: int
    kinds: dict[str, int]
    named: int | None = None

    def rows(self) -> Iterator[Row]:
        """The figures: share of faults named, and the probability of so many false alarms at the stated rate."""
        if self.named is not None:
            yield Row(self.name, "named, share", self.named / self.scenes, least=1.0)
        chance = _chance(self.alarms, self.scenes) if self.alarms else 1.0
        least = SURE if self.named is None else -np.inf
        note = f"{self.alarms} in {self.scenes} scenes"
        yield Row(self.name, "probability of so many false alarms", chance, least=least, note=note)

    def __str__(self) -> str:
        named = "" if self.named is None else f"named in {self.named}, "
        kinds = ", ".join(f"{kind} {count}" for kind, count in self.kinds.items())
        count = f"{self.name:40}{self.scenes:5} scenes  {named}{self.alarms:3} false alarms"
        return f"{count}  {next(self.rows()).verdict:4}{kinds}".rstrip()


def _chance(alarms: int, scenes: int) -> float:
    """Probability of so many false alarms at the stated rate."""
    return float(np.exp(log_binomial_tail(alarms, scenes, FALSE_ALARM_RATE)))


def diagnosed(problem: Problem, seed: int) -> Diagnosis:
    observations = problem.observe(seed)
    return diagnose(calibrate(observations, problem.options), observations)


def _found(name: str, seed: int) -> tuple[Finding, ...]:
    return diagnosed(CLEAN[name] if name in CLEAN else FAULTS[name][0], seed).findings


def clean_tally(name: str, seeds: range) -> Tally:
    alarms, kinds = 0, Counter[str]()
    for findings in over(partial(_found, name), seeds):
        alarms += bool(findings)
        kinds.update(finding.kind for finding in findings)
    return Tally(name, len(seeds), alarms, dict(kinds))


def fault_tally(name: str, seeds: range) -> Tally:
    """A fault counts as named when the finding with the largest effect has its kind and subject."""
    _, kind, subject = FAULTS[name]
    named, alarms, kinds = 0, 0, Counter[str]()
    for findings in over(partial(_found, name), seeds):
        named += bool(findings) and (findings[0].kind, findings[0].subject) == (kind, subject)
        others = [one for one in findings if (one.kind, one.subject) != (kind, subject)]
        alarms += bool(others)
        kinds.update(one.kind for one in others)
    return Tally(name, len(seeds), alarms, dict(kinds), named)


def process_rows(_: int) -> Iterator[Row]:
    """Time of the command with many observations: boards, and a lens with one power too few."""
    observations = simulate(held_boards(USUAL, count=1860), NOISE, 1).observations
    with tempfile.TemporaryDirectory() as folder:
        names = [str(Path(folder) / name) for name in ("calibration.json", "observations.json")]
        calibrate(observations, Options(powers=(3,))).save(names[0])
        observations.save(names[1])
        command = [sys.executable, "-c", "from ceres_cal.cli import main; main()", "diagnose", *names]
        taken = []
        for _ in range(3):
            start = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            taken.append(time.perf_counter() - start)
    note = f"{len(observations.points)} observations"
    yield Row("time", "ceres-cal diagnose, whole process, s", min(taken), most=MOST_SECONDS, note=note)


def main(arguments: Sequence[str] | None = None) -> int:
    options = parser(__doc__, (50, "clean scenes of each kind"), [*CLEAN, *FAULTS])
    options.add_argument("--faults", type=int, default=10, help="scenes of each fault (default 10)")
    options.add_argument("--seed", type=int, default=0, help="of the first scene (default 0)")
    options.add_argument("--time", action="store_true", help="measure the command on 100 000 observations instead")
    given = options.parse_args(arguments)
    if given.time:
        given.case = None
        return measured({"time": process_rows}, given)
    tallies = []
    with over_processes(given.jobs):
        for number, name in enumerate([*CLEAN, *FAULTS]):
            if name in (given.case or (name,)):
                make, count = (clean_tally, given.runs) if name in CLEAN else (fault_tally, given.faults)
                first = given.seed + 1000 * number  # scenes of different kinds get different noise
                tallies.append(make(name, range(first, first + count)))
                if given.json != "-":
                    print(tallies[-1], flush=True)
    clean = [tally for tally in tallies if tally.named is None]
    if clean:
        scenes, alarms = sum(tally.scenes for tally in clean), sum(tally.alarms for tally in clean)
        tallies.append(Tally(f"all clean, at most {100 * FALSE_ALARM_RATE:g} % by design", scenes, alarms, {}))
        if given.json != "-":
            print(tallies[-1])
    return finished([row for tally in tallies for row in tally.rows()], given)
