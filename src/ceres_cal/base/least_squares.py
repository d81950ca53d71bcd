"""Small smooth least-squares problems by Levenberg and Marquardt: lens models fitted to each other, without noise."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ceres_cal.base.arrays import Array

_STEP = 1e-6  # of a number's size, for derivatives


@np.errstate(over="ignore", invalid="ignore")  # a step there is not taken
def least_squares(residuals: Callable[[Array], Array], start: Array, sizes: Array) -> Array:
    """The numbers (K,) that make the sum of squared residuals least, from a start (K,).

    Args:
        residuals: numbers -> (N,), finite at the start; where they are not, the step there is not taken.
        sizes: (K,) by how much each number changes the residuals about as much as the others do.
    """
    rests = 1e-9  # relative fall of the cost below which nothing is left to gain
    most_steps = 100
    scaled, at = start / sizes, residuals(start)
    cost, damping = float(at @ at), 1e-4
    for _ in range(most_steps):
        jacobian = np.empty((len(at), len(scaled)))
        for k in range(len(scaled)):
            step = np.zeros(len(scaled))
            step[k] = _STEP
            jacobian[:, k] = (residuals((scaled + step) * sizes) - residuals((scaled - step) * sizes)) / (2.0 * _STEP)
        normal, gradient = jacobian.T @ jacobian, jacobian.T @ at
        before = cost
        while damping < 1e12:
            curved = normal + damping * np.diag(np.diag(normal) + 1e-300)
            if not (np.all(np.isfinite(curved)) and np.all(np.isfinite(gradient))):
                return np.asarray(scaled * sizes)  # no way on from here
            there = scaled - np.linalg.lstsq(curved, gradient, rcond=None)[0]
            moved = residuals(there * sizes)
            lower = float(moved @ moved)
            if lower < cost:
                scaled, at, cost, damping = there, moved, lower, 0.1 * damping
                break
            damping *= 10.0
        if not cost < before * (1.0 - rests):
            break
    return np.asarray(scaled * sizes)
