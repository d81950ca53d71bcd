"""Maps over the field and over the image: the accuracy of located points, or the difference of two calibrations."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base import Array, at_height, evenly, grid_places, largest, mm, sentence, short
from ceres_cal.calibration import Calibration
from ceres_cal.posterior.maps import FieldMap, ImageMap, image_grid
from ceres_cal.report import canvas
from ceres_cal.report.canvas import INK, OUTLIER, QUIET, Draw
from ceres_cal.report.document import Figure, Table
from ceres_cal.report.quality import Material, image_border, paint_of
from ceres_cal.report.residual_pictures import counts_of_parts, number_of, owner_suffix
from ceres_cal.report.scale import COLORS, MM, PX, Scale, spoken
from ceres_cal.scene import Camera, Target, still

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ceres_cal.moves.agreement import Agreement

_SERIES = (
    (1.0, 2.0, 5.0),
    (1.0, 1.5, 2.0, 3.0, 5.0, 7.0),
    (1.0, 1.2, 1.5, 1.8, 2.2, 2.7, 3.3, 3.9, 4.7, 5.6, 6.8, 8.2),
)
"""Steps of contour levels: the rounder series first; finer ones where the others would leave too few lines."""
_TABLE_SIZE = 7, 6
_DOT, _DOT_ALPHA = 1.1, 0.45
LABEL = "95 % within, mm"


def field_drawing(
    grid: tuple[Array, Array],
    values: Array,
    label: str,
    camera: Camera,
    height_m: float,
    fields: Iterable[Target],
    worst_m: tuple[float, float] | None = None,
    observed: Array | None = None,
) -> tuple[Draw, float]:
    """Return a map over the field, with the field's lines, the border of the image and the camera on top, and its
    height.

    Args:
        grid: x (X,) and y (Y,) m. values: (Y, X) mm, NaN where nothing is shown, infinite where the value is unknown.
        label: of the colour scale. camera: posed over the fields. height_m: of the map.
        worst_m: place that is marked by a ring, if any. observed: (N, 2) m, places of observations.
    """
    x_m, y_m = grid

    def draw(axes: Axes, width_in: float) -> None:
        fill(axes, MM, grid, values)
        for line in paint_of(fields):
            axes.plot(*line[:, :2].T, color="white", linewidth=1.8, alpha=0.8)
            axes.plot(*line[:, :2].T, color=QUIET, linewidth=0.6)
        if observed is not None:
            canvas.dots(axes, observed, MM.ink(values), _DOT, alpha=_DOT_ALPHA)
        axes.plot(*image_border(camera, height_m).T, color=QUIET, linewidth=0.8, dashes=(3, 2))
        axes.plot(*camera.position[:2], "^", color=INK, markersize=4, markeredgecolor="white", markeredgewidth=0.6)
        if worst_m is not None:
            axes.plot(*worst_m, "o", markersize=5, markerfacecolor="none", markeredgecolor=OUTLIER)
        margin = 0.03 * (x_m[-1] - x_m[0])
        axes.set(xlim=(x_m[0] - margin, x_m[-1] + margin), aspect="equal", xlabel="x, m", ylabel="y, m")
        axes.set(ylim=(y_m[0] - margin, y_m[-1] + margin))
        axes.grid(visible=False)
        MM.bar(axes, label)

    return draw, min(max(float(np.ptp(y_m) / np.ptp(x_m)) * 0.9 + 0.2, 0.4), 1.4)


def fill(axes: Axes, scale: Scale, grid: tuple[Array, Array], values: Array) -> None:
    """Draw the colours of a map (Y, X) over x and y, and labelled contour lines."""
    most_lines = 4
    scale.fill(axes, *grid, values)
    known = np.where(np.isinf(values), np.nan, values)
    if np.isfinite(known).any():
        levels = levels_of(known)
        few = levels[1 :: -(-len(levels) // most_lines)]
        lines = axes.contour(*grid, known, few, colors=[scale.ink(level) for level in few], linewidths=0.4)
        for text in axes.clabel(lines, fmt=short, fontsize=6.5, colors=scale.ink(0.0)):
            text.set_bbox({"facecolor": COLORS[0], "edgecolor": "none", "pad": 0.6, "alpha": 0.75})


def levels_of(*maps: Array) -> Array:
    """Contour levels: round numbers that cover all values of the maps (Y, X), at least three."""
    fewest_steps = 6
    values = np.concatenate([one[np.isfinite(one)] for one in maps])
    if not len(values):
        return np.array([1.0, 2.0, 5.0])
    low, high = max(float(values.min()), 1e-6), max(float(values.max()), 1e-6)
    decades = range(int(np.floor(np.log10(low))), int(np.floor(np.log10(high))) + 2)
    for series in _SERIES:
        steps = np.array([s * 10.0**d for d in decades for s in series])
        first = max(int(np.searchsorted(steps, low, side="right")) - 1, 0)
        levels = steps[first : max(int(np.searchsorted(steps, high)), first + 2) + 1]
        if len(levels) > fewest_steps:
            break
    return levels


def plot_map(one: FieldMap | ImageMap, axes: Axes) -> None:
    """Draw 95 % radii over the field, m, or over the image, px, into the user's own axes."""
    if isinstance(one, FieldMap):
        fill(axes, MM, (one.x_m, one.y_m), one.radius_95_mm)
        axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
        MM.bar(axes, LABEL)
    else:
        fill(axes, PX, (one.x_px, one.y_px), one.radius_95_px)
        axes.set(ylim=(one.y_px[-1], one.y_px[0]), aspect="equal", xlabel="px", ylabel="px")
        PX.bar(axes, "95 % within, px")


