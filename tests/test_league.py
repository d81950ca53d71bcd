"""The league's set-ups: an answer, or one line that refuses. `scripts/league.py` has all of them."""

from __future__ import annotations

from itertools import combinations

import pytest
from league import SET_UPS, SetUp, outcome, pairwise


def test_each_two_values_come_together() -> None:
    every, chosen = (
        {pair for one in some for pair in combinations(enumerate(one), 2)} for some in (SET_UPS, pairwise())
    )
    assert chosen == every and len(SET_UPS) == 180


@pytest.mark.parametrize("set_up", pairwise(), ids=str)
def test_an_answer_or_one_honest_line(set_up: SetUp) -> None:
    """No traceback, no warning of NumPy, at most 5 s; nothing "known" over 5 sd off, nor wider than it was stated."""
    assert outcome(set_up, 0).fault == ""
