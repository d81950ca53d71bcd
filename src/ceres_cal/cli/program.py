"""The commands as a program of their own: its signals, its streams, its end."""

from __future__ import annotations

import io
import os
import signal
import sys
from types import FrameType
from typing import NoReturn

TERMINATED = 143
"""What a shell reports of a program that SIGTERM ended."""


class Terminated(KeyboardInterrupt):
    """SIGTERM came: everything is left as by Ctrl-C."""


def as_a_program() -> None:
    """Take SIGTERM like Ctrl-C, print whatever a name holds, and let nobody but us write on standard error."""
    signal.signal(signal.SIGTERM, _terminate)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    if not os.environ.get("CERES_CAL_DEBUG"):
        _silence_libraries()


def _terminate(number: int, frame: FrameType | None) -> NoReturn:
    raise Terminated


def _silence_libraries() -> None:
    """What image libraries and solvers print on descriptor 2 goes nowhere; `sys.stderr` has one of its own."""
    if sys.stderr is None:
        return
    own = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    os.close(nowhere)
    sys.stderr = open(own, "w", buffering=1, errors="backslashreplace")  # noqa: PTH123, SIM115 until the end


def ended(exit_code: int) -> int:
    """The same code; the process ends here where native work that nobody waits for would hold it."""
    native = sys.modules.get("ceres_cal.base.native")
    if native is not None and native.is_busy():
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(exit_code)
    return exit_code
