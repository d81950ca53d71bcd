"""The league's set-ups: a calibration, or a refusal of one line. `scripts/run.py league` has all of them."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from accuracy.league import SET_UPS, SetUp, outcome, pairwise
from thorough import partly


def test_each_two_values_come_together() -> None:
    every, chosen = (
        {pair for one in some for pair in combinations(enumerate(one), 2)} for some in (SET_UPS, pairwise())
    )
    assert chosen == every and len(SET_UPS) == 180


SOME = [*pairwise()[1::2], pairwise()[6]]
"""Every value occurs in one of them; the script runs the others."""


def test_each_value_is_tried() -> None:
    assert [set(values) for values in zip(*SOME, strict=True)] == [set(values) for values in zip(*SET_UPS, strict=True)]


@pytest.mark.parametrize(
    "set_up", partly(SOME, [one for one in SOME if one.cameras < 4 and (one.lens != "brown" or one.boards)]), ids=str
)
def test_an_answer_or_one_honest_line(set_up: SetUp) -> None:
    """No traceback, no warning of NumPy, no "known" number with an error over 5 sd or wider than it was stated. The
    limit of five seconds is tested by the script, since tests share their processors.
    """
    assert outcome(set_up, 0, most_seconds=np.inf).fault == ""
