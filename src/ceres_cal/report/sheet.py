"""A target to print: its paper at its true size as a PDF, with a ruler to check the printer by."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Image8
from ceres_cal.base.errors import InputError
from ceres_cal.scene.targets import Target
from ceres_cal.scene.targets.paper import Footprints, Paper

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_INCH_M = 0.0254
_PER_INCH = 400
_MOST_PX = 4e8
_BAND = 64  # rows at a time
_MARGIN_M, _FOOT_M = 0.008, 0.022


def sheet_pdf(target: Target, title: str) -> bytes:
    """The sheet as a PDF page of its own size: the target, below it a ruler and what it is.

    Raises:
        InputError: the target is not printed on paper, or is too large for one page.
    """
    if target.paper is None:
        raise InputError(f"a target of kind {target.kind!r} is not printed on paper: print a board, circles or rings")
    file = io.BytesIO()
    _page(target.paper, title).savefig(file, format="pdf", dpi=_PER_INCH, metadata={"CreationDate": None})
    return file.getvalue()


def _page(paper: Paper, title: str) -> Figure:
    from matplotlib.figure import Figure

    low, high = np.array(paper.low_m), np.array(paper.high_m)
    width, height = high - low
    page = np.array([width + 2.0 * _MARGIN_M, height + 2.0 * _MARGIN_M + _FOOT_M])
    figure = Figure(figsize=tuple(page / _INCH_M))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, page[0]), ylim=(0.0, page[1]))  # metres from the bottom left
    axes.set_axis_off()
    extent = (_MARGIN_M, _MARGIN_M + width, _FOOT_M + _MARGIN_M, _FOOT_M + _MARGIN_M + height)
    axes.imshow(_levels(paper), cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="none", aspect="auto")
    _draw_ruler(axes, page[0], title)
    return figure


def _levels(paper: Paper) -> Image8:
    """The paper in grey levels, x to the right and y down, as the target's own axes are seen from the front."""
    step = _INCH_M / _PER_INCH
    low, high = np.array(paper.low_m), np.array(paper.high_m)
    columns, rows = np.rint((high - low) / step).astype(int)
    if columns * rows > _MOST_PX:
        raise InputError(f"a sheet of {high[0] - low[0]:.2f} x {high[1] - low[1]:.2f} m is too large for one page")
    steps = (high - low) / (columns, rows)
    x = low[0] + (np.arange(columns) + 0.5) * steps[0]
    levels = np.empty((rows, columns), np.uint8)
    for first in range(0, rows, _BAND):
        y = low[1] + (np.arange(first, min(first + _BAND, rows)) + 0.5) * steps[1]
        plane = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        along = [np.tile(direction, (len(plane), 1)) for direction in np.diag(steps)]
        dark = paper.dark(Footprints(plane, along[0], along[1]))
        levels[first : first + len(y)] = np.rint(255.0 * (1.0 - dark)).reshape(len(y), columns)
    return levels


def _draw_ruler(axes: Axes, width_m: float, title: str) -> None:
    """A ruler of as many centimetres as fit, at most ten, and what to do with it."""
    count = int(min(10, (width_m - 2.0 * _MARGIN_M) / 0.01))
    left, base = _MARGIN_M, _FOOT_M - 0.006
    axes.plot([left, left + 0.01 * count], [base, base], color="black", linewidth=0.5)
    for tick in range(10 * count + 1):
        long = 0.004 if tick % 10 == 0 else 0.003 if tick % 5 == 0 else 0.002
        axes.plot([left + 0.001 * tick] * 2, [base, base + long], color="black", linewidth=0.3)
    words = f"{10 * count} mm: print at 100 %, measure this ruler, and scale the sizes in the file by what it shows"
    axes.text(left, base - 0.001, words, fontsize=6, va="top")
    axes.text(left, base - 0.006, title, fontsize=6, va="top")
