"""Work in parts: every item once, for any number of threads."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceres_cal.base.errors import InputError, noting
from ceres_cal.base.files import write_bytes
from ceres_cal.base.threads import at_most, in_turn, interruptibly, meanwhile, parts_of, run_parts


@given(
    items=st.integers(0, 2000),
    rows=st.integers(0, 10**7),
    row_ns=st.floats(1.0, 1000.0),
    threads=st.integers(1, 8),
)
def test_parts_hold_every_item_once(items: int, rows: int, row_ns: float, threads: int) -> None:
    with at_most(threads):
        parts = parts_of(items, rows, row_ns)
    assert parts[0] == 0
    assert parts[-1] == items
    assert parts == sorted(parts)
    assert 1 <= len(parts) - 1 <= threads
    assert [item for part in run_parts(lambda a, b: list(range(a, b)), parts) for item in part] == list(range(items))


def test_little_work_stays_in_one_part() -> None:
    with at_most(8):
        assert parts_of(100, 10_000, 10.0) == [0, 100]


def test_the_part_of_the_caller_is_the_largest() -> None:
    """Other threads start later; for very much work this is negligible."""
    with at_most(2):
        few, many = parts_of(1000, 10_000, 60.0), parts_of(1000, 10**7, 60.0)
    assert few[1] > 550
    assert 500 <= many[1] <= 501


def test_meanwhile_is_another_thread_and_brings_what_it_raises() -> None:
    assert meanwhile(threading.get_ident).result() != threading.get_ident()
    with pytest.raises(ZeroDivisionError):
        meanwhile(lambda: 1 // 0).result()


@given(count=st.integers(0, 30), threads=st.integers(1, 4))
def test_items_come_in_their_order(count: int, threads: int) -> None:
    with at_most(threads):
        assert list(in_turn(lambda item: item**2, range(count))) == [item**2 for item in range(count)]


def test_two_items_are_at_work_at_once_and_the_rest_ends_with_an_error() -> None:
    both, seen = threading.Barrier(2), []

    def work(item: int) -> int:
        seen.append(item)
        if item < 2:
            both.wait(10.0)  # fails if they run one after the other
        if item == 1:
            raise ValueError("the second")
        return item

    with at_most(2), pytest.raises(ValueError, match="the second"):
        list(in_turn(work, range(1000)))
    assert len(seen) < 10


def test_work_that_is_left_writes_no_more_files_and_ends_the_one_that_it_writes(tmp_path: Path) -> None:
    """A waiting caller knows the files that were written."""
    begun, ended = threading.Event(), threading.Event()

    def work() -> None:
        with suppress(InputError):
            for number in range(1000):
                write_bytes(tmp_path / str(number), bytes(1_000_000))
                begun.set()
        ended.set()

    with noting() as files, pytest.raises(TimeoutError):
        interruptibly(work, 0.2)
    assert begun.is_set() and ended.wait(10.0)
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == sorted(Path(file).name for file in files) and 0 < len(written) < 1000
