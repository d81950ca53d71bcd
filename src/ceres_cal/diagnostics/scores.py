"""Score tests of many alternatives at once: their columns against the residuals, beyond what the free numbers take up.

An alternative is a group of equations that some columns move: one line of the field, one frame, everything after a
frame. With X its columns beyond the free numbers and r the residuals, both in standard deviations, r'X (X'X)^-1 X'r
over the mean square of what is left is Fisher's F where the noise is normal, and -(X'X)^-1 X'r is the amount that would
mend it. Of those that the residuals speak for the strongest is chosen first, then what it leaves (forward selection).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.tails import log_f_tail
from ceres_cal.solve.linear_model import LEAST_LEFT, LinearModel, inverse_root

# Nats of log p: alternatives nearer than that are told apart by luck. Of what is planted the right name is first by 20.
_ALIKE = 7.0
_MOST = 12  # causes that are named; more than that is not a calibration with faults but none
# Of the first cause's statistic: below it the error of its linear picture speaks. At half of it one of seven planted
# faults has a second finding beside it, at double nothing changes.
_LEAST_SHARE = 0.02


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
class Score:
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
    rivals: tuple[Score, ...] = ()

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


def score_all(model: LinearModel, families: Sequence[Family], inflation: float = 1.0) -> list[Score]:
    """The tests of every alternative that the free numbers leave testable.

    Args:
        inflation: how many observations weigh as much as one independent one, where neighbours agree.
    """
    squares = float(model.left_over @ model.left_over)
    slope = _robust_slope(model)
    testable: list[tuple[Family, int, Array, Array, Array]] = []
    for family in families:
        normals, scores, sizes = _sums(model, family)
        for number in np.flatnonzero(sizes.max(axis=1) > 0.0):
            root = inverse_root(normals[number], sizes[number], LEAST_LEFT)
            if root.shape[1] and model.spare + model.known_noise - root.shape[1] >= 1.0:
                testable.append((family, int(number), root, root.T @ scores[number], sizes[number]))
    if not testable:
        return []
    ranks = np.array([root.shape[1] for _, _, root, _, _ in testable])
    statistics = np.array([float(z @ z) for _, _, _, z, _ in testable])
    spare = model.spare + model.known_noise - ranks
    variance = (np.maximum(squares - statistics, 1e-12 * squares) + model.known_noise) / spare
    log_p = log_f_tail(statistics / (inflation * ranks * np.maximum(variance, 1e-300)), ranks, spare)
    return [
        Score(
            family, number, float(statistics[i] / variance[i]), int(ranks[i]), float(log_p[i]), -root @ z / slope,
            _spread(root, sizes, float(np.sqrt(variance[i] * inflation)) / slope),
        )
        for i, (family, number, root, z, sizes) in enumerate(testable)
    ]  # fmt: skip


def _spread(root: Array, sizes: Array, scale: float) -> Array:
    return np.where(sizes > 0.0, scale * np.sqrt(np.sum(root**2, axis=1)), np.inf)


def _robust_slope(model: LinearModel) -> float:
    """Mean derivative of a robust residual by the residual itself: 1 without a loss (Stein's lemma)."""
    plain = model.weight * model.equations.residual * model.used
    return float(plain @ model.score) / max(float(plain @ plain), 1e-300)


def _sums(model: LinearModel, family: Family) -> tuple[Array, Array, Array]:
    """Of each alternative: X'X (G, Q, Q), X'r (G, Q), and the squared lengths (G, Q) before any projection."""
    rows = np.flatnonzero((family.group >= 0) & model.used)
    rows = rows[np.argsort(family.group[rows], kind="stable")]
    group, count = family.group[rows], len(family.subjects)
    columns = family.columns[rows] * model.weight[rows, None]
    size = columns.shape[1]
    rest = model.placed_score[rows]

    def total(values: Array) -> Array:
        sums = _by_group(values, group, count)
        if family.onwards:  # group g stands for all groups after it
            sums = np.concatenate([np.cumsum(sums[::-1], axis=0)[::-1][1:], np.zeros_like(sums[:1])])
        return sums

    products = total((columns[:, :, None] * columns[:, None, :]).reshape(len(rows), size * size)).reshape(
        -1, size, size
    )
    sizes = np.einsum("gqq->gq", products).copy()
    shared = model.shared[rows]
    taken = np.stack([total(columns[:, k, None] * shared) for k in range(size)], axis=1)
    scores = total(columns * rest[:, None]) - taken @ model.step
    products -= taken @ taken.transpose(0, 2, 1)
    for places, overlap in _private_overlaps(model, family, rows, columns):
        np.subtract.at(products, places, overlap @ overlap.transpose(0, 2, 1))
    return products, scores, sizes


def _by_group(values: Array, group: Indices, count: int) -> Array:
    """Sums (count, K) of rows (N, K) sorted by group."""
    sums = np.zeros((count, values.shape[1]))
    if len(values):
        starts = np.flatnonzero(np.diff(group, prepend=-1))
        sums[group[starts]] = np.add.reduceat(values, starts, axis=0)
    return sums


def _private_overlaps(model: LinearModel, family: Family, rows: Indices, columns: Array) -> list[tuple[Indices, Array]]:
    """Alternatives (N,) and what of their columns lies in the private bases of one sight or another, (N, Q, 6)."""
    basis = model.private[rows]
    held = np.flatnonzero(np.any(basis != 0.0, axis=1))
    if not len(held):
        return []
    size, count = columns.shape[1], len(family.subjects)
    sight, group = model.equations.sight[rows[held]], family.group[rows[held]]
    order = np.lexsort((group, sight))
    products = (columns[held, :, None] * basis[held, None, :]).reshape(len(held), -1)[order]
    key = (sight * count + group)[order]
    starts = np.flatnonzero(np.diff(key, prepend=-1))
    sums = np.add.reduceat(products, starts, axis=0).reshape(-1, size, 6)
    sights, groups = np.divmod(key[starts], count)
    if not family.onwards:
        return [(groups, sums)]
    answer = []
    for number in np.unique(sights):
        own = sights == number
        every = np.zeros((count, size, 6))
        every[groups[own]] = sums[own]
        after = np.concatenate([np.cumsum(every[::-1], axis=0)[::-1][1:], np.zeros_like(every[:1])])
        answer.append((np.arange(count), after))
    return answer


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

    chosen: tuple[Score, ...]
    tests: int
    log_level: float
    model: LinearModel


def select(
    model: LinearModel, families: Sequence[Family], rate: float, extra: int, inflation: float = 1.0
) -> Selection:
    """Alternatives whose tests would give a false alarm with probability `rate` in all, one after the other, each with
    those before it free.

    Args:
        extra: how many other tests share the rate. inflation: see `score_all`.
    """
    chosen: list[Score] = []
    extended, scores = model, score_all(model, families, inflation)
    tests = len(scores) + extra
    log_level = float(np.log(rate / tests))
    while scores and len(chosen) < _MOST:
        best = min(scores, key=lambda score: score.log_p)
        if best.log_p > log_level or (chosen and best.statistic < _LEAST_SHARE * chosen[0].statistic):
            break
        before, extended = scores, extended.with_columns(best.columns)
        scores = score_all(extended, families, inflation)
        chosen.append(replace(best, rivals=_rivals(best, before, scores, log_level)))
    if chosen:
        together = model.freed(np.hstack([score.columns for score in chosen]))
        ends = np.cumsum([len(score.amount) for score in chosen])[:-1]
        parts = zip(chosen, np.split(together.amount, ends), np.split(together.sd, ends), strict=True)
        chosen = [replace(score, amount=amount, sd=sd) for score, amount, sd in parts]
    return Selection(tuple(chosen), tests, log_level, extended)


def _rivals(best: Score, before: Sequence[Score], after: Sequence[Score], log_level: float) -> tuple[Score, ...]:
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
