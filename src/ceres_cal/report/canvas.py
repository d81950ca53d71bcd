"""SVG pictures in one style: the frame of each, and the letters, lines and dots that they share.

A picture is drawn for the width at which it is shown, so that its letters have the size of the page's. Many similar
parts are drawn as one path (`dots`, `strokes`): thousands of them take a few bytes each and stay sharp in print.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ceres_cal.base import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# Okabe and Ito's colours, which colour-blind readers can distinguish, too
POINT, CURVE, OUTLIER = "#0072b2", "#009e73", "#d55e00"
INK, QUIET, PAINT, FAINT = "#1f2933", "#5b6770", "#b3bcc4", "#e8ecef"
DIVERGING = ("#a84a00", "#c47039", "#dc9a6d", "#f0cbb0", "#fdfdfd", "#c0dbee", "#8bbadb", "#4a8ebb", "#004f80")
_THEMED = {
    **dict(zip((INK, QUIET, PAINT, FAINT, "#ffffff"), ("ink", "quiet", "paint", "grid", "page"), strict=True)),
    **dict(zip((POINT, CURVE, OUTLIER), ("point", "curve", "outlier"), strict=True)),
    **{color: f"diverging-{number}" for number, color in enumerate(DIVERGING)},
}
"""Colours that the page replaces in a dark window, and their names in its style sheet."""

NARROW_IN, WIDE_IN = 3.65, 7.5
"""Widths of a picture in one column, which is what a phone shows, and of one across both, inches."""
_TICKS = {
    "color": PAINT,
    "labelcolor": QUIET,
    "labelsize": 7.0,
    "major.size": 2.5,
    "major.width": 0.7,
    "minor.size": 0.0,
}
_STYLE: dict[str, Any] = {
    "svg.fonttype": "none",  # text remains text, in the page's font, and can be searched and read aloud
    "text.parse_math": False,  # names come from files
    "path.simplify": False,
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.labelsize": 7.5,
    "axes.labelcolor": QUIET,
    "axes.edgecolor": PAINT,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.7,
    "text.color": INK,
    **{f"{axis}tick.{name}": value for axis in "xy" for name, value in _TICKS.items()},
    "legend.frameon": False,
    "legend.fontsize": 7.0,
    "legend.handlelength": 1.4,
    "lines.linewidth": 1.3,
    "hatch.linewidth": 0.6,
}


Draw = Callable[["Axes", float], None]
"""Draws into one pair of axes, for a picture of a width in inches."""


def hover(x: Array, y: Array, values: Iterable[str], text: str, *names: Sequence[str]) -> dict[str, Any]:
    """Text beside the pointer, for the nearest of evenly spaced places over the axes, as the page's script reads it.

    Args:
        x (X,), y (Y,): the places, in units of the axes.
        values: text of the value at each place, row by row; "" where nothing is shown.
        text: template with {x}, {y} and {value}. names: of columns and of rows, shown instead of their numbers.
    """
    across, down = ((float(axis[0]), float(axis[-1]), len(axis)) for axis in (x, y))
    return {"x": across, "y": down, "values": tuple(values), "text": text, "names": names or ((), ())}


def to_svg(draw: Draw, height: float, width_in: float, name: str, *, whole_file: bool = False) -> str:
    """Return an <svg> element for a page, or the text of a file of its own.

    Args:
        height: height over width of the whole picture.
        name: unique on the page; it prefixes the ids in the element.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    style: Any = {**_STYLE, "svg.hashsalt": name}
    with rc_context(style):
        figure = Figure(figsize=(width_in, width_in * height), layout="constrained")
        engine = figure.get_layout_engine()
        assert engine is not None
        engine.set(w_pad=0.03, h_pad=0.03)  # type: ignore[call-arg]
        axes = figure.add_subplot()
        draw(axes, width_in)
        stream = io.StringIO()
        write: Any = FigureCanvasSVG(figure).print_svg
        write(stream, metadata={"Date": None, "Creator": None})
        where = _place_of(axes)
    text = stream.getvalue()
    element = text[text.index("<svg") :]
    return element if whole_file else _for_page(element).replace("<svg", f'<svg data-axes="{where}"', 1)


def _place_of(axes: Axes) -> str:
    """Left, top, right and bottom of the axes as shares of the picture, and the values of the axes there."""
    box, (left, right), (bottom, top) = axes.get_position(), axes.get_xlim(), axes.get_ylim()
    return " ".join(f"{v:.6g}" for v in (box.x0, 1.0 - box.y1, box.x1, 1.0 - box.y0, left, top, right, bottom))


def _for_page(text: str) -> str:
    """Return a file's <svg> without what a page does not need, in the page's colours."""
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    text = re.sub(r' (?:width|height)="[\d.]+pt"', "", text)  # the page sets the width
    named = set(re.findall(r'(?:href="|url\()#([^")]+)', text))
    text = re.sub(r' id="([^"]+)"', lambda match: match[0] if match[1] in named else "", text)
    text = re.sub(r' xmlns(?::xlink)?="[^"]*"| version="1.1"', "", text)  # implied in HTML
    text = re.sub(r' d="[^"]+"', lambda match: re.sub(r"(?<=\.\d\d)\d+", "", match[0]), text)  # a hundredth of a point
    themed = "|".join(_THEMED)
    text = re.sub(rf"(?:{themed})\b", lambda match: f"var(--{_THEMED[match[0]]},{match[0]})", text)
    text = text.replace("xlink:href", "href")
    return re.sub(r"\n\s*", "\n", text).strip()


# ---- many things in one path ----------------------------------------------------------------------------------------


def strokes(axes: Axes, starts: Array, ends: Array, color: str, width: float, **how: Any) -> None:
    """Draw lines from starts (N, 2) to ends (N, 2); long ones are not clipped at the border of the axes."""
    path = np.full((len(starts), 3, 2), np.nan)
    path[:, 0], path[:, 1] = starts, ends
    axes.plot(*path.reshape(-1, 2).T, color=color, linewidth=width, solid_capstyle="round", **how)


def dots(axes: Axes, places: Array, color: str, size: float, **how: Any) -> None:
    """Draw round dots of `size` points at places (N, 2), as strokes without length."""
    strokes(axes, places, places, color, size, **how)


def crosses(axes: Axes, places: Array, color: str, size: float, **how: Any) -> None:
    """Draw crosses of `size` units of the axes at places (N, 2)."""
    for slope in (1.0, -1.0):
        reach = 0.5 * size * np.array([1.0, slope])
        strokes(axes, places - reach, places + reach, color, 0.9, **how)


def key(axes: Axes, columns: int = 4) -> None:
    """Draw the legend above the axes."""
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, borderaxespad=0.2, columnspacing=1.2)


def plain(value: float, _: float) -> str:
    """Format a tick of a logarithmic axis: 0.01, 1, 100, 1e+07."""
    return f"{value:g}"


def clipped(text: str, most: int) -> str:
    """Shorten a label to so many letters at most."""
    return text if len(text) <= most else f"{text[: most - 1]}…"