# ---- how far off a located point may be -----------------------------------------------------------------------------


def map_figure(material: Material, station: str, number: int) -> Figure:
    """Make the map of one station over the field, at one of its heights."""
    one, drawn = material.maps[station][number], material.drawn_maps[station][number]
    posed = material.calibration.stations[station]
    draw, height = field_drawing(
        (drawn.x_m, drawn.y_m),
        drawn.radius_95_mm,
        LABEL,
        posed,
        one.height_m,
        material.fields,
        one.place_of_largest(one.radius_95_mm) if np.isfinite(largest(one.radius_95_mm)) else None,
        _within(posed.locate(material.observed(station)), one) if one.height_m == 0.0 else None,
    )
    where = sentence(at_height(one.height_m)) + ("" if one.height_m == 0.0 else ", robot height")
    return Figure(
        f"map-{list(material.maps).index(station)}-{number}",
        where + _named(material, station),
        f"{_reading(one)}. Dashed: the border of the image, open beyond it. Triangle: the camera."
        + (" Dots: observations." if one.height_m == 0.0 else ""),
        draw,
        grid_table(f"{LABEL}, at y \\ x", one.radius_95_mm[::-1], one.x_m, one.y_m[::-1], "{:.1f} m"),
        height,
        hover=canvas.hover(one.x_m, one.y_m, spoken(one.radius_95_mm), "x {x} m, y {y} m: 95 % within {value} mm"),
    )


def _named(material: Material, station: str) -> str:
    return f", {station}" if len(material.maps) > 1 else ""


def _within(places: Array, one: FieldMap) -> Array:
    """Return the places that the map shows."""
    low, high = (one.x_m[0], one.y_m[0]), (one.x_m[-1], one.y_m[-1])
    with np.errstate(invalid="ignore"):
        return np.asarray(places[np.all((places >= low) & (places <= high), axis=1)])


def _reading(one: FieldMap) -> str:
    radius = largest(one.radius_95_mm)
    if np.isnan(radius):
        return "The image shows no place of the field"
    if np.isinf(radius):
        return "Hatched: the observations do not determine how far off a located point is"
    return f"Darker is worse: 95 % of the points located at the worst place (ring) are within {mm(radius)}"


