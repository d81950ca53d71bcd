"""Maps over the drawn field: the standard deviation of a located point, in mm."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.report import canvas
from ceres_cal.report.canvas import INK, OUTLIER, QUIET, RAMP, Drawing
from ceres_cal.report.material import Material
from ceres_cal.report.page import Picture, Table
from ceres_cal.report.words import metres, mm, short
from ceres_cal.uncertainty import FieldMap

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_SERIES = (
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
    (1.0, 1.2, 1.5, 1.8, 2.2, 2.7, 3.3, 3.9, 4.7, 5.6, 6.8, 8.2),
)
"""Rounder steps first; the finer ones where the others would leave too few colours."""
_FEWEST_STEPS = 6
_TABLE_COLUMNS, _TABLE_ROWS = 7, 6


def levels_of(maps: tuple[FieldMap, ...]) -> Array:
    """Steps of colour, mm: round numbers around everything that the maps show, at least three."""
    values = np.concatenate([m.sd_mm[np.isfinite(m.sd_mm)] for m in maps])
    if not len(values):
        return np.array([1.0, 2.0, 5.0])
    low, high = max(float(values.min()), 1e-6), max(float(values.max()), 1e-6)
    decades = range(int(np.floor(np.log10(low))), int(np.floor(np.log10(high))) + 2)
    for series in _SERIES:
        steps = np.array([s * 10.0**d for d in decades for s in series])
        first = max(int(np.searchsorted(steps, low, side="right")) - 1, 0)
        found = steps[first : max(int(np.searchsorted(steps, high)), first + 2) + 1]
        if len(found) > _FEWEST_STEPS:
            break
    return found


def map_picture(material: Material, station: str, number: int) -> Picture:
    """One map of one station; the colours are the same on both of its heights."""
    maps = material.maps[station]
    found, drawn = maps[number], material.drawn_maps[station][number]
    levels = levels_of((*maps, *material.drawn_maps[station]))
    where = "On the floor" if found.height_m == 0.0 else f"At {1e3 * found.height_m:.0f} mm, robot height"
    border = material.border(station, found.height_m)
    paint = [line[:, :2] for line in material.paint()]
    camera = material.calibration.estimate.camera_at(station).position

    def draw(axes: Axes, width_in: float) -> None:
        _fill(axes, drawn, levels)
        for line in paint:
            axes.plot(*line.T, color="white", linewidth=1.8, alpha=0.8)
            axes.plot(*line.T, color=QUIET, linewidth=0.6)
        axes.plot(*border.T, color=QUIET, linewidth=0.8, dashes=(3, 2))
        axes.plot(*camera[:2], "^", color=INK, markersize=4, markeredgecolor="white", markeredgewidth=0.6)
        if np.isfinite(found.worst_mm):
            axes.plot(*found.worst_place_m, "o", markersize=5, markerfacecolor="none", markeredgecolor=OUTLIER)
        margin = 0.03 * (found.x_m[-1] - found.x_m[0])
        axes.set(xlim=(found.x_m[0] - margin, found.x_m[-1] + margin), aspect="equal", xlabel="x, m", ylabel="y, m")
        axes.set(ylim=(found.y_m[0] - margin, found.y_m[-1] + margin))
        axes.grid(visible=False)

    height = float(np.ptp(found.y_m) / np.ptp(found.x_m))
    return Picture(
        f"map-{list(material.maps).index(station)}-{number}",
        where + (f", {station}" if len(material.maps) > 1 else ""),
        f"{_said(found)}. Dashed: the border of the image, white beyond it. Triangle: the camera.",
        Drawing(draw, min(max(height * 0.9 + 0.2, 0.4), 1.4)),
        _grid_table(found),
    )


def _said(found: FieldMap) -> str:
    if np.isnan(found.worst_mm):
        return "The image shows no place of the field"
    if np.isinf(found.worst_mm):
        return "Hatched: the observations cannot tell how far off a located point is"
    worst = f"{mm(found.worst_mm)} at worst (ring, {metres(found.worst_place_m)})"
    return f"Darker is worse: {mm(found.mean_mm)} in the mean, {worst}"


def _fill(axes: Axes, found: FieldMap, levels: Array) -> None:
    from matplotlib.colors import BoundaryNorm

    colors = canvas.ramp(RAMP)
    norm = BoundaryNorm(levels, colors.N)
    x, y = found.x_m, found.y_m
    unknown = np.isinf(found.sd_mm)
    if unknown.any():
        axes.contourf(x, y, unknown.astype(float), [0.5, 1.5], colors=["#fcede4"], hatches=["////"])
    shown = np.where(unknown, np.nan, found.sd_mm)
    if np.isfinite(shown).any():
        axes.contourf(x, y, shown, levels, cmap=colors, norm=norm)
        axes.contour(x, y, shown, levels[1:-1], colors="white", linewidths=0.5)
    _bar(axes, colors, norm, levels)


def _bar(axes: Axes, colors: object, norm: object, levels: Array) -> None:
    """The scale of colours, beneath."""
    from matplotlib.cm import ScalarMappable

    figure = axes.get_figure()
    assert figure is not None
    scale = ScalarMappable(norm, colors)  # type: ignore[arg-type]
    bar = figure.colorbar(
        scale, ax=axes, orientation="horizontal", ticks=levels, aspect=45, shrink=0.9, pad=0.02, spacing="uniform"
    )
    bar.ax.set_xticklabels([short(level) for level in levels.tolist()])
    bar.set_label("standard deviation of a located point, mm")
    bar.ax.tick_params(length=0)
    bar.outline.set_visible(False)


def _grid_table(found: FieldMap) -> Table:
    """The map at a few places."""
    columns = np.unique(np.linspace(0, len(found.x_m) - 1, _TABLE_COLUMNS).round().astype(int))
    rows = np.unique(np.linspace(0, len(found.y_m) - 1, _TABLE_ROWS).round().astype(int))[::-1]
    return Table(
        ("mm at y \\ x", *(f"{found.x_m[c]:.1f} m" for c in columns)),
        tuple((f"{found.y_m[r]:.1f} m", *(_cell(float(found.sd_mm[r, c])) for c in columns)) for r in rows),
    )


def _cell(sd_mm: float) -> str:
    return "∞" if np.isinf(sd_mm) else short(sd_mm)
