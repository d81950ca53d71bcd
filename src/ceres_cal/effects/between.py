"""Views against each other: do they scatter as their own equations say?

At the optimum the scores g_i of the views add up to nothing. With A_i the information of each where errors are
independent, M_i the covariance of its score and M that of all of them, in directions in which everything together is
known to one, the optimum leaves

    Cov(g_i, g_j) = d_ij M_i - A_i M_j - M_i A_j + A_i M A_j.

Their mean square over what is expected is the factor c on the variance, whose own spread follows from the same matrices
(Satterthwaite). The jackknife (1 - A_i)^-1 g_i, by which the optimum moves without a view, says in which directions
they scatter (CR3; Bell and McCaffrey, Survey Methodology 28, 2002). With few views, or one that says most, it is
singular and overshoots: it counts as far as views disagree at all, and as much as G - 1 of G - 1 + P numbers with G the
number of views that would say as much if all said the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.effects.sample import Sample

FEWEST_GROUPS = 3
INDEPENDENT = 0.8
"""Probability, before anything was seen, that errors are independent."""
# Equations that groups leave between them: views that each tell numbers of their own, as of cameras side by side, leave
# rounding, and the ratio to that was 17 000 where nothing was wrong.
_LEAST_LEFT = 1.0
_RIDGE = 1e-3  # of a view's information: one that tells a direction alone cannot be left out
_LOG_C = np.linspace(0.02, 6.0, 300)  # either way exponential of mean 1, where views do not scatter as expected


@dataclass(frozen=True)
class Between:
    """How views or placements scatter.

    Attributes:
        groups: how many were compared. variance: factor on the variance, beyond what errors within them do.
        probability: that it is not 1. degrees_of_freedom: behind it.
    """

    groups: int
    variance: float
    probability: float
    degrees_of_freedom: float


def compare_groups(sample: Sample, scatter: Array, whole: Array) -> tuple[Between, Array] | None:
    """How the groups scatter, and the covariance (P, P) of the whole score with that in it; None where they have too
    little in common to be compared.

    Args:
        scatter: (G, P, P) covariance of each group's score, by errors within it. whole: (P, P) of all of them and of
            the priors.
    """
    values, vectors = np.linalg.eigh(whole)
    values = np.maximum(values, 1e-12 * values[-1])
    white, root = (vectors * values**-0.5) @ vectors.T, (vectors * values**0.5) @ vectors.T
    expected, spread = _expected(sample.informations, scatter, whole, white)
    mean = float(np.sum(np.trace(expected, axis1=1, axis2=2)))
    if mean < _LEAST_LEFT:
        return None
    ratio, degrees = float(np.sum((sample.scores @ white) ** 2)) / mean, 2.0 * mean**2 / spread
    variance, probability = _averaged(ratio, degrees, float(np.trace(whole)) / len(whole))
    size, traces = len(whole), np.trace(sample.informations, axis1=1, axis2=2)
    alike = (
        float(np.sum(traces) ** 2 / np.sum(traces**2)) - 1.0
    )  # groups beyond the first that say as much as one another
    weight = probability * alike / (alike + size)
    jackknife = _jackknife(sample, expected, white, root)
    factor = (1.0 - weight) * variance * np.eye(size) + weight * jackknife
    widened = _widened(factor, white @ (whole - sample.prior) @ white)
    return Between(len(scatter), variance, probability, degrees), root @ widened @ root


def _expected(informations: Array, scatter: Array, whole: Array, white: Array) -> tuple[Array, float]:
    """(G, P, P) covariance of each group's score, whitened, and the variance of the sum of their squared lengths."""
    a, m, size = informations @ white, scatter @ white, len(white)
    left = np.concatenate([a, -m], axis=1)  # Cov(g_i, g_j) is left_i^T right_j for others, and more for i = j
    right = np.concatenate([whole @ a - m, a], axis=1)
    cross = np.swapaxes(left, 1, 2) @ right
    own = cross + white @ m
    lefts, rights = (np.swapaxes(part, 0, 1).reshape(2 * size, -1) for part in (left, right))
    pairs = float(np.sum((lefts @ lefts.T) * (rights @ rights.T)))
    return own, 2.0 * (pairs - float(np.sum(cross**2)) + float(np.sum(own**2)))


def _averaged(ratio: float, degrees: float, widened: float) -> tuple[float, float]:
    """Mean of the factor on the variance over what it may be, given a chi-squared ratio; and that it is not 1.

    Args:
        widened: factor on the variance by errors within the views. No more than that is taken back where the views
            agree better than it says: what looks like an error of each view is then one of all of them.
    """
    logs = np.concatenate([[0.0], _LOG_C, -_LOG_C])
    prior = np.exp(-np.abs(logs)) * (logs >= -np.log(max(widened, 1.0)))
    weights = (1.0 - INDEPENDENT) / prior[1:].sum() * prior
    weights[0] = INDEPENDENT
    likelihood = -0.5 * degrees * (logs + ratio * np.exp(-logs))
    weights *= np.exp(np.minimum(likelihood - likelihood[weights > 0.0].max(), 0.0))
    weights /= weights.sum()
    return float(weights @ np.exp(logs)), float(1.0 - weights[0])


def _jackknife(sample: Sample, expected: Array, white: Array, root: Array) -> Array:
    """(P, P) how leaving out one group after the other moves it, whitened; 1 on average where they agree."""
    size = len(white)
    moves = white @ np.linalg.inv((1.0 + _RIDGE) * np.eye(size) - sample.informations)
    steps = np.einsum("gij,gj->gi", moves, sample.scores)
    turned = moves @ root
    mean = float(np.sum(turned * (turned @ expected)))
    return np.asarray(steps.T @ steps * (size / mean))


def _widened(factor: Array, observed: Array) -> Array:
    """The unit matrix with the factor on its part that observations say; what priors say is not theirs."""
    values, vectors = np.linalg.eigh(observed)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return np.asarray(np.eye(len(factor)) + root @ (factor - np.eye(len(factor))) @ root)
