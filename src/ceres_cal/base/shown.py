"""Representations of objects: a few lines in a shell, a table in a notebook, a picture in the user's Axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from typing import Any

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import grouped

_MOST_LINES, _MOST_LETTERS = 9, 70  # lines of a text; letters of a value in it
_PICTURES = "ceres_cal.report"  # a higher layer: imported only when something is drawn

Shown = tuple[str, Sequence[tuple[str, ...]]]
"""A line that says what an object is, and rows on its content."""


def brief(instance: Any) -> str:
    """Return the `__repr__` of an object with large parts: its class, and a line for each of its first fields."""
    names = [name for name in instance.__dataclass_fields__ if name[0] != "_"]
    lines = [f"  {name}={_short(getattr(instance, name))}" for name in names[: _MOST_LINES - 1]]
    return "\n".join([f"{type(instance).__name__}(", *lines]) + ")"


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"<array {' x '.join(map(str, value.shape))}>"
    if isinstance(value, tuple | list | Mapping) and len(value) > 3:
        return f"<{grouped(len(value))} entries>"
    text = repr(value)
    return text if len(text) <= _MOST_LETTERS and "\n" not in text else f"<{type(value).__name__}>"


def text_of(shown: Shown) -> str:
    """Format as text of at most ten lines."""
    title, rows = shown
    most = len(rows) if len(rows) < _MOST_LINES else _MOST_LINES - 1
    widths = [max(map(len, column)) for column in zip(*rows[:most], strict=True)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows[:most]]
    more = [f"  and {grouped(len(rows) - most)} more"] if len(rows) > most else []
    return "\n".join([title, *(f"  {line}" for line in lines), *more])


def html_of(shown: Shown) -> str:
    """Format as a table for a notebook, with the first column as row headers."""
    from html import escape

    title, lines = escape(shown[0]), [[escape(cell) for cell in row] for row in shown[1]]
    cells = [(first, "".join(f"<td>{cell}</td>" for cell in rest)) for first, *rest in lines]
    rows = "".join(f'<tr><th scope="row">{first}</th>{rest}</tr>' for first, rest in cells)
    return f"<table><caption>{title}</caption>{rows}</table>"


def drawn(picture: str, thing: Any, ax: Any, **how: Any) -> Any:
    """Draw a picture of the report, "module.function", into the given Axes, or into pyplot's current ones; return the
    Axes.

    Raises:
        InputError: Matplotlib is not installed, or ax is something else.
    """
    if ax is None:
        try:
            from matplotlib import pyplot
        except ImportError:
            raise InputError("plot() needs Matplotlib: pip install matplotlib") from None
        ax = pyplot.gca()
    if not hasattr(ax, "contourf"):
        raise InputError(f"ax must be Matplotlib's Axes, not {type(ax).__name__}")
    module, _, name = picture.partition(".")
    getattr(import_module(f"{_PICTURES}.{module}"), name)(thing, ax, **how)
    return ax
