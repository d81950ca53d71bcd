"""Errors, whose text is written for users: one line that says what is wrong and what to do.

Also what long work reports: its progress, and which files have been written, which is stated when it is interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, wraps
from typing import ParamSpec, TypeVar

from ceres_cal.base.words import first_of

_T = TypeVar("_T")
_P = ParamSpec("_P")


class CalibrationError(Exception):
    """Base of every failure of the package. `str(error)` is one line; `exit_code` is the exit code of the commands.

    Attributes:
        camera: the camera whose observations caused it, if others are not affected.
    """

    exit_code = 2

    def __init__(self, message: str = "", camera: str | None = None) -> None:
        super().__init__(message)
        self.camera = camera

    def __str__(self) -> str:
        return " ".join(super().__str__().splitlines())  # names out of a file may hold line breaks


class InputError(CalibrationError):
    """A file, an option or an observation is wrong: nothing was computed."""


class NothingShownError(InputError):
    """No image shows what was looked for.

    Attributes:
        missed: path and reason of every image.
    """

    def __init__(self, message: str, missed: tuple[tuple[str, str], ...]) -> None:
        super().__init__(message)
        self.missed = missed


class DegenerateError(CalibrationError):
    """The observations are well formed but cannot determine what was asked for."""


class SolutionError(CalibrationError):
    """The solve ended without a usable camera."""

    exit_code = 3


@contextmanager
def naming(where: object) -> Iterator[None]:
    """Prefix an InputError with `where`, a file or a place in one, unless it begins with that already."""
    try:
        yield
    except InputError as error:
        text = str(error)
        begins_with_it = text.startswith((f"{where}: ", f"{where}.", f"{where}/"))
        raise InputError(text if begins_with_it else f"{where}: {text}") from None


def attempt(work: Callable[[], _T], expected: type[CalibrationError] = CalibrationError) -> _T | CalibrationError:
    """Return the result of `work`, or the failure that it raised as a value; a comment there says what users read."""
    try:
        return work()
    except expected as error:  # quiet: whoever attempts it says what follows
        return error


def or_none(function: Callable[_P, _T | None]) -> Callable[_P, _T | None]:
    """Make a function return None where it fails; a comment beside it says what the user reads."""

    @wraps(function)
    def answer(*args: _P.args, **kwargs: _P.kwargs) -> _T | None:
        found = attempt(partial(function, *args, **kwargs))
        return None if isinstance(found, CalibrationError) else found

    return answer


def answer_or_reason(work: Callable[[], _T]) -> tuple[_T | None, str]:
    """Return the result of `work` and "", or None and one line with the reason; for callers that continue after any
    failure.
    """
    try:
        return work(), ""
    except Exception as error:  # reads: "field.json: cannot be written: ..." on the page
        foreseen = isinstance(error, CalibrationError)
        return None, str(error) if foreseen else f"unexpected {type(error).__name__}: {error}: please report it"


StepProgress = Callable[[int, int, str], None]
"""Called after each step with (steps done, steps in all, what was done)."""
ImageProgress = StepProgress
"""Progress over images, which are named by their files."""

_noted: ContextVar[list[str] | None] = ContextVar("noted", default=None)


@contextmanager
def noting() -> Iterator[list[str]]:
    """Yield a list to which files are added as they are written within the context."""
    files: list[str] = []
    token = _noted.set(files)
    try:
        yield files
    finally:
        _noted.reset(token)


def note(path: object) -> None:
    """Record that a file has been written."""
    files = _noted.get()
    if files is not None:
        files.append(str(path))


def noted_words() -> str:
    """List the files that have been written, as the end of a message."""
    files = _noted.get()
    return f"files written: {first_of(files)}" if files else "nothing was written"
