"""Our own threads and those of NumPy's linear algebra must not stand in each other's way."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import numpy as np  # noqa: F401 its BLAS is what the controller looks for
from threadpoolctl import ThreadpoolController


@cache
def _controller() -> ThreadpoolController:
    return ThreadpoolController()


@contextmanager
def single_threaded_blas() -> Iterator[None]:
    """While it lasts BLAS works in the calling thread alone, in the whole process.

    Our matrices are small: OpenBLAS's other threads bring nothing, but spin for milliseconds after each call, on the
    cores that the parts of a sweep need (design, section 6: threads only where they pay).
    """
    with _controller().limit(limits=1, user_api="blas"):
        yield
