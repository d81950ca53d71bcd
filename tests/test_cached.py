"""The package's cached property: the value is computed once, and other instances do not wait for it."""

from __future__ import annotations

import ast
import os
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

from scenes import RADIAL, corners

from ceres_cal.base.frozen import cached_property
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.simulate import simulate

PACKAGE = Path(__file__).parents[1] / "src" / "ceres_cal"
SOURCES = sorted(PACKAGE.rglob("*.py"))


class SlowObject:
    """An object whose value takes until `go` is set."""

    def __init__(self) -> None:
        self.begun, self.go, self.calls = threading.Event(), threading.Event(), 0

    @cached_property
    def value(self) -> object:
        """What the test reads."""
        self.calls += 1
        self.begun.set()
        self.go.wait(20.0)
        return object()


def fast() -> SlowObject:
    one = SlowObject()
    one.go.set()
    return one


def exit_code_of_fork(work: Callable[[], object], seconds: float) -> int | None:
    """0 where a forked child does the work, None where it hangs; the child is ended in both cases."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # from Python 3.12 on, since the process has threads
        child = os.fork()
    if not child:
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if (ended := os.waitpid(child, os.WNOHANG))[0]:
            return os.waitstatus_to_exitcode(ended[1])
        time.sleep(0.01)
    os.kill(child, 9)
    os.waitpid(child, 0)
    return None


def test_it_is_computed_once_and_keeps_its_words() -> None:
    one = fast()
    assert one.value is one.value
    assert one.calls == 1
    assert SlowObject.__dict__["value"].__doc__ == "What the test reads."


def test_threads_share_the_first_value() -> None:
    one, found = SlowObject(), list[object]()
    threads = [threading.Thread(target=lambda: found.append(one.value)) for _ in range(4)]
    for thread in threads:
        thread.start()
    one.go.set()
    for thread in threads:
        thread.join()
    assert len({id(value) for value in found}) == 1


def test_nobody_waits_for_another_instance() -> None:
    """With functools of Python 3.11 the fork hangs for ever, and so does a second thread."""
    slow = SlowObject()
    thread = threading.Thread(target=lambda: slow.value)
    thread.start()
    slow.begun.wait()
    try:
        assert exit_code_of_fork(lambda: fast().value, 5.0) == 0
        assert fast().value is not None
    finally:
        slow.go.set()
        thread.join()


def test_a_child_calibrates_that_is_forked_while_a_thread_does() -> None:
    observations, ends = simulate(corners("radial-2-3")).observations, threading.Event()

    def again() -> None:
        while not ends.is_set():
            calibrate(observations, RADIAL)

    calibrate(observations, RADIAL)
    thread = threading.Thread(target=again)
    thread.start()
    try:
        codes = []
        for number in range(5):
            time.sleep(0.01 * number)
            codes.append(exit_code_of_fork(lambda: calibrate(observations, RADIAL), 20.0))
    finally:
        ends.set()
        thread.join()
    assert codes == [0] * 5


def test_nobody_takes_the_one_that_locks() -> None:
    taken = [path for path in SOURCES if "cached_property" in path.read_text() and _is_functools(path)]
    assert taken == [PACKAGE / "base" / "frozen.py"], "take base.frozen's, which holds no lock"


def _is_functools(path: Path) -> bool:
    imports = (node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom))
    return any(
        node.module == "functools" and "cached_property" in [alias.name for alias in node.names] for node in imports
    )
