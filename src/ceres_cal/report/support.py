"""What was observed: which parts of a camera's image, and which stretches of the field's lines."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.words import grouped
from ceres_cal.report import canvas
from ceres_cal.report.canvas import CURVE, OUTLIER, POINT
from ceres_cal.report.document import Figure, Table
from ceres_cal.report.material import Material
from ceres_cal.report.residual_pictures import frame_image, lines_in_image, number_of, owner_suffix, stride

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_NEAR = 0.06  # of the image's width: a stretch of a line is supported where an observation of it lies as near
_FILLED, _EMPTY = "#d9e8f3", "#fcede4"


def support(material: Material, name: str) -> Figure:
    """The picture of one camera."""
    table, size = material.diagnosis.table, material.calibration.cameras[name].image_size
    own = material.of_camera(name) & table.inlier
    counts, ends = _counts(table.pixel[own], size)
    lines = []
    for curve, pixels in lines_in_image(material, name).items():
        known = curve in table.features
        of_curve = own & table.is_curve & (table.feature == (table.features.index(curve) if known else -1))
        lines.append((curve, pixels, _near(pixels, table.pixel[of_curve], _NEAR * size[0]), int(of_curve.sum())))
    seen = [np.isfinite(pixels[:, 0]) for _, pixels, _, _ in lines]
    found = [near[visible] for (_, _, near, _), visible in zip(lines, seen, strict=True)]
    shares = [float(np.mean(one)) if len(one) else np.nan for one in found]
    whole, observed = sum(map(len, found)), sum(int(one.sum()) for one in found)

    def draw(axes: Axes, width_in: float) -> None:
        from matplotlib.colors import ListedColormap

        axes.pcolormesh(*ends, counts > 0, cmap=ListedColormap([_EMPTY, _FILLED]), vmin=0, vmax=1, edgecolor="white")
        canvas.dots(axes, table.pixel[own][:: stride(material, int(own.sum()))], POINT, 1.2, alpha=0.5)
        for color, kept, label in ((OUTLIER, False, "line not observed"), (CURVE, True, "line observed")):
            parts = [np.where((near == kept)[:, None], pixels, np.nan) for _, pixels, near, _ in lines]
            if parts:
                apart = [np.vstack([part, [[np.nan, np.nan]]]) for part in parts]
                axes.plot(*np.concatenate(apart).T, color=color, linewidth=2.0, label=label)
        frame_image(axes, size)
        if lines:
            canvas.key(axes)

    filled = int(np.count_nonzero(counts))
    of_lines = f" {100.0 * observed / whole:.0f} % of the visible line length was observed (green)." if whole else ""
    shape = size[1] / size[0]
    rows = [
        (curve, "not visible" if np.isnan(share) else f"{100.0 * share:.0f} %", grouped(count))
        for (curve, _, _, count), share in zip(lines, shares, strict=True)
    ]
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


def _counts(pixels: Array, size: tuple[int, int]) -> tuple[Array, tuple[Array, Array]]:
    """How many observations (Y, X) lie in each part of an image, and the parts' ends."""
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
