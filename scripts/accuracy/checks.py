"""How often `check` reports a move of an unmoved camera, and how small a move it finds: python scripts/run.py checks

The camera of `moves.py` is calibrated 40 times and checked with line points: with the same kind of observations as in
the calibration, with other noise, outliers and correlations, for the calibrations with the largest errors, every hour,
and after a move. "yes": the limit is kept. "no": it is missed. Exits with 1 when a figure is missed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from runner import Row, over, script, share_error

from accuracy.dependent_errors import along_lines
from accuracy.moves import ALARMS, DAY, HOME, NOISE, calibrated, seen, thinned, truth_of
from accuracy.scenes import without_noise
from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.calibration import Calibration
from ceres_cal.moves.agreement import Agreement
from ceres_cal.moves.checks import check
from ceres_cal.observations import Observations
from ceres_cal.problem.quantities import difference
from ceres_cal.simulate import Disturbance

CALIBRATIONS = 40
MONTH = 720  # hourly checks
LINE_POINTS = 100
REACH_M = 0.5  # length over which errors of edges are correlated


@dataclass(frozen=True)
class Kind:
    """What the observations of a check are like."""

    name: str
    disturbance: Disturbance = DAY
    sigma: float = 1.0  # true noise over stated noise
    together: bool = False
    count: int = LINE_POINTS

    def seen(self, pose: Pose, seed: int) -> Observations:
        """Observations of this kind from a pose."""
        simulation = seen(pose, self.disturbance, seed, spacing_m=0.12)
        observations = simulation.observations
        sigma_px = observations.curves.sigma_px / self.sigma
        if self.together:
            observations = along_lines(without_noise(simulation), simulation.scene, seed, REACH_M)
        curves = replace(observations.curves, sigma_px=sigma_px)
        return thinned(replace(observations, curves=curves), (), self.count, seed)


KINDS = (
    Kind("as before"),
    Kind("noise 1.3 times", Disturbance(points_sigma_px=0.39, curves_sigma_px=0.39), sigma=1.3),
    Kind("20 % outliers", replace(NOISE, outliers=0.2)),
    Kind("edges correlated over 0.5 m", NOISE, together=True),
    Kind("40 line points", count=40),
)
calibration_of = cache(calibrated)


def checked(kind: Kind, number: int, seed: int, pose: Pose = HOME) -> Agreement:
    """One check of one of the calibrations."""
    return check(calibration_of(number), kind.seen(pose, 10_000 + seed), ALARMS)["overhead"]


def _checked_by_turns(kind: Kind, number: int, first: int = 0, pose: Pose = HOME) -> Agreement:
    return checked(kind, number % CALIBRATIONS, first + number, pose)


def false_case(runs: int) -> Iterator[Row]:
    """False alarms for each kind of observations, over all calibrations."""
    for kind in KINDS:
        share = np.mean([not one.holds for one in over(partial(_checked_by_turns, kind), range(runs))])
        note = f"{runs} unmoved cases, {min(runs, CALIBRATIONS)} calibrations"
        yield Row("false alarms at 1 %", kind.name, float(share), share_error(ALARMS, runs), 0.005, 0.015, note)


def unlucky_case(runs: int) -> Iterator[Row]:
    """False alarms given the calibration, for those with the smallest and the largest errors; also over many checks."""
    order = np.argsort([_off(calibration_of(number)) for number in range(CALIBRATIONS)])
    for what, some in (("the luckiest 20 of 40", order[:20]), ("the unluckiest 4 of 40", order[-4:])):
        each = max(runs // len(some), 1)
        asked = [(n, 50_000 + 1000 * n + i) for n in some.tolist() for i in range(each)]
        rare = [one.probability for one in over(partial(checked, KINDS[0]), *zip(*asked, strict=True))]
        rates = np.mean(np.reshape(rare, (len(some), each)) < ALARMS, axis=1)
        note = (
            f"{each} checks each, {100 * rates.max():.1f} % at most; off by {_off(calibration_of(int(some[-1]))):.1f}"
        )
        yield Row(
            "given the calibration",
            what,
            float(np.mean(rates)),
            share_error(ALARMS, len(some) * each),
            most=0.015,
            note=note,
        )
        twice = np.mean(np.reshape(rare, (len(some), each)) < np.sqrt(ALARMS / MONTH), axis=1)
        both = np.mean((twice**2 - twice * (1.0 - twice) / max(each - 1, 1)).clip(0.0))
        yield Row(
            "hourly for a month, asked twice", what, float(MONTH * both), most=0.015, note="acts on nothing, times"
        )
        once = float(np.mean(np.array(rare) < ALARMS / MONTH))
        yield Row(
            "hourly for a month, --checks 720",
            what,
            MONTH * once,
            MONTH * share_error(ALARMS / MONTH, len(some) * each),
            most=0.015,
        )


def power_case(runs: int) -> Iterator[Row]:
    """The smallest tilt and shift that are found in 95 % of the cases."""
    for kind in (KINDS[0], KINDS[3]):
        for what, moved, sizes in (
            ("tilt, deg", _tilted, (0.01, 0.014, 0.02, 0.028, 0.04, 0.056, 0.08)),
            ("shift, mm", _shifted, (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)),
        ):
            yield Row(
                "found in 95 %", f"{kind.name}: {what}", _smallest(kind, moved, sizes, runs), note=f"{runs} cases"
            )


CASES: dict[str, Callable[[int], Iterator[Row]]] = {
    "false": false_case,
    "unlucky": unlucky_case,
    "power": power_case,
}


def _tilted(deg: float) -> Pose:
    return Pose.looking(HOME.position, rotation_exp((np.deg2rad(deg), 0.0, 0.0)) @ HOME.rotation)


def _shifted(mm: float) -> Pose:
    return Pose.looking(HOME.position + np.array([1e-3 * mm, 0.0, 0.0]), HOME.rotation)


def _smallest(kind: Kind, moved: Callable[[float], Pose], sizes: Sequence[float], runs: int) -> float:
    """The smallest size that is found in 95 % of the cases, interpolated linearly in the logarithm of the size."""
    before = 0.0
    for at, size in enumerate(sizes):
        one_of_them = partial(_checked_by_turns, kind, first=90_000, pose=moved(size))
        found = float(np.mean([not one.holds for one in over(one_of_them, range(runs))]))
        if found >= 0.95:
            if at == 0 or found == before:
                return size
            share = (0.95 - before) / (found - before)
            return float(sizes[at - 1] * (size / sizes[at - 1]) ** share)
        before = found
    return np.inf


def _off(calibration: Calibration) -> float:
    """Distance of pose and phi from the truth, in standard deviations."""
    posterior = calibration.uncertainty.posterior
    keys = [key for key in posterior.keys if key.kind == "station" or key.quantity == "phi"]
    off: Array = difference(truth_of(calibration, HOME), calibration.estimate, keys)
    return float(np.sqrt(off @ posterior.information.marginal(keys).matrix @ off))


main = script(CASES, __doc__, (400, "checks of each row"))
