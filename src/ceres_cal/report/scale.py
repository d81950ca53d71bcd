"""Colour scales, the same in every report: blue is good, amber is usable with limits, brown is not to be used.

Lightness decreases monotonically, so that the order is visible in grey print and to colour-blind readers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from msgspec import Struct

from ceres_cal.base import Array, short
from ceres_cal.report.grounds import CARE_MM, GOOD_MM

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLORS = ("#eef5fa", "#d9e8f3", "#bfd8ea", "#a3c6e0", "#86b2d4", "#6a9dc7", "#4f88b8", "#a05c08", "#7e3f06", "#5e1c0a")
_ON_LIGHT, _ON_DARK = "#26303a", "#eef5fb"
"""Colours of what is drawn on top, in a dark window, too."""
_UNKNOWN = "#fcede4"


class Scale(Struct, frozen=True):
    """Limits between the colours of `COLORS`, in a unit."""

    borders: tuple[float, ...]
    unit: str

    def fill(self, axes: Axes, x: Array, y: Array, values: Array) -> None:
        """Draw values (Y, X) over a grid: NaN is left open, infinity is hatched."""
        endless = 1e300
        unknown = np.isinf(values)
        if unknown.any():
            axes.contourf(x, y, unknown.astype(float), [0.5, 1.5], colors=[_UNKNOWN], hatches=["////"])
        known = np.where(unknown, np.nan, values)
        if np.isfinite(known).any():
            axes.contourf(x, y, known, [0.0, *self.borders, endless], colors=COLORS)

    def ink(self, values: Array | float) -> str:
        """Return the colour of what is drawn on top of these values."""
        dark = 7  # index of the first dark colour
        known = np.ravel(values)[np.isfinite(np.ravel(values))]
        return _ON_DARK if len(known) and np.median(known) > self.borders[dark - 1] else _ON_LIGHT

    def bar(self, axes: Axes, label: str) -> None:
        """Draw the whole scale beneath the axes, independent of the picture's values."""
        from matplotlib.cm import ScalarMappable
        from matplotlib.colors import BoundaryNorm, ListedColormap

        figure = axes.get_figure()
        assert figure is not None
        steps = range(len(COLORS) + 1)
        every = ScalarMappable(BoundaryNorm(list(steps), len(COLORS)), ListedColormap(list(COLORS)))
        bar = figure.colorbar(
            every, ax=axes, orientation="horizontal", ticks=steps[1:-1], aspect=45, shrink=0.9, pad=0.02,
            drawedges=True,
        )  # fmt: skip
        bar.ax.set_xticklabels([f"{border:g}" for border in self.borders])
        bar.set_label(label)
        bar.ax.tick_params(length=0)
        bar.outline.set_visible(False)
        bar.dividers.set(color="#ffffff", linewidth=0.7)


MM = Scale((0.1, 0.2, 0.5, 1.0, 2.0, 5.0, GOOD_MM, 20.0, CARE_MM), "mm")
PX = Scale((0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0), "px")
"""Scale for lenses, to which no verdict applies: amber is more than the error of a detected corner or line."""


def spoken(values: Sequence[float] | Array) -> tuple[str, ...]:
    """Format each value with two digits; "" for NaN, "unknown" for infinity."""
    return tuple("" if np.isnan(value) else short(float(value)) for value in np.ravel(values))
