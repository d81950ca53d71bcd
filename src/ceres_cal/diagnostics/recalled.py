"""Observations that were taken out and are asked again: those of a line or point that lies aside as a whole.

Such a feature is an outlier everywhere. Where more of its observations agree about one place of their own than agree
with the drawing, those take part instead.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.diagnostics.diagnostic import Case
from ceres_cal.diagnostics.registry import all_families

# Rejected observations of one line that must agree on its place: two determine it, three more do not by chance.
# Nothing changes from half to double.
_FEWEST_AGREE = 5
# What lies farther aside is no painting error: its label is wrong. Nothing changes from half to double.
_FAR_M = 0.1


def recalled(case: Case) -> Mask:
    """(E,) which equations take part when lines and points that were taken out nearly whole may speak too."""
    equations, weight, used = case.equations, case.model.weight, case.model.used.copy()
    open_to_it = ~_mislabelled(case)[equations.observation]
    for family in all_families(replace(case, model=replace(case.model, used=open_to_it)), recalled=True):
        own = (family.group >= 0) & open_to_it
        rejected = np.bincount(family.group[own & ~used], minlength=len(family.subjects))
        for number in np.flatnonzero(rejected >= _FEWEST_AGREE):
            rows = np.flatnonzero(own & (family.group == number))
            agree = _agreeing(family.columns[rows] * weight[rows, None], equations.residual[rows] * weight[rows],
                              equations.observation[rows], case.problem.options.reject_sigma)  # fmt: skip
            if np.count_nonzero(agree) > max(int(np.count_nonzero(used[rows])), _FEWEST_AGREE - 1):
                used[rows] = agree
    return used


def _mislabelled(case: Case) -> Mask:
    """(N + M,) the observations that a wrong label explains."""
    points = len(case.observations.points)
    explained = np.zeros(len(case.table), dtype=bool)
    for label in case.labels.mislabelled:
        explained[label.rows + (points if label.is_curve else 0)] = True
    return explained


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
