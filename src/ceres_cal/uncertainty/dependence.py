"""What the residuals say of the errors' dependence, as one covariance of everything shared (a sandwich).

First what goes together within a view (`correlation`), then whether views scatter as that says (`between`). In
directions in which the model knows everything shared to one (root root^T its covariance) the observations, of
information A, have a score of covariance C = M - P with P the priors: with S = root^T A and B = S root they say
A + S^T (C^-1 - B^-1) S instead of A. Priors are as certain as they were; what nothing tells stays unknown.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.words import two_digits
from ceres_cal.model.information import Information
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.residuals import Residuals
from ceres_cal.observations import Observations
from ceres_cal.solve import Problem, ReducedInformation
from ceres_cal.uncertainty.between import FEWEST_GROUPS, Between, compare_groups
from ceres_cal.uncertainty.correlation import Correlation, correlated
from ceres_cal.uncertainty.sample import Sample, take_sample

_DETERMINED = 1e-12  # share of the largest variance of a score: what is below is rounding
_LIKELY = 0.5  # probability from which on a cause is named
_OVER = {"points": "errors go together between a target's points", "curves": "errors go together along lines"}


@dataclass(frozen=True)
class Dependence:
    """What the residuals say of the errors' dependence.

    Attributes:
        correlations: of points and of curves, where neighbours might agree. between: how views or placements scatter;
            None where there are too few, or one sees what lasts over all of them.
        private: factor on the variance of placements by their own observations.
        inverse_freedom: 1 / degrees of freedom of all that, beside the noise scale's.
    """

    correlations: tuple[Correlation, ...] = ()
    between: Between | None = None
    private: float = 1.0
    inverse_freedom: float = 0.0

    @property
    def causes(self) -> tuple[str, ...]:
        """What is likely, in words."""
        likely = [one for one in self.correlations if one.probability > _LIKELY]
        causes = [_OVER[one.kind] + _reach(one) for one in likely]
        if self.between is not None and self.between.probability > _LIKELY:
            factor = two_digits(self.between.variance**0.5)
            causes.append(f"views scatter {factor} times as far as what is within them says")
        return tuple(causes)


def _reach(correlation: Correlation) -> str:
    length = correlation.length_m
    over = " as a whole" if length is None else f" over {two_digits(length)} m"
    return over + (" in all views alike" if correlation.lasting else "")


@dataclass(frozen=True, eq=False)
class Scatter:
    """How much more, or less, the shared numbers scatter than the model says.

    Attributes:
        root: (K, P) from directions in which they are known to one by the model. matrix: (P, P) their covariance as
            the data scatter. dependence: what that rests on.
    """

    root: Array
    matrix: Array
    dependence: Dependence

    def widened(self, seen: Information) -> Information:
        """What the observations say without any prior, as they scatter.

        Args:
            seen: what they say by the model.
        """
        along = self.root.T @ seen.matrix
        own = along @ self.root
        values, vectors = np.linalg.eigh(0.5 * (own + own.T))
        determined = values > _DETERMINED * values[-1]
        white = vectors[:, determined] / np.sqrt(values[determined])
        scores = np.eye(white.shape[1]) + white.T @ (self.matrix - np.eye(len(own))) @ white
        change = (along.T @ white) @ (np.linalg.inv(scores) - np.eye(len(scores))) @ (white.T @ along)
        return Information(seen.keys, seen.matrix + 0.5 * (change + change.T))


def measure_scatter(
    observations: Observations, problem: Problem, there: Residuals, estimate: Estimate, reduced: ReducedInformation
) -> Scatter | None:
    """How the shared numbers scatter by the residuals; None where there is no such number, or nothing left over.

    Args:
        problem: as it was solved, at the noise that was found. there: residuals at the estimate. reduced: what the
            problem says there.
    """
    sample = take_sample(observations, problem, there, estimate, reduced)
    if sample is None or not sample.root.shape[1]:
        return None
    within = correlated(sample)
    whole = _whole(sample, within.scores)
    lasting = sample.is_shared and any(kind.lasting for kind in within.kinds)
    between, inverse = None, within.inverse_freedom
    compared = compare_groups(sample, within.scores, whole) if sample.groups >= FEWEST_GROUPS and not lasting else None
    if compared is not None:
        between, whole = compared
        inverse += between.probability / between.degrees_of_freedom
    return Scatter(sample.root, whole, Dependence(within.kinds, between, within.private, inverse))


def _whole(sample: Sample, scores: Array) -> Array:
    """(P, P) covariance of the score of everything: the views that were not looked at scatter like those that were."""
    seen, everything = sample.informations.sum(axis=0), np.eye(len(sample.prior)) - sample.prior
    values, vectors = np.linalg.eigh(seen)
    determined = values > 1e-6
    back = vectors[:, determined] / np.sqrt(values[determined])
    change = back.T @ scores.sum(axis=0) @ back - np.eye(int(determined.sum()))
    values, vectors_of = np.linalg.eigh(everything)
    root = (vectors_of * np.sqrt(np.maximum(values, 0.0))) @ vectors_of.T @ vectors[:, determined]
    whole = np.eye(len(seen)) + root @ change @ root.T
    return np.asarray(0.5 * (whole + whole.T))
