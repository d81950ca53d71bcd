"""Numbers and names as people read them on the page."""

from __future__ import annotations

import numpy as np

from ceres_cal.base.digits import two_digits
from ceres_cal.uncertainty import Verdict

DASH = "\N{EN DASH}"
_SPACE = "\N{NO-BREAK SPACE}"
_POWERS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def short(value: float) -> str:
    """Two digits: 0.21, 6.6, 24, 130; a dash for what is not there, "unknown" for infinity."""
    if np.isnan(value):
        return DASH
    if np.isinf(value):
        return "unknown"
    return two_digits(value)


def mm(value: float) -> str:
    """Two digits with their unit, on one line."""
    return f"{short(value)}{_SPACE}mm" if np.isfinite(value) else short(value)


def metres(place: tuple[float, float]) -> str:
    """A place on the field."""
    return f"x{_SPACE}{place[0]:.1f}, y{_SPACE}{place[1]:.1f}{_SPACE}m"


def powered(unit: str) -> str:
    """px^-2, or 10^7, as it is written by hand."""
    base, _, power = unit.partition("^")
    return base + power.translate(_POWERS)


def fixed(value: float, places: int) -> str:
    """So many places; a dash for what is not there."""
    return f"{value:.{places}f}" if np.isfinite(value) else DASH


def signed(value: float, places: int) -> str:
    """The same with its sign."""
    return f"{value:+.{places}f}" if np.isfinite(value) else DASH


def count(number: int, word: str) -> str:
    """A count with its word: 1 view, 1 204 views."""
    return f"{grouped(number)} {word}{'' if number == 1 else 's'}"


def grouped(number: int) -> str:
    """A count with its thousands apart."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def listed(names: tuple[str, ...] | list[str], most: int) -> str:
    """At most so many names, and how many more there are."""
    more = f" and {grouped(len(names) - most)} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def at_precision(value: float, sd: float, unit: str) -> str:
    """A value with as many places as two digits of its sd; coefficients keep every digit."""
    if unit.startswith("px^"):
        return repr(value)
    if not (np.isfinite(sd) and sd > 0.0):
        return f"{value:.4f}"
    return f"{value:.{int(np.clip(1 - np.floor(np.log10(sd)), 0, 9))}f}"


def bounds(verdict: Verdict) -> str:
    """What 95 % bounds leave: "848.1 to 889.8", "below 1209", "above 300", "anything"; 0 is no bound."""
    low, high = verdict.low, verdict.high
    below, above = np.isinf(low) or low == 0.0, np.isinf(high)
    if below or above:
        return "anything" if below and above else f"below {high:.4g}" if below else f"above {low:.4g}"
    if verdict.key.unit.startswith("px^"):
        return f"{low:.4g} to {high:.4g}"
    places = int(np.clip(2 - np.floor(np.log10(max(high - low, 1e-12))), 0, 9))
    return f"{low:.{places}f} to {high:.{places}f}"
