"""One page on many jobs: what needs attention first."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from ceres_cal.base.words import DASH, counted, mm
from ceres_cal.cli.jobs import LEVELS, Outcome
from ceres_cal.report.document import Card, Chapter, Piece, Table, Text, Tile, Tiles
from ceres_cal.report.page import page

_WORDS = {"failed": "failed", "no": "not to be trusted, or moved", "care": "usable with limits", "good": "good"}
_LEVELS = {"failed": "no"}
"""What the page colours otherwise."""


def summary_page(title: str, outcomes: Sequence[Outcome], links: dict[str, str]) -> str:
    """The page.

    Args:
        links: a job's name -> file beside the page to look at.
    """
    most_cards = 40
    ranked = sorted(outcomes, key=lambda one: one.order)
    attention = [one for one in ranked if one.level != "good"]
    count = Counter(one.level for one in outcomes)
    level = _LEVELS.get(ranked[0].level, ranked[0].level)
    how = f"{counted(len(attention), 'job')} of {len(ranked)} to look at" if attention else "Nothing to look at"
    tiles = Tiles(tuple(Tile(_WORDS[name], str(count[name]), "", "", _LEVELS.get(name, name)) for name in LEVELS))
    chapters = [Chapter("verdict", f"{how}.", (tiles,), level)]
    if attention:
        cards: list[Piece] = [_card(one, links.get(one.job, "")) for one in attention[:most_cards]]
        if len(attention) > most_cards:
            cards.append(Text(f"And {len(attention) - most_cards} more, in the table."))
        chapters.append(Chapter("attention", "What needs attention, the worst first", tuple(cards)))
    rows = tuple(
        (one.job, one.command, one.level, DASH if one.worst_mm is None else mm(one.worst_mm), one.line)
        for one in ranked
    )
    table = Table(("job", "command", "level", "worst", "what it says"), rows, stacked=True, most=len(rows))
    chapters.append(Chapter("jobs", "All jobs", (table,)))
    return page(title, counted(len(ranked), "job"), chapters, "Written by ceres-cal batch.", "Batch summary")


def _card(one: Outcome, link: str) -> Card:
    facts = [one.command, one.level] + ([] if one.worst_mm is None else [f"worst {mm(one.worst_mm)}"])
    reasons = " ".join(one.reasons)
    return Card(_LEVELS.get(one.level, one.level), f"{one.job}: {one.line}", reasons, tuple(facts), link)