def grid_table(
    head: str,
    values: Array,
    x: Array,
    y: Array,
    place: str,
    most: tuple[int, int] = _TABLE_SIZE,
    shown: Callable[[float], str] = short,
) -> Table:
    """Table of some values (Y, X) of a map, the first row at the top.

    Args:
        place: format of a place on the axes. most: columns and rows. shown: format of a value.
    """
    columns, rows = (evenly(len(axis), number).tolist() for axis, number in zip((x, y), most, strict=True))
    cells = [["∞" if np.isinf(value) else shown(value) for value in values[r, columns].tolist()] for r in rows]
    names = (place.format(y[r]) for r in rows)
    return Table(
        (head, *(place.format(x[c]) for c in columns)),
        tuple((name, *row) for name, row in zip(names, cells, strict=True)),
    )


# ---- over the image -------------------------------------------------------------------------------------------------


def _over_image(
    name: tuple[str, str, str],
    image_size: tuple[int, int],
    grid: tuple[Array, Array],
    radii: Array,
    observed: Array,
    scale: Scale,
) -> Figure:
    """Figure of radii (Y, X) at x (X,), y (Y,) px over one image, with observations (N, 2) px on top and how much of
    the image they cover; `name`: of the figure, its title, and what it shows.
    """
    (width, height), unit = image_size, scale.unit
    counts, _ = counts_of_parts(observed, image_size)

    def draw(axes: Axes, width_in: float) -> None:
        fill(axes, scale, grid, radii)
        canvas.dots(axes, observed, scale.ink(radii), _DOT, alpha=_DOT_ALPHA)
        axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal", xlabel="px")
        axes.grid(visible=False)
        scale.bar(axes, f"95 % within, {unit}")

    return Figure(
        *name[:2],
        f"{name[2]} Dots: observations, in {np.count_nonzero(counts)} of {counts.size} parts of the image. Where there "
        "are none, the lens model is extrapolated.",
        draw,
        grid_table(f"95 % within, {unit}, at y \\ x", radii, *grid, "{:.0f} px"),
        0.92 * height / width + 0.2,
        hover=canvas.hover(*grid, spoken(radii), f"pixel {{x}}, {{y}}: 95 % within {{value}} {unit}"),
    )


def image_figure(material: Material, station: str) -> Figure:
    """Make the map of one station on the floor, over its image instead of the field."""
    posed = material.calibration.stations[station]
    x, y = image_grid(posed.image_size)
    pixels = grid_places(x, y)
    radii = np.full(len(pixels), np.nan)
    shown = np.isfinite(posed.locate(pixels)).all(axis=1)
    assert material.uncertainty is not None
    radii[shown] = 1e3 * material.uncertainty.located(pixels[shown], 0.0, station).radius_95_m
    name = (
        f"image-{list(material.maps).index(station)}",
        f"On the floor, over the image{_named(material, station)}",
        "The same accuracy, drawn where the camera sees each place.",
    )
    return _over_image(name, posed.image_size, (x, y), radii.reshape(len(y), len(x)), material.observed(station), MM)


def lens_image_figure(material: Material, name: str) -> Figure:
    """Make the map of the accuracy in its own image, px, of a camera that has no place over a field."""
    assert material.uncertainty is not None
    known = material.uncertainty.map_px(name)
    stations = [s for s, owner in material.observations.stations.items() if owner == name]
    observed = np.concatenate([material.observed(station) for station in stations])
    called = (
        f"image-{number_of(material, name)}",
        f"Over the image{owner_suffix(material, name)}",
        "How far off the pixel of a direction may be, with the camera turned to its best pose. Darker is worse.",
    )
    size = material.calibration.cameras[name].image_size
    return _over_image(called, size, (known.x_px, known.y_px), known.radius_95_px, observed, PX)


# ---- where two calibrations differ ----------------------------------------------------------------------------------


def comparison_svg(comparison: Agreement, before: Calibration) -> str:
    """Return the map of one station's differences as an SVG file, over the field as the first calibration sees it."""
    assert comparison.change is not None
    (over,) = comparison.change.maps
    label = f"{comparison.name}, {at_height(over.height_m)}: difference, mm ({over.mean_mm:.2f} on average)"
    grid, camera = (over.x_m, over.y_m), before.stations[comparison.name]
    drawing = field_drawing(grid, over.errors_mm, label, camera, over.height_m, still(before.targets).values())
    return canvas.to_svg(*drawing, canvas.WIDE_IN, "comparison", whole_file=True)
