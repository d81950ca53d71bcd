"""The inner loops, compiled by numba: the only place that imports it. They release the GIL."""

from ceres_cal.kernels.alignment import align_sights, alignment_errors, normalised_planes, usual_by_radius
from ceres_cal.kernels.arguments import NOTHING, Blocks, CurveColumns, Loss, Optics, PointColumns, Sweep, Unknowns
from ceres_cal.kernels.block import ROUNDING, cholesky, evaluate_block
from ceres_cal.kernels.elimination import eliminate_placements
from ceres_cal.kernels.groups import grouped_scatter
from ceres_cal.kernels.information import sight_normals
from ceres_cal.kernels.lenses import lens_functions
from ceres_cal.kernels.losses import LOSS_CODES
from ceres_cal.kernels.planes import plane_homographies
from ceres_cal.kernels.rows import curve_rows, loss_weights, point_rows
from ceres_cal.kernels.sight import curve_residuals, point_residuals

__all__ = [
    "LOSS_CODES",
    "NOTHING",
    "ROUNDING",
    "Blocks",
    "CurveColumns",
    "Loss",
    "Optics",
    "PointColumns",
    "Sweep",
    "Unknowns",
    "align_sights",
    "alignment_errors",
    "cholesky",
    "curve_residuals",
    "curve_rows",
    "eliminate_placements",
    "evaluate_block",
    "grouped_scatter",
    "lens_functions",
    "loss_weights",
    "normalised_planes",
    "plane_homographies",
    "point_residuals",
    "point_rows",
    "sight_normals",
    "usual_by_radius",
]
