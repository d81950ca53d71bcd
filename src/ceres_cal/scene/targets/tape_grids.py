"""A plain grid of tape on a floor: lines at even distances both ways.

How many lines there are its spec says, so that it is no data file as other fields are.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.typed import checked
from ceres_cal.scene.curves import Curve, Segment
from ceres_cal.scene.targets.target import Target, TargetKind, from_arguments, require_size


@checked
def tape_grid(columns: int, rows: int, pitch_m: float, line_thickness_m: float) -> Target:
    """Lines "column_c" at x = c pitches and "row_r" at y = r pitches, and points "c,r" where they cross.

    Args:
        columns, rows: lines; at least two. pitch_m: between the centres of neighbouring lines.

    Raises:
        InputError: fewer than two lines a way, more than MOST_FEATURES crossings, or lengths that are no positive
            numbers.
    """
    if columns < 2 or rows < 2:
        raise InputError(f"tape-grid: columns and rows count lines, at least 2, not {columns} and {rows}")
    require_size(columns * rows + columns + rows, "tape-grid")
    if not (np.isfinite(pitch_m) and np.isfinite(line_thickness_m) and 0.0 < line_thickness_m < pitch_m):
        raise InputError(
            f"tape-grid: line_thickness_m and pitch_m must increase from 0, not {line_thickness_m}, {pitch_m}"
        )
    x, y = (columns - 1) * pitch_m, (rows - 1) * pitch_m
    curves: dict[str, Curve] = {
        f"column_{c}": Segment((c * pitch_m, 0.0, 0.0), (c * pitch_m, y, 0.0), line_thickness_m) for c in range(columns)
    }
    for r in range(rows):
        curves[f"row_{r}"] = Segment((0.0, r * pitch_m, 0.0), (x, r * pitch_m, 0.0), line_thickness_m)
    points = {f"{c},{r}": (c * pitch_m, r * pitch_m, 0.0) for r in range(rows) for c in range(columns)}
    sizes = {"pitch_m": float(pitch_m), "line_thickness_m": float(line_thickness_m)}
    spec = {"kind": "tape-grid", "columns": int(columns), "rows": int(rows), **sizes}
    return Target(spec, points, curves, dimensions=sizes)


KIND = TargetKind(
    "tape-grid",
    "a plain grid of tape on the floor: x along its rows, the first crossing at 0, 0",
    "columns and rows (lines), pitch_m (between their centres), line_thickness_m",
    'lines "column_0", ... at x = c pitches and "row_0", ... at y = r pitches, points "c,r" where they cross',
    lambda: {"tape-grid": tape_grid(5, 4, 0.5, 0.02)},
    from_arguments("tape-grid", tape_grid),
)
