"""Wald's test of what is stated: how far everything else is from it.

With C the covariance of some numbers x, P what their priors say of them and z = sum P_j (x - mean_j) their slope,
everything else says M = C^-1 - P and stands at x + M^-1 z; a prior j is d = x + M^-1 z - mean_j away from that, with
covariance M^-1 + P_j^-1, and the squared distance is Fisher's F. A number that is held is a prior without width, z the
slope of the cost along it.
"""

from __future__ import annotations

from functools import reduce
from operator import add
from typing import NamedTuple

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.tails import log_f_tail
from ceres_cal.model.information import Information
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.quantities import moved, natural_sizes, values_of
from ceres_cal.model.residuals import residuals
from ceres_cal.observations import Observations
from ceres_cal.solve.costs import robust_weights
from ceres_cal.solve.information import information
from ceres_cal.solve.problem import Problem
from ceres_cal.solve.robust import RobustSolution
from ceres_cal.solve.stated import Statement, Test

LARGEST_FREEDOM = 1e6
"""Degrees of freedom that count as infinitely many."""
_LEAST_TOLD = 1e-7  # of what is known of a number, the share that others must bring to speak of it
_STATED = 1e-14  # eigenvalue, at unit diagonal, from which on a direction counts as stated
# Of a standard deviation, and at most of a number's natural size, to either side, for the slope of the cost along what
# is held.
_STEP, _MOST_STEP = 0.1, 1e-3


class Rest(NamedTuple):
    """What everything else says of a statement's numbers: a step from an estimate, and how well that is known."""

    estimate: Estimate
    step: Array
    information: Information
    freedom: float


def linear_rest(statement: Statement, end: RobustSolution, observations: Observations) -> Rest:
    """By the linear picture where the problem with the statement was solved."""
    estimate, freedom = end.solution.estimate, min(end.inliers.degrees_of_freedom, LARGEST_FREEDOM)
    if statement.priors:
        reduced = end.reduced or information(end.problem, estimate)
        stated = reduce(add, (prior.information for prior in statement.priors), Information.nothing(statement.keys))
        at = reduced.shared.columns(stated.keys)
        slope = np.zeros(len(stated.keys))
        for prior in statement.priors:
            slope[stated.columns(prior.keys)] += prior.information.matrix @ prior.offsets(estimate)
        matrix, step = _beside(reduced.shared.inverse[np.ix_(at, at)], stated.matrix, slope)
        rest = Information(stated.keys, matrix)
    else:
        freed = statement.left_out(end.problem, estimate)
        rest = information(freed, estimate).shared.marginal(statement.keys)
        slope = -_slopes(end.problem, observations, estimate, rest)
        step = rest.inverse @ slope
    # It swells the noise that the rest is measured by, as far as the linear picture goes.
    noise = max(freedom - float(slope @ step), 1.0) / freedom if end.inliers.degrees_of_freedom < np.inf else 1.0
    return Rest(estimate, step, Information(rest.keys, rest.matrix / noise), freedom)


def _beside(covariance: Array, stated: Array, slope: Array) -> tuple[Array, Array]:
    """M = C^-1 - P and the step M^-1 z, both 0 where M is lost in rounding beside P."""
    root, back = _roots(stated, _LEAST_TOLD)
    share, turned = np.linalg.eigh(root.T @ covariance @ root)
    share = np.clip(share, 1e-300, None)
    told = share < 1.0 - _LEAST_TOLD
    root, back, rest = root @ turned[:, told], back @ turned[:, told], 1.0 / share[told] - 1.0
    return np.asarray(root * rest @ root.T), np.asarray(back @ (back.T @ slope / rest))


def _roots(stated: Array, least: float) -> tuple[Array, Array]:
    """(n, k) R and B with R R^T = P and B^T R = 1, over what is stated by more than the least at unit diagonal."""
    size = np.sqrt(np.where(np.diagonal(stated) > 0.0, np.diagonal(stated), 1.0))[:, None]
    values, vectors = np.linalg.eigh(stated / size / size.T)
    kept = values > least
    vectors, root = vectors[:, kept], np.sqrt(values[kept])
    return size * vectors * root, vectors / root / size


