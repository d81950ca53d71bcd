"""Maps over the drawn field, in mm: the standard deviation of a located point, or where two calibrations differ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.words import metres, mm, sentence, short
from ceres_cal.calibration import Calibration
from ceres_cal.moves import StationComparison
from ceres_cal.report import canvas
from ceres_cal.report.canvas import INK, OUTLIER, QUIET, RAMP, Drawing
from ceres_cal.report.material import Material, image_border, paint_of
from ceres_cal.report.page import Figure, Table
from ceres_cal.scene.heights import at_height
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


@dataclass(frozen=True, eq=False)
class MapDrawing:
    """What is drawn of a map.

    Attributes:
        x_m (X,), y_m (Y,), values (Y, X): mm, NaN where nothing is shown, infinite where nothing can be said.
        levels: (L,) steps of colour, mm. label: of the scale of colours.
        paint: (S, 2) m each, what lies in the world. border: (B, 2) m, of the image. camera: (3,) m.
        worst_m: the place that is ringed, where there is one.
    """

    x_m: Array
    y_m: Array
    values: Array
    levels: Array
    label: str
    paint: Sequence[Array]
    border: Array
    camera: Array
    worst_m: tuple[float, float] | None = None

    def draw(self, axes: Axes, width_in: float) -> None:
        """The map with the field's lines, the border of the image, and the camera on top."""
        self._fill(axes)
        for line in self.paint:
            axes.plot(*line.T, color="white", linewidth=1.8, alpha=0.8)
            axes.plot(*line.T, color=QUIET, linewidth=0.6)
        axes.plot(*self.border.T, color=QUIET, linewidth=0.8, dashes=(3, 2))
        axes.plot(*self.camera[:2], "^", color=INK, markersize=4, markeredgecolor="white", markeredgewidth=0.6)
        if self.worst_m is not None:
            axes.plot(*self.worst_m, "o", markersize=5, markerfacecolor="none", markeredgecolor=OUTLIER)
        margin = 0.03 * (self.x_m[-1] - self.x_m[0])
        axes.set(xlim=(self.x_m[0] - margin, self.x_m[-1] + margin), aspect="equal", xlabel="x, m", ylabel="y, m")
        axes.set(ylim=(self.y_m[0] - margin, self.y_m[-1] + margin))
        axes.grid(visible=False)

    @property
    def drawing(self) -> Drawing:
        """As high as the field and the scale beneath it need."""
        shape = float(np.ptp(self.y_m) / np.ptp(self.x_m))
        return Drawing(self.draw, min(max(shape * 0.9 + 0.2, 0.4), 1.4))

    def _fill(self, axes: Axes) -> None:
        from matplotlib.colors import BoundaryNorm

        colors = canvas.ramp(RAMP)
        norm = BoundaryNorm(self.levels, colors.N)
        unknown = np.isinf(self.values)
        if unknown.any():
            unsure = unknown.astype(float)
            axes.contourf(self.x_m, self.y_m, unsure, [0.5, 1.5], colors=["#fcede4"], hatches=["////"])
        known = np.where(unknown, np.nan, self.values)
        if np.isfinite(known).any():
            axes.contourf(self.x_m, self.y_m, known, self.levels, cmap=colors, norm=norm)
            axes.contour(self.x_m, self.y_m, known, self.levels[1:-1], colors="white", linewidths=0.5)
        self._bar(axes, colors, norm)

    def _bar(self, axes: Axes, colors: object, norm: object) -> None:
        from matplotlib.cm import ScalarMappable

        figure = axes.get_figure()
        assert figure is not None
        scale = ScalarMappable(norm, colors)  # type: ignore[arg-type]
        bar = figure.colorbar(
            scale, ax=axes, orientation="horizontal", ticks=self.levels, aspect=45, shrink=0.9, pad=0.02,
            spacing="uniform",
        )  # fmt: skip
        bar.ax.set_xticklabels([short(level) for level in self.levels.tolist()])
        bar.set_label(self.label)
        bar.ax.tick_params(length=0)
        bar.outline.set_visible(False)


