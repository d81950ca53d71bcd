"""Watching a folder for weeks, and a journal of events; the base of `refit_after_move.py`. Copy both.

The folder, the log and standard output may disappear and come back, the clock may be set back, and the folder may
contain anything: only regular files with the right endings are used, each after it has stopped growing.
"""

from __future__ import annotations

import json
import os
import sys
from collections import deque
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

PATIENCE = 3  # attempts before a file counts as unreadable, since it may still be arriving
_MOST_KEPT = 10_000  # events that wait to be written

Stamp = tuple[int, int, int]


class Folder:
    """Files that appear in a folder; a changed file appears again. It remembers only files that still exist."""

    def __init__(self, path: Path, endings: Collection[str]) -> None:
        self._path, self._endings = path, endings
        self._done = self._before = self._files() or {}
        self._tries: dict[Path, int] = {}
        self.is_there = True

    def look(self) -> list[Path]:
        """New files, and files that are tried again, in the order of their times."""
        now = self._files()
        self.is_there = now is not None
        if now is None:  # processed files stay known until the folder is back
            return []
        # A file that is still being written has grown since the last look.
        ready = [path for path in now if now[path] != self._done.get(path) and now[path] == self._before.get(path)]
        self._done = {path: stamp for path, stamp in self._done.items() if path in now} | {p: now[p] for p in ready}
        self._before, self._tries = now, {path: tries for path, tries in self._tries.items() if path in now}
        return sorted(ready, key=lambda path: now[path])

    def again(self, path: Path) -> bool:
        """Whether a file that could not be read is tried again, after the others; the number of attempts is limited."""
        self._tries[path] = self._tries.get(path, 0) + 1
        if self._tries[path] % PATIENCE == 0:
            return False
        self._done.pop(path, None)
        return True

    def _files(self) -> dict[Path, Stamp] | None:
        """Time, size and inode of each file; None where the folder does not exist."""
        found: dict[Path, Stamp] = {}
        try:
            with os.scandir(self._path) as entries:
                for entry in entries:
                    name = entry.name
                    if not name.startswith(".") and os.path.splitext(name)[1].lower() in self._endings:  # noqa: PTH122
                        _add(found, entry)
        except OSError:
            return None
        return found


def _add(found: dict[Path, Stamp], entry: os.DirEntry[str]) -> None:
    try:
        if entry.is_file():  # not a pipe or a device
            status = entry.stat()
            found[Path(entry.path)] = (status.st_mtime_ns, status.st_size, status.st_ino)
    except OSError:  # it was just removed, or is a circular link
        pass


class Journal:
    """Events as lines of JSON, in a log or on standard output; what cannot be written waits for the next event."""

    def __init__(self, log: Path | None) -> None:
        self._log = log
        self._waiting: deque[str] = deque(maxlen=_MOST_KEPT)

    def write(self, event: Mapping[str, Any]) -> None:
        self._waiting.append(json.dumps(event) + "\n")
        try:
            if self._log is None:
                self._print()
            else:
                with self._log.open("a", encoding="utf-8") as log:
                    log.write("".join(self._waiting))
            self._waiting.clear()
        except (OSError, ValueError):  # a full disk, a removed folder, a closed stream
            pass

    def _print(self) -> None:
        try:
            sys.stdout.write("".join(self._waiting))
            sys.stdout.flush()
        except BrokenPipeError:  # the reader has ended, and none will follow
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
