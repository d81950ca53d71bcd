"""Pictures of the residuals: over the image, against the radius, by frame; and of the outliers, by feature.

Also of what was observed: parts of a camera's image, and stretches of the field's lines.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base import Array, Indices, InputError, Mask, fixed, grouped, no_such, short
from ceres_cal.diagnostics import Diagnosis, ResidualTable
from ceres_cal.diagnostics.summaries import RadiusTrend, Summary
from ceres_cal.report import canvas
from ceres_cal.report.canvas import CURVE, INK, OUTLIER, PAINT, POINT, QUIET
from ceres_cal.report.document import Figure, Table
from ceres_cal.report.findings import summary_table
from ceres_cal.report.quality import Material, paint_of
from ceres_cal.report.scale import spoken
from ceres_cal.scene import Camera, still

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_FRAMES_NAMED, _MOST_BARS = 24, 12


def stride(material: Material, count: int) -> int:
    """Return the step between the rows that are drawn, so that there are few enough for the page."""
    most_drawn = 5000  # largest number of strokes in a page, shared by its cameras
    most = max(most_drawn // len(material.observations.cameras), 200)
    return max(-(-count // most), 1)


def _thinned(drawn: int, of: int) -> str:
    return "" if drawn == of else f" Drawn are {grouped(drawn)} of {grouped(of)}, evenly spread."


# ---- vectors over the image -----------------------------------------------------------------------------------------


def vectors(material: Material, name: str) -> Figure:
    """Make the figure of residual vectors over one camera's image."""
    table, size = material.diagnosis.table, material.calibration.cameras[name].image_size
    own = material.of_camera(name)
    inliers, outliers = np.flatnonzero(own & table.inlier), np.flatnonzero(own & table.outlier)
    step = stride(material, len(inliers) + len(outliers))
    means = significant_means(table, inliers, size)
    shown, paint = (inliers[::step], outliers[::step]), list(lines_in_image(material, name).values())

    def draw(axes: Axes, width_in: float) -> None:
        draw_vectors(axes, width_in, table, shown, size, means, paint)

    shape = size[1] / size[0]
    return Figure(
        f"vectors-{number_of(material, name)}",
        f"Residual vectors over the image{owner_suffix(material, name)}",
        f"Each stroke leads from an observation to where the model puts it, enlarged {_enlarged(table, inliers, size)} "
        "times. For a line or arc it is the shortest way to the curve. Strokes in random directions are noise. "
        f"Thick: means of regions that noise cannot explain ({len(means[0])} of {means[2]}). Where they grow "
        f"or turn together, the model is wrong.{_thinned(sum(map(len, shown)), len(inliers) + len(outliers))}",
        draw,
        _region_table(material.diagnosis.summaries.regions, name),
        0.86 * shape + 0.18,
        0.93 * shape + 0.07,
    )


def _enlarged(table: ResidualTable, inliers: Indices, size: tuple[int, int]) -> int:
    """Return the enlargement of the strokes, a round number."""
    enlarged = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000)
    typical = 0.015  # drawn length of the median residual, as a share of the image's width
    wanted = typical * size[0] / max(_typical_px(table, inliers), 1e-12)
    return max((e for e in enlarged if e <= wanted), default=1)


def _typical_px(table: ResidualTable, inliers: Indices) -> float:
    return float(np.median(np.abs(table.distance_px[inliers]))) if len(inliers) else 1.0


