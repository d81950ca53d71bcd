"""Information with named keys: what is known of some numbers together, the inverse of a covariance if there is one.

Information adds up; numbers that are held are struck out, numbers that are not asked about are integrated out. Nothing
is inverted where nothing is known.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.cached import cached_property
from ceres_cal.base.spread import Spread, known_inverses, without
from ceres_cal.model.keys import Key, sigma_limits

_VISIBLE = 1e-12  # share of what is known of a number that can be told from rounding
_DETERMINED = 1e-11  # eigenvalue, at unit diagonal, from which on a direction counts as determined


@dataclass(frozen=True, eq=False)
class Information:
    """An information matrix, symmetric, not necessarily of full rank.

    Attributes:
        keys: (K) the numbers. matrix: (K, K), in the inverse units of the keys.
    """

    keys: tuple[Key, ...]
    matrix: Array

    @classmethod
    def nothing(cls, keys: Sequence[Key] = ()) -> Information:
        """Nothing at all is known of these numbers."""
        return cls(tuple(keys), np.zeros((len(keys), len(keys))))

    @classmethod
    def of_sigmas(cls, sigmas: Mapping[Key, float]) -> Information:
        """Each number known by itself, to a standard deviation."""
        return cls(tuple(sigmas), np.diag(np.array(list(sigmas.values()), dtype=float) ** -2.0))

    @cached_property
    def _column(self) -> dict[Key, int]:
        return {key: column for column, key in enumerate(self.keys)}

    def columns(self, keys: Sequence[Key]) -> Indices:
        """Where some of the keys are."""
        return np.array([self._column[key] for key in keys], dtype=np.int64)

    def among(self, keys: Collection[Key]) -> tuple[Key, ...]:
        """Those of its keys that are among others."""
        wanted = set(keys)
        return tuple(key for key in self.keys if key in wanted)

    def given(self, keys: Sequence[Key]) -> Information:
        """About some of the numbers, with all others held where they are."""
        at = self.columns(keys)
        return Information(tuple(keys), self.matrix[np.ix_(at, at)])

    def marginal(self, keys: Sequence[Key]) -> Information:
        """About some of the numbers, all others integrated out: the Schur complement."""
        rest = [key for key in self.keys if key not in set(keys)]
        if not rest:
            return self.given(keys)
        at, others = self.columns(keys), self.columns(rest)
        here, coupling = self.matrix[np.ix_(at, at)], self.matrix[np.ix_(others, at)]
        return Information(
            tuple(keys), without(here, coupling, self.matrix[np.ix_(others, others)], sigma_limits(rest))
        )

    def without(self, keys: Collection[Key]) -> Information:
        """About all but some numbers, of which nothing is known any more."""
        gone = set(keys)
        return self.marginal([key for key in self.keys if key not in gone])

    def over(self, keys: Sequence[Key]) -> Information:
        """The same over other keys, which have all of its own among them."""
        whole = Information.nothing(keys)
        at = whole.columns(self.keys)
        whole.matrix[np.ix_(at, at)] = self.matrix
        return whole

    def widened(self, shifts: Array) -> Information:
        """With a covariance that is larger by d d^T for each of the shifts d (S, K) (Woodbury).

        By a root A of the matrix, so that rounding makes no variance negative: A^T (1 + A D D^T A^T)^-1 A.
        """
        if not len(shifts):
            return self
        unit = np.sqrt(np.maximum(np.diagonal(self.matrix), np.finfo(float).tiny))
        values, vectors = np.linalg.eigh(self.matrix / unit[:, None] / unit)
        root = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T * unit
        along, sizes, _ = np.linalg.svd(root @ shifts.T, full_matrices=False)
        left = root - (along * (1.0 - 1.0 / np.hypot(1.0, sizes))) @ (along.T @ root)
        return Information(self.keys, left.T @ left)

    def less(self, other: Information) -> Information:
        """What is left without a part of it; nothing of numbers of which that part says all but rounding."""
        left = self.matrix - other.over(self.keys).matrix
        visible = np.diagonal(left) > _VISIBLE * np.diagonal(self.matrix)
        return Information(self.keys, np.where(visible[:, None] & visible, left, 0.0))

    def __add__(self, other: Information) -> Information:
        """Both together, over the keys of either."""
        if self.keys == other.keys:
            return Information(self.keys, self.matrix + other.matrix)
        keys = tuple(dict.fromkeys((*self.keys, *other.keys)))
        return Information(keys, self.over(keys).matrix + other.over(keys).matrix)

    @cached_property
    def spread(self) -> Spread:
        """Covariance and unknown directions."""
        return Spread.of(self.matrix, sigma_limits(self.keys))

    @cached_property
    def inverse(self) -> Array:
        """(K, K) inverse over what is known; unknown directions are left out."""
        return known_inverses(self.matrix, sigma_limits(self.keys))

    @property
    def known_rank(self) -> int:
        """Number of directions that are known."""
        return len(self.keys) - int(self.spread.unknown.shape[1])

    @cached_property
    def root(self) -> Array:
        """(R, K) with root^T root = matrix: a row for each direction that is determined, in standard deviations."""
        diagonal = np.diagonal(self.matrix)
        if np.count_nonzero(self.matrix) == np.count_nonzero(diagonal):
            return np.asarray(np.diag(np.sqrt(diagonal))[diagonal > 0.0])
        scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 1.0)
        values, vectors = np.linalg.eigh(self.matrix * scale[:, None] * scale)
        kept = values > _DETERMINED
        return np.asarray((vectors[:, kept] * np.sqrt(values[kept])).T / scale)
