"""What the diagnostics find where nothing is wrong, and where one thing is: python scripts/false_alarms.py [--help]

Every finding on a clean scene is a false alarm; their share of the scenes must keep to the stated rate. On a scene with
one planted fault the largest finding must name it; any other finding there is counted too. Exits with 1 when the rate
is exceeded by more than chance allows, or a fault is not named. --time measures `ceres-cal diagnose` on 100 000
observations instead, as a whole process.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from cases import add_jobs, over, over_processes
from diagnostic_scenes import CLEAN, FAULTS, NOISE, USUAL, Problem, held_boards

from ceres_cal.base.tails import log_binomial_tail
from ceres_cal.calibrating import calibrate
from ceres_cal.diagnostics import FALSE_ALARM_RATE, Diagnosis, Finding, diagnose
from ceres_cal.model.parameters import Options
from ceres_cal.simulate import simulate

MOST_SECONDS = 5.0
SURE = 0.001  # a count of false alarms less probable than this exceeds the rate


@dataclass(frozen=True)
class Row:
    """One kind of scene: how many, in how many of them there was a (false) finding, and which."""

    name: str
    scenes: int
    alarms: int
    kinds: dict[str, int]
    named: int | None = None

    @property
    def verdict(self) -> str:
        if self.named is not None:
            return "yes" if self.named == self.scenes else "no"
        return "no" if self.alarms and _chance(self.alarms, self.scenes) < SURE else "yes"

    def __str__(self) -> str:
        named = "" if self.named is None else f"named in {self.named}, "
        kinds = ", ".join(f"{kind} {count}" for kind, count in self.kinds.items())
        count = f"{self.name:40}{self.scenes:5} scenes  {named}{self.alarms:3} false alarms"
        return f"{count}  {self.verdict:4}{kinds}".rstrip()


def _chance(alarms: int, scenes: int) -> float:
    """Probability of so many false alarms at the stated rate."""
    return float(np.exp(log_binomial_tail(alarms, scenes, FALSE_ALARM_RATE)))


def diagnosed(problem: Problem, seed: int) -> Diagnosis:
    observations = problem.observe(seed)
    return diagnose(calibrate(observations, problem.options), observations)


def _found(name: str, seed: int) -> tuple[Finding, ...]:
    return diagnosed(CLEAN[name] if name in CLEAN else FAULTS[name][0], seed).findings


def clean_row(name: str, seeds: range) -> Row:
    alarms, kinds = 0, Counter[str]()
    for findings in over(partial(_found, name), seeds):
        alarms += bool(findings)
        kinds.update(finding.kind for finding in findings)
    return Row(name, len(seeds), alarms, dict(kinds))


def fault_row(name: str, seeds: range) -> Row:
    """A scene counts as named when the finding of most effect is of the planted kind and subject."""
    _, kind, subject = FAULTS[name]
    named, alarms, kinds = 0, 0, Counter[str]()
    for findings in over(partial(_found, name), seeds):
        named += bool(findings) and (findings[0].kind, findings[0].subject) == (kind, subject)
        others = [one for one in findings if (one.kind, one.subject) != (kind, subject)]
        alarms += bool(others)
        kinds.update(one.kind for one in others)
    return Row(name, len(seeds), alarms, dict(kinds), named)


def process_seconds() -> tuple[int, float]:
    """Observations, and how long the command takes on them: boards and a lens one power too short, cache warm."""
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
    return len(observations.points), min(taken)


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=50, help="clean scenes of each kind; default: 50")
    parser.add_argument("--faults", type=int, default=10, help="scenes of each fault; default: 10")
    parser.add_argument("--case", choices=[*CLEAN, *FAULTS], help="only this one")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene; default: 0")
    parser.add_argument("--time", action="store_true", help="measure the command on 100 000 observations instead")
    parser.add_argument("--json", action="store_true")
    add_jobs(parser)
    args = parser.parse_args(arguments)
    if args.time:
        count, seconds = process_seconds()
        print(f"ceres-cal diagnose, {count} observations, whole process: {seconds:.2f} s (at most {MOST_SECONDS:g} s)")
        return int(seconds > MOST_SECONDS)
    rows, start = [], time.perf_counter()
    with over_processes(args.jobs):
        for number, name in enumerate([*CLEAN, *FAULTS]):
            if args.case in (None, name):
                make, count = (clean_row, args.runs) if name in CLEAN else (fault_row, args.faults)
                first = args.seed + 1000 * number  # one draw of noise before two lenses is no two draws
                rows.append(make(name, range(first, first + count)))
                if not args.json:
                    print(rows[-1], flush=True)
    clean = [row for row in rows if row.named is None]
    scenes, alarms = sum(row.scenes for row in clean), sum(row.alarms for row in clean)
    total = Row(f"all clean, at most {100 * FALSE_ALARM_RATE:g} % by design", scenes, alarms, {})
    if args.json:
        print(json.dumps({"rows": [vars(row) | {"verdict": row.verdict} for row in [*rows, total]]}, indent=1))
    elif clean:
        print(f"{total} {100.0 * alarms / scenes:.2f} %, {time.perf_counter() - start:.0f} s")
    return int(any(row.verdict == "no" for row in [*rows, total]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