def draw_vectors(
    axes: Axes,
    width_in: float,
    table: ResidualTable,
    rows: tuple[Indices, Indices],
    size: tuple[int, int],
    means: tuple[Array, Array, int],
    paint: Sequence[Array] = (),
) -> None:
    """Draw paint (each (S, 2) px), vectors of points and of curves, means of regions, and outliers.

    Args:
        rows: of the table, inliers and outliers. means: see `significant_means`.
    """
    (inliers, outliers), (places, displaced, _) = rows, means
    enlarged = _enlarged(table, inliers, size)
    frame_image(axes, size)
    for line in paint:
        axes.plot(*line.T, color=PAINT, linewidth=1.6 if width_in > canvas.NARROW_IN else 1.0, alpha=0.6)
    is_curve = table.is_curve[inliers]
    for own, color, label in ((inliers[~is_curve], POINT, "points"), (inliers[is_curve], CURVE, "curves")):
        if len(own):
            ends = table.pixel[own] + enlarged * table.residual_px[own]
            canvas.strokes(axes, table.pixel[own], ends, color, 0.7, alpha=0.8, label=label)
    if len(places):
        canvas.strokes(axes, places, places + enlarged * displaced, INK, 1.6, label="mean of a region")
        canvas.dots(axes, places, INK, 3.2)
    if len(outliers):
        canvas.crosses(axes, table.pixel[outliers], OUTLIER, 0.012 * size[0])
        axes.plot([], [], "x", color=OUTLIER, markersize=4, label="taken out")
    typical = _typical_px(table, inliers)
    start = np.array([[0.03 * size[0], 0.95 * size[1]]])  # a stroke of the length of the median residual
    end = start + np.array([enlarged * typical, 0.0])
    canvas.strokes(axes, start, end, INK, 1.5)
    text = axes.text(end[0, 0] + 0.012 * size[0], start[0, 1], f"median {short(typical)} px", va="center", fontsize=7.0)
    text.set_bbox({"facecolor": "white", "edgecolor": "none", "pad": 1.0, "alpha": 0.85})
    canvas.key(axes, 4 if width_in > canvas.NARROW_IN else 2)


def plot_residuals(diagnosis: Diagnosis, axes: Axes, camera: str | None) -> None:
    """Draw residual vectors over one camera's image, as large as what was observed there, into the user's own axes.

    Raises:
        InputError: no such camera, or none named where there are several.
    """
    table = diagnosis.table
    owners = [str(view["camera"]) for view in table.views]
    known = list(dict.fromkeys(owners))
    if camera is None and len(known) > 1:
        raise InputError(f"which camera? Name one of {', '.join(known)}")
    if camera is not None and camera not in known:
        raise InputError(no_such("camera", camera, known))
    own = (np.array(owners) == (camera or known[0]))[table.view]
    inliers, outliers = np.flatnonzero(own & table.inlier), np.flatnonzero(own & table.outlier)
    width, height = (int(np.ceil(end)) + 1 for end in table.pixel[own].max(axis=0))
    means = significant_means(table, inliers, (width, height))
    draw_vectors(axes, canvas.WIDE_IN, table, (inliers, outliers), (width, height), means)


def owner_suffix(material: Material, camera: str) -> str:
    """The camera's name for the end of a title, if there are several cameras; else ""."""
    return f", {camera}" if len(material.observations.cameras) > 1 else ""


def number_of(material: Material, camera: str) -> int:
    """Index of the camera among all."""
    return list(material.observations.cameras).index(camera)


def significant_means(table: ResidualTable, rows: Indices, size: tuple[int, int]) -> tuple[Array, Array, int]:
    """Mean displacements in regions of an image that noise does not explain: places (C, 2) px, displacements (C, 2) px,
    and the number of regions with enough rows.

    A point determines both coordinates, a curve the one across it: least squares over the region, weighted by their
    sigmas.
    """
    not_noise = 13.8  # squared length of a mean in sigmas that noise exceeds once in a thousand
    fewest = 4  # least number of observations in a cell
    mean_grid = 16  # cells along the image's longer side
    width, height = size
    cell = max(width, height) / mean_grid
    columns, lines = int(np.ceil(width / cell)), int(np.ceil(height / cell))
    pixel, residual = table.pixel[rows], table.residual_px[rows]
    column = np.clip((pixel[:, 0] / cell).astype(int), 0, columns - 1)
    region = np.clip((pixel[:, 1] / cell).astype(int), 0, lines - 1) * columns + column
    length = np.maximum(np.linalg.norm(residual, axis=1), 1e-300)
    across = np.einsum("ni,nj->nij", residual, residual) / length[:, None, None] ** 2
    projector = np.where(table.is_curve[rows, None, None], across, np.eye(2))
    weight = (table.sigma_px[rows] * table.scale[rows]) ** -2.0
    count = np.bincount(region, minlength=columns * lines)
    normal, moved, centre = np.zeros((len(count), 2, 2)), np.zeros((len(count), 2)), np.zeros((len(count), 2))
    np.add.at(normal, region, weight[:, None, None] * projector)
    np.add.at(moved, region, weight[:, None] * residual)
    np.add.at(centre, region, pixel)
    sizes = np.linalg.eigvalsh(normal)
    good = (count >= fewest) & (sizes[:, 0] > 0.1 * sizes[:, 1])
    places, means = centre[good] / count[good, None], np.linalg.solve(normal[good], moved[good, :, None])[:, :, 0]
    significant = np.sum(means * moved[good], axis=1) > not_noise
    return places[significant], means[significant], len(places)


