"""Kalibr's AprilGrid: tags in columns and rows, with small dark squares where their corners nearly meet."""

from __future__ import annotations

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.typed import checked
from ceres_cal.scene.targets.target import Target, TargetKind, from_arguments, require_size


@checked
def april_grid(columns: int, rows: int, tag_m: float, gap: float) -> Target:
    """The corners of the tags: feature "c,r" counts them from the top left, c < 2 columns, r < 2 rows.

    Args:
        columns, rows: tags; Kalibr's tagCols and tagRows. Their numbers count from the bottom left, row by row.
        tag_m: side of a tag's dark border, Kalibr's tagSize. gap: between tags over that, Kalibr's tagSpacing.

    Raises:
        InputError: no tags, more than MOST_FEATURES corners, or sizes that are no positive numbers.
    """
    if columns < 1 or rows < 1:
        raise InputError(f"april-grid: columns and rows count tags, at least 1, not {columns} and {rows}")
    require_size(4 * columns * rows, "april-grid")
    if not (np.isfinite(tag_m) and tag_m > 0.0 and np.isfinite(gap) and gap > 0.0):
        raise InputError(f"april-grid: tag_m and gap must be positive numbers, not {tag_m} and {gap}")
    x, y = ([(n // 2 * (1.0 + gap) + n % 2) * tag_m for n in range(2 * count)] for count in (columns, rows))
    points = {f"{c},{r}": (x[c], y[r], 0.0) for r in range(2 * rows) for c in range(2 * columns)}
    numbers = {"columns": int(columns), "rows": int(rows), "tag_m": float(tag_m), "gap": float(gap)}
    return Target({"kind": "april-grid", **numbers}, points, {}, movable=True, bows=True)


KIND = TargetKind(
    "april-grid",
    "the corners of the tags of Kalibr's AprilGrid",
    "columns and rows (tags), tag_m, gap (between tags, over tag_m)",
    'points "c,r", two of each tag along a row and a column, counted from the top left',
    lambda: {"april-grid": april_grid(6, 6, 0.088, 0.3)},
    from_arguments("april-grid", april_grid),
)
