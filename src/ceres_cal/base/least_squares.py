"""Levenberg-Marquardt for small smooth least-squares problems without noise: lens models fitted to each other."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ceres_cal.base.arrays import Array

_STEP = 1e-6  # step for derivatives, relative to a number's size


@np.errstate(over="ignore", invalid="ignore")  # such a step is rejected
def least_squares(residuals: Callable[[Array], Array], start: Array, sizes: Array) -> Array:
    """Return the numbers (K,) that minimise the sum of squared residuals, from a start (K,).

    Args:
        residuals: numbers -> (N,), finite at the start; a step to where they are not finite is rejected.
        sizes: (K,) changes of the numbers that change the residuals by similar amounts.
    """
    rests = 1e-9  # relative decrease of the cost below which the iteration has converged
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
                return np.asarray(scaled * sizes)  # no further step is possible
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