def lines_in_image(material: Material, camera: str) -> dict[str, Array]:
    """The field's curves, by "target/name", as the camera's first placed station sees them, (S, 2) px; NaN outside."""
    stations = [s for s, owner in material.observations.stations.items() if owner == camera]
    seen = [v.station for v in material.observations.views if v.placement is None and v.station in stations]
    if not seen:
        return {}
    posed = material.calibration.estimate.camera_at(seen[0])
    targets = still(material.calibration.targets)
    names = [f"{target}/{curve}" for target, one in targets.items() for curve in one.curves]
    lines = [posed.project(curve) for curve in paint_of(targets.values())]
    with np.errstate(invalid="ignore"):
        inside = [np.all((line > -1.0) & (line < posed.image_size), axis=1) for line in lines]
    shown = (np.where(keep[:, None], line, np.nan) for line, keep in zip(lines, inside, strict=True))
    return dict(zip(names, shown, strict=True))


def frame_image(axes: Axes, size: tuple[int, int]) -> None:
    """Set the axes to an image of this size in pixels."""
    axes.set(xlim=(-0.5, size[0] - 0.5), ylim=(size[1] - 0.5, -0.5), aspect="equal", xlabel="px")
    axes.grid(visible=False)
    for side in axes.spines.values():
        side.set_visible(True)


def _region_table(summary: Summary, camera: str) -> Table:
    rows = [i for i, name in enumerate(summary.names) if name.rpartition(" ")[0] == camera]
    parts = [summary.names[i].rpartition(" ")[2] for i in rows]
    return summary_table("part of the image (column, row)", summary, rows, parts)


# ---- against the radius ---------------------------------------------------------------------------------------------


def against_radius(material: Material, name: str) -> Figure:
    """Make the figure of residuals away from the principal point against the radius, with their trend."""
    # Limit of the sd of a ring's mean, as a share of the residuals' range; less certain means are only in the table.
    vague = 0.3
    table, camera = material.diagnosis.table, material.calibration.cameras[name]
    trend = next(trend for trend in material.diagnosis.summaries.trends if trend.camera == name)
    radius, outward = _outward(table, np.flatnonzero(material.of_camera(name) & table.inlier), camera)
    known = np.flatnonzero(np.isfinite(outward))
    drawn = known[:: stride(material, len(known))]
    middle = 0.5 * (trend.radius_px[1:] + trend.radius_px[:-1])
    spread = float(np.quantile(np.abs(outward[known]), 0.995)) if len(known) else 1.0
    mean_px = np.where(trend.sd_px < vague * spread, trend.outward_px, np.nan)  # otherwise it would hide the others
    reach = 1.15 * max(spread, float(np.nanmax(np.abs(mean_px), initial=0.0)), 1e-9)

    def draw(axes: Axes, width_in: float) -> None:
        canvas.dots(axes, np.column_stack([radius, outward])[drawn], POINT, 1.6, alpha=0.35)
        axes.axhline(0.0, color=QUIET, linewidth=0.7)
        low, high = (mean_px + side * 2.0 * trend.sd_px for side in (-1.0, 1.0))
        axes.fill_between(middle, low, high, color=OUTLIER, alpha=0.25, linewidth=0.0, label="± 2 sd")
        axes.plot(middle, mean_px, color=OUTLIER, marker="o", markersize=2.6, label="trend")
        axes.set(xlim=(0.0, camera.corner_radius), ylim=(-reach, reach))
        axes.set(xlabel="distance from the principal point, px", ylabel="residual outwards, px")
        canvas.key(axes)

    return Figure(
        f"radius-{number_of(material, name)}",
        f"Residuals against the radius{owner_suffix(material, name)}",
        "Each dot is the component of a residual away from the principal point. The trend should stay at 0 within its "
        f"band. A wave means that the lens needs more coefficients.{_thinned(len(drawn), len(known))}",
        draw,
        Table(("radius, px", "trend px", "± sd", "mean / sd"), tuple(_trend_rows(trend))),
    )


def _trend_rows(trend: RadiusTrend) -> Iterator[tuple[str, ...]]:
    for low, high, mean, sd in zip(
        trend.radius_px[:-1], trend.radius_px[1:], trend.outward_px.tolist(), trend.sd_px.tolist(), strict=True
    ):
        yield f"{low:.0f} to {high:.0f}", fixed(mean, 4, "+"), fixed(sd, 4), fixed(mean / sd if sd else np.nan, 1, "+")


