"""Outliers by deleted residuals: how far off an observation is where the others alone predict it.

A residual that the fit has taken up is short whether or not it belongs, and one that only a guess predicts is long
though it belongs: the only corner at a picture's rim, once left out, would stay out. So where nothing changes any more
those in doubt are judged by what the others say of them, at the standard deviation of that (Cook and Weisberg 1982,
Residuals and Influence in Regression, 2.2).
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.frozen import Frozen
from ceres_cal.effects.linearised import equation_weights, shared_columns, studentised
from ceres_cal.observations import Observations
from ceres_cal.problem.noise import Inliers
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.quantities import from_placement
from ceres_cal.problem.reduced import ReducedInformation
from ceres_cal.problem.residuals import Equations, Residuals, equations_of, pairs_of


class Fitted(Frozen):
    """An estimate of some observations, and what these say there.

    Attributes:
        problem: of all the observations. used: (N + M,) which took part. residuals: of all. reduced: what those that
            took part, and what was known before, say there.
    """

    problem: Problem
    observations: Observations
    estimate: Estimate
    residuals: Residuals
    used: Mask
    reduced: ReducedInformation


def by_deleted_residuals(inliers: Inliers, fitted: Fitted) -> Inliers:
    """The inliers by deleted residuals, where the residuals alone, by which these are, leave it in doubt."""
    # Share of the bound from which on an inlier is asked about: a shorter one is an outlier only where it says more of
    # its place than all others, and then nobody knows which of the two is wrong.
    doubted = 0.5**0.5
    doubtful = np.isfinite(inliers.sigmas) & (inliers.sigmas > doubted * inliers.bound)
    if not np.any(doubtful):
        return inliers
    rows = inliers.rows
    observation, length = deleted_lengths(doubtful, inliers.weighting(fitted.problem.options), fitted)
    rows[observation] = length <= inliers.bound
    return inliers.with_rows(rows)


def deleted_lengths(rows: Mask, weighting: Weighting, fitted: Fitted) -> tuple[Indices, Array]:
    """Of some of the observations (N + M,), whose residuals are finite: which one each is, and the length of its
    deleted residual in that one's standard deviations.
    """
    observations, estimate = fitted.observations, fitted.estimate
    sights = fitted.problem.sights.used(*np.split(rows, [len(observations.points)]))
    equations = equations_of(observations, sights, estimate, fitted.residuals)
    weights = equation_weights(observations, weighting, equations, fitted.residuals)
    share = np.where(fitted.used[equations.observation], weights.robust, 0.0)
    leverage, overlap = _leverages(equations, weights.inverse_sigma, estimate, fitted.reduced)
    residual = weights.inverse_sigma * equations.residual
    observation, length = studentised(equations, residual, share, leverage, overlap)
    return observation, np.abs(length)


def _leverages(
    equations: Equations, weight: Array, estimate: Estimate, reduced: ReducedInformation
) -> tuple[Array, Array]:
    """(E,) what the estimate's covariance adds to the variance of equations of this weight, in theirs, and (P,) to the
    covariance of the two of each point.

    How targets were built is held: what it would add is its own scatter.
    """
    rest = np.array([not key.is_structure for key in reduced.shared.keys], dtype=bool)
    keys = [key for key in reduced.shared.keys if not key.is_structure]
    covariance = reduced.shared.inverse[np.ix_(rest, rest)]
    shared = shared_columns(equations, estimate, keys) * weight[:, None]
    private, own = np.zeros((2, len(equations), 6))
    for part in reduced.eliminated:
        at = {name: number for number, name in enumerate(part.names)}
        placed = np.array([at.get(str(key.placement), -1) for key in equations.sights.keys])[equations.sight]
        rows = np.flatnonzero(placed >= 0)
        world = estimate.stations[part.station].cam_from_world
        chain = from_placement(equations.poses, world)[equations.sight[rows]]
        private[rows] = np.einsum("ei,eij->ej", equations.pose[rows], chain) * weight[rows, None]
        own[rows] = np.einsum("ei,eij->ej", private[rows], part.inverses[placed[rows]])
        for column, key in enumerate(part.keys):
            if not key.is_structure:
                shared[rows, keys.index(key)] -= np.sum(private[rows] * part.gains[placed[rows], :, column], axis=1)
    along, (first, second) = shared @ covariance, pairs_of(equations)
    return (
        np.sum(along * shared, axis=1) + np.sum(own * private, axis=1),
        np.sum(along[first] * shared[second], axis=1) + np.sum(own[first] * private[second], axis=1),
    )
