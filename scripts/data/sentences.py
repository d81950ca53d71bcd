"""All sentences of the source that a user may see, in one table: python scripts/run.py sentences [WORD ...]

One line each: file and line, kind (error, help, answer, words), and the text, with {names} for inserted values. With
words: only texts that contain one of them. `rules` returns what is wrong with a text (tests/test_sentences.py).
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

SOURCE = Path(__file__).resolve().parents[2] / "src" / "ceres_cal"
MOST_WORDS = 35
_FEWEST_WORDS = 3
_HELP = {"option", "switch", "argument", "command", "output_option", "calibration_argument", "height_option"}
_HELP |= {"station_option", "jobs_option", "not_painted_option", "prior_option"}
_PIECES = {"Section", "Text", "Figure", "Tile", "Card", "Chapter", "Table", "Folded", "BulletList"}
_BANNED = (
    *("go together", "goes with", "go with", "came to rest", "come to rest", "comes to rest", "stands off", "in doubt"),
    *(
        "with care",
        "from nothing",
        "a test each",
        "is not told",
        "are told",
        "hardly tell",
        "hardly told",
        "to be told",
    ),
    *("cannot be told", "cannot tell", "px aside", "mm aside", "lies aside", "nobody observed", "brought back"),
)
"""Our own idioms that readers do not know; plain English must be used instead."""
_UNITS = (
    *(
        "px",
        "mm",
        "m",
        "m²",
        "deg",
        "degrees",
        "°",
        "%",
        "s",
        "ms",
        "MB",
        "kB",
        "px^",
        "rad",
        "times",
        "sigma",
        "sigmas",
    ),
    *("Hz", "standard", "iterations", "of", "x", "to", "GB", "over", "at", "seconds", "km"),
)
_NUMBER = re.compile(r"\{[^{}]*:[+ ]?\.\d[fg]\}")


class Sentence(NamedTuple):
    """One text: file and line, kind, and the text itself."""

    where: str
    kind: str
    text: str


def sentences() -> list[Sentence]:
    """All texts, by file."""
    return [one for path in sorted(SOURCE.rglob("*.py")) for one in _of_file(path)]


def _of_file(path: Path) -> Iterator[Sentence]:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    docstrings = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    }
    yield from (
        Sentence(f"{path.relative_to(SOURCE)}:{line}", kind, text)
        for line, kind, text in _texts(tree, "words")
        if len(text.split()) >= _FEWEST_WORDS and line not in docstrings and _is_prose(text)
    )


def _texts(node: ast.AST, kind: str) -> Iterator[tuple[int, str, str]]:
    """Line, kind and text of every string below a node, except docstrings."""
    if isinstance(node, ast.Constant | ast.JoinedStr):
        if not isinstance(node, ast.Constant) or isinstance(node.value, str):
            yield node.lineno, kind, _text(node)
        parts = node.values if isinstance(node, ast.JoinedStr) else []
        for part in parts:
            if isinstance(part, ast.FormattedValue):
                yield from _texts(part.value, kind)
        return
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return
    if isinstance(node, ast.Call):
        name = node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        kind = "error" if name.endswith("Error") else "help" if name in _HELP else "answer" if name in _PIECES else kind
    for child in ast.iter_child_nodes(node):
        yield from _texts(child, kind)


def _text(node: ast.Constant | ast.JoinedStr) -> str:
    if isinstance(node, ast.Constant):
        return str(node.value)
    return "".join(
        str(part.value) if isinstance(part, ast.Constant) else _placeholder(part)
        for part in node.values
        if isinstance(part, ast.Constant | ast.FormattedValue)
    )


def _placeholder(part: ast.FormattedValue) -> str:
    names = [one.attr if isinstance(one, ast.Attribute) else one.id for one in ast.walk(part.value)
             if isinstance(one, ast.Attribute | ast.Name)]  # fmt: skip
    form = "" if part.format_spec is None else ":" + ast.unparse(part.format_spec).strip("f'\"")
    return f"{{{names[0] if names else 'x'}{form}}}"


def _is_prose(text: str) -> bool:
    """Whether the text is a sentence or a part of one, not a pattern, a style or a command."""
    words = re.findall(r"[a-z]{2,}", text)
    return len(words) >= _FEWEST_WORDS and not re.search(r"[\\^]|\(\?|</|\(\)|://|;base64", text)


# ---- rules ----------------------------------------------------------------------------------------------------------


def rules(text: str) -> list[str]:
    """Rules of plain English that a text breaks."""
    wrong = [f"banned: {idiom}" for idiom in _BANNED if re.search(rf"\b{re.escape(idiom)}\b", text)]
    for part in re.split(r"[.!?;](?:\s|$)|: (?=[a-z])", text):
        if (count := len(part.split())) > MOST_WORDS:
            wrong.append(f"{count} words in a sentence")
    for found in _NUMBER.finditer(text):
        rest = re.match(r"[\s,)}\]]*([\w°%^²]+)?", text[found.end() :])
        after = rest[1] if rest else None
        if after in ("px", "mm", "m", "deg") and found[0].endswith("g}"):
            wrong.append(f"large ones come out as 2e+02, use two_digits: {found[0]} {after}")
        if after is not None and after not in _UNITS and not after.startswith("px"):
            wrong.append(f"no unit after {found[0]}: {after}")
    return wrong


def main(arguments: Sequence[str]) -> int:
    asked = [word.lower() for word in arguments]
    for one in sentences():
        if not asked or any(word in one.text.lower() for word in asked):
            print(f"{one.where:42} {one.kind:7} {one.text!r}")
    return 0