def _outward(table: ResidualTable, rows: Indices, camera: Camera) -> tuple[Array, Array]:
    """Radius and outward residual of some rows, px; NaN for a curve that runs outwards, which does not determine it."""
    offsets, residual = camera.offsets(table.pixel[rows]), table.residual_px[rows]
    radius = np.asarray(np.linalg.norm(offsets, axis=1))
    outward = np.sum(residual * offsets, axis=1) / np.maximum(radius, 1e-9)
    length = np.maximum(np.linalg.norm(residual, axis=1), 1e-300)
    cosine = np.abs(outward) / length
    with np.errstate(divide="ignore", invalid="ignore"):
        of_curve = np.where(cosine > 0.7, np.sign(outward) * length / cosine, np.nan)
    return radius, np.where(table.is_curve[rows], of_curve, outward)


# ---- by frame -------------------------------------------------------------------------------------------------------


def by_frame(material: Material) -> Figure:
    """Make the figure of each frame's root mean square residual, in standard deviations."""
    frames = material.diagnosis.summaries.frames
    number = np.arange(len(frames.names), dtype=float)
    heads, few = np.column_stack([number, frames.rms_sigma]), len(number) <= _MOST_FRAMES_NAMED
    top = 1.25 * float(np.nanmax(frames.rms_sigma, initial=1.0))

    def draw(axes: Axes, width_in: float) -> None:
        axes.axhline(1.0, color=QUIET, linewidth=0.9)
        if few:
            canvas.strokes(axes, np.column_stack([number, 0.0 * number]), heads, PAINT, 1.4)
            names = [_clipped(name) for name in frames.names]
            axes.set_xticks(number, names, rotation=60, ha="right", rotation_mode="anchor", fontsize=6.5)
        canvas.dots(axes, heads, POINT, 5.0 if few else 2.5)
        axes.grid(visible=False, axis="x")
        axes.set(ylim=(0.0, top), xlim=(-0.7, len(number) - 0.3), ylabel="rms, in standard deviations")
        if not few:
            axes.set_xlabel("frame, in order")

    return Figure(
        "frames",
        "Residuals frame by frame",
        "Root mean square residual of each frame in units of the expected noise; 1 is normal. A single high frame "
        "has wrong labels, motion blur or a moved camera. A lasting step means that the camera moved at that frame.",
        draw,
        summary_table("frame", frames, range(len(frames.names))),
        hover=canvas.hover(number, np.zeros(1), spoken(frames.rms_sigma), "{x}: {value} sigma", frames.names, [""]),
    )


def _clipped(name: str) -> str:
    return name if len(name) <= 14 else f"{name[:6]}…{name[-7:]}"


# ---- outliers -------------------------------------------------------------------------------------------------------


def outliers(material: Material) -> Figure | None:
    """Make the figure of how many outliers each feature has; None if there are none."""
    table = material.diagnosis.table
    rows = np.flatnonzero(table.outlier)
    if not len(rows):
        return None
    totals = Counter(table.features[i] for i in table.feature.tolist())
    named = Counter(table.features[i] for i in table.feature[rows].tolist()).most_common(_MOST_BARS)
    several = len(material.observations.targets) > 1

    def draw(axes: Axes, width_in: float) -> None:
        places = np.arange(len(named))
        axes.barh(places, [number for _, number in named], height=0.62, color=OUTLIER)
        for place, (name, number) in enumerate(named):
            text = f"{number} of {totals[name]}"
            axes.annotate(
                text, (number, place), (3, 0), textcoords="offset points", va="center", fontsize=6.5, color=INK
            )
        names = [canvas.clipped(name if several else name.partition("/")[2], 30) for name, _ in named]
        axes.set_yticks(places, names, fontsize=6.5)
        axes.tick_params(axis="y", length=0)
        axes.invert_yaxis()
        axes.set(xlim=(0.0, 1.25 * named[0][1]), xlabel="observations taken out")
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_color(QUIET)

    off = np.abs(table.distance_px[rows])
    sigmas = off / (table.sigma_px[rows] * table.scale[rows])
    sigmas = np.where(np.isfinite(sigmas), sigmas, np.inf)
    farthest = np.argsort(-sigmas, kind="stable")
    cells = (
        (
            table.id_of(row),
            table.features[table.feature[row]],
            str(table.views[table.view[row]]["frame"]),
            fixed(px, 2),
            short(sigma) if sigma < np.inf else "",
        )
        for row, px, sigma in zip(*(column[farthest].tolist() for column in (rows, off, sigmas)), strict=True)
    )
    return Figure(
        "outliers",
        "Outliers, by feature",
        f"{grouped(len(rows))} of {grouped(len(table))} observations did not take part "
        f"({material.calibration.options.reject_sigma:g} sigma and more). A few are normal. Most of one feature "
        "means a wrong label, or paint that is off its nominal position.",
        draw,
        Table(("farthest first", "feature", "frame", "px off", "sigma"), tuple(cells)),
        0.2 + 0.055 * max(len(named), 6),
    )


