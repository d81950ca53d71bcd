"""The page and its pieces as HTML. Every text that comes in is escaped here, and only here."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from html import escape
from importlib.resources import files
from typing import Protocol
from urllib.parse import quote

from ceres_cal.base.words import grouped
from ceres_cal.report.canvas import NARROW_IN, WIDE_IN, Drawing, Hover, to_svg

_SHORT = 14  # letters that stay on one line


class Piece(Protocol):
    """A part of a chapter."""

    def html(self) -> str:
        """The element."""
        ...


@dataclass(frozen=True)
class Text:
    """A paragraph; `kind` is a class of the style sheet."""

    text: str
    kind: str = ""

    def html(self) -> str:
        return f"<p{_class(self.kind)}>{escape(self.text)}</p>"


@dataclass(frozen=True)
class BulletList:
    """A list; each line begins with a mark that its level has: "good", "care", "no" or ""."""

    lines: tuple[tuple[str, str], ...]

    def html(self) -> str:
        items = (f"<li{_class(level)}>{escape(text)}</li>" for level, text in self.lines)
        return f'<ul class="points">{"".join(items)}</ul>'


@dataclass(frozen=True)
class Table:
    """Columns under their heads; the first column names its row.

    Of more than `most` rows the first are shown, and how many there are. `stacked`: on a phone each row becomes a card.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""
    stacked: bool = False
    most: int = 200

    def html(self) -> str:
        shown = self.rows[: self.most]
        head = "".join(f'<th scope="col">{escape(name)}</th>' for name in self.head)
        body = "".join(self._row(row) for row in shown)
        caption = f"<caption>{escape(self.caption)}</caption>" if self.caption else ""
        more = len(self.rows) - len(shown)
        note = f'<p class="note">The first {len(shown)} of {grouped(len(self.rows))} rows.</p>' if more else ""
        table = f"<table{_class('stacked' if self.stacked else '')}>{caption}<thead><tr>{head}</tr></thead>"
        return f'<div class="table">{table}<tbody>{body}</tbody></table>{note}</div>'

    def _row(self, row: Sequence[str]) -> str:
        cells = (
            f'<td{_class("short" if len(text) <= _SHORT else "")} data-head="{escape(name)}">{escape(text)}</td>'
            for name, text in zip(self.head[1:], row[1:], strict=True)
        )
        return f'<tr><th scope="row">{escape(row[0])}</th>{"".join(cells)}</tr>'


@dataclass(frozen=True)
class Figure:
    """A picture with a title, a sentence that says how to read it, and the table behind it.

    A wide one is drawn twice, for a wide and for a narrow window. `hover` is what is said beside the pointer; whoever
    has none finds it in the table.
    """

    name: str
    title: str
    reading: str
    drawing: Drawing
    table: Table
    wide: bool = False
    narrow_drawing: Drawing | None = None
    hover: Hover | None = None

    def html(self) -> str:
        label = f'role="img" aria-label="{escape(self.title)}"'
        if self.hover is not None:
            label += f' data-hover="{escape(json.dumps(vars(self.hover), separators=(",", ":"), ensure_ascii=False))}"'
        narrow = to_svg(self.narrow_drawing or self.drawing, NARROW_IN, f"{self.name}-narrow")
        if self.wide:
            wide = to_svg(self.drawing, WIDE_IN, f"{self.name}-wide")
            drawn = f'<div class="on-wide" {label}>{wide}</div><div class="on-narrow" {label}>{narrow}</div>'
        else:
            drawn = f"<div {label}>{narrow}</div>"
        return (
            f'<figure id="{escape(self.name)}"{_class("wide" if self.wide else "")}><h3>{escape(self.title)}</h3>'
            f'{drawn}<div class="reading"><figcaption>{escape(self.reading)}</figcaption>'
            f"<details><summary>The numbers behind it</summary>{self.table.html()}</details></div></figure>"
        )


@dataclass(frozen=True)
class PhotoFigure:
    """A picture that is an image (JPEG), across both columns, and a sentence on what it shows."""

    name: str
    title: str
    reading: str
    jpeg: bytes
    wide: bool = True

    def html(self) -> str:
        content = b64encode(self.jpeg).decode("ascii")
        return (
            f'<figure id="{escape(self.name)}" class="wide"><h3>{escape(self.title)}</h3>'
            f'<img alt="{escape(self.title)}" src="data:image/jpeg;base64,{content}">'
            f"<figcaption>{escape(self.reading)}</figcaption></figure>"
        )


