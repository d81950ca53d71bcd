"""Other minima of few observations: where a solve ends that begins at another phi, or where a start may be as well.

A floor seen by few points and lines may be explained from two places, by two lenses; a start cannot tell which of the
minima is the least, nor that there are two.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError
from ceres_cal.observations import Observations
from ceres_cal.problem.bundle import Solution, solve
from ceres_cal.problem.information import Information
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import difference, natural_sizes
from ceres_cal.robust.robust import RobustSolution

_FEW = 300  # equations from which on one minimum was seen: the cases mended had under 200
_FACTORS = 0.7, 0.85, 1.15, 1.4  # on phi: the other valleys that were seen began within a sixth
_MOST_ITERATIONS = 30  # of each: along a flat valley the solver creeps for hundreds that change nothing here
# Share of what the normal equations say that another minimum costs at most: the same one, not quite reached, costs all.
_OTHER = 0.25
_APART = 0.05  # of the height: places that are no farther apart are one valley, which the standard deviations show
_ALIKE = 0.01  # of natural sizes: two solves that ended no farther apart are one minimum
_LOWER = 1.0  # of twice the cost: rounding is less, and what is no lower than that is as likely


def least_of_few(
    problem: Problem, observations: Observations, end: RobustSolution, elsewhere: Sequence[Estimate] = ()
) -> tuple[RobustSolution, tuple[Solution, ...]]:
    """The end of all rounds in the least minimum that is found from there, and others, with what they cost beyond it;
    where all observations are inliers.

    Args:
        problem: of all the observations. end: of its rounds. elsewhere: starts that showed the observations alike.
    """
    count = end.problem.sights.equations
    if count >= _FEW or count < problem.sights.equations:  # what was taken out belongs to the minimum it was judged in
        return end, ()
    least = solve(end.problem, end.solution.estimate)
    others = list(_ends(end.problem, (*_at_other_phi(end.problem, least.estimate), *elsewhere)))
    lowest = min(others, key=lambda one: one.cost, default=least)
    if 2.0 * (least.cost - lowest.cost) > _LOWER:
        others.append(least)
        least = solve(end.problem, lowest.estimate)
        end = replace(end.moved_to(least.estimate, observations, problem), reduced=None)
    return end, tuple(replace(one, cost=one.cost - least.cost) for one in others)


def minima_of(
    others: Sequence[Solution], estimate: Estimate, information: Information, half_width: float
) -> tuple[list[Array], list[float]]:
    """(K,) from the estimate to each other minimum that costs no more than 95 % intervals reach, and their
    probabilities.

    Args:
        others: with what they cost beyond the estimate. information: by the model, about the K numbers.
        half_width: standard deviations from the middle to an end of an interval.
    """
    sizes = natural_sizes(estimate, information.keys)
    shifts, odds = list[Array](), list[float]()
    here = np.zeros(len(sizes))
    for one in sorted(others, key=lambda other: other.cost):
        shift = difference(one.estimate, estimate, information.keys)
        least = min(half_width**2, _OTHER * float(shift @ information.matrix @ shift))
        if 2.0 * one.cost < least and all(np.max(np.abs(shift - d) / sizes) > _ALIKE for d in (here, *shifts)):
            shifts.append(shift)
            odds.append(float(np.exp(-max(one.cost, 0.0))))
    return shifts, [each / (1.0 + sum(odds)) for each in odds]


def seen_alike(others: Sequence[Solution], estimate: Estimate, half_width: float) -> Iterator[str]:
    """A warning for each station that may stand elsewhere, with the likeliest other place.

    Args:
        others, half_width: see `minima_of`.
    """
    for name, station in estimate.stations.items():
        here = station.cam_from_world.position
        for one in sorted(others, key=lambda other: other.cost):
            there = one.estimate.stations[name].cam_from_world.position
            if 2.0 * one.cost < half_width**2 and np.linalg.norm(there - here) > _APART * abs(here[2]):
                places = (", ".join(f"{value:.2f}" for value in place) for place in (here, there))
                first, second = (f"({place}) m" for place in places)
                yield (
                    f"station {name!r}: what it shows is seen alike from {first} and from {second}: add a point or a "
                    "line, or the camera's height as a prior"
                )
                break


def _ends(problem: Problem, starts: Iterable[Estimate]) -> Iterator[Solution]:
    """Where solves end; the same minimum may come again."""
    short = replace(problem.options, max_iterations=min(_MOST_ITERATIONS, problem.options.max_iterations))
    for start in starts:
        with suppress(CalibrationError):  # quiet: nothing is seen from there, so no minimum is
            solution = solve(replace(problem, options=short), start, is_near=False)
            if not solution.failed:
                yield solution


def _at_other_phi(problem: Problem, estimate: Estimate) -> Iterator[Estimate]:
    for name in [name for name, numbers in problem.layout.free.items() if 0 in numbers]:
        for factor in _FACTORS:
            camera = estimate.cameras[name]
            yield replace(estimate, cameras={**estimate.cameras, name: replace(camera, phi=factor * camera.phi)})
