"""No error is swallowed silently: each handler after which work continues states what the user then reads."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

SOURCES = Path(__file__).parents[1] / "src" / "ceres_cal"
SAID = re.compile(r'# (reads: "[^"]{3,}"|quiet: .{10,})')
MOST = 45  # the present number; a new one must replace another
WORDS = re.compile(r"\bexcept\b|suppress\(|attempt\(|or_none")
GOES_ON = (ast.Return, ast.Continue, ast.Break)


@cache
def nodes(text: str) -> tuple[ast.AST, ...]:
    """All of a module that has any of them."""
    return tuple(ast.walk(ast.parse(text))) if WORDS.search(text) else ()


def handlers(text: str) -> Iterator[ast.ExceptHandler | ast.With]:
    """Handlers after which work may continue, and each `with suppress(...)`."""
    for node in nodes(text):
        if isinstance(node, ast.ExceptHandler):
            inside = [part for statement in node.body for part in ast.walk(statement)]
            if not isinstance(node.body[-1], ast.Raise) or any(isinstance(part, GOES_ON) for part in inside):
                yield node
        elif isinstance(node, ast.With) and any("suppress(" in ast.unparse(item.context_expr) for item in node.items):
            yield node


def comments_of(lines: list[str], node: ast.ExceptHandler | ast.With) -> str:
    """Comments on its line, on the line above, or before its first statement."""
    return "\n".join(lines[node.lineno - 2 : node.body[0].lineno])


def attempts(text: str) -> Iterator[ast.Call | ast.Name]:
    """Calls of `attempt`, and functions that are `or_none`: one handler each serves all of them."""
    for node in nodes(text):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "attempt":
            yield node
        elif isinstance(node, ast.FunctionDef):
            yield from (one for one in node.decorator_list if isinstance(one, ast.Name) and one.id == "or_none")


# kernels/ is left out: its cache is replaced as a whole.
FOUND = [
    (path, path.read_text(encoding="utf-8"))
    for path in sorted(SOURCES.rglob("*.py"))
    if path.relative_to(SOURCES).parts[0] != "kernels"
]


def test_every_handler_says_what_the_user_reads() -> None:
    silent = [
        f"{path.relative_to(SOURCES)}:{node.lineno}"
        for path, text in FOUND
        for node in handlers(text)
        if not SAID.search(comments_of(text.splitlines(), node))
    ]
    assert not silent, f'{silent}: add # reads: "the sentence", or # quiet: why nobody needs to be told'


def test_every_attempt_says_what_the_user_reads() -> None:
    silent = [
        f"{path.relative_to(SOURCES)}:{node.lineno}"
        for path, text in FOUND
        if path.name != "errors.py"
        for node in attempts(text)
        if not SAID.search("\n".join(text.splitlines()[max(node.lineno - 2, 0) : (node.end_lineno or node.lineno) + 1]))
    ]
    assert not silent, f'{silent}: add # reads: "the sentence", or # quiet: why nobody needs to be told'


def test_there_are_no_more_of_them() -> None:
    assert sum(1 for _, text in FOUND for _ in handlers(text)) <= MOST


def test_a_silent_handler_is_found() -> None:
    text = "try:\n    f()\nexcept E:\n    pass\ntry:\n    f()\nexcept E:\n    if a:\n        return 1\n    raise\n"
    assert len(list(handlers(text + "try:\n    f()\nexcept E as error:\n    raise F from error\n"))) == 2
    assert not SAID.search(comments_of(text.splitlines(), next(handlers(text))))
