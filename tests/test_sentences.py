"""Every sentence for users obeys the simple rules of plain English."""

from functools import cache

import pytest
from data.sentences import MOST_WORDS, rules, sentences

every = cache(sentences)


def test_all_kinds_are_read() -> None:
    kinds = {one.kind for one in every()}
    assert kinds == {"error", "help", "answer", "words"} and len(every()) > 1200  # 1700 measured
    texts = {one.text for one in every()}
    assert "The solve converged." in texts and any(text.startswith("--corner says where to start") for text in texts)


@pytest.mark.parametrize(
    "text, wrong",
    [
        ("errors go together along lines", "banned: go together"),
        ("moved by {x:.1f} since then", "no unit after {x:.1f}: since"),
        ("off by {x:.2g} mm", "large ones come out as 2e+02, use two_digits: {x:.2g} mm"),
        ("word " * (MOST_WORDS + 1), f"{MOST_WORDS + 1} words in a sentence"),
    ],
)
def test_what_breaks_a_rule_is_found(text: str, wrong: str) -> None:
    assert rules(text) == [wrong]


def test_every_sentence_keeps_the_rules() -> None:
    broken = [f"{one.where}: {wrong}: {one.text!r:.80}" for one in every() for wrong in rules(one.text)]
    assert not broken, "\n".join(broken)
