"""The robust losses."""

from __future__ import annotations

import numpy as np

from ceres_cal.kernels.jit import jit

LOSS_CODES = {"trivial": 0, "huber": 1, "soft_l1": 2, "cauchy": 3, "tukey": 4}

_TRIVIAL, _HUBER, _SOFT_L1, _CAUCHY = 0, 1, 2, 3


@jit
def robust_loss(code: int, scale: float, squared: float) -> tuple[float, float]:
    """rho and its derivative at the squared residual, as Ceres defines its losses."""
    b = scale * scale
    if code == _TRIVIAL:
        return squared, 1.0
    if code == _HUBER:
        if squared <= b:
            return squared, 1.0
        root = np.sqrt(squared)
        return 2.0 * scale * root - b, scale / root
    if code == _SOFT_L1:
        root = np.sqrt(1.0 + squared / b)
        return 2.0 * b * (root - 1.0), 1.0 / root
    if code == _CAUCHY:
        return b * np.log(1.0 + squared / b), 1.0 / (1.0 + squared / b)
    if squared >= b:
        return b / 3.0, 0.0
    rest = 1.0 - squared / b
    return b / 3.0 * (1.0 - rest * rest * rest), rest * rest
