"""Grids: checkerboards, OpenCV's grids of dark circles, Kalibr's AprilGrid, and lines of tape on a floor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import product

import numpy as np

from ceres_cal.base import InputError, checked, two_digits
from ceres_cal.scene.curves import Curve, Segment
from ceres_cal.scene.targets.target import Grid, Paper, Shape, Target, TargetKind, from_arguments, require_size


def _require_counts(kind: str, what: str, columns: int, rows: int, least: int = 2) -> None:
    if min(columns, rows) < least:
        counts = f"{columns} and {rows}"
        raise InputError(f"{kind}: columns and rows count {what}, at least {least}, not {counts}")


# ---- checkerboards --------------------------------------------------------------------------------------------------


@checked
def checkerboard(columns: int, rows: int, square_m: float) -> Target:
    """The inner corners of a checkerboard: feature "c,r" lies at (c, r, 0) squares, c < columns, r < rows.

    Raises:
        InputError: fewer than 2 corners a side, more than MOST_FEATURES, or a square that is no positive number.
    """
    _require_counts("checkerboard", "inner corners", columns, rows)
    require_size(columns * rows, "checkerboard")
    if not (np.isfinite(square_m) and square_m > 0.0):
        raise InputError(f"checkerboard: square_m must be a positive number of metres, not {square_m}")
    grid = Grid(int(columns), int(rows), float(square_m), checkered=True)
    spec = {"kind": "checkerboard", "columns": grid.columns, "rows": grid.rows, "square_m": grid.spacing_m}
    points = {f"{c},{r}": (c * square_m, r * square_m, 0.0) for r in range(rows) for c in range(columns)}
    paper = Paper(
        (-2.0 * grid.spacing_m, -2.0 * grid.spacing_m),
        ((grid.columns + 1) * grid.spacing_m, (grid.rows + 1) * grid.spacing_m),
        partial(checkered, grid),
    )
    sizes = {"square_m": grid.spacing_m}
    return Target(spec, points, {}, movable=True, bows=True, grid=grid, paper=paper, dimensions=sizes)


def checkered(grid: Grid, parity: int = 0) -> Iterator[Shape]:
    """Yield the dark squares, one more on each side than corners: that between "0,0" and "1,1" has parity 0."""
    for row, column in product(range(-1, grid.rows), range(-1, grid.columns)):
        if (row + column) % 2 == parity:
            yield Shape((column * grid.spacing_m, row * grid.spacing_m), grid.spacing_m)


CHECKERBOARD = TargetKind(
    "checkerboard",
    "the inner corners of a checkerboard",
    "columns and rows (inner corners), square_m",
    'points "c,r" at (c, r, 0) squares, c from 0 to columns - 1, r from 0 to rows - 1',
    lambda: {"checkerboard": checkerboard(9, 6, 0.025)},
    from_arguments("checkerboard", checkerboard),
)


# ---- circles: in columns and rows, or every other row half a step aside ---------------------------------------------


@checked
def circle_grid(columns: int, rows: int, spacing_m: float, diameter_m: float, *, asymmetric: bool = False) -> Target:
    """The centres of a grid of circles, features "c,r", c < columns, r < rows.

    Centre "c,r" lies at (c, r, 0) spacings; of an asymmetric grid at (2 c + r mod 2, r, 0), as OpenCV counts them: the
    spacing is half the distance between circles of one row.

    Raises:
        InputError: fewer than 2 circles a side, more than MOST_FEATURES, a spacing that is no positive number, or
            circles that meet.
    """
    _require_counts("circle-grid", "circles", columns, rows)
    require_size(columns * rows, "circle-grid")
    if not (np.isfinite(spacing_m) and spacing_m > 0.0):
        raise InputError(f"circle-grid: spacing_m must be a positive number of metres, not {spacing_m}")
    apart_m = float(spacing_m) * (np.sqrt(2.0) if asymmetric else 1.0)
    if not 0.0 < diameter_m < apart_m:
        raise InputError(
            f"circle-grid: diameter_m must be above 0 and below the {two_digits(apart_m, 4)} m between circles"
        )
    size = Grid(int(columns), int(rows), float(spacing_m))
    spec = {
        "kind": "circle-grid",
        "columns": size.columns,
        "rows": size.rows,
        "spacing_m": size.spacing_m,
        "diameter_m": float(diameter_m),
        "asymmetric": bool(asymmetric),
    }
    step = 2 if asymmetric else 1
    places = {
        f"{c},{r}": ((step * c + (r % 2 if asymmetric else 0)) * spacing_m, r * spacing_m, 0.0)
        for r in range(rows)
        for c in range(columns)
    }
    flat, border = np.array(list(places.values()))[:, :2], apart_m
    paper = Paper(
        (-border, -border),
        (float(flat[:, 0].max() + border), float(flat[:, 1].max() + border)),
        partial(_discs, places, 0.5 * float(diameter_m)),
    )
    sizes, shown = {"spacing_m": size.spacing_m}, None if asymmetric else size
    return Target(spec, places, {}, movable=True, bows=True, grid=shown, paper=paper, dimensions=sizes)


def _discs(places: Mapping[str, tuple[float, float, float]], radius_m: float) -> Iterator[Shape]:
    for x, y, _ in places.values():
        yield Shape((x, y), radius_m, is_round=True)


CIRCLE_GRID = TargetKind(
    "circle-grid",
    "the centres of a grid of circles",
    "columns and rows (circles), spacing_m, diameter_m, asymmetric (every other row shifted by half a step, OpenCV's)",
    'points "c,r" at (c, r, 0) spacings, or (2 c + r mod 2, r, 0) of an asymmetric grid',
    lambda: {"circle-grid": circle_grid(4, 11, 0.02, 0.016, asymmetric=True)},
    from_arguments("circle-grid", circle_grid),
)


# ---- tags, with small dark squares where their corners nearly meet --------------------------------------------------


@checked
def april_grid(columns: int, rows: int, tag_m: float, gap: float) -> Target:
    """The corners of the tags: feature "c,r" counts them from the top left, c < 2 columns, r < 2 rows.

    Args:
        columns: of tags, Kalibr's tagCols. rows: Kalibr's tagRows. Tags count from the bottom left, row by row.
        tag_m: side of a tag's dark border, Kalibr's tagSize. gap: between tags, over tag_m, Kalibr's tagSpacing.

    Raises:
        InputError: no tags, more than MOST_FEATURES corners, or sizes that are no positive numbers.
    """
    _require_counts("april-grid", "tags", columns, rows, 1)
    require_size(4 * columns * rows, "april-grid")
    if not (np.isfinite(tag_m) and tag_m > 0.0 and np.isfinite(gap) and gap > 0.0):
        raise InputError(f"april-grid: tag_m and gap must be positive numbers, not {tag_m} and {gap}")
    x, y = ([(n // 2 * (1.0 + gap) + n % 2) * tag_m for n in range(2 * count)] for count in (columns, rows))
    points = {f"{c},{r}": (x[c], y[r], 0.0) for r in range(2 * rows) for c in range(2 * columns)}
    numbers = {"columns": int(columns), "rows": int(rows), "tag_m": float(tag_m), "gap": float(gap)}
    sizes = {"tag_m": float(tag_m)}
    return Target({"kind": "april-grid", **numbers}, points, {}, movable=True, bows=True, dimensions=sizes)


APRIL_GRID = TargetKind(
    "april-grid",
    "the corners of the tags of Kalibr's AprilGrid",
    "columns and rows (tags), tag_m, gap (between tags, over tag_m)",
    'points "c,r", two of each tag along a row and a column, counted from the top left',
    lambda: {"april-grid": april_grid(6, 6, 0.088, 0.3)},
    from_arguments("april-grid", april_grid),
)


# ---- lines of tape at even distances both ways ----------------------------------------------------------------------


@checked
def tape_grid(columns: int, rows: int, pitch_m: float, line_thickness_m: float) -> Target:
    """Lines "column_c" at x = c pitches and "row_r" at y = r pitches, and points "c,r" where they cross.

    Args:
        columns: lines along y, at least two. rows: lines along x, at least two.
        pitch_m: distance between the centres of neighbouring lines.

    Raises:
        InputError: fewer than two lines a way, more than MOST_FEATURES crossings, or lengths that are no positive
            numbers.
    """
    _require_counts("tape-grid", "lines", columns, rows)
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


TAPE_GRID = TargetKind(
    "tape-grid",
    "a plain grid of tape on the floor: x along its rows, the first crossing at 0, 0",
    "columns and rows (lines), pitch_m (between their centres), line_thickness_m",
    'lines "column_0", ... at x = c pitches and "row_0", ... at y = r pitches, points "c,r" where they cross',
    lambda: {"tape-grid": tape_grid(5, 4, 0.5, 0.02)},
    from_arguments("tape-grid", tape_grid),
)
