"""The inner loops, compiled by numba: the only place that imports it. They release the GIL."""

from ceres_cal.kernels.block import evaluate_block
from ceres_cal.kernels.lenses import INTRINSICS, LENS_CODES
from ceres_cal.kernels.sight import LOSS_CODES, curve_residuals, normal_equations, point_residuals

__all__ = [
    "INTRINSICS",
    "LENS_CODES",
    "LOSS_CODES",
    "curve_residuals",
    "evaluate_block",
    "normal_equations",
    "point_residuals",
]
