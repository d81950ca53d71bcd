"""Pictures of the solve (correlations, convergence, closed form against bundle adjustment) and of the lens."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base import Array, counted, fixed, powered, short
from ceres_cal.calibration import Calibration
from ceres_cal.problem.information import Key
from ceres_cal.report import canvas
from ceres_cal.report.canvas import DIVERGING, OUTLIER, PAINT, POINT, QUIET
from ceres_cal.report.document import Figure, Table
from ceres_cal.report.quality import Material
from ceres_cal.report.residual_pictures import number_of, owner_suffix
from ceres_cal.scene.camera import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STEPS, _TABLE_STEPS = 120, 10


# ---- correlation ----------------------------------------------------------------------------------------------------


def correlation(material: Material) -> Figure | None:
    """Make the figure of correlations between shared numbers, cameras and stations first; None without a covariance."""
    most_numbers = 24  # largest number of rows in the picture
    posterior = material.calibration.posterior
    if posterior is None:
        return None
    order = sorted(range(len(posterior.keys)), key=lambda i: posterior.keys[i].kind not in ("camera", "station"))
    chosen = np.array(order[:most_numbers])
    keys = [posterior.keys[i] for i in chosen]
    sd = np.sqrt(np.diagonal(posterior.covariance)[chosen])
    with np.errstate(invalid="ignore", divide="ignore"):
        matrix = posterior.covariance[np.ix_(chosen, chosen)] / sd[:, None] / sd
    labels = [label(key, keys) for key in keys]
    rest, places = len(posterior.keys) - len(keys), np.arange(0.5, len(labels))
    shown = (f"{value:+.3f}" if np.isfinite(value) else "unknown" for value in matrix.ravel().tolist())
    return Figure(
        "correlation",
        "Correlation of the numbers",
        "Dark blue: errors of two numbers have the same sign; brown: opposite signs. Where the correlation is near 1 "
        "or -1 (such as phi and height), the ratio is known much better than each number. Grey: unknown."
        + (f" {counted(rest, 'further number')} not drawn." if rest else ""),
        lambda axes, _: _draw_matrix(axes, matrix, labels),
        _pairs(matrix, labels),
        0.86,
        hover=canvas.hover(places, places, shown, "{x}, {y}: {value}", labels, labels),
    )


def _draw_matrix(axes: Axes, matrix: Array, labels: Sequence[str]) -> None:
    from matplotlib.colors import ListedColormap

    colors = ListedColormap(list(DIVERGING))
    axes.set_facecolor(PAINT)
    drawn = axes.pcolormesh(matrix, vmin=-1.0, vmax=1.0, cmap=colors, edgecolor="white", linewidth=0.8)
    size = 6.5 if len(labels) <= 14 else 6.0
    places = np.arange(len(labels)) + 0.5
    axes.set_xticks(places, labels, rotation=60, ha="right", rotation_mode="anchor", fontsize=size)
    axes.set_yticks(places, labels, fontsize=size)
    axes.tick_params(length=0)
    axes.invert_yaxis()
    axes.set_aspect("equal")
    axes.grid(visible=False)
    figure = axes.get_figure()
    assert figure is not None
    bar = figure.colorbar(drawn, ax=axes, ticks=[-1, 0, 1], shrink=0.5, aspect=18, pad=0.02)
    bar.outline.set_visible(False)


def label(key: Key, others: Sequence[Key]) -> str:
    """Name of a number, with its owner where several owners have a number of that name."""
    same = {other.owner for other in others if (other.kind, other.quantity) == (key.kind, key.quantity)}
    name = key.quantity.replace("_", " ")
    whole = f"{name} {key.owner}" if len(same) > 1 or key.kind in ("placement", "structure", "dimension") else name
    return canvas.clipped(whole, 22)


def _pairs(matrix: Array, labels: Sequence[str]) -> Table:
    most_pairs = 30
    first, second = np.triu_indices(len(labels), 1)
    strength = matrix[first, second]
    order = np.argsort(-np.abs(np.nan_to_num(strength)))[:most_pairs]
    return Table(
        ("strongest pairs", "and", "correlation"),
        tuple((labels[first[i]], labels[second[i]], fixed(float(strength[i]), 4, "+")) for i in order),
    )


# ---- convergence ----------------------------------------------------------------------------------------------------


def convergence(material: Material) -> Figure | None:
    """Make the figure of the cost above its minimum for each iteration of the last solve; None if nothing was
    minimised.
    """
    history = np.array(material.calibration.history)
    if len(history) < 2:
        return None
    above = history - history.min()
    floor = max(1e-16 * float(history.min()), 1e-300)
    shown = np.maximum(above, floor)
    steps = np.arange(len(history))
    falls = ("", *(f"{fall:.3g}" for fall in history[:-1] - history[1:]))
    rows = tuple(zip(map(str, steps), map("{:.10g}".format, history), falls, strict=True))

    def draw(axes: Axes, width_in: float) -> None:
        from matplotlib.ticker import MaxNLocator

        drawn = above > floor
        axes.plot(steps[drawn], shown[drawn], color=POINT, marker="o", markersize=3.2)
        axes.set(yscale="log", xlim=(-0.3, len(history) - 0.7), xlabel="iteration", ylabel="cost above its least")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
        axes.yaxis.set_major_formatter(canvas.plain)

    solved = material.calibration
    how = "It converged" if solved.converged else "It did not converge"
    return Figure(
        "convergence",
        "Convergence of the last solve",
        f"The cost should fall steeply and end. A long flat tail means that some combination of numbers is hardly "
        f"determined. {how} after {counted(solved.rounds, 'solve')}. The last one ends at {history[-1]:.6g}.",
        draw,
        Table(("iteration", "cost", "fall"), rows),
    )


# ---- closed form against bundle -------------------------------------------------------------------------------------


def against_closed_form(material: Material, closed: Calibration, left_px: Array) -> Figure:
    """Make the figure of the distribution of residuals under the paper's closed form and the bundle adjustment."""
    table = material.diagnosis.table
    inlier = table.inlier
    lengths = {"closed form": left_px[inlier], "bundle": np.abs(table.distance_px[inlier])}
    lengths = {name: np.where(np.isfinite(values), values, np.inf) for name, values in lengths.items()}
    shares = np.linspace(0.01, 0.99, 99)
    curves = {name: np.quantile(values, shares, method="nearest") for name, values in lengths.items()}

    def draw(axes: Axes, width_in: float) -> None:
        for name, color in (("closed form", OUTLIER), ("bundle", POINT)):
            shown = np.isfinite(curves[name]) & (curves[name] > 0.0)
            axes.plot(curves[name][shown], 100.0 * shares[shown], color=color, linewidth=1.8, label=name)
        axes.set(xscale="log", ylim=(0.0, 100.0), xlabel="residual, px", ylabel="% of the inliers below it")
        axes.xaxis.set_major_formatter(canvas.plain)
        canvas.key(axes)

    medians = {name: float(np.median(values)) for name, values in lengths.items()}
    return Figure(
        "closed-form",
        "Closed form against bundle",
        f"Farther left is better. The median residual is {short(medians['bundle'])} px after the bundle adjustment and "
        f"{short(medians['closed form'])} px after the closed form of the paper.",
        draw,
        _comparison(material.calibration, closed, curves, shares),
    )


