"""The distortion curve: the paper's figure 4."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.words import powered
from ceres_cal.report import canvas
from ceres_cal.report.canvas import POINT, QUIET, Drawing
from ceres_cal.report.material import Material
from ceres_cal.report.page import Figure, Table
from ceres_cal.scene.camera import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_STEPS, _TABLE_STEPS = 120, 10
_WIDEST = 2.5  # r' over r: what lies beyond is nearly at a right angle to the axis


def ideal_radii(camera: Camera, radii: Array) -> Array:
    """r' in px of measured radii r, along the image's x axis: phi times the tangent of the angle to the axis.

    NaN past the lens's monotone radius, and from 90 degrees on.
    """
    rays = camera.lens.undistort(np.column_stack([radii, 0.0 * radii]), camera.phi)
    with np.errstate(divide="ignore", invalid="ignore"):
        ideal = camera.phi * np.hypot(rays[:, 0], rays[:, 1]) / rays[:, 2]
        return np.where((rays[:, 2] > 0.0) & (ideal <= _WIDEST * np.maximum(radii, 1.0)), ideal, np.nan)


def distortion(material: Material, name: str) -> Figure:
    """r' against r of one camera, and how far observations reach."""
    camera, table = material.calibration.cameras[name], material.diagnosis.table
    radii = np.linspace(0.0, camera.corner_radius, _STEPS)
    ideal = ideal_radii(camera, radii)
    seen = table.radius_px[material.of_camera(name) & table.inlier]
    reach = float(seen.max()) if len(seen) else 0.0
    terms = [powered(term) for term in camera.lens.formula.split(" ")]
    model = " ".join(terms) if camera.lens.formula else f"the {camera.lens.kind} lens"

    def draw(axes: Axes, width_in: float) -> None:
        axes.plot(radii, radii, color=QUIET, linewidth=0.9, dashes=(4, 3), label="no distortion")
        known = radii <= reach
        axes.plot(radii[known], ideal[known], color=POINT, linewidth=1.8, label="this lens")
        axes.plot(radii[~known], ideal[~known], color=POINT, linewidth=1.2, dashes=(1, 1.5), label="not observed")
        axes.set(xlim=(0.0, camera.corner_radius), ylim=(0.0, None))
        axes.set(xlabel="measured radius r, px", ylabel="undistorted radius r', px")
        canvas.key(axes)

    steps = np.linspace(0.0, camera.corner_radius, _TABLE_STEPS + 1)[1:]
    table_rows = zip(steps.tolist(), ideal_radii(camera, steps).tolist(), strict=True)
    return Figure(
        f"lens-{list(material.observations.cameras).index(name)}",
        "The distortion curve" + (f", {name}" if len(material.observations.cameras) > 1 else ""),
        f"The paper's figure 4: how far from the principal point a pixel is (across) and would be without "
        f"distortion (up), {model}. Observations reach {reach:.0f} of {camera.corner_radius:.0f} px; "
        "dotted, beyond them, the curve is a guess.",
        Drawing(draw, 0.66),
        Table(
            ("r, px", "r', px", "r' - r, px", "r' / r"),
            tuple((f"{r:.1f}", *_row(r, ideal_radius)) for r, ideal_radius in table_rows),
        ),
    )


def _row(r: float, ideal: float) -> tuple[str, ...]:
    if not np.isfinite(ideal):
        return ("none", "", "")
    return (f"{ideal:.2f}", f"{ideal - r:+.2f}", f"{ideal / r:.4f}")
