"""A document as text, as JSON and as a page."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceres_cal.cli.terminal import print_answer
from ceres_cal.report.document import (
    BulletList,
    Card,
    Chapter,
    Details,
    Document,
    Section,
    Table,
    Text,
    Tile,
    wrapped,
)
from ceres_cal.report.page import html

TABLE = Table(("lens", "px", ""), (("radial 2,3", "0.3549", "chosen"), ("brown", "0.36", "")), "Lenses")


def test_titles_stand_beside_the_first_line() -> None:
    sections = (
        Section("fit", ["points", "curves"]),
        Section("empty"),
        Section("", ["alone"]),
        Section("vision-processor", ["long"]),
    )
    text = Document(sections).text()
    assert text == "fit       points\n          curves\nalone\nvision-processor long"
    assert Document(sections).text(["fit"]) == "fit       points\n          curves"


def test_data_of_all_sections_are_joined() -> None:
    sections = (
        Section("a", data={"holds": True, "stations": {"left": {"mm": 1.0}}}),
        Section("b", ["said"], {"stations": {"right": {"mm": 2.0}}, "warnings": []}),
    )
    joined = {"holds": True, "stations": {"left": {"mm": 1.0}, "right": {"mm": 2.0}}, "warnings": []}
    assert Document(sections).data == joined and sections[0].data["stations"] == {"left": {"mm": 1.0}}


_LEAVES = st.dictionaries(st.sampled_from("abc"), st.integers(), max_size=3)


@given(st.lists(st.dictionaries(st.sampled_from("xyz"), _LEAVES, max_size=3), max_size=4))
def test_nothing_of_the_data_is_lost(parts: list[dict[str, dict[str, int]]]) -> None:
    joined = Document(tuple(Section(data=part) for part in parts)).data
    assert {(x, y) for part in parts for x, inside in part.items() for y in inside} == {
        (x, y) for x, inside in joined.items() for y in inside
    }


def test_json_has_null_for_what_is_no_number(capsys: pytest.CaptureFixture[str]) -> None:
    document = Document((Section("", ["x"], {"sd": float("inf"), "mean": float("nan"), "words": "ü"}),))
    print_answer(document, as_json=True)
    said: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert said["sd"] is None and said["mean"] is None and said["words"] == "ü"


def test_a_table_in_columns() -> None:
    assert TABLE.lines() == ["lens            px", "radial 2,3  0.3549  chosen", "brown         0.36"]
    assert Table(("only",), ()).lines() == ["only"]


@given(st.lists(st.tuples(st.text("ab ", max_size=5), st.text("12.", max_size=6)), max_size=5))
def test_columns_are_as_wide_as_their_widest(rows: list[tuple[str, str]]) -> None:
    lines = Table(("name", "px"), tuple(rows)).lines()
    width = max(len("name"), *(len(name) for name, _ in rows)) if rows else len("name")
    ends = {len(line) for line, (_, cell) in zip(lines[1:], rows, strict=True) if cell}
    assert len(lines) == len(rows) + 1 and len(ends) <= 1
    assert all(
        line[: width + 2].rstrip() == name.rstrip() for line, (name, cell) in zip(lines[1:], rows, strict=True) if cell
    )


def test_every_piece_of_a_page_is_escaped() -> None:
    evil = "<b>&"
    pieces = (
        Text(evil),
        BulletList((("good", evil),)),
        Table((evil, evil), ((evil, evil),), evil),
        (Tile(evil, evil, evil, evil),),
        Card("no", evil, evil, (evil,), "a b.html"),
        Details(evil, (Text(evil),)),
    )
    said = html(Chapter("numbers", evil, pieces, "care"))
    assert "<b>" not in said and said.count("&lt;b&gt;&amp;") == 18 and 'href="a%20b.html"' in said
    with pytest.raises(TypeError, match="no piece of a page"):
        html(evil)


def test_long_texts_are_wrapped() -> None:
    assert [len(line) for line in wrapped("word " * 25)] == [99, 24]