def _comparison(bundle: Calibration, closed: Calibration, curves: dict[str, Array], shares: Array) -> Table:
    percents = (10, 25, 50, 75, 90, 99)
    rows = [
        (f"{p} % of residuals below, px", *(fixed(float(np.interp(p / 100.0, shares, c)), 3) for c in curves.values()))
        for p in percents
    ]
    for name, camera in bundle.cameras.items():
        other = closed.cameras[name]
        rows.append((f"phi of {name}, px", f"{other.phi:.2f}", f"{camera.phi:.2f}"))
        for key, value in camera.lens.listed.items():
            rows.append((f"{key} of {name}", f"{other.lens.coefficients[key]:.4g}", f"{value:.4g}"))
    for name, station in bundle.stations.items():
        rows.append((f"height of {name}, m", f"{closed.stations[name].position[2]:.4f}", f"{station.position[2]:.4f}"))
    return Table(("", "closed form", "bundle"), tuple(rows))


# ---- the lens -------------------------------------------------------------------------------------------------------


def ideal_radii(camera: Camera, radii: Array) -> Array:
    """r' in px for measured radii r, along the image's x axis: phi times the tangent of the angle to the axis.

    NaN past the lens's monotone radius, and from 90 degrees on.
    """
    widest = 2.5  # largest r' over r: beyond it the ray is nearly at a right angle to the axis
    rays = camera.lens.undistort(np.column_stack([radii, 0.0 * radii]), camera.phi)
    with np.errstate(divide="ignore", invalid="ignore"):
        ideal = camera.phi * np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]
        return np.where((rays[:, 2] > 0.0) & (ideal <= widest * np.maximum(radii, 1.0)), ideal, np.nan)


def plot_distortion(camera: Camera, axes: Axes, reach: float = np.inf) -> None:
    """Draw r' against r of a camera, px, also into the user's own axes; dotted beyond the reach of observations."""
    radii = np.linspace(0.0, camera.corner_radius, _STEPS)
    ideal, known = ideal_radii(camera, radii), radii <= reach
    axes.plot(radii, radii, color=QUIET, linewidth=0.9, dashes=(4, 3), label="no distortion")
    axes.plot(radii[known], ideal[known], color=POINT, linewidth=1.8, label="this lens")
    if not known.all():
        axes.plot(radii[~known], ideal[~known], color=POINT, linewidth=1.2, dashes=(1, 1.5), label="not observed")
    axes.set(xlim=(0.0, camera.corner_radius), ylim=(0.0, None))
    axes.set(xlabel="measured radius r, px", ylabel="undistorted radius r', px")
    canvas.key(axes)


def distortion(material: Material, name: str) -> Figure:
    """Make the figure of r' against r of one camera, with the extent of its observations."""
    camera, table = material.calibration.cameras[name], material.diagnosis.table
    seen = table.radius_px[material.of_camera(name) & table.inlier]
    reach = float(seen.max()) if len(seen) else 0.0
    terms = [powered(term) for term in camera.lens.formula.split(" ")]
    model = " ".join(terms) if camera.lens.formula else f"the {camera.lens.kind} lens"
    steps = np.linspace(0.0, camera.corner_radius, _TABLE_STEPS + 1)[1:]
    rows = (_row(*radii) for radii in zip(steps.tolist(), ideal_radii(camera, steps).tolist(), strict=True))
    return Figure(
        f"lens-{number_of(material, name)}",
        f"The distortion curve{owner_suffix(material, name)}",
        f"Radius of a pixel from the principal point, measured (horizontal) and without distortion (vertical), "
        f"{model}. Observations reach {reach:.0f} of {camera.corner_radius:.0f} px. The dotted part is extrapolated.",
        lambda axes, _: plot_distortion(camera, axes, reach),
        Table(("r, px", "r', px", "r' - r, px", "r' / r"), tuple(rows)),
    )


def _row(r: float, ideal: float) -> tuple[str, ...]:
    if not np.isfinite(ideal):
        return f"{r:.1f}", "none", "", ""
    return f"{r:.1f}", f"{ideal:.2f}", f"{ideal - r:+.2f}", f"{ideal / r:.4f}"
