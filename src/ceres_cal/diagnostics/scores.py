"""Score tests of many alternatives at once: their columns against the residuals, beyond what the free numbers take up.

An alternative is a group of equations that some columns move: one line of the field, one frame, everything after a
frame. With X its columns beyond the free numbers and r the residuals, both in standard deviations, r'X (X'X)^-1 X'r
over the mean square of what is left is Fisher's F where the noise is normal, and -(X'X)^-1 X'r is the amount that would
mend it. Of those that the residuals speak for the strongest is chosen first, then what it leaves (forward selection).

Alternatives to a model, a family of each kind, and what the equations say of each: sums over those it moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.cached import cached_property
from ceres_cal.base.tails import log_f_tail
from ceres_cal.effects.linearised import LEAST_LEFT, Linearised, inverse_roots


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
class _MovedRows:
    """The equations in use that any of G alternatives moves, by alternative.

    Attributes:
        rows: (N,) which they are. columns: (N, Q) of the family, in standard deviations.
    """

    family: Family
    rows: Indices
    columns: Array

    @classmethod
    def of(cls, model: Linearised, family: Family) -> _MovedRows:
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

    def private_squares(self, model: Linearised) -> Array:
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
class AlternativeSums:
    """What the equations say of each of G alternatives: X their columns beyond the free numbers of a model, and r the
    residuals, both in standard deviations.

    Attributes:
        sizes: (G, Q) squared lengths of the columns as they are. normals: (G, Q, Q) X'X. scores: (G, Q) X'r.
        directions: how many shared directions of the model X is beyond.
    """

    moved: _MovedRows
    sizes: Array
    normals: Array
    scores: Array
    directions: int = 0

    @classmethod
    def of(cls, model: Linearised, family: Family) -> AlternativeSums:
        """Of a family."""
        moved = _MovedRows.of(model, family)
        sums = moved.products(np.column_stack([moved.columns, model.placed_score[moved.rows]]))
        normals, scores = sums[:, :, :-1], sums[:, :, -1]
        sizes = np.diagonal(normals, axis1=1, axis2=2)
        return cls(moved, sizes, normals - moved.private_squares(model), scores).beside(model)

    def beside(self, model: Linearised) -> AlternativeSums:
        """The same beyond all that is free in a model that has more of it."""
        new = slice(self.directions, None)
        taken = self.moved.products(model.shared[:, new].take(self.moved.rows, axis=0))
        normals, scores = taken @ taken.transpose(0, 2, 1), taken @ model.step[new]
        return replace(self, normals=self.normals - normals, scores=self.scores - scores, directions=len(model.step))

    @property
    def family(self) -> Family:
        return self.moved.family


# Nats of log p: alternatives nearer than that are told apart by luck. Of what is planted the right name is first by 20.
_ALIKE = 7.0
_MOST = 12  # causes that are named; more than that is not a calibration with faults but none
# Of the first cause's statistic: below it the error of its linear picture speaks. At half of it one of seven planted
# faults has a second finding beside it, at double nothing changes.
_LEAST_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class TestedAlternative:
    """The test of one alternative.

    Attributes:
        family, number: which. statistic: decrease of the squared residuals, in variances. rank: numbers it can tell.
        log_p: natural logarithm of the probability of as much in mere noise, not corrected for how many were tested.
        amount: (Q,) what would mend it. sd: (Q,) standard deviations, infinite for a number it cannot tell at all.
        rivals: alternatives of other kinds that explain nearly as much, and nothing more beside it.
    """

    family: Family
    number: int
    statistic: float
    rank: int
    log_p: float
    amount: Array
    sd: Array
    rivals: tuple[TestedAlternative, ...] = ()

    @property
    def subject(self) -> str:
        return self.family.subjects[self.number]

    @property
    def frame(self) -> str | None:
        return self.family.frames[self.number] if self.family.frames else None

    @property
    def columns(self) -> Array:
        """(E, Q) px per unit of its amounts."""
        return self.family.of(self.number)


def score_all(
    model: Linearised, alternatives: Sequence[AlternativeSums], inflation: float = 1.0
) -> list[TestedAlternative]:
    """The tests of every alternative that the free numbers leave testable.

    Args:
        alternatives: of each family, beyond the free numbers of this model.
        inflation: how many observations weigh as much as one independent one, where neighbours agree.
    """
    squares, equations = float(model.left_over @ model.left_over), model.spare + model.known_noise
    slope = _robust_slope(model)
    testable: list[tuple[Family, int, Array, Array]] = []
    all_ranks, all_z = [], []
    for sums in alternatives:
        roots, ranks = inverse_roots(sums.normals, sums.sizes, LEAST_LEFT)
        z = np.einsum("gqk,gq->gk", roots, sums.scores)
        amounts, spreads = np.einsum("gqk,gk->gq", roots, z), np.sqrt(np.sum(roots**2, axis=2))
        spreads[sums.sizes == 0.0] = np.inf
        numbers = np.flatnonzero((ranks > 0) & (equations - ranks >= 1.0))
        testable += [(sums.family, number, -amounts[number], spreads[number]) for number in numbers.tolist()]
        all_ranks.append(ranks[numbers])
        all_z.append(np.sum(z[numbers] ** 2, axis=1))
    if not testable:
        return []
    ranks, statistics = np.concatenate(all_ranks), np.concatenate(all_z)
    spare = equations - ranks
    variance = (np.maximum(squares - statistics, 1e-12 * squares) + model.known_noise) / spare
    log_p = log_f_tail(statistics / (inflation * ranks * np.maximum(variance, 1e-300)), ranks, spare)
    sd = np.sqrt(variance * inflation) / slope
    of_each = zip(testable, (statistics / variance).tolist(), ranks.tolist(), log_p.tolist(), sd.tolist(), strict=True)
    return [
        TestedAlternative(family, number, statistic, rank, one_log_p, amount / slope, spread * one_sd)
        for (family, number, amount, spread), statistic, rank, one_log_p, one_sd in of_each
    ]


def _robust_slope(model: Linearised) -> float:
    """Mean derivative of a robust residual by the residual itself: 1 without a loss (Stein's lemma)."""
    plain = model.weight * model.equations.residual * model.used
    return float(plain @ model.score) / max(float(plain @ plain), 1e-300)


# ---- the choice among them ------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Selection:
    """The alternatives chosen, and the model with all of them in.

    Attributes:
        chosen: in the order of their strength, with their amounts when all of them are free at once.
        tests: number of alternatives that could be tested, and `extra`.
        log_level: natural logarithm of the probability below which one is chosen.
        model: the model with the chosen ones free.
    """

    chosen: tuple[TestedAlternative, ...]
    tests: int
    log_level: float
    model: Linearised


def select(
    model: Linearised, alternatives: Sequence[AlternativeSums], rate: float, extra: int, inflation: float = 1.0
) -> Selection:
    """Alternatives whose tests would give a false alarm with probability `rate` in all, one after the other, each with
    those before it free.

    Args:
        alternatives: see `score_all`. extra: how many other tests share the rate. inflation: see `score_all`.
    """
    chosen: list[TestedAlternative] = []
    extended, scores = model, score_all(model, alternatives, inflation)
    tests = len(scores) + extra
    log_level = float(np.log(rate / tests))
    while scores and len(chosen) < _MOST:
        best = min(scores, key=lambda score: score.log_p)
        if best.log_p > log_level or (chosen and best.statistic < _LEAST_SHARE * chosen[0].statistic):
            break
        before, extended = scores, extended.with_columns(best.columns)
        alternatives = [sums.beside(extended) for sums in alternatives]
        scores = score_all(extended, alternatives, inflation)
        chosen.append(replace(best, rivals=_rivals(best, before, scores, log_level)))
    if chosen:
        together = model.freed(np.hstack([score.columns for score in chosen]))
        ends = np.cumsum([len(score.amount) for score in chosen])[:-1]
        parts = zip(chosen, np.split(together.amount, ends), np.split(together.sd, ends), strict=True)
        chosen = [replace(score, amount=amount, sd=sd) for score, amount, sd in parts]
    return Selection(tuple(chosen), tests, log_level, extended)


def _rivals(
    best: TestedAlternative, before: Sequence[TestedAlternative], after: Sequence[TestedAlternative], log_level: float
) -> tuple[TestedAlternative, ...]:
    """Alternatives of other kinds that were about as probable as the best one, and are nothing beside it."""
    left = {(id(score.family), score.number): score.log_p for score in after}
    near = [
        score
        for score in before
        if score.family.kind != best.family.kind
        and score.log_p < best.log_p + _ALIKE
        and left.get((id(score.family), score.number), 0.0) > log_level
    ]
    return tuple(sorted(near, key=lambda score: score.log_p))