def _slopes(problem: Problem, observations: Observations, estimate: Estimate, rest: Information) -> Array:
    """Derivative of the cost by what is held, everything else where it is."""
    weighting = problem.weighting
    sigmas = (
        weighting.point_scale * observations.points.sigma_px[:, None],
        weighting.curve_scale * observations.curves.sigma_px,
    )

    def standardised(there: Estimate) -> tuple[Array, Array]:
        seen = residuals(observations, problem.sights, there, problem.feet)
        return np.nan_to_num(seen.points / sigmas[0]), np.nan_to_num(seen.curves / sigmas[1])

    points, curves = standardised(estimate)
    weights = robust_weights(weighting, np.concatenate([np.sum(points**2, axis=1), curves**2]))
    points, curves = points * weights[: len(points), None], curves * weights[len(points) :]
    slopes, sizes = [], natural_sizes(estimate, rest.keys)
    for number, stated in enumerate(np.diagonal(rest.matrix)):
        if not stated > 0.0:  # the rest says nothing of it
            slopes.append(0.0)
            continue
        step = np.zeros(len(rest.keys))
        step[number] = min(_STEP / np.sqrt(stated), _MOST_STEP * sizes[number])
        above, below = (standardised(moved(estimate, rest.keys, sign * step)) for sign in (1.0, -1.0))
        change = np.sum(points * (above[0] - below[0])) + curves @ (above[1] - below[1])
        slopes.append(float(change) / (2.0 * step[number]))
    return np.array(slopes)


def rest_at(statement: Statement, end: RobustSolution) -> Rest:
    """Where a problem without the statement was solved."""
    estimate = end.solution.estimate
    reduced = end.reduced or information(end.problem, estimate)
    freedom = min(end.inliers.degrees_of_freedom, LARGEST_FREEDOM)
    return Rest(estimate, np.zeros(len(statement.keys)), reduced.shared.marginal(statement.keys), freedom)


def worst_test(statement: Statement, rest: Rest) -> Test:
    """The test of what is farthest off of a statement."""
    if not statement.priors:
        off = values_of(rest.estimate, statement.keys) + rest.step - statement.held
        return _tested(off, None, rest)
    tests = []
    for prior in statement.priors:
        at = rest.information.columns(prior.keys)
        own = Rest(rest.estimate, rest.step[at], rest.information.marginal(prior.keys), rest.freedom)
        tests.append(_tested(prior.offsets(rest.estimate) + own.step, prior.information, own))
    return min(tests, key=lambda test: test.log_p)


def _tested(off: Array, stated: Information | None, rest: Rest) -> Test:
    """The test of numbers that are off by so much; `stated` None: they were held."""
    matrix = rest.information.matrix
    squared = max(float(off @ matrix @ off), 0.0) if stated is None else _squared(off, stated.matrix, matrix)
    own = np.zeros(len(off)) if stated is None else stated.spread.sd
    others, keys = rest.information.spread.sd, rest.information.keys
    with np.errstate(invalid="ignore"):
        apart = np.nan_to_num(np.abs(off) / np.hypot(own, others))
    worst = int(np.argmax(apart))
    value = float(values_of(rest.estimate, [keys[worst]])[0] + rest.step[worst])
    return Test(
        squared,
        log_probability(squared, rest),
        keys[worst],
        (value - float(off[worst]), float(own[worst])),
        (value, float(others[worst])),
        float(apart[worst]),
    )


def _squared(off: Array, stated: Array, rest: Array) -> float:
    """off^T (M^-1 + P^-1)^-1 off: where everything else, M, says nothing beside what is stated, P, it is 0 however far
    off that seems.
    """
    root, back = _roots(stated, _STATED)
    told, turn = np.linalg.eigh(back.T @ rest @ back)  # in directions in which each is stated to one
    along = off @ root @ turn
    return float(np.sum(np.where(told > _LEAST_TOLD, told / (1.0 + told), 0.0) * along**2))


def log_probability(squared: float, rest: Rest) -> float:
    """Natural logarithm of the probability of so large a squared distance."""
    rank = max(rest.information.known_rank, 1)
    return float(log_f_tail(squared / rank, rank, max(rest.freedom, 1.0)))
