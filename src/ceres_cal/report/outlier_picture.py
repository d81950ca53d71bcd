"""The picture of outliers: what was taken out, by feature."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.words import fixed, grouped, short
from ceres_cal.report.canvas import INK, OUTLIER, QUIET, Drawing
from ceres_cal.report.material import Material
from ceres_cal.report.page import Figure, Table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_MOST_BARS = 12


def outliers(material: Material) -> Figure | None:
    """Which features were taken out, how often; None where nothing was."""
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
        names = [_short_name(name, several) for name, _ in named]
        axes.set_yticks(places, names, fontsize=6.5)
        axes.tick_params(axis="y", length=0)
        axes.invert_yaxis()
        axes.set(xlim=(0.0, 1.25 * named[0][1]), xlabel="observations taken out")
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_color(QUIET)

    order = rows[np.argsort(-_sigmas(material, rows), kind="stable")]
    return Figure(
        "outliers",
        "Outliers, by feature",
        f"{grouped(len(rows))} of {grouped(len(table))} observations did not take part "
        f"({material.calibration.options.reject_sigma:g} sigma off and more). Here and there one is normal; most "
        "of one feature means a wrong label, or paint that is not where it was drawn.",
        Drawing(draw, 0.2 + 0.055 * max(len(named), 6)),
        Table(
            ("farthest first", "feature", "frame", "px off", "sigma"),
            tuple(_outlier_row(material, int(row)) for row in order),
        ),
    )


def _sigmas(material: Material, rows: Indices) -> Array:
    table = material.diagnosis.table
    sigmas = np.abs(table.distance_px[rows]) / (table.sigma_px[rows] * table.scale[rows])
    return np.where(np.isfinite(sigmas), sigmas, np.inf)


def _outlier_row(material: Material, row: int) -> tuple[str, ...]:
    table = material.diagnosis.table
    frame = str(table.views[table.view[row]]["frame"])
    sigma = float(_sigmas(material, np.array([row]))[0])
    off = float(abs(table.distance_px[row]))
    return (
        table.id_of(row),
        table.features[table.feature[row]],
        frame,
        fixed(off, 2),
        short(sigma) if sigma < np.inf else "",
    )


def _short_name(name: str, several: bool) -> str:
    text = name if several else name.partition("/")[2]
    return text if len(text) <= 30 else f"{text[:29]}…"
