"""The commands as a program of their own: its signals, its streams, its end."""

from __future__ import annotations

import atexit
import gc
import io
import os
import signal
import sys
from select import select
from types import FrameType
from typing import Any, NoReturn, TextIO, cast

_OBJECTS = 50_000  # between collections: what is imported is no garbage, and to look it through takes time
TERMINATED = 143
"""What a shell reports of a program that SIGTERM ended."""


class Terminated(KeyboardInterrupt):
    """SIGTERM came: everything is left as by Ctrl-C."""


class _Kept(io.FileIO):
    """A standard stream that never fails: what cannot be written is lost, and `lost` says why.

    So the exit code of a command is that of its work, wherever its words go.
    """

    lost: OSError | None = None

    def write(self, content: Any) -> int:
        try:
            while self.lost is None:
                if (written := super().write(content)) is not None:
                    return written
                select([], [self], [])  # a pipe that does not block, and is full
        except OSError as error:  # reads: "the answer is not on standard output: ..."
            self.lost = error
        return len(content)


def as_a_program() -> None:
    """Take SIGTERM like Ctrl-C, print whatever a name holds wherever it goes, and let nobody but us write on standard
    error.
    """
    signal.signal(signal.SIGTERM, _terminate)
    gc.set_threshold(_OBJECTS)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # to begin threads that are not used (base.threads) takes time
    _open_what_is_closed()
    error = 2
    if not os.environ.get("CERES_CAL_DEBUG"):
        error = os.dup(2)
        _silence_libraries()
    sys.stdout, sys.stderr = _stream(1, sys.stdout), _stream(error, sys.stderr)


def _open_what_is_closed() -> None:
    """Or the next file that is opened is written on as standard output, or standard error."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)


def _stream(number: int, before: TextIO | None) -> TextIO:
    """A descriptor as a stream like the one before, or like any where there was none."""
    encoding = "utf-8" if before is None else before.encoding
    buffered = io.BufferedWriter(_Kept(number, "w", closefd=False))
    by_lines = number != 1 or os.isatty(number)
    return io.TextIOWrapper(buffered, encoding, "backslashreplace", line_buffering=by_lines)


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise Terminated


def _silence_libraries() -> None:
    """What image libraries and solvers print on descriptor 2 goes nowhere."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)


def ended(exit_code: int) -> int:
    """The process ends here, after all that was to be done at its end; Python would take its objects apart one by one,
    which takes as long as many a solve, and wait for native work that was left to itself.
    """
    if os.environ.get("CERES_CAL_DEBUG"):  # a profiler wants its say
        return exit_code
    native = sys.modules.get("ceres_cal.base.native")
    if native is None or not native.is_busy():
        atexit._run_exitfuncs()
    sys.stdout.flush()
    lost = cast(_Kept, cast(io.BufferedWriter, sys.stdout.buffer).raw).lost
    if lost is not None and not isinstance(lost, BrokenPipeError):  # who closes a pipe wants no more
        print(f"ceres-cal: the answer is not on standard output: {lost.strerror}", file=sys.stderr)
    sys.stderr.flush()
    os._exit(exit_code)
