"""HTML of the page and its pieces. All text is escaped here, and only here."""

from __future__ import annotations

import json
from base64 import b64encode
from collections.abc import Sequence
from functools import singledispatch
from hashlib import sha256
from html import escape
from importlib.resources import files
from string import Template
from typing import Any
from urllib.parse import quote

from ceres_cal.base.words import grouped
from ceres_cal.report import document
from ceres_cal.report.canvas import NARROW_IN, WIDE_IN, to_svg


@singledispatch
def html(piece: Any) -> str:
    """Return the element of a piece."""
    raise TypeError(f"no piece of a page: {piece!r}")


@html.register
def _(piece: document.Text) -> str:
    return f"<p{_class(piece.kind)}>{escape(piece.text)}</p>"


@html.register
def _(piece: document.BulletList) -> str:
    items = (f"<li{_class(level)}>{escape(text)}</li>" for level, text in piece.lines)
    return f'<ul class="points">{"".join(items)}</ul>'


@html.register
def _(piece: document.Table) -> str:
    short = 14  # largest number of letters that stay on one line

    def of_row(row: Sequence[str]) -> str:
        cells = (
            f'<td{_class("short" if len(text) <= short else "")} data-head="{escape(name)}">{escape(text)}</td>'
            for name, text in zip(piece.head[1:], row[1:], strict=True)
        )
        return f'<tr><th scope="row">{escape(row[0])}</th>{"".join(cells)}</tr>'

    shown = piece.rows[: piece.most]
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in piece.head)
    caption = f"<caption>{escape(piece.caption)}</caption>" if piece.caption else ""
    more = len(piece.rows) - len(shown)
    note = f'<p class="note">The first {len(shown)} of {grouped(len(piece.rows))} rows.</p>' if more else ""
    table = f"<table{_class('stacked' if piece.stacked else '')}>{caption}<thead><tr>{head}</tr></thead>"
    return f'<div class="table">{table}<tbody>{"".join(map(of_row, shown))}</tbody></table>{note}</div>'


@html.register
def _(piece: document.Figure) -> str:
    is_wide = piece.wide_height or isinstance(piece.draw, bytes)
    behind = f"<details><summary>The numbers behind it</summary>{html(piece.table)}</details>" if piece.table else ""
    reading = f"<figcaption>{escape(piece.reading)}</figcaption>{behind}"
    below = f'<div class="reading">{reading}</div>' if behind else reading
    title = f"<h3>{escape(piece.title)}</h3>"
    return (
        f'<figure id="{escape(piece.name)}"{_class("wide" if is_wide else "")}>{title}{_drawn(piece)}{below}</figure>'
    )


def _drawn(piece: document.Figure) -> str:
    if isinstance(piece.draw, bytes):
        content = b64encode(piece.draw).decode("ascii")
        return f'<img alt="{escape(piece.title)}" src="data:image/jpeg;base64,{content}">'
    label = f'role="img" aria-label="{escape(piece.title)}"'
    if piece.hover is not None:
        label += f' data-hover="{escape(json.dumps(piece.hover, separators=(",", ":"), ensure_ascii=False))}"'
    narrow = to_svg(piece.draw, piece.height, NARROW_IN, f"{piece.name}-narrow")
    if piece.wide_height is not None:
        wide = to_svg(piece.draw, piece.wide_height, WIDE_IN, f"{piece.name}-wide")
        return f'<div class="on-wide" {label}>{wide}</div><div class="on-narrow" {label}>{narrow}</div>'
    return f"<div {label}>{narrow}</div>"


@html.register
def _(piece: document.Gallery) -> str:
    elements = [html(picture) for picture in piece.pictures]
    in_a_column = [one.wide_height is None and not isinstance(one.draw, bytes) for one in piece.pictures]
    if sum(in_a_column) % 2 and in_a_column[-1]:
        elements[-1] = elements[-1].replace("<figure ", '<figure class="lone" ', 1)
    return f'<div class="gallery">{"".join(elements)}</div>'


@html.register
def _(piece: document.Details) -> str:
    body = "".join(map(html, piece.pieces))
    return f'<details class="folded"><summary>{escape(piece.title)}</summary>{body}</details>'


@html.register
def _(tiles: tuple) -> str:  # type: ignore[type-arg]
    return f'<div class="tiles">{"".join(map(html, tiles))}</div>'


@html.register
def _(piece: document.Tile) -> str:
    unit = f" <small>{escape(piece.unit)}</small>" if piece.unit else ""
    return (
        f"<div{_class('tile', piece.level)}><p>{escape(piece.label)}</p>"
        f'<p class="value">{escape(piece.value)}{unit}</p><p class="note">{escape(piece.note)}</p></div>'
    )


@html.register
def _(piece: document.Card) -> str:
    facts = "".join(f"<li>{escape(fact)}</li>" for fact in piece.facts)
    said = escape(piece.sentence)
    title = f'<a href="{quote(piece.link)}">{said}</a>' if piece.link else said
    advice = f"<p>{escape(piece.advice)}</p>" if piece.advice else ""
    return f'<article{_class("card", piece.level)}><h3>{title}</h3>{advice}<ul class="facts">{facts}</ul></article>'


@html.register
def _(piece: document.Chapter) -> str:
    body = "".join(map(html, piece.pieces))
    return f'<section id="{piece.name}"{_class(piece.level)}><h2>{escape(piece.title)}</h2>{body}</section>'


def _class(*names: str) -> str:
    known = " ".join(name for name in names if name)
    return f' class="{known}"' if known else ""


def page(
    title: str, about: str, chapters: Sequence[document.Chapter], foot: str, kind: str = "Calibration report"
) -> str:
    """Return the whole page, which is self-contained and runs no script but its own."""
    template, style, script = (
        files("ceres_cal.report").joinpath(name).read_text(encoding="utf-8")
        for name in ("page.html", "style.css", "hover.js")
    )
    head, *rest = map(html, chapters)
    return Template(template).substitute(
        kind=escape(kind),
        title=escape(title),
        about=escape(about),
        foot=escape(foot),
        style=style,
        script=script,
        script_digest=b64encode(sha256(script.encode()).digest()).decode("ascii"),
        links="".join(f'<a href="#{one.name}">{escape(one.title)}</a>' for one in chapters[1:]),
        head=head,
        rest="\n".join(rest),
    )
