"""Effects of the constants that decide something: python scripts/constants.py [--help]

Each constant is halved and doubled (a share of one half or more by its odds, a whole number to the nearest one), and
small, fast scenes are measured again: false alarms and findings of `diagnose`, refusals, boards mirrored or lost, the
error over the Cramer-Rao bound, false alarms and power of `check`, moves refitted, fields, boards and rings found. One
row for each constant and factor lists the figures that change; "nothing" where none changes in the digits shown.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HALF, TWICE = 0.5, 2.0
Value = float | int | tuple[float, ...]


@dataclass(frozen=True)
class Constant:
    """A constant that decides something.

    Attributes:
        module: below `ceres_cal`. name: in the module; "Class.field" for a default of a dataclass, "PRIOR.field" for a
            prior. figures: those that it may change.
    """

    module: str
    name: str
    figures: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"

    @property
    def value(self) -> Value:
        owner = importlib.import_module(f"ceres_cal.{self.module}")
        if "." in self.name:
            cls, field = self.name.split(".")
            of = getattr(owner, cls)
            value: Value = (
                inspect.signature(of).parameters[field].default if inspect.isclass(of) else getattr(of, field)
            )
        else:
            value = getattr(owner, self.name)
        return value

    def set(self, value: Value) -> None:
        """Sets the value in this process, also in modules that have imported a copy."""
        owner, old = importlib.import_module(f"ceres_cal.{self.module}"), self.value
        if "." in self.name:
            cls, field = self.name.split(".")
            if not inspect.isclass(getattr(owner, cls)):
                object.__setattr__(getattr(owner, cls), field, value)
                return
            if "__init__" not in vars(getattr(owner, cls)):  # that of all frozen data, which reads the fields
                getattr(owner, cls).__dataclass_fields__[field].default = value
                return
            make = inspect.unwrap(getattr(owner, cls).__init__)
            names = [name for name, one in inspect.signature(make).parameters.items() if one.default is not one.empty]
            defaults = list(make.__defaults__)
            defaults[names.index(field)] = value
            make.__defaults__ = tuple(defaults)
            return
        for module in [module for name, module in sys.modules.items() if name.startswith("ceres_cal")]:
            if vars(module).get(self.name) is old:
                setattr(module, self.name, value)


def _of(module: str, names: str, *figures: str) -> list[Constant]:
    return [Constant(module, name, figures) for name in names.split()]


DECIDING: tuple[Constant, ...] = (
    *_of("problem.parameters", "Options.loss_scale Options.reject_sigma", "calibrate", "diagnose"),
    *_of("problem.quantities", "PHI_RANGE _BUILT _REDRAWN", "calibrate"),
    *_of("observations.validation", "_SIGMA_RATIO _FAR", "calibrate"),
    *_of("robust.usable", "_OFF_CENTRE", "calibrate"),
    *_of("robust.usable", "NO_FIT", "calibrate"),
    *_of("calibration.lens_forms", "AS_GOOD ALIKE CLEARLY", "lens"),
    *_of("calibration.lens_comparison", "_QUIETER _SOUND_PX PRICE", "lens"),
    *_of("calibration.lens_seen", "_REFUTED _UNSEEN_GROUPS", "lens"),
    *_of("calibration.lens_seen", "_AT_BEST _KEPT _NEAR _FAR", "lens"),
    *_of("calibration.lens_comparison", "_TOGETHER", "lens"),
    *_of("calibration.lens_of_few", "_STRONG", "lens"),
    *_of("calibration.stretched", "_STRETCHED _BY _WORTH_A_SOLVE", "calibrate"),
    *_of("calibration.renaming", "_FITTING _BETTER", "calibrate"),
    *_of("posterior.posterior", "LEAST_PROBABILITY", "calibrate", "refit"),
    *_of("posterior.other_lenses", "AGREES", "lens"),
    *_of("calibration.outcome", "_RESTING", "calibrate"),
    *_of("observations.validation", "_LARGE_M _REMOTE_M", "calibrate"),
    *_of("robust.robust", "AT_REST", "calibrate"),
    *_of("robust.robust", "_ENOUGH_PLACEMENTS _MUCH_LESS", "calibrate"),
    *_of("robust.robust", "AT_REST_AGAIN", "refit"),
    *_of("robust.noise", "LEAST_SPARE _BORROWED", "calibrate"),
    *_of("robust.noise", "LARGER", "diagnose"),
    *_of("robust.noise", "USUAL_EQUATIONS", "refit"),
    *_of("robust.conflicts", "_SUSPICIOUS _RIVAL", "calibrate"),
    *_of("robust.stated", "LEVEL", "calibrate"),
    *_of("robust.usable", "_BELOW", "calibrate"),
    *_of("scene.targets.target", "HANDY_M", "calibrate"),
    *_of("robust.other_minima", "LOST _FEWEST", "calibrate"),
    *_of("robust.other_minima", "_DECIDED_SIGMA _SAME _MUCH_WORSE", "calibrate"),
    *_of("robust.competing", "_STANDS_OUT", "calibrate"),
    *_of("robust.competing", "_LEFT", "calibrate"),
    *_of("effects.aside", "DOUBTFUL", "calibrate"),
    *_of("effects.evidence", "FEATURE_ASIDE.absent VIEW_ASIDE.absent OFFSETS_SCATTER.absent", "calibrate"),
    *_of("effects.evidence", "DEPENDENCE.absent", "verdicts"),
    *_of("robust.as_built", "_REPEATS", "calibrate", "diagnose"),
    *_of("effects.evidence", "AS_BUILT.absent STRETCHED.absent", "calibrate", "diagnose"),
    *_of("effects.evidence", "LIKELY", "calibrate"),
    *_of("robust.competing", "FEWEST", "calibrate"),
    *_of("problem.bundle", "_POSED", "calibrate"),
    *_of("problem.costs", "_LEFT_TO_THE_COMPLEMENT", "calibrate"),
    *_of("start.initialise", "USUAL_PHI", "calibrate", "verdicts"),
    *_of("start.listed", "_CLEARLY _BY_CHANCE", "calibrate"),
    *_of("start.planes", "_ROUGH_PX _SUSPICIOUS _NO_FIT", "calibrate"),
    *_of("start.closed_forms", "_WRONG", "calibrate"),
    *_of("start.world", "_HOLDS _SCALES _ROUGH _LEFT_OVER _TOLD _OPEN _ALIKE _APART", "calibrate"),
    *_of("posterior.assess", "_BENT", "verdicts"),
    *_of("effects.groups", "_LEAST_LEFT", "verdicts"),
    *_of("posterior.bent", "_FAR", "verdicts"),
    *_of("posterior.mixture", "_BOUNDED _SHRINKING", "verdicts"),
    *_of("posterior.uncertainty", "KNOWN WEAK _IN_WORDS _TOGETHER", "verdicts"),
    *_of("posterior.assess", "_MOST_DOUBT", "verdicts"),
    *_of("posterior.other_lenses", "_PARTS", "verdicts"),
    *_of("posterior.mixture", "_LARGER", "verdicts"),
    *_of("posterior.mixture", "_FLAT", "verdicts"),
    *_of("posterior.uncertainty", "_LEARNT", "verdicts"),
    *_of("posterior.bent", "BENDING", "verdicts"),
    *_of("effects.strands", "LOUD _MATTERS", "verdicts"),
    *_of("robust.noise", "_TAIL", "calibrate"),
    *_of("problem.priors", "USUAL_ASPECT USUAL_DECENTRING", "calibrate", "verdicts"),
    *_of("robust.as_built", "_UNMEASURED", "calibrate"),
    *_of("robust.usable", "_NOT_BUILT", "calibrate", "diagnose"),
    *_of("effects.aside", "FEWEST_VIEWS", "calibrate"),
    *_of("robust.other_minima", "FEW _APART", "calibrate"),
    *_of("robust.usable", "_UNFILLED _UNUSUAL", "calibrate"),
    *_of("effects.columns", "_ALIKE", "diagnose"),
    *_of("diagnostics.advice.ranking", "_MUST_LEAVE _LARGER _LESS", "advice"),
    *_of("diagnostics.advice.candidates", "_MARKED", "advice"),
    *_of("effects.effect", "SMALL", "diagnose"),
    *_of("diagnostics.checks", "_FEWEST_PAIRS", "diagnose"),
    *_of("effects.columns", "_LEAST_SHARE", "diagnose"),
    *_of("effects.table.targets", "_FEWEST_ON_CURVE _FEWEST_OF_POINT", "diagnose"),
    *_of("diagnostics.diagnosis", "_FEWEST_AGREE _FAR_M", "diagnose"),
    *_of("moves.checks", "_INLIER_SIGMA _LEAST_SHARE _NEARBY _USUAL_EQUATIONS", "check"),
    *_of("moves.agreement", "FALSE_ALARMS NOISIER _SEEN_NATS", "check", "refit"),
    *_of("problem.residuals", "_STRAY", "check", "refit"),
    *_of("moves.poses", "_FITS_SHARE _FITS_SIGMA _FITS_SCALE _ALIKE _NATS_ALIKE _WIDE NOISES", "check", "refit"),
    *_of("moves.refit_plan", "_CHANGED", "refit"),
    *_of("moves.refits", "_UNIQUE", "refit"),
    *_of("moves.misplaced", "FEW SUPPORTED", "refit"),
    *_of("moves.explanations", "_HALF _RARE _TOO_NOISY _FAR_M _NEAR_M _NEAR_RAD", "refit"),
    *_of("detect.lines", "_LEAST_CLARITY _LEAST_CONTRAST _OF_NEARBY _NOISY _WANDERING _FAR", "lines"),
    *_of("detect.strokes", "_LEAST_PX _STRAIGHT_PX _NOISE _NOISE_NEARBY _WIDEST _COARSER _OWN", "auto"),
    *_of("detect.saddles", "_LOST _FAINT", "boards"),
    *_of("detect.april_grids", "_OTHER_GAP", "boards"),
    *_of("detect.boards", "_MOST_PX _UNEVEN _LONG _LEAST_SIDE_PX", "boards"),
    *_of("detect.partly", "_MISFIT _AS_STRONG _CLEAR _ENDED", "boards"),
    *_of("detect.rings", "_FEWEST_RAYS _LEAST_CONTRAST _NOISY _FAR _MOST_MISFIT", "rings"),
    *_of("detect.photographs.by_hand", "SIGMA_PX _WRONG", "clicks"),
    *_of("detect.photographs.beside", "_REACH _FAINT _LEAST", "auto"),
    *_of("detect.photographs.field_lines", "LEAST_SHARE SURE_SHARE _ABSENT _MOST_ABSENT", "lines", "auto"),
    *_of("detect.photographs.grid", "_FACES _AS_WELL _NEARER_DEG _SHORT", "auto"),
    *_of("detect.photographs.candidates", "_SURE _COMPARABLE _ALIKE _LIKELY BUDGET_S", "auto"),
    *_of("detect.photographs.painted", "BY_CHANCE _LACKS _SURELY", "auto"),
    *_of("detect.photographs.as_built", "_OTHER_FIELD _SURELY _FARTHEST", "lines", "auto"),
    *_of("detect.photographs.judgement", "_NEAR_PX _EXPLAINED _OF_ALL _FEWEST_PLACES _FEWEST_CURVES", "auto"),
    *_of("detect.photographs.judgement", "_LEAST_UPRIGHT _SAME_FLOOR _NO_CHANCE _BY_ANY _IF_ANY", "auto"),
    *_of("detect.photographs.matching", "_PEAK _LEAST_PEAK _PARALLEL _CELL _PAIRS _LEAST_IN_VIEW", "auto"),
    *_of("detect.photographs.search", "_SURE _AS_GOOD", "auto"),
    *_of("detect.photographs.upright", "_USUAL_TILT _PRIOR_WEIGHT _LEAST_SHARE _LEAST_OF_OWN _APART", "auto"),
)  # fmt: skip
"""Constants that decide what is an outlier, a lost board, a competing pose, a move, a finding, a found field etc."""


def scaled(value: Value, factor: float) -> Value:
    """The value times the factor; a share of one half or more by its odds; a whole number rounded, at least 1."""
    if isinstance(value, tuple):
        return tuple(factor * part for part in value)
    if isinstance(value, int):
        return max(round(factor * value), 1)
    if 0.5 <= value < 1.0:
        odds = factor * value / (1.0 - value)
        return odds / (1.0 + odds)
    return factor * value


# ---- measuring ------------------------------------------------------------------------------------------------------


def measured(
    figures: str, runs: int, folder: Path, constant: Constant | None = None, value: Value = 0
) -> dict[str, str]:
    """The figures as printed, measured in a new process with a constant set to another value."""
    setting = [] if constant is None else ["--set", str(constant), json.dumps(value)]
    command = [sys.executable, __file__, "--measure", figures, str(folder), "--runs", str(runs), *setting]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    if done.returncode:
        return {"error": done.stderr.strip().rpartition("\n")[2]}
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return {name: f"{number:.0f}" if float(number).is_integer() else f"{number:.3g}" for name, number in found.items()}


def changes(now: dict[str, str], then: dict[str, str]) -> str:
    """The figures that differ."""
    if "error" in then:
        return then["error"]
    found = [f"{name} {now.get(name)} -> {then[name]}" for name in then if then[name] != now.get(name)]
    return "; ".join(found) or "nothing"


def rows(chosen: Sequence[Constant], runs: int, folder: Path) -> Iterator[tuple[str, str, str, str]]:
    """Constant, value, new value, changes; two rows for each constant, after one for the unchanged constants."""
    now: dict[str, dict[str, str]] = {}
    for constant in chosen:
        for name in constant.figures:
            if name not in now:
                now[name] = measured(name, runs, folder)
                yield name, "", "", "; ".join(f"{what} {value}" for what, value in now[name].items())
        for factor in (HALF, TWICE):
            value = scaled(constant.value, factor)
            found = [changes(now[name], measured(name, runs, folder, constant, value)) for name in constant.figures]
            told = "; ".join(each for each in found if each != "nothing") or "nothing"
            yield str(constant), short(constant.value), short(value), told


def short(value: Value) -> str:
    return ", ".join(f"{part:.3g}" for part in (value if isinstance(value, tuple) else (value,)))


def _measure(figures: str, folder: Path, runs: int, setting: Sequence[str] | None) -> int:
    """In the process that `measured` starts: set the constant, then measure; the last line printed is the answer."""
    from accuracy.constants_figures import FIGURES  # this also imports all modules that copy constants

    if setting is not None:
        constant = next(one for one in DECIDING if str(one) == setting[0])
        value: Any = json.loads(setting[1])
        constant.set(tuple(value) if isinstance(value, list) else value)
    print(json.dumps(FIGURES[figures](runs, folder)))
    return 0


def main(arguments: Sequence[str]) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10, help="simulations or photographs of each kind; default: 10")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only constants with one of these in their names")
    parser.add_argument("--json", type=Path, help="write the rows there, too")
    parser.add_argument("--measure", nargs=2, metavar=("FIGURES", "FOLDER"), help=argparse.SUPPRESS)
    parser.add_argument("--set", nargs=2, metavar=("NAME", "VALUE"), help=argparse.SUPPRESS)
    given = parser.parse_args(arguments)
    if given.measure:
        return _measure(given.measure[0], Path(given.measure[1]), given.runs, given.set)
    chosen = [one for one in DECIDING if not given.only or any(part in str(one) for part in given.only)]
    if not chosen:
        parser.error(f"no constant has {' or '.join(given.only)} in its name")
    every = []
    with tempfile.TemporaryDirectory() as folder:
        for row in rows(chosen, given.runs, Path(folder)):
            every.append(row)
            name, value, other, told = row
            print(f"{name:38} {value + ' -> ' + other if other else 'as it is':26} {told}", flush=True)
    if given.json:
        keys = ("constant", "value", "set to", "changes")
        given.json.write_text(
            json.dumps([dict(zip(keys, row, strict=True)) for row in every], indent=1), encoding="utf-8"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
