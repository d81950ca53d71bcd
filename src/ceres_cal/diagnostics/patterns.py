"""Which alternatives the residuals speak for: the most telling one first, then what it leaves (forward selection)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.diagnostics.equations import Equations
from ceres_cal.diagnostics.findings import OF_LENS
from ceres_cal.diagnostics.linear_model import LinearModel, inverse_root
from ceres_cal.diagnostics.scores import LEAST_LEFT, Family, Score, score_all

_MOST = 12  # causes that are named; more than that is not a calibration with faults but none
# Of the first cause's statistic: below it the error of its linear picture speaks. At half of it one of seven planted
# faults has a second finding beside it, at double nothing changes.
_LEAST_SHARE = 0.02
# Rejected observations of one line that must agree on its place: two determine it, three more do not by chance.
# Nothing changes from half to double.
_FEWEST_AGREE = 5
# What lies farther aside is no painting error: its label is wrong. Nothing changes from half to double.
_FAR_M = 0.1


@dataclass(frozen=True, eq=False)
class Selection:
    """The alternatives chosen, and the model with all of them in.

    Attributes:
        chosen: in the order of their strength, with their amounts when all of them are free at once.
        shift: (E, len(chosen)) px that each moves; of the lens, beyond what the calibration would absorb.
        tests: number of alternatives that could be tested, and `extra`.
        log_level: natural logarithm of the probability below which one is chosen.
        model: the model with the chosen ones free.
    """

    chosen: tuple[Score, ...]
    shift: Array
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
    now, scores = model, score_all(model, families, inflation)
    tests = len(scores) + extra
    log_level = float(np.log(rate / tests))
    while scores and len(chosen) < _MOST:
        best = min(scores, key=lambda score: score.log_p)
        if best.log_p > log_level or (chosen and best.statistic < _LEAST_SHARE * chosen[0].statistic):
            break
        chosen.append(best)
        now = now.with_columns(best.family.of(best.number) * model.weight[:, None])
        scores = score_all(now, families, inflation)
    shift = np.zeros((len(model.equations), len(chosen)))
    if chosen:
        columns = [score.family.of(score.number) for score in chosen]
        amount, sd, _ = amounts_of(model, np.hstack(columns))
        ends = np.cumsum([column.shape[1] for column in columns])[:-1]
        parts = zip(chosen, np.split(amount, ends), np.split(sd, ends), strict=True)
        chosen = [replace(score, amount=own, sd=own_sd) for score, own, own_sd in parts]
        for k, score in enumerate(chosen):
            moved = columns[k] @ score.amount
            shift[:, k] = beyond(model, moved) if score.family.kind in OF_LENS else moved
    return Selection(tuple(chosen), shift, tests, log_level, now)


def amounts_of(model: LinearModel, columns: Array) -> tuple[Array, Array, float]:
    """Amounts (Q,) that mend most with columns (E, Q) px per unit, their standard deviations, and by how much the
    squared residuals fall; 0 and infinite for what cannot be determined.
    """
    scaled = columns * model.weight[:, None]
    rest = model.beyond_private(scaled)[model.used]
    taken = model.shared[model.used].T @ rest
    sizes = np.sum(scaled[model.used] ** 2, axis=0)
    root = inverse_root(rest.T @ rest - taken.T @ taken, sizes, LEAST_LEFT)
    z = root.T @ (rest.T @ model.score[model.used] - taken.T @ model.step)
    sd = np.where(np.any(root != 0.0, axis=1), np.sqrt(np.sum(root**2, axis=1)), np.inf)
    return -root @ z, sd, float(z @ z)


def gains_of(model: LinearModel, columns: Array) -> Array:
    """(Q,) by how much the squared residuals fall with each of the columns (E, Q), px per unit, alone."""
    scaled = columns * model.weight[:, None]
    rest = model.beyond_private(scaled)[model.used]
    taken = model.shared[model.used].T @ rest
    left = np.sum(rest**2, axis=0) - np.sum(taken**2, axis=0)
    determined = left > LEAST_LEFT * np.sum(scaled[model.used] ** 2, axis=0)
    slope = rest.T @ model.score[model.used] - taken.T @ model.step
    return np.where(determined, slope**2 / np.where(determined, left, 1.0), 0.0)


def beyond(model: LinearModel, column: Array) -> Array:
    """(E,) px of a displacement (E,) px that the calibration could not have absorbed."""
    rest = model.beyond_private((column * model.weight)[:, None])
    rest -= model.shared @ (model.shared[model.used].T @ rest[model.used])
    return np.asarray(rest[:, 0] / model.weight)


def heard_again(
    equations: Equations, weight: Array, used: Mask, families: Sequence[Family], reject_sigma: float, silent: Mask
) -> Mask:
    """The equations that take part when a line or point that was taken out nearly whole may speak for itself.

    A feature that lies aside is an outlier everywhere. Where more of its observations agree about one place of their
    own than agree with the drawing, those take part instead.

    Args:
        silent: (E,) equations that have another explanation, such as a wrong label.
    """
    used = used.copy()
    for family in families:
        if family.kind not in ("curve aside", "point aside"):
            continue
        rejected = np.bincount(family.group[(family.group >= 0) & ~used & ~silent], minlength=len(family.names))
        for number in np.flatnonzero(rejected >= _FEWEST_AGREE):
            rows = np.flatnonzero((family.group == number) & ~silent)
            agree = _agreeing(family.columns[rows] * weight[rows, None], equations.residual[rows] * weight[rows],
                              equations.observation[rows], reject_sigma)  # fmt: skip
            if np.count_nonzero(agree) > max(int(np.count_nonzero(used[rows])), _FEWEST_AGREE - 1):
                used[rows] = agree
    return used


def _agreeing(columns: Array, residual: Array, observation: Indices, reject_sigma: float) -> Mask:
    """(N,) which equations one amount brings within the bound, by least absolute deviations; none if it is too far."""
    columns = columns[:, np.any(columns != 0.0, axis=0)]
    amount: Array = np.zeros(columns.shape[1])
    for _ in range(30):
        sizes = 1.0 / np.sqrt(np.maximum(np.abs(residual + columns @ amount), 1.0))
        amount = -np.asarray(np.linalg.lstsq(columns * sizes[:, None], residual * sizes, rcond=1e-9)[0])
    _, of = np.unique(observation, return_inverse=True)
    lengths = np.sqrt(np.bincount(of, (residual + columns @ amount) ** 2))
    agree = (lengths <= reject_sigma)[of]
    return agree if np.all(np.abs(amount) < _FAR_M) else np.zeros(len(agree), dtype=bool)
