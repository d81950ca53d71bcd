"""Score tests of many effects at once: their columns against the residuals, beyond what the free numbers take up.

With X the columns of one group of an effect beyond the free numbers and r the residuals, both in standard deviations,
r'X (X'X)^-1 X'r over the mean square of what is left is Fisher's F where the noise is normal, and -(X'X)^-1 X'r is the
amount that would mend it. Of those that the residuals speak for the strongest is chosen first, then what it leaves
(forward selection).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.frozen import Frozen, replace
from ceres_cal.base.tails import log_f_tail
from ceres_cal.effects.columns import EffectColumns, EffectSums
from ceres_cal.effects.linearised import LEAST_LEFT, Linearised, inverse_roots

_LN_10 = float(np.log(10.0))
# Nats of log p: alternatives nearer than that are told apart by luck. Of what is planted the right name is first by 20.
_ALIKE = 7.0
# Of the first cause's statistic: below it the error of its linear picture speaks. At half of it one of seven planted
# faults has a second finding beside it, at double nothing changes.
_LEAST_SHARE = 0.02


class ScoreTest(Frozen):
    """The score test of one group of an effect.

    Attributes:
        effect, number: which. statistic: decrease of the squared residuals, in variances. rank: numbers it can tell.
        log_p: natural logarithm of the probability of as much in mere noise, not corrected for how many were tested.
        amount: (Q,) what would mend it. sd: (Q,) standard deviations, infinite for a number it cannot tell at all.
        rivals: alternatives of other kinds that explain nearly as much, and nothing more beside it.
    """

    effect: EffectColumns
    number: int
    statistic: float
    rank: int
    log_p: float
    amount: Array
    sd: Array
    rivals: tuple[ScoreTest, ...] = ()

    @property
    def subject(self) -> str:
        return self.effect.subjects[self.number]

    @property
    def frame(self) -> str | None:
        return self.effect.frames[self.number] if self.effect.frames else None

    @property
    def columns(self) -> Array:
        """(E, Q) px per unit of its amounts."""
        return self.effect.of(self.number)


def score_all(model: Linearised, alternatives: Sequence[EffectSums], inflation: float = 1.0) -> list[ScoreTest]:
    """The tests of every alternative that the free numbers leave testable.

    Args:
        alternatives: of each effect, beyond the free numbers of this model.
        inflation: how many observations weigh as much as one independent one, where neighbours agree.
    """
    squares, equations = float(model.left_over @ model.left_over), model.spare + model.known_noise
    slope = _robust_slope(model)
    testable: list[tuple[EffectColumns, int, Array, Array]] = []
    all_ranks, all_z = [], []
    for sums in alternatives:
        roots, ranks = inverse_roots(sums.normals, sums.sizes, LEAST_LEFT)
        z = np.einsum("gqk,gq->gk", roots, sums.scores)
        amounts, spreads = np.einsum("gqk,gk->gq", roots, z), np.sqrt(np.sum(roots**2, axis=2))
        spreads[sums.sizes == 0.0] = np.inf
        numbers = np.flatnonzero((ranks > 0) & (equations - ranks >= 1.0))
        testable += [(sums.effect, number, -amounts[number], spreads[number]) for number in numbers.tolist()]
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
        ScoreTest(effect, number, statistic, rank, one_log_p, amount / slope, spread * one_sd)
        for (effect, number, amount, spread), statistic, rank, one_log_p, one_sd in of_each
    ]


def _robust_slope(model: Linearised) -> float:
    """Mean derivative of a robust residual by the residual itself: 1 without a loss (Stein's lemma)."""
    plain = model.weight * model.equations.residual * model.used
    return float(plain @ model.score) / max(float(plain @ plain), 1e-300)


# ---- the choice among them ------------------------------------------------------------------------------------------


class Selection(Frozen):
    """The alternatives chosen, and the model with all of them in.

    Attributes:
        chosen: in the order of their strength, with their amounts when all of them are free at once.
        tests: number of alternatives that could be tested, and `extra`.
        log_level: natural logarithm of the probability below which one is chosen.
        model: the model with the chosen ones free.
    """

    chosen: tuple[ScoreTest, ...]
    tests: int
    log_level: float
    model: Linearised

    def log10_p(self, log_p: float) -> float:
        """Decimal logarithm of a probability after Bonferroni."""
        return min(0.0, (log_p + float(np.log(self.tests))) / _LN_10)


def select(
    model: Linearised, alternatives: Sequence[EffectSums], rate: float, extra: int, inflation: float = 1.0
) -> Selection:
    """Alternatives whose tests would give a false alarm with probability `rate` in all, one after the other, each with
    those before it free.

    Args:
        alternatives: see `score_all`. extra: how many other tests share the rate. inflation: see `score_all`.
    """
    most = 12  # causes that are named; more than that is not a calibration with faults but none
    chosen: list[ScoreTest] = []
    extended, scores = model, score_all(model, alternatives, inflation)
    tests = len(scores) + extra
    log_level = float(np.log(rate / tests))
    while scores and len(chosen) < most:
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
    best: ScoreTest, before: Sequence[ScoreTest], after: Sequence[ScoreTest], log_level: float
) -> tuple[ScoreTest, ...]:
    """Alternatives of other kinds that were about as probable as the best one, and are nothing beside it."""
    left = {(id(score.effect), score.number): score.log_p for score in after}
    near = [
        score
        for score in before
        if score.effect.kind != best.effect.kind
        and score.log_p < best.log_p + _ALIKE
        and left.get((id(score.effect), score.number), 0.0) > log_level
    ]
    return tuple(sorted(near, key=lambda score: score.log_p))
