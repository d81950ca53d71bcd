"""A target as drawn: its curves at their true widths, with their names, and its points."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.report import canvas
from ceres_cal.report.canvas import CURVE, INK, PAINT, POINT, WIDE_IN, Drawing
from ceres_cal.scene.curves import Arc, Curve, crossings, curve_points
from ceres_cal.scene.targets import Target

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PIECES = 60
_STYLE = {
    "margin": 0.04,  # of the target's size
    "away": 0.006,  # of its width: names from what they name
    "short": 15.0,  # of that distance: a curve whose name would be longer than it
    "letters": 4.2,  # points
}


def target_svg(target: Target, name: str) -> str:
    """A file (.svg) of a target seen from above, x to the right, in metres; points that only crossings name are dots.

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

    return canvas.to_svg(Drawing(draw, float(height / width) + 0.08), WIDE_IN, f"target-{name}", whole_file=True)


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
    """x and y of a place beside a curve's middle, and degrees by which letters there are turned."""
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
