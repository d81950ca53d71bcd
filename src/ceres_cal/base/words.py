"""Numbers and names as people read them, in messages, answers and reports.

The heights above the floor that matter: where a robot's cover and the ball are located.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import PurePath

DASH = "\N{EN DASH}"
_SPACE = "\N{NO-BREAK SPACE}"
IN_A_METRE = {"mm": 1000.0, "cm": 100.0, "m": 1.0, "inch": 1.0 / 0.0254, "ft": 1.0 / 0.3048}
"""How many of each unit that lengths are given in."""
_POWERS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def finite(given: object, otherwise: Exception, largest: float = math.inf) -> float:
    """A number that somebody typed, or a file has; raises `otherwise` for anything else, or one that is too large."""
    try:
        value = float(given)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        raise otherwise from None
    if not abs(value) < largest:
        raise otherwise
    return value


# ---- numbers --------------------------------------------------------------------------------------------------------


def two_digits(value: float, digits: int = 2, sign: str = "") -> str:
    """So many digits, and all that stand before the point: 0.21, 6.6, 24, 130; `sign` "+" also of what is positive."""
    large = abs(value) >= 10.0**digits - 0.5  # two digits of 99.5 are 1e+02
    return f"{value:{sign}.0f}" if large else f"{value:{sign}.{digits}g}"


def short(value: float, digits: int = 2) -> str:
    """Two digits, or so many: 0.21, 6.6, 24, 130; a dash for what is not there, "unknown" for infinity."""
    if math.isnan(value):
        return DASH
    return "unknown" if math.isinf(value) else two_digits(value, digits)


def mm(value: float) -> str:
    """Two digits with their unit, on one line."""
    return f"{short(value)}{_SPACE}mm" if math.isfinite(value) else short(value)


def metres(place: tuple[float, float]) -> str:
    """A place on the field."""
    return f"x{_SPACE}{place[0]:.1f}, y{_SPACE}{place[1]:.1f}{_SPACE}m"


def fixed(value: float, places: int, sign: str = "") -> str:
    """So many places, a dash for what is not there; `sign` "+" also of what is positive."""
    return f"{value:{sign}.{places}f}" if math.isfinite(value) else DASH


def powered(text: str) -> str:
    """px^-2, or 10^7, as it is written by hand."""
    base, _, power = text.partition("^")
    return base + power.translate(_POWERS)


def chance(log10_p: float) -> str:
    """A probability: "0.21 %", "1 in 10^12"."""
    return f"{100.0 * 10.0**log10_p:.2g} %" if log10_p >= -3.0 else f"1 in 10^{-log10_p:.0f}"


def at_precision(value: float, sd: float, sign: str = "") -> str:
    """A value that ends where two digits of its sd end: 868.9 beside 1.4, -5.0e-05 beside 2.2e-06; `sign` "+" also of
    what is positive.
    """
    small = abs(value) < 1e-3  # which is written with a power of ten
    if not (math.isfinite(sd) and sd > 0.0):
        return f"{value:{sign}.3e}" if small else f"{value:{sign}.4f}"
    places = 1 - math.floor(math.log10(sd))
    if small and places > 4:
        above = math.floor(math.log10(max(abs(value), sd)))
        return f"{round(value, places):{sign}.{max(above + places, 0)}e}"
    return f"{value:{sign}.{max(places, 0)}f}"


def with_sd(value: float, sd: float, sign: str = "") -> str:
    """A value and its standard deviation, to two digits of that but for a last 0: "868.9 ± 1.4", "0.0496 ± 0.002"."""
    return f"{at_precision(value, sd, sign)} ± {short(sd)}"


def bounds_text(low: float, high: float, unit: str, digits: str = "") -> str:
    """What 95 % bounds leave: "477 to 672 px", "below 1209 px", "above 300 px", "anything"; 0 is no bound.

    Args:
        digits: how a bound is formatted; whole numbers by default, centimetres where the unit is m.
    """
    digits, space = digits or (".2f" if unit == "m" else ".0f"), f" {unit}" if unit else ""
    if low == 0.0 or math.isinf(low):
        return "anything" if math.isinf(high) else f"below {high:{digits}}{space}"
    return f"above {low:{digits}}{space}" if math.isinf(high) else f"{low:{digits}} to {high:{digits}}{space}"


# ---- counts and names -----------------------------------------------------------------------------------------------


def grouped(number: int) -> str:
    """A count with its thousands apart."""
    return f"{number:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")


def plural(number: int, word: str, shown: str = "") -> str:
    """A count with its word: 1 view, 1204 views; `shown` is the count as it is written, where otherwise."""
    return f"{shown or number} {word}{'' if number == 1 else 's'}"


def counted(number: int, word: str) -> str:
    """A count with its word, thousands apart: 1 view, 1 204 views."""
    return plural(number, word, grouped(number))


def first_of(names: Sequence[str], most: int = 3) -> str:
    """At most so many names, and how many more there are."""
    more = f" and {grouped(len(names) - most)} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def did_you_mean(name: object, known: Iterable[str]) -> str:
    """The end of a message, ": did you mean ...", where a known name is much like this one; else nothing.

    One that it begins, or a word of, or that begins it; else one of the same letters, but for one in four: "sise" is
    "size", and "force" is not "tolerance". Dashes before options are no letters.
    """
    from difflib import get_close_matches

    typed, enough = str(name).lower().lstrip("-"), 3  # fewer letters begin a word of too many names
    every = {one.lower().lstrip("-"): one for one in known}
    whole = re.compile(rf"(?<![a-z0-9]){re.escape(typed)}")
    begun = [one for one in every if len(typed) >= enough <= len(one) and (whole.search(one) or typed.startswith(one))]
    near = get_close_matches(typed, every, 1, 0.75) or sorted(begun, key=lambda one: abs(len(one) - len(typed)))
    return f": did you mean {every[near[0]]!r}?" if near else ""


def no_such(what: str, name: object, known: Iterable[str]) -> str:
    """What a message says of a wrong name: the known one that is much like it, else which there are, twelve at most."""
    every, most = list(known), 12
    rest = f" and {len(every) - most} more" if len(every) > most else ""
    listed = f": choose one of {', '.join(every[:most])}{rest}" if every else ": none is known"
    return f"there is no {what} {name!r}{did_you_mean(name, every) or listed}"


def sentence(text: str) -> str:
    """The text with a capital at its beginning."""
    return f"{text[:1].upper()}{text[1:]}"


def ended(text: str) -> str:
    """The text as a whole sentence, which a question is already."""
    return sentence(text) + ("" if text.endswith("?") else ".")


def printable(text: str) -> str:
    """The text with what is no letter (bytes of a file's name in another encoding) as \\udc..: it can be written."""
    return text.encode("utf-8", "backslashreplace").decode()


def frame_of(image: str | PurePath) -> str:
    """What the frame of an image is called: its name without folder and ending."""
    return printable(PurePath(image).stem)


ROBOT_TOP_M = 0.15
"""As high as the league lets robots be, and where vision looks for the markers on their covers."""
HEIGHTS_M = (0.0, ROBOT_TOP_M)
"""At which maps, errors and movements are stated: what holds at both holds between them."""


def at_height(height_m: float) -> str:
    """How people say it: "on the floor", "at 150 mm"."""
    return "on the floor" if height_m == 0.0 else f"at {1e3 * height_m:.0f} mm"
