"""The robust losses."""

from __future__ import annotations

import numpy as np

from ceres_cal.kernels.arguments import LOSS_CODES, Loss
from ceres_cal.kernels.jit import jit

_TRIVIAL, _HUBER, _SOFT_L1, _CAUCHY = (LOSS_CODES[name] for name in ("trivial", "huber", "soft_l1", "cauchy"))
_STRAIGHT = 0.1  # in place of 0, where a loss has no curvature left


@jit
def robust_loss(loss: Loss, squared: float) -> tuple[float, float]:
    """rho and its derivative at the squared residual, as Ceres defines its losses."""
    code, scale = loss.code, loss.scale
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
        return 2.0 * squared / (1.0 + root), 1.0 / root  # 2 b (root - 1) without its rounding
    if code == _CAUCHY:
        return b * np.log1p(squared / b), 1.0 / (1.0 + squared / b)
    if squared >= b:
        return b / 3.0, 0.0
    share = squared / b
    rest = 1.0 - share
    return squared * (1.0 - share + share * share / 3.0), rest * rest  # b / 3 (1 - rest^3) without its rounding


@jit
def bend(loss: Loss, squared: float) -> float:
    """sqrt(1 + 2 s rho'' / rho') at the squared residual s: how the loss' own bend shortens the Jacobian along the
    residual (Triggs et al., Bundle Adjustment - A Modern Synthesis, section 4.3).

    1 for the redescending losses: along their bend a step may climb.
    """
    scale = loss.scale
    if loss.code == _HUBER and squared > scale * scale:
        return _STRAIGHT
    if loss.code == _SOFT_L1:
        return 1.0 / np.sqrt(1.0 + squared / (scale * scale))
    return 1.0
