"""Tails of chi-squared variables, without a statistics library."""

from __future__ import annotations

import math

_PARTS, _REACH = 40, 6.0  # of a mean over a normal variable: steps to either side, and how far in sigmas


def upper_tail(value: float, degrees: int, freedom: float = math.inf) -> float:
    """Probability that a chi-squared variable is larger.

    Args:
        freedom: spare equations behind the noise that the value was divided by; then it is that of `degrees` times an F
            variable, as a mean over what the noise may be: good to 2 % down to 1e-3 from 30 on.
    """
    if degrees < 1 or value <= 0.0:
        return 1.0
    if math.isinf(freedom):
        return _tail(value, degrees)
    spread = 2.0 / (9.0 * max(freedom, 3.0))  # the noise's own distribution: Wilson and Hilferty
    total = weights = 0.0
    for part in range(-_PARTS, _PARTS + 1):
        z = _REACH * part / _PARTS
        weight = math.exp(-0.5 * z * z)
        total += weight * _tail(value * max(1.0 - spread + z * math.sqrt(spread), 0.0) ** 3, degrees)
        weights += weight
    return total / weights


def _tail(value: float, degrees: int) -> float:
    """Q(k + 2) = Q(k) + (x / 2)^(k / 2) exp(-x / 2) / Gamma(k / 2 + 1), from Q(1) or Q(2) on."""
    half = 0.5 * value
    total, at = (math.erfc(math.sqrt(half)), 1) if degrees % 2 else (math.exp(-half), 2)
    while at < degrees and half > 0.0:
        total += math.exp(0.5 * at * math.log(half) - half - math.lgamma(0.5 * at + 1.0))
        at += 2
    return min(total, 1.0)


def upper_bound(tail: float, degrees: int) -> float:
    """The value that a chi-squared variable exceeds with probability `tail`."""
    low, high = 0.0, 10.0 * degrees + 200.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _tail(middle, degrees) > tail else (low, middle)
    return 0.5 * (low + high)
