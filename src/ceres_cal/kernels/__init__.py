"""The inner loops, compiled by numba: the only place that imports it. They release the GIL.

`KERNELS` are what the rest of the package calls. They work on what they are handed, and fill what is there for it.
"""

from ceres_cal.kernels.arguments import (
    BUILT,
    LOSS_CODES,
    NOTHING,
    ROUNDING,
    Blocks,
    CurveColumns,
    Loss,
    Optics,
    PointColumns,
    Sweep,
    Unknowns,
)
from ceres_cal.kernels.library import Kernel, lens_functions, numba_version

KERNELS = (
    align_sights := Kernel("alignment.align_sights", "l1", "d2", "d2", "d1", "d2*", "d3*", "d2*"),
    alignment_errors := Kernel("alignment.alignment_errors", "l1", "d2", "d2", "d2", "d2", "d1", "d1*"),
    normalised_planes := Kernel("alignment.normalised_planes", "l1", "d2", "d2*", "d2*"),
    usual_by_radius := Kernel("alignment.usual_by_radius", "d1", "d1", "d1*"),
    cholesky := Kernel("block.cholesky", "d2", "d2*"),
    evaluate_block := Kernel(
        "block.evaluate_block", Optics, Unknowns, PointColumns, CurveColumns, Loss, Blocks, "d1*", Blocks
    ),
    eliminate_placements := Kernel(
        "elimination.eliminate_placements",
        *("l", "l", Optics, Unknowns, PointColumns, CurveColumns, Loss, "?", "d", "d1", Sweep),
    ),
    grouped_scatter := Kernel("groups.grouped_scatter", "d2", "l1", "d3*"),
    sight_normals := Kernel(
        "information.sight_normals",
        *("l", "l", Optics, Unknowns, PointColumns, CurveColumns, Loss, "d3", "d1", "d3*"),
    ),
    plane_homographies := Kernel("planes.plane_homographies", "l1", "d2", "d2", "d1", "d", "d3*", "d1*"),
    curve_rows := Kernel("rows.curve_rows", Optics, "d3", CurveColumns, "d2*", "d2*"),
    loss_weights := Kernel("rows.loss_weights", Loss, "d1", "d1*"),
    point_rows := Kernel("rows.point_rows", Optics, "d3", PointColumns, "d3*"),
    curve_residuals := Kernel("sight.curve_residuals", Optics, "d3", CurveColumns, "d1*"),
    point_residuals := Kernel("sight.point_residuals", "l", "l", Optics, "d3", PointColumns, "l1", "d2*"),
)

__all__ = [
    "BUILT",
    "KERNELS",
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
    "numba_version",
    "plane_homographies",
    "point_residuals",
    "point_rows",
    "sight_normals",
    "usual_by_radius",
]
