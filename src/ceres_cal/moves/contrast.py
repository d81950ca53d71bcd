"""Do two independent statements about the same numbers contradict each other in some of them? (design, section 10)

The first one was made once, and many others are compared with it: its error is the same each time. So what is asked is
how often a true second statement would differ as much, given a first one whose own error is as large as it may be.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.lazy import cached_property
from ceres_cal.base.tails import NORMAL_95_ONE_SIDED, quadratic_tail
from ceres_cal.problem.information import Information, Key


@dataclass(frozen=True, eq=False)
class NormalDistribution:
    """A normal distribution of K numbers, seen from an estimate.

    Attributes:
        information: about them. offsets: (K,) estimate less mean. degrees_of_freedom: spare equations behind its noise.
    """

    information: Information
    offsets: Array
    degrees_of_freedom: float


@dataclass(frozen=True, eq=False)
class Contrast:
    """By how much the least squared distance to two statements falls when some numbers may differ between them.

    Attributes:
        statistic: that fall. shares: (D,) of the variance of each direction that both can tell, what the first one
            brings to it. degrees_of_freedom: spare equations behind the noise of both.
    """

    statistic: float
    shares: Array
    degrees_of_freedom: float

    @property
    def degrees(self) -> int:
        """How many directions of these numbers both statements determine."""
        return len(self.shares)

    @cached_property
    def probability(self) -> float:
        """Of such a fall, or a larger one, where nothing differs and the first statement's error is what one in 20
        exceeds.
        """
        total = float(np.sum(self.shares))
        few = total**2 / max(float(np.sum(self.shares**2)), 1e-300)
        unlucky = self.shares * _chi2_95(few) / max(few, 1e-300)
        return quadratic_tail(self.statistic, 1.0 - self.shares, unlucky, self.degrees_of_freedom)


def _chi2_95(freedom: float) -> float:
    """What 95 % of chi-squared variables stay below, after Wilson and Hilferty: to 4 % from 1 degree of freedom on."""
    spread = 2.0 / (9.0 * max(freedom, 1e-3))
    return freedom * (1.0 - spread + NORMAL_95_ONE_SIDED * math.sqrt(spread)) ** 3


def contrast(first: NormalDistribution, second: NormalDistribution, tested: Sequence[Key]) -> Contrast:
    """The contrast in the tested numbers, all others being the same in both; both speak of the same numbers."""
    testable = 1e-6  # length, at unit columns, that both statements together must leave of a direction
    determined = 1e-11  # singular value, at unit columns, from which on a direction counts as determined
    roots = first.information.root, second.information.root
    known, at = len(roots[0]), first.information.columns(tested)
    rows = np.vstack(roots)
    sizes = np.linalg.norm(rows, axis=0)
    rows /= np.where(sizes > 0.0, sizes, 1.0)
    alike = _basis(rows, determined)
    apart = rows[:, at] * (np.arange(len(rows)) >= known)[:, None]
    for _ in range(2):  # the second time for what rounding left
        apart = apart - alike @ (alike.T @ apart)
    apart = _basis(apart, testable)
    off = np.concatenate([root @ one.offsets for root, one in zip(roots, (first, second), strict=True)])
    shares = np.clip(np.linalg.eigvalsh(apart[:known].T @ apart[:known]), 0.0, 1.0)
    share = float(np.mean(shares)) if len(shares) else 0.0
    inverse = share**2 / first.degrees_of_freedom + (1.0 - share) ** 2 / second.degrees_of_freedom
    return Contrast(float(np.sum((apart.T @ off) ** 2)), shares, 1.0 / inverse if inverse > 0.0 else math.inf)


def _basis(columns: Array, least: float) -> Array:
    """Orthonormal basis (N, D) of the directions of columns (N, Q) that are longer than `least`."""
    vectors, lengths, _ = np.linalg.svd(columns, full_matrices=False)
    return np.asarray(vectors[:, lengths > least])
