"""What a terminal shows: colour, where NO_COLOR does not say otherwise, and progress on standard error.

Progress is a bar on a terminal, now and then a line elsewhere, nothing where it is not wanted. Colour is for titles,
warnings, and whether the answer is good.
"""

from __future__ import annotations

import os
import re
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import TextIO

from ceres_cal.cli.options import QuietArguments

_BOLD, _RED, _GREEN, _YELLOW, _PLAIN = "\x1b[1m", "\x1b[31m", "\x1b[32m", "\x1b[33m", "\x1b[0m"
_REDRAW_S = 0.1
_FIRST_LINE_S = 3.0  # where there is no terminal; each further line waits twice as long
_BAR_COLUMNS = 24
_CLEAR = "\r\x1b[K"
_TITLE = re.compile(r"^([a-z][a-z ]{0,8})(?=[ ]*(?<=^.{10})\S)", re.MULTILINE)
_DOUBTFUL = {"warning", "weak", "unknown", "widened"}
_ANSWERS = (
    (_GREEN, re.compile(r"^(?:verdict +This calibration can be trusted|(?:check|audit) +yes).*$", re.MULTILINE)),
    (_YELLOW, re.compile(r"^verdict +Usable (?:with limits|on the floor).*$", re.MULTILINE)),
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


# ---- progress -------------------------------------------------------------------------------------------------------


def progress_bar(args: QuietArguments) -> ProgressBar:
    """The bar of a command: nothing with --quiet or --json."""
    return ProgressBar(silent=args.quiet or args.json)


class ProgressBar:
    """How far some long work is. A context: the bar is gone when it ends, however it ends.

    Args:
        silent: show nothing.
        stream: where; standard error by default.
        clock: seconds.
    """

    def __init__(
        self, *, silent: bool, stream: TextIO | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._silent, self._clock = silent, clock
        self._terminal = self._stream.isatty() and os.environ.get("TERM") != "dumb"
        self._wait = _REDRAW_S if self._terminal else _FIRST_LINE_S
        self._due = clock() + (0.0 if self._terminal else self._wait)

    def __enter__(self) -> ProgressBar:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._terminal and not self._silent:
            self._write(_CLEAR)

    def say(self, text: str) -> None:
        """A line that stays."""
        if not self._silent:
            self._write(f"{_CLEAR if self._terminal else ''}{text}\n")

    def update(self, done: int, total: int, note: str) -> None:
        """Show that `done` of `total` steps are done, 0 where nobody knows; `note` says what is going on."""
        now = self._clock()
        if self._silent or now < self._due:
            return
        if self._terminal:
            import shutil

            bar = f"{_bar(done, total)} {note}" if total else note
            self._write(_CLEAR + bar[: shutil.get_terminal_size().columns - 1])
        else:
            self._write(f"{note} ({done} of {total})\n" if total else f"{note}\n")
            self._wait *= 2.0
        self._due = now + self._wait

    def _write(self, text: str) -> None:
        self._stream.write(text)
        self._stream.flush()


def _bar(done: int, total: int) -> str:
    full = _BAR_COLUMNS * done // total
    return f"[{'#' * full}{'.' * (_BAR_COLUMNS - full)}] {100 * done // total:3} %"