# ---- what was observed ----------------------------------------------------------------------------------------------


_NEAR = 0.06  # share of the image's width within which an observation supports a stretch of its line
_FILLED, _EMPTY = "#d9e8f3", "#fcede4"


def support(material: Material, name: str) -> Figure:
    """Make the figure of what one camera observed."""
    table, size = material.diagnosis.table, material.calibration.cameras[name].image_size
    own = material.of_camera(name) & table.inlier
    counts, ends = counts_of_parts(table.pixel[own], size)
    lines, rows, whole, observed = [], [], 0, 0
    for curve, pixels in lines_in_image(material, name).items():
        known = curve in table.features
        of_curve = own & table.is_curve & (table.feature == (table.features.index(curve) if known else -1))
        near = _near(pixels, table.pixel[of_curve], _NEAR * size[0])
        visible = near[np.isfinite(pixels[:, 0])]
        share = f"{100.0 * float(np.mean(visible)):.0f} %" if len(visible) else "not visible"
        lines.append((pixels, near))
        rows.append((curve, share, grouped(int(of_curve.sum()))))
        whole, observed = whole + len(visible), observed + int(visible.sum())

    def draw(axes: Axes, width_in: float) -> None:
        from matplotlib.colors import ListedColormap

        axes.pcolormesh(*ends, counts > 0, cmap=ListedColormap([_EMPTY, _FILLED]), vmin=0, vmax=1, edgecolor="white")
        canvas.dots(axes, table.pixel[own][:: stride(material, int(own.sum()))], POINT, 1.2, alpha=0.5)
        for color, kept, label in ((OUTLIER, False, "line not observed"), (CURVE, True, "line observed")):
            parts = [np.where((near == kept)[:, None], pixels, np.nan) for pixels, near in lines]
            if parts:
                apart = [np.vstack([part, [[np.nan, np.nan]]]) for part in parts]
                axes.plot(*np.concatenate(apart).T, color=color, linewidth=2.0, label=label)
        frame_image(axes, size)
        if lines:
            canvas.key(axes)

    filled = int(np.count_nonzero(counts))
    of_lines = f" {100.0 * observed / whole:.0f} % of the visible line length was observed (green)." if whole else ""
    shape = size[1] / size[0]
    rows.append(("parts of the image", f"{100.0 * filled / counts.size:.0f} %", grouped(int(own.sum()))))
    return Figure(
        f"support-{number_of(material, name)}",
        f"What the observations support{owner_suffix(material, name)}",
        f"Observations lie in {filled} of {counts.size} parts of the image (blue). Elsewhere the lens model is "
        f"extrapolated.{of_lines} Where lines are orange, neither lens nor field was checked.",
        draw,
        Table(("line", "visible length observed", "observations"), tuple(rows)),
        0.86 * shape + 0.18,
        0.93 * shape + 0.07,
    )


def counts_of_parts(pixels: Array, size: tuple[int, int]) -> tuple[Array, tuple[Array, Array]]:
    """Number of observations (Y, X) in each part of an image, and the parts' limits, px."""
    cells = 16  # along the longer side of the image
    cell = max(size) / cells
    ends = [np.linspace(-0.5, side - 0.5, round(side / cell) + 1) for side in size]
    counts, _, _ = np.histogram2d(pixels[:, 0], pixels[:, 1], ends)
    return counts.T, (ends[0], ends[1])


def _near(places: Array, observed: Array, reach: float) -> Mask:
    """(S,) whether an observation lies within reach of each place."""
    if not len(observed):
        return np.zeros(len(places), dtype=bool)
    apart = np.linalg.norm(places[:, None] - observed[None], axis=2)
    return np.asarray(np.nan_to_num(apart, nan=np.inf).min(axis=1) <= reach)
