"""Which sources machine code was made of."""

from __future__ import annotations

from collections.abc import Iterable
from hashlib import sha256
from pathlib import Path


def digest(paths: Iterable[Path]) -> str:
    """Of the contents of files."""
    contents = sha256()
    for path in sorted(paths):
        contents.update(path.read_bytes())
    return contents.hexdigest()[:16]