@dataclass(frozen=True)
class Gallery:
    """Pictures, two beside one another where there is room; one that is left over has its words beside it."""

    pictures: tuple[Figure | PhotoFigure, ...]

    def html(self) -> str:
        elements = [picture.html() for picture in self.pictures]
        if sum(not picture.wide for picture in self.pictures) % 2 and not self.pictures[-1].wide:
            elements[-1] = elements[-1].replace("<figure ", '<figure class="lone" ', 1)
        return f'<div class="gallery">{"".join(elements)}</div>'


@dataclass(frozen=True)
class Folded:
    """Pieces that are there when somebody asks for them."""

    title: str
    pieces: tuple[Piece, ...]

    def html(self) -> str:
        body = "".join(piece.html() for piece in self.pieces)
        return f'<details class="folded"><summary>{escape(self.title)}</summary>{body}</details>'


@dataclass(frozen=True)
class Tile:
    """One large number: what it is, the number, its unit, and what to know about it."""

    label: str
    value: str
    unit: str
    note: str
    level: str = ""

    def html(self) -> str:
        unit = f" <small>{escape(self.unit)}</small>" if self.unit else ""
        return (
            f"<div{_class('tile', self.level)}><p>{escape(self.label)}</p>"
            f'<p class="value">{escape(self.value)}{unit}</p><p class="note">{escape(self.note)}</p></div>'
        )


@dataclass(frozen=True)
class Tiles:
    """Tiles in a row."""

    tiles: tuple[Tile, ...]

    def html(self) -> str:
        return f'<div class="tiles">{"".join(tile.html() for tile in self.tiles)}</div>'


@dataclass(frozen=True)
class Card:
    """One finding: a sentence, what to do where that is known, small facts, and a file beside the page to look at."""

    level: str
    sentence: str
    advice: str
    facts: tuple[str, ...]
    link: str = ""

    def html(self) -> str:
        facts = "".join(f"<li>{escape(fact)}</li>" for fact in self.facts)
        title = f'<a href="{quote(self.link)}">{escape(self.sentence)}</a>' if self.link else escape(self.sentence)
        advice = f"<p>{escape(self.advice)}</p>" if self.advice else ""
        return f'<article{_class("card", self.level)}><h3>{title}</h3>{advice}<ul class="facts">{facts}</ul></article>'


@dataclass(frozen=True)
class Chapter:
    """A part of the page under a title; `level` colours it where it is a verdict."""

    name: str
    title: str
    pieces: tuple[Piece, ...]
    level: str = ""

    def html(self) -> str:
        body = "".join(piece.html() for piece in self.pieces)
        return f'<section id="{self.name}"{_class(self.level)}><h2>{escape(self.title)}</h2>{body}</section>'


def _class(*names: str) -> str:
    known = " ".join(name for name in names if name)
    return f' class="{known}"' if known else ""


def page(title: str, about: str, chapters: Sequence[Chapter], foot: str, kind: str = "Calibration report") -> str:
    """The whole page, which needs nothing from elsewhere, and in which no script but its own runs."""
    style, script = (
        files("ceres_cal.report").joinpath(name).read_text(encoding="utf-8") for name in ("style.css", "hover.js")
    )
    own = b64encode(sha256(script.encode()).digest()).decode("ascii")
    links = "".join(f'<a href="#{c.name}">{escape(c.title)}</a>' for c in chapters[1:])
    head, *rest = (chapter.html() for chapter in chapters)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; "
        f"script-src 'sha256-{own}'; img-src data:\">\n"
        '<meta name="color-scheme" content="light dark">\n<link rel="icon" href="data:,">\n'
        f"<title>{escape(title)}</title>\n<style>\n{style}</style>\n</head>\n<body>\n"
        f"<header><p>{escape(kind)}</p><h1>{escape(title)}</h1><p>{escape(about)}</p></header>\n<main>\n"
        f"{head}\n<nav>{links}</nav>\n{chr(10).join(rest)}\n</main>\n<footer>{escape(foot)}</footer>\n"
        f"<script>{script}</script>\n</body>\n</html>\n"
    )
