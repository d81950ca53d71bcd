"""How many digits of a number people are shown."""

from __future__ import annotations


def two_digits(value: float) -> str:
    """Two digits, and all that stand before the point: 0.21, 6.6, 24, 130."""
    return f"{value:.2g}" if abs(value) < 99.5 else f"{value:.0f}"  # two digits of 99.5 are 1e+02
