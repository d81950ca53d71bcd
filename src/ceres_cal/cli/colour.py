"""Colour where a terminal is, and NO_COLOR does not say otherwise: titles, warnings, and whether the answer is good."""

from __future__ import annotations

import os
import re
from typing import TextIO

_BOLD, _RED, _GREEN, _YELLOW, _PLAIN = "\x1b[1m", "\x1b[31m", "\x1b[32m", "\x1b[33m", "\x1b[0m"
_TITLE = re.compile(r"^([a-z][a-z ]{0,8})(?=[ ]*(?<=^.{10})\S)", re.MULTILINE)
_DOUBTFUL = {"warning", "weak", "unknown", "widened"}
_ANSWERS = (
    (_GREEN, re.compile(r"^(?:verdict +This calibration can be trusted|(?:check|audit) +yes).*$", re.MULTILINE)),
    (_YELLOW, re.compile(r"^verdict +Use it with care.*$", re.MULTILINE)),
    (_RED, re.compile(r"^(?:verdict +Do not trust|(?:check|audit) +no\b).*$", re.MULTILINE)),
)


def in_colour(stream: TextIO) -> bool:
    """Whether a stream shows colours and nobody asked for none (no-color.org)."""
    return stream.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb"


def coloured(text: str) -> str:
    """The text of an answer."""
    for colour, answer in _ANSWERS:
        text = answer.sub(rf"{colour}\g<0>{_PLAIN}", text)
    return _TITLE.sub(_title, text)


def error(text: str) -> str:
    """What went wrong."""
    return f"{_RED}{text}{_PLAIN}"


def _title(found: re.Match[str]) -> str:
    title = found[1].rstrip()
    colour = _YELLOW if title in _DOUBTFUL else _BOLD
    return f"{colour}{title}{_PLAIN}{found[1][len(title) :]}"
