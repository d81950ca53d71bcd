"""Which parameters of a test run each time, and which only with `scripts/test --thorough`."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import TypeVar

import pytest

_T = TypeVar("_T")


def partly(values: Iterable[_T], always: Collection[_T]) -> list[object]:
    """Each value is one argument; those that are not in `always` take minutes together and test more of the same."""
    return [pytest.param(one, marks=() if one in always else pytest.mark.thorough) for one in values]
