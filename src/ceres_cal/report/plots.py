"""The pictures of the report in somebody's own Axes: what `plot()` of public objects draws."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.words import no_such
from ceres_cal.diagnostics import Diagnosis
from ceres_cal.posterior.maps import FieldMap, ImageMap
from ceres_cal.report.canvas import WIDE_IN
from ceres_cal.report.maps import LABEL, fill
from ceres_cal.report.residual_pictures import draw_vectors, significant_means
from ceres_cal.report.scale import MM, PX
from ceres_cal.report.solve_pictures import draw_distortion
from ceres_cal.scene.camera import Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot_map(one: FieldMap | ImageMap, axes: Axes) -> None:
    """95 % radii over the field, m, or over the image, px."""
    if isinstance(one, FieldMap):
        fill(axes, MM, (one.x_m, one.y_m), one.radius_95_mm)
        axes.set(aspect="equal", xlabel="x, m", ylabel="y, m")
        MM.bar(axes, LABEL)
    else:
        fill(axes, PX, (one.x_px, one.y_px), one.radius_95_px)
        axes.set(ylim=(one.y_px[-1], one.y_px[0]), aspect="equal", xlabel="px", ylabel="px")
        PX.bar(axes, "95 % within, px")


def plot_distortion(camera: Camera, axes: Axes) -> None:
    """Undistorted against measured radius, px."""
    draw_distortion(axes, camera)


def plot_residuals(diagnosis: Diagnosis, axes: Axes, camera: str | None) -> None:
    """Residual vectors over one camera's image, as large as what was observed there.

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
    draw_vectors(axes, WIDE_IN, table, (inliers, outliers), (width, height), means)
