"""The commands as a program of their own: its signals, its streams, its end."""

from __future__ import annotations

import atexit
import gc
import io
import os
import signal
import sys
from contextlib import suppress
from types import FrameType
from typing import NoReturn

_OBJECTS = 50_000  # between collections: what is imported is no garbage, and to look it through takes time
TERMINATED = 143
"""What a shell reports of a program that SIGTERM ended."""


class Terminated(KeyboardInterrupt):
    """SIGTERM came: everything is left as by Ctrl-C."""


def as_a_program() -> None:
    """Take SIGTERM like Ctrl-C, print whatever a name holds, and let nobody but us write on standard error."""
    signal.signal(signal.SIGTERM, _terminate)
    gc.set_threshold(_OBJECTS)
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # to begin threads that are not used (base.threads) takes time
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
    """The process ends here, after all that was to be done at its end; Python would take its objects apart one by one,
    which takes as long as many a solve, and wait for native work that was left to itself.
    """
    if os.environ.get("CERES_CAL_DEBUG"):  # a profiler wants its say
        return exit_code
    native = sys.modules.get("ceres_cal.base.native")
    if native is None or not native.is_busy():
        atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError, OSError, ValueError):  # there is none, nobody reads, it is closed
            stream.flush()
    os._exit(exit_code)
