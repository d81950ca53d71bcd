"""Columns of many numbers over the equations, of which each equation has few: what residuals say of all of them.

A board's corners, a field's lines, the offsets of features: each number moves few equations. So sums over the equations
are taken by number, and nothing is as large as equations times numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.effects.linearised import Linearised


@dataclass(frozen=True, eq=False)
class SparseColumns:
    """Columns of Q numbers over E equations, in standard deviations.

    Attributes:
        slots: (E, B) which numbers move each equation, Q for none. values: (E, B) by how much, 0 where it is not used.
        size: Q.
    """

    slots: Indices
    values: Array
    size: int

    @classmethod
    def of_groups(cls, model: Linearised, columns: Array, group: Indices, groups: int) -> SparseColumns:
        """Of groups of equations (E,), -1 for none, which have a number for each of the columns (E, M), in standard
        deviations; group after group.
        """
        width, there = columns.shape[1], (group >= 0) & model.used
        slots = np.where(there[:, None], group[:, None] * width + np.arange(width), groups * width)
        return cls(slots, np.where(there[:, None], columns, 0.0), groups * width)

    def gathered(self, factors: Array, owner: Indices, owners: int) -> Array:
        """(owners, Q) sums of the values times factors (E,) or (E, B), by number and owner (E,)."""
        products = self.values * (factors if factors.ndim == 2 else factors[:, None])
        key = owner[:, None] * (self.size + 1) + self.slots
        sums = np.bincount(key.ravel(), products.ravel(), minlength=owners * (self.size + 1))
        return np.asarray(sums.reshape(owners, -1)[:, :-1])

    def summed(self, factors: Array) -> Array:
        """(Q,) the same over all equations."""
        return np.asarray(self.gathered(factors, np.zeros(len(self.slots), dtype=np.int64), 1)[0])

    def products(self) -> Array:
        """(Q, Q) X^T X."""
        every = [self.gathered(self.values[:, k], self.slots[:, k], self.size + 1) for k in range(self.slots.shape[1])]
        return np.asarray(np.sum(every, axis=0)[:-1])

    def at(self, amounts: Array) -> Array:
        """(E,) what amounts (Q,) do to the equations."""
        return np.asarray(np.sum(self.values * np.append(amounts, 0.0)[self.slots], axis=1))

    def in_private(self, model: Linearised) -> Array:
        """(6, S, Q) what the private placement of each sight takes of them."""
        bounds, sight = model.equations.bounds, model.equations.sight
        return np.array([self.gathered(column, sight, len(bounds) - 1) for column in model.private.T])

    def left_of(self, model: Linearised) -> tuple[Array, Array]:
        """V (Q, Q) and u (Q,), see `effects.evidence`."""
        private = self.in_private(model).reshape(-1, self.size)
        shared = np.array([self.summed(column) for column in model.shared.T]).reshape(-1, self.size)
        return self.products() - private.T @ private - shared.T @ shared, self.summed(model.left_over)