def levels_of(*maps: Array) -> Array:
    """Steps of colour, mm: round numbers around everything that the maps (Y, X) show, at least three."""
    values = np.concatenate([one[np.isfinite(one)] for one in maps])
    if not len(values):
        return np.array([1.0, 2.0, 5.0])
    low, high = max(float(values.min()), 1e-6), max(float(values.max()), 1e-6)
    decades = range(int(np.floor(np.log10(low))), int(np.floor(np.log10(high))) + 2)
    for series in _SERIES:
        steps = np.array([s * 10.0**d for d in decades for s in series])
        first = max(int(np.searchsorted(steps, low, side="right")) - 1, 0)
        levels = steps[first : max(int(np.searchsorted(steps, high)), first + 2) + 1]
        if len(levels) > _FEWEST_STEPS:
            break
    return levels


# ---- the standard deviation of a located point ----------------------------------------------------------------------


def map_figure(material: Material, station: str, number: int) -> Figure:
    """One map of one station; the colours are the same on both of its heights."""
    maps = material.maps[station]
    one, drawn = maps[number], material.drawn_maps[station][number]
    map_drawing = MapDrawing(
        drawn.x_m,
        drawn.y_m,
        drawn.sd_mm,
        levels_of(*(each.sd_mm for each in (*maps, *material.drawn_maps[station]))),
        "standard deviation of a located point, mm",
        [line[:, :2] for line in paint_of(material.fields)],
        image_border(material.calibration.stations[station], one.height_m),
        material.calibration.stations[station].position,
        one.worst_place_m if np.isfinite(one.worst_mm) else None,
    )
    where = sentence(at_height(one.height_m)) + ("" if one.height_m == 0.0 else ", robot height")
    return Figure(
        f"map-{list(material.maps).index(station)}-{number}",
        where + (f", {station}" if len(material.maps) > 1 else ""),
        f"{_reading(one)}. Dashed: the border of the image, white beyond it. Triangle: the camera.",
        map_drawing.drawing,
        _grid_table(one),
    )


def _reading(one: FieldMap) -> str:
    if np.isnan(one.worst_mm):
        return "The image shows no place of the field"
    if np.isinf(one.worst_mm):
        return "Hatched: the observations cannot tell how far off a located point is"
    worst = f"{mm(one.worst_mm)} at worst (ring, {metres(one.worst_place_m)})"
    return f"Darker is worse: {mm(one.mean_mm)} in the mean, {worst}"


def _grid_table(one: FieldMap) -> Table:
    columns, rows = evenly(len(one.x_m), _TABLE_COLUMNS), evenly(len(one.y_m), _TABLE_ROWS)[::-1]
    return Table(
        ("mm at y \\ x", *(f"{one.x_m[c]:.1f} m" for c in columns)),
        tuple(
            (f"{one.y_m[r]:.1f} m", *("∞" if np.isinf(sd) else short(sd) for sd in one.sd_mm[r, columns].tolist()))
            for r in rows
        ),
    )


def evenly(count: int, most: int) -> list[int]:
    """At most so many of `count` numbers from 0 on, that lie evenly, both ends among them."""
    return [int(number) for number in np.unique(np.linspace(0, count - 1, most).round())]


# ---- where two calibrations differ ----------------------------------------------------------------------------------


def comparison_svg(comparison: StationComparison, before: Calibration) -> str:
    """The map of one station's differences as a file of its own, over the field as the first calibration sees it."""
    camera = before.stations[comparison.station]
    fields = [target for target in before.targets.values() if not target.movable]
    where = at_height(comparison.height_m)
    map_drawing = MapDrawing(
        comparison.x_m,
        comparison.y_m,
        comparison.errors_mm,
        levels_of(comparison.errors_mm),
        f"{comparison.station}, {where}: difference, mm ({comparison.mean_mm:.2f} on average)",
        [line[:, :2] for line in paint_of(fields)],
        image_border(camera, comparison.height_m),
        camera.position,
    )
    return canvas.to_svg(map_drawing.drawing, canvas.WIDE_IN, "comparison", whole_file=True)
