"""What is said of a result: a document of sections, made once, rendered as text, as JSON or as a page (`report.page`).

A section holds one subject in the three ways in which it is shown: lines for a terminal, data for scripts, and pieces
of a page. So what is said of one thing stands in one place.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import chain
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from ceres_cal.base.frozen import Frozen, field

if TYPE_CHECKING:
    from ceres_cal.report.canvas import Draw, Hover

WIDTH = 100
"""Of a text for people, in letters."""
_RESULTS = ("verdict", "check", "audit", "jobs", "advice")
_NOT_MADE = "error"  # what could not be made is said with --quiet as well


def wrapped(*texts: str) -> list[str]:
    """The texts in lines of WIDTH letters."""
    return [line for text in texts for line in wrap(text, WIDTH)]


# ---- pieces of a page -----------------------------------------------------------------------------------------------


class Text(Frozen, eq=True):
    """A paragraph; `kind` is a class of the style sheet."""

    text: str
    kind: str = ""


class BulletList(Frozen, eq=True):
    """A list; each line begins with a mark that its level has: "good", "care", "no" or ""."""

    lines: tuple[tuple[str, str], ...]


class Table(Frozen, eq=True):
    """Columns under their heads, which say the unit; the first column names its row.

    Of more than `most` rows the first are shown, and how many there are. `stacked`: on a phone each row becomes a card.
    `printed`: the columns that a terminal has room for, by default all.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    stacked: bool = False
    most: int = 200
    printed: tuple[int, ...] = ()

    def lines(self) -> list[str]:
        """The same for a terminal, the first column to the left; columns in which no row says anything are left out."""
        every = self.printed or range(len(self.head))
        printed = [n for n in every if not (n and self.rows) or any(row[n] for row in self.rows)]
        cells = [[row[n] for n in printed] for row in (self.head, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        return [
            "  ".join(f"{cell:{'>' if n else '<'}{widths[n]}}" for n, cell in enumerate(row)).rstrip() for row in cells
        ]


class Figure(Frozen, eq=True):
    """A picture with a title, a sentence that says how to read it, and the table behind it; or an image (JPEG), across
    both columns.

    One that has a `wide_height` is drawn twice, for a wide and for a narrow window; heights are over the width. `hover`
    is what is said beside the pointer; whoever has none finds it in the table.
    """

    name: str
    title: str
    reading: str
    draw: Draw | bytes
    table: Table | None = None
    height: float = 0.66
    wide_height: float | None = None
    hover: Hover | None = None


class Gallery(Frozen, eq=True):
    """Pictures, two beside one another where there is room; one that is left over has its words beside it."""

    pictures: tuple[Figure, ...]


class Details(Frozen, eq=True):
    """Pieces that are there when somebody asks for them."""

    title: str
    pieces: tuple[Piece, ...]


class Tile(Frozen, eq=True):
    """One large number: what it is, the number, its unit, and what to know about it."""

    label: str
    value: str
    unit: str
    note: str
    level: str = ""


class Card(Frozen, eq=True):
    """One finding: a sentence, what to do where that is known, small facts, and a file beside the page to look at."""

    level: str
    sentence: str
    advice: str
    facts: tuple[str, ...]
    link: str = ""

    def lines(self) -> list[str]:
        """The same for a terminal."""
        return wrapped(self.sentence, *([f"-> {self.advice}"] if self.advice else []), f"   {'; '.join(self.facts)}")


Piece = Text | BulletList | Table | Gallery | Details | tuple[Tile, ...] | Card


class Chapter(Frozen, eq=True):
    """A part of a page under a title; `level` colours it where it is a verdict."""

    name: str
    title: str
    pieces: tuple[Piece, ...]
    level: str = ""


# ---- the document ---------------------------------------------------------------------------------------------------


class Section(Frozen, eq=True):
    """One subject.

    Attributes:
        title: what stands beside its lines in a terminal; without it they stand alone.
        lines: for people, those of a result whole. data: the same for scripts, numbers at full precision; pieces: the
            same on a page.
    """

    title: str = ""
    lines: Iterable[str] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    pieces: tuple[Piece, ...] = ()

    def shown(self) -> Iterator[str]:
        """Its lines, the title beside the first."""
        lines = chain.from_iterable(map(wrapped, self.lines)) if self.title in _RESULTS else self.lines
        for number, line in enumerate(lines):
            yield f"{'' if number else self.title:9} {line}" if self.title else line


class Document(Frozen, eq=True):
    """What a command answers: sections in the order in which they are read.

    Attributes:
        exit_code: 0, or 1 where the answer is no or a part of it could not be made.
        headline: the answer in a line, where it is not the first of its result's.
    """

    sections: tuple[Section, ...]
    exit_code: int = 0
    headline: str = ""

    def text(self, titles: Collection[str] | None = None) -> str:
        """For people; of the sections with one of these titles, by default of all."""
        kept = (one for one in self.sections if titles is None or one.title in titles)
        return "\n".join(line for one in kept for line in one.shown())

    @property
    def one_line(self) -> str:
        """The answer in one line, as with --quiet: the verdict, or what is said first; and what could not be made."""
        first = sorted(self.sections, key=lambda one: one.title not in _RESULTS)
        lines = (line for one in first for line in one.lines if line.strip())
        failed = (" ".join(one.shown()) for one in self.sections if one.title == _NOT_MADE and one.lines)
        return "\n".join((self.headline or next(lines, "").strip(), *failed)).strip()

    @property
    def data(self) -> dict[str, Any]:
        """For scripts: what infinite or not a number is, becomes null in JSON."""
        joined: dict[str, Any] = {}
        for one in self.sections:
            joined = _joined(joined, one.data)
        return joined


def _joined(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    both = {name for name in first.keys() & second.keys() if isinstance(first[name], Mapping)}
    return {**first, **second, **{name: _joined(first[name], second[name]) for name in both}}
