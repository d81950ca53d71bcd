"""Pictures of targets: drawings with names, and sheets to print at true size, PDF with a ruler to check the printer."""

from __future__ import annotations

import io
from collections.abc import Iterator
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base import Array, InputError
from ceres_cal.report import canvas
from ceres_cal.report.canvas import CURVE, INK, PAINT, POINT, WIDE_IN
from ceres_cal.scene import Arc, Curve, Target, crossings, curve_points
from ceres_cal.scene.targets.target import Paper

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch

_PIECES = 60
_STYLE = {
    "margin": 0.04,  # margin, as a share of the target's size
    "away": 0.006,  # distance of a name from its feature, as a share of the width
    "short": 15.0,  # least length of a curve that is named, in units of that distance
    "letters": 4.2,  # font size in points
}


def target_svg(target: Target, name: str) -> str:
    """Return an SVG file of a target seen from above, x to the right, in metres; unnamed crossings are dots.

    Raises:
        InputError: the target has no curves, and so nothing to draw.
    """
    if not target.curves:
        raise InputError(f"{name}: a target without lines is drawn by `ceres-cal targets print`")
    low, high = target.box
    margin = _STYLE["margin"] * float(np.max(high - low))
    width, height = high - low + 2.0 * margin

    def draw(axes: Axes, width_in: float) -> None:
        away = _STYLE["away"] * float(width)
        _draw_curves(axes, target, away)
        _draw_points(axes, target, away)
        axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))
        axes.set(aspect="equal", xlabel="x, m", ylabel="y, m", title=name)

    return canvas.to_svg(draw, float(height / width) + 0.08, WIDE_IN, f"target-{name}", whole_file=True)


def _draw_curves(axes: Axes, target: Target, away: float) -> None:
    for name, curve in target.curves.items():
        pieces = _PIECES if isinstance(curve, Arc) else 1
        border = np.concatenate([curve_points(curve, 1, pieces), curve_points(curve, -1, pieces)[::-1]])[:, :2]
        axes.fill(*np.round(border, 4).T, facecolor=PAINT, edgecolor=PAINT, linewidth=0.6)
        if curve.length_m < _STYLE["short"] * away:
            continue
        x, y, turn = _beside(curve, away)
        axes.text(
            x, y, name, color=CURVE, fontsize=_STYLE["letters"], rotation=turn, ha="center", va="center", alpha=0.9
        )


def _beside(curve: Curve, away: float) -> Array:
    """x and y of a place beside a curve's middle, and the angle of text there in degrees."""
    before, there, after = curve_points(curve, 1, _PIECES)[[_PIECES // 3 - 1, _PIECES // 3, _PIECES // 3 + 1], :2]
    along = (after - before) / np.linalg.norm(after - before)
    turn = (np.degrees(np.arctan2(along[1], along[0])) + 90.0) % 180.0 - 90.0
    return np.array([*(there + 1.5 * away * np.array([-along[1], along[0]])), turn])


def _draw_points(axes: Axes, target: Target, away: float) -> None:
    canvas.dots(axes, target.point_array[:, :2], POINT, 2.4)
    unnamed = crossings(target.curves).keys()
    for name, (x, y, _) in target.points.items():
        if name not in unnamed:
            axes.text(x + away, y + away, name, color=INK, fontsize=_STYLE["letters"])


# ---- on paper -------------------------------------------------------------------------------------------------------


_MARGIN_M, _FOOT_M = 0.008, 0.022


def sheet_pdf(target: Target, title: str) -> bytes:
    """Return the sheet as a PDF page of its own size: the target, a ruler below it, and a title.

    Raises:
        InputError: the target is not printed on paper, or is too large for one page.
    """
    if target.paper is None:
        raise InputError(f"a target of kind {target.kind!r} is not printed on paper: print a board, circles or rings")
    file = io.BytesIO()
    _page(target.paper, title).savefig(file, format="pdf", metadata={"CreationDate": None})
    return file.getvalue()


def _page(paper: Paper, title: str) -> Figure:
    inch_m = 0.0254
    most_m = 14400 / 72.0 * inch_m  # largest page, a limit of PDF
    from matplotlib.figure import Figure

    low, high = np.array(paper.low_m), np.array(paper.high_m)
    width, height = high - low
    page = np.array([width + 2.0 * _MARGIN_M, height + 2.0 * _MARGIN_M + _FOOT_M])
    if page.max() > most_m:
        raise InputError(f"a sheet of {width:.2f} x {height:.2f} m is too large for one page, at most {most_m:.2f} m")
    figure = Figure(figsize=tuple(page / inch_m))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, page[0]), ylim=(0.0, page[1]))  # in metres from the bottom left
    axes.set_axis_off()
    for patch in _patches(paper):
        axes.add_patch(patch)
    _draw_ruler(axes, page[0], title)
    return figure


def _patches(paper: Paper) -> Iterator[PathPatch]:
    """Yield consecutive shapes of one colour as one path, x to the right and y down, as the target's axes are seen from
    the front.
    """
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    left, top = _MARGIN_M - paper.low_m[0], _FOOT_M + _MARGIN_M + paper.high_m[1]
    for is_dark, shapes in groupby(paper.shapes(), lambda shape: shape.is_dark):
        paths = []
        for shape in shapes:
            (x, y), size = shape.place_m, shape.size_m
            path = Path.unit_circle() if shape.is_round else Path.unit_rectangle()
            paths.append(Path(np.asarray(path.vertices) * (size, -size) + (left + x, top - y), path.codes))
        yield PathPatch(Path.make_compound_path(*paths), facecolor="black" if is_dark else "white", linewidth=0.0)


def _draw_ruler(axes: Axes, width_m: float, title: str) -> None:
    """Draw a ruler of as many centimetres as fit, at most ten, and how to use it."""
    count = int(min(10, (width_m - 2.0 * _MARGIN_M) / 0.01))
    left, base = _MARGIN_M, _FOOT_M - 0.006
    axes.plot([left, left + 0.01 * count], [base, base], color="black", linewidth=0.5)
    for tick in range(10 * count + 1):
        long = 0.004 if tick % 10 == 0 else 0.003 if tick % 5 == 0 else 0.002
        axes.plot([left + 0.001 * tick] * 2, [base, base + long], color="black", linewidth=0.3)
    words = f"{10 * count} mm: print at 100 %, measure this ruler, and scale the sizes in the file by what it shows"
    axes.text(left, base - 0.001, words, fontsize=6, va="top")
    axes.text(left, base - 0.006, title, fontsize=6, va="top")
