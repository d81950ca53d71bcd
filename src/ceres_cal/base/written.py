"""Which files were written, for those who must say so when they are interrupted."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

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
