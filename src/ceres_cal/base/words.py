"""Formatting of numbers and names for users, in messages, documents and reports.

Also the heights above the floor at which results are stated: the floor, and the height of a robot's cover.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import PurePath

DASH = "\N{EN DASH}"
_SPACE = "\N{NO-BREAK SPACE}"
IN_A_METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0, "km": 0.001, "inch": 1.0 / 0.0254, "ft": 1.0 / 0.3048}
"""Number of each unit of length in a metre."""
_POWERS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def finite(given: object, otherwise: Exception, largest: float = math.inf) -> float:
    """Return a number that was typed, or read from a file; raise `otherwise` for anything else, or one too large."""
    try:
        value = float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise otherwise from None
    if not abs(value) < largest:
        raise otherwise
    return value


# ---- numbers --------------------------------------------------------------------------------------------------------


def two_digits(value: float, digits: int = 2, sign: str = "") -> str:
    """Format with two significant digits, or `digits`, and all digits before the point: 0.21, 6.6, 24, 130; `sign` "+"
    marks positive values, too.
    """
    large = abs(value) >= 10.0**digits - 0.5  # with two digits, 99.5 would be 1e+02
    return f"{value:{sign}.0f}" if large else f"{value:{sign}.{digits}g}"


def short(value: float, digits: int = 2) -> str:
    """Format with two significant digits, or `digits`: 0.21, 6.6, 24, 130; a dash for NaN, "unknown" for infinity."""
    if math.isnan(value):
        return DASH
    return "unknown" if math.isinf(value) else two_digits(value, digits)


def mm(value: float) -> str:
    """Format with two significant digits and the unit, without a line break between them."""
    return f"{short(value)}{_SPACE}mm" if math.isfinite(value) else short(value)


def metres(place: tuple[float, float]) -> str:
    """Format a place on the field."""
    return f"x{_SPACE}{place[0]:.1f}, y{_SPACE}{place[1]:.1f}{_SPACE}m"


def fixed(value: float, places: int, sign: str = "") -> str:
    """Format with so many decimals; a dash for NaN or infinity; `sign` "+" marks positive values, too."""
    return f"{value:{sign}.{places}f}" if math.isfinite(value) else DASH


def powered(text: str) -> str:
    """Format powers with superscript digits, as in px^-2 or 10^7."""
    base, _, power = text.partition("^")
    return base + power.translate(_POWERS)


def chance(log10_p: float) -> str:
    """Format a probability: "0.21 %", "1 in 10^12"."""
    return f"{100.0 * 10.0**log10_p:.2g} %" if log10_p >= -3.0 else f"1 in 10^{-log10_p:.0f}"


def at_precision(value: float, sd: float, sign: str = "") -> str:
    """Format a value to the last of two digits of its standard deviation: 868.9 for 1.4, -5.0e-05 for 2.2e-06; `sign`
    "+" marks positive values, too.
    """
    small = abs(value) < 1e-3  # written with a power of ten
    if not (math.isfinite(sd) and sd > 0.0):
        return f"{value:{sign}.3e}" if small else f"{value:{sign}.4f}"
    places = 1 - math.floor(math.log10(sd))
    if small and places > 4:
        above = math.floor(math.log10(max(abs(value), sd)))
        return f"{round(value, places):{sign}.{max(above + places, 0)}e}"
    return f"{value:{sign}.{max(places, 0)}f}"


def with_sd(value: float, sd: float, sign: str = "") -> str:
    """Format a value and its standard deviation of two digits without a last 0: "868.9 ± 1.4", "0.0496 ± 0.002"."""
    return f"{at_precision(value, sd, sign)} ± {short(sd)}"


def bounds_text(low: float, high: float, unit: str, digits: str = "") -> str:
    """Format 95 % bounds: "477 to 672 px", "below 1209 px", "above 300 px", "anything"; 0 is no bound.

    Args:
        digits: format of a bound; by default whole numbers, centimetres where the unit is m.
    """
    digits, space = digits or (".2f" if unit == "m" else ".0f"), f" {unit}" if unit else ""
    if low == 0.0 or math.isinf(low):
        return "anything" if math.isinf(high) else f"below {high:{digits}}{space}"
    return f"above {low:{digits}}{space}" if math.isinf(high) else f"{low:{digits}} to {high:{digits}}{space}"


# ---- counts and names -----------------------------------------------------------------------------------------------


def grouped(number: int) -> str:
    """Format a count with its thousands separated."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def plural(number: int, word: str, shown: str = "") -> str:
    """Format a count with its noun: 1 view, 1204 views; `shown` replaces the count's own digits."""
    return f"{shown or number} {word}{'' if number == 1 else 's'}"


def counted(number: int, word: str) -> str:
    """Format a count with its noun, thousands separated: 1 view, 1 204 views."""
    return plural(number, word, grouped(number))


def first_of(names: Sequence[str], most: int = 3) -> str:
    """List at most `most` names, and how many more there are."""
    more = f" and {grouped(len(names) - most)} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """Return the end of a message, ": did you mean ...", if a known name is similar to this one; else "".

    A known name is similar if this one is its beginning or that of a word of it, or if it is the beginning of this one;
    otherwise if at most one letter in four differs: "sise" is "size", and "force" is not "tolerance". Dashes before
    options are ignored.
    """
    from difflib import get_close_matches

    typed, enough = str(name).lower().lstrip("-"), 3  # with fewer letters too many names match
    every = {one.lower().lstrip("-"): one for one in known}
    whole = re.compile(rf"(?<![a-z0-9]){re.escape(typed)}")
    begun = [one for one in every if len(typed) >= enough <= len(one) and (whole.search(one) or typed.startswith(one))]
    near = get_close_matches(typed, every, 1, 0.75) or sorted(begun, key=lambda one: abs(len(one) - len(typed)))
    return f": did you mean {every[near[0]]!r}?" if near else ""


def no_such(what: str, name: object, known: Iterable[str]) -> str:
    """Return a message on a wrong name: a similar known one, else the known ones, at most twelve."""
    every, most = list(known), 12
    rest = f" and {len(every) - most} more" if len(every) > most else ""
    listed = f": choose one of {', '.join(every[:most])}{rest}" if every else ": none is known"
    return f"there is no {what} {name!r}{did_you_mean(name, every) or listed}"


def sentence(text: str) -> str:
    """Capitalise the first letter of a text."""
    return f"{text[:1].upper()}{text[1:]}"


def ended(text: str) -> str:
    """Make a text a whole sentence; a question keeps its mark."""
    return sentence(text) + ("" if text.endswith("?") else ".")


def printable(text: str) -> str:
    """Replace bytes that are no letters (a file's name in another encoding) by \\udc.., so that the text can be
    written.
    """
    return text.encode("utf-8", "backslashreplace").decode()


def frame_of(image: str | PurePath) -> str:
    """Name of the frame of an image: its file's name without folder and ending."""
    return printable(PurePath(image).stem)


ROBOT_TOP_M = 0.15
"""Largest height of robots that the league allows, m; vision locates the markers on their covers there."""
HEIGHTS_M = (0.0, ROBOT_TOP_M)
"""Heights at which maps, errors and movements are stated, m; what holds at both holds between them."""


def at_height(height_m: float) -> str:
    """Words for a height: "on the floor", "at 150 mm"."""
    return "on the floor" if height_m == 0.0 else f"at {1e3 * height_m:.0f} mm"
