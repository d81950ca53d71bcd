"""What long work says as it goes: how far it is, and which files are in their place, which is said when it is
interrupted.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

StepProgress = Callable[[int, int, str], None]
"""Called after each step with (steps done, steps in all, what was done)."""
ImageProgress = StepProgress
"""Steps are images, named by their files."""

_noted: ContextVar[list[str] | None] = ContextVar("noted", default=None)


@contextmanager
def noting() -> Iterator[list[str]]:
    """The files that are written while it lasts, as they come."""
    files: list[str] = []
    token = _noted.set(files)
    try:
        yield files
    finally:
        _noted.reset(token)


def note(path: object) -> None:
    """That a file is in its place."""
    files = _noted.get()
    if files is not None:
        files.append(str(path))
