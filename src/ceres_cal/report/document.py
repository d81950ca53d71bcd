"""Documents: the answer of a command in sections, made once and rendered as text, as JSON or as a page (`report.page`).

A section presents one subject in three ways: lines for a terminal, data for scripts, and pieces of a page. So
everything about one subject is written in one place.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from itertools import chain
from textwrap import wrap
from typing import TYPE_CHECKING, Any

from ceres_cal.base.frozen import Frozen, field

if TYPE_CHECKING:
    from ceres_cal.report.canvas import Draw

WIDTH = 100
"""Width of a text for users, in letters."""
_RESULTS = ("verdict", "check", "audit", "jobs", "advice")
_NOT_MADE = "error"  # what could not be made is printed with --quiet, too


def wrapped(*texts: str) -> list[str]:
    """Wrap the texts to lines of WIDTH letters."""
    return [line for text in texts for line in wrap(text, WIDTH)]


# ---- pieces of a page -----------------------------------------------------------------------------------------------


class Text(Frozen, eq=True):
    """A paragraph; `kind` is a class of the style sheet."""

    text: str
    kind: str = ""


class BulletList(Frozen, eq=True):
    """A list; each line has a level that determines its mark: "good", "care", "no" or ""."""

    lines: tuple[tuple[str, str], ...]


class Table(Frozen, eq=True):
    """Columns with heads that state the unit; the first column names the row.

    If there are more than `most` rows, the first ones and the total number are shown. `stacked`: on a phone each row
    becomes a card. `printed`: columns that are printed in a terminal, by default all.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    stacked: bool = False
    most: int = 200
    printed: tuple[int, ...] = ()

    def lines(self) -> list[str]:
        """Return the table for a terminal, with the first column left-aligned; columns that are empty in every row are
        left out.
        """
        every = self.printed or range(len(self.head))
        printed = [n for n in every if not (n and self.rows) or any(row[n] for row in self.rows)]
        cells = [[row[n] for n in printed] for row in (self.head, *self.rows)]
        widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
        return [
            "  ".join(f"{cell:{'>' if n else '<'}{widths[n]}}" for n, cell in enumerate(row)).rstrip() for row in cells
        ]


class Figure(Frozen, eq=True):
    """A picture with a title, a sentence that explains it, and the table behind it; or an image (JPEG), across both
    columns.

    With a `wide_height` it is drawn twice, for a wide and for a narrow window; heights are over the width. `hover` is
    the text beside the pointer (`canvas.hover`); without a pointer the table has the same values.
    """

    name: str
    title: str
    reading: str
    draw: Draw | bytes
    table: Table | None = None
    height: float = 0.66
    wide_height: float | None = None
    hover: Mapping[str, Any] | None = None


class Gallery(Frozen, eq=True):
    """Pictures, two beside one another where there is room; a single remaining one has its text beside it."""

    pictures: tuple[Figure, ...]


class Details(Frozen, eq=True):
    """Pieces that are folded until the reader opens them."""

    title: str
    pieces: tuple[Piece, ...]


class Tile(Frozen, eq=True):
    """One large number: what it is, the number, its unit, and a note on it."""

    label: str
    value: str
    unit: str
    note: str
    level: str = ""


class Card(Frozen, eq=True):
    """One finding: a sentence, advice if there is any, short facts, and a file beside the page."""

    level: str
    sentence: str
    advice: str
    facts: tuple[str, ...]
    link: str = ""

    def lines(self) -> list[str]:
        """Return the card for a terminal."""
        return wrapped(self.sentence, *([f"-> {self.advice}"] if self.advice else []), f"   {'; '.join(self.facts)}")


Piece = Text | BulletList | Table | Gallery | Details | tuple[Tile, ...] | Card


class Chapter(Frozen, eq=True):
    """A part of a page under a title; `level` colours it if it is a verdict."""

    name: str
    title: str
    pieces: tuple[Piece, ...]
    level: str = ""


# ---- the document ---------------------------------------------------------------------------------------------------


class Section(Frozen, eq=True):
    """One subject of a document.

    Attributes:
        title: printed beside its lines in a terminal; without a title only the lines are printed.
        lines: for users; those of results are wrapped when they are shown.
        data: the content for scripts, with numbers at full precision. pieces: the content on a page.
    """

    title: str = ""
    lines: Iterable[str] = ()
    data: Mapping[str, Any] = field(default_factory=dict)
    pieces: tuple[Piece, ...] = ()

    def shown(self) -> Iterator[str]:
        """Yield its lines, with the title beside the first one."""
        lines = chain.from_iterable(map(wrapped, self.lines)) if self.title in _RESULTS else self.lines
        for number, line in enumerate(lines):
            yield f"{'' if number else self.title:9} {line}" if self.title else line


class Document(Frozen, eq=True):
    """The answer of a command: sections in reading order.

    Attributes:
        exit_code: 0, or 1 where the answer is no or a part of it could not be made.
        headline: the answer in one line, if it is not the first line of the result.
    """

    sections: tuple[Section, ...]
    exit_code: int = 0
    headline: str = ""

    def text(self, titles: Collection[str] | None = None) -> str:
        """Return the text for users, of the sections with one of these titles, by default of all."""
        kept = (one for one in self.sections if titles is None or one.title in titles)
        return "\n".join(line for one in kept for line in one.shown())

    @property
    def one_line(self) -> str:
        """The answer in one line, as with --quiet: the verdict, or else the first line; and what could not be made."""
        first = sorted(self.sections, key=lambda one: one.title not in _RESULTS)
        lines = (line for one in first for line in one.lines if line.strip())
        failed = (" ".join(one.shown()) for one in self.sections if one.title == _NOT_MADE and one.lines)
        return "\n".join((self.headline or next(lines, "").strip(), *failed)).strip()

    @property
    def data(self) -> dict[str, Any]:
        """The data for scripts; infinity and NaN become null in JSON."""
        joined: dict[str, Any] = {}
        for one in self.sections:
            joined = _joined(joined, one.data)
        return joined


def _joined(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    both = {name for name in first.keys() & second.keys() if isinstance(first[name], Mapping)}
    return {**first, **second, **{name: _joined(first[name], second[name]) for name in both}}
