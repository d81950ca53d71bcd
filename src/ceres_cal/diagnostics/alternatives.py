"""Alternatives to a model, a family of each kind, and what the equations say of each: sums over those it moves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.cached import cached_property
from ceres_cal.solve.linear_model import LinearModel


@dataclass(frozen=True, eq=False)
class Family:
    """Alternatives of one kind.

    Attributes:
        kind: of the diagnostic that they are of.
        columns: (E, Q) px per unit of the Q amounts, for every equation.
        group: (E,) which alternative's amounts move each equation, -1 for none.
        subjects: what each alternative is about. frames: at which frame; empty where all are about all frames.
        onwards: whether alternative g moves the groups after g instead of group g itself.
    """

    kind: str
    columns: Array
    group: Indices
    subjects: tuple[str, ...]
    frames: tuple[str, ...] = ()
    onwards: bool = False

    def of(self, number: int) -> Array:
        """(E, Q) columns of one alternative over all equations."""
        moved = self.group > number if self.onwards else self.group == number
        return np.asarray(self.columns * moved[:, None])


def grouped(values: Indices, rows: Mask) -> tuple[Indices, Indices]:
    """The different values in the chosen rows, and which of them each row (N,) has, -1 for the others."""
    numbers, inverse = np.unique(values[rows], return_inverse=True)
    group = np.full(len(values), -1)
    group[rows] = inverse
    return numbers, group


@dataclass(frozen=True, eq=False)
class _Moved:
    """The equations in use that any of G alternatives moves, by alternative.

    Attributes:
        rows: (N,) which they are. columns: (N, Q) of the family, in standard deviations.
    """

    family: Family
    rows: Indices
    columns: Array

    @classmethod
    def of(cls, model: LinearModel, family: Family) -> _Moved:
        """By a family."""
        inside = np.flatnonzero((family.group >= 0) & model.used)
        rows = inside[np.argsort(family.group[inside], kind="stable")]
        return cls(family, rows, family.columns[rows] * model.weight[rows, None])

    def products(self, values: Array) -> Array:
        """(G, Q, K) of each alternative's columns with values (N, K) of the rows."""
        products = np.zeros((len(self.family.subjects), self.columns.shape[1], values.shape[1]))
        for number, first, last in self._runs:
            np.matmul(self.columns[first:last].T, values[first:last], out=products[number])
        if self.family.onwards:  # alternative g stands for all groups after it
            products[:-1] = np.cumsum(products[:0:-1], axis=0)[::-1]
            products[-1] = 0.0
        return products

    @cached_property
    def _runs(self) -> list[tuple[int, int, int]]:
        """Each group that has rows, where they begin and where they end."""
        group = self.family.group[self.rows]
        starts = np.flatnonzero(np.diff(group, prepend=-1))
        ends = np.append(starts, len(group))[1:]
        return list(zip(group[starts].tolist(), starts.tolist(), ends.tolist(), strict=True))

    def private_squares(self, model: LinearModel) -> Array:
        """(G, Q, Q) squares of what each alternative's columns have in the private bases."""
        size, count = self.columns.shape[1], len(self.family.subjects)
        squares, held = np.zeros((count + 1, size, size)), np.flatnonzero(model.of_private[self.rows])
        if not len(held):
            return squares[:-1]
        key = model.equations.sight[self.rows[held]] * count + self.family.group[self.rows[held]]
        order = np.argsort(key, kind="stable")
        key, held = key[order], held[order]
        starts = np.flatnonzero(np.diff(key, prepend=-1))
        products = self.columns[held, :, None] * model.private[self.rows[held], None, :]
        inside = np.add.reduceat(products, starts, axis=0)
        sight, group = np.divmod(key[starts], count)
        if not self.family.onwards:
            np.add.at(squares, group, inside @ inside.transpose(0, 2, 1))
            return squares[:-1]
        # From one group of a sight on, up to the next, the alternatives move all that come after.
        first = np.flatnonzero(np.diff(sight, prepend=-1))
        after = np.vstack([np.cumsum(inside[::-1], axis=0)[::-1], np.zeros_like(inside[:1])])
        end = np.append(first, len(sight))[np.searchsorted(first, np.arange(len(sight)), side="right")]
        inside, before = after[:-1] - after[end], np.append(0, group[:-1])
        before[first] = 0
        np.add.at(squares, before, inside @ inside.transpose(0, 2, 1))
        np.subtract.at(squares, group, inside @ inside.transpose(0, 2, 1))
        return np.cumsum(squares, axis=0)[:-1]


@dataclass(frozen=True, eq=False)
class Sums:
    """What the equations say of each of G alternatives: X their columns beyond the free numbers of a model, and r the
    residuals, both in standard deviations.

    Attributes:
        sizes: (G, Q) squared lengths of the columns as they are. normals: (G, Q, Q) X'X. scores: (G, Q) X'r.
        directions: how many shared directions of the model X is beyond.
    """

    moved: _Moved
    sizes: Array
    normals: Array
    scores: Array
    directions: int = 0

    @classmethod
    def of(cls, model: LinearModel, family: Family) -> Sums:
        """Of a family."""
        moved = _Moved.of(model, family)
        sums = moved.products(np.column_stack([moved.columns, model.placed_score[moved.rows]]))
        normals, scores = sums[:, :, :-1], sums[:, :, -1]
        sizes = np.diagonal(normals, axis1=1, axis2=2)
        return cls(moved, sizes, normals - moved.private_squares(model), scores).beside(model)

    def beside(self, model: LinearModel) -> Sums:
        """The same beyond all that is free in a model that has more of it."""
        new = slice(self.directions, None)
        taken = self.moved.products(model.shared[:, new].take(self.moved.rows, axis=0))
        normals, scores = taken @ taken.transpose(0, 2, 1), taken @ model.step[new]
        return replace(self, normals=self.normals - normals, scores=self.scores - scores, directions=len(model.step))

    @property
    def family(self) -> Family:
        return self.moved.family
