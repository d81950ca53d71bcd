"""Which alternatives the residuals speak for: the strongest one first, then what it leaves (forward selection)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.diagnostics.linear_model import LinearModel
from ceres_cal.diagnostics.scores import Family, Score, score_all

_MOST = 12  # causes that are named; more than that is not a calibration with faults but none
# Of the first cause's statistic: below it the error of its linear picture speaks. At half of it one of seven planted
# faults has a second finding beside it, at double nothing changes.
_LEAST_SHARE = 0.02


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
        chosen.append(best)
        extended = extended.with_columns(best.columns)
        scores = score_all(extended, families, inflation)
    if chosen:
        together = model.freed(np.hstack([score.columns for score in chosen]))
        ends = np.cumsum([len(score.amount) for score in chosen])[:-1]
        parts = zip(chosen, np.split(together.amount, ends), np.split(together.sd, ends), strict=True)
        chosen = [replace(score, amount=amount, sd=sd) for score, amount, sd in parts]
    return Selection(tuple(chosen), tests, log_level, extended)
