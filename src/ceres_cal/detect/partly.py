"""Chessboards that are partly outside the picture: which squares are seen, and which of the board's squares they are.

OpenCV finds a few squares anywhere, and corners are added around them where the picture has a saddle as strong as the
neighbouring one. On each side of what was found the board either ends in the picture or is cut off by the picture's
border. If only one position on the board is consistent with this, the corners are named.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product

import numpy as np

from ceres_cal.base.arrays import Array, Image, Mask, medians_known
from ceres_cal.detect.saddles import Saddles, fit_saddles, is_begun_dark, measure_saddles, steps_px

# Largest root mean square misfit of a saddle, as a share of its contrast: where the board ends dark squares meet the
# margin, which no saddle describes.
_MISFIT = 0.25
# Least contrast of a new corner, as a share of that of the known corner next to it.
_AS_STRONG = 0.75
_BORDER_PX = 3.0  # px from the picture's border; nearer to it a corner has too few pixels on one side
_CLEAR = 0.2  # share of the corners' spacing, from the border: a predicted corner may be off by less
# Limit of the contrast steps along a line of corners, as a share of those of the next line inside. On 82 real boards
# the outermost lines have 0.79 or more, with blur of 5 px or noise of 12 grey levels 0.66; lines beyond the board's end
# have 0.57 at most, with blur or noise 0.56.
_ENDED = 0.7
# Offsets from a corner, in squares: a corner is predicted to a tenth of a square.
_QUARTERS = np.array([-0.35, -0.2, 0.2, 0.35])
NO_PLACE = "do not fit on the board"


def part_of_board(image: Image, seed: Array, columns: int, rows: int) -> Array | str:
    """Return corners (rows, columns, 2) px, NaN where one is not seen, or the reason why there are none.

    Args:
        seed: (h, w, 2) px, right-handed: approximate positions of some neighbouring corners of the board.
    """
    grown = _grown(image, seed, max(columns, rows))
    if np.isnan(steps_px(grown.grid)).all():
        return f"no chessboard of {columns} x {rows} inner corners found, only isolated squares"
    places = list(_places(grown, image.shape, columns, rows))
    if len({missing for missing, _ in places}) != 1:
        width, height = sorted(grown.contrast.shape, reverse=columns >= rows)
        why = "fit on the board in several positions" if places else NO_PLACE
        found = f"but {width} x {height} corners, which {why}"
        return f"no chessboard of {columns} x {rows} inner corners found, {found}"
    return places[0][1]


def is_whole(image: Image, seen: Saddles) -> bool:
    """Whether the board ends exactly with the outer lines of the corners, as far as the picture shows. OpenCV finds a
    board within a larger one, and extends a smaller board over its margin.
    """
    steps = _steps_across(image, _foreseen(_padded(_clean(seen, image.shape).grid)))
    sides = (np.rot90(steps, turns)[:3] for turns in range(4))
    return all(_excess(edge, inner) >= 0.0 >= _excess(beyond, edge) for beyond, edge, inner in sides)


def _excess(line: Array, within: Array) -> float:
    """Sum over a line by which its contrast steps exceed the limit for a board's end, given those of the next line
    inside.
    """
    return -float(np.nansum(line * np.sign(within) + _ENDED * np.abs(within)))


def _steps_across(image: Image, grid: Array) -> Array:
    """(rows, columns) half the step between dark and bright around each corner; NaN where not all of it is in the
    picture. Where a board ends, two or three of the four quarters around a corner are alike, so the step is half of
    that inside.
    """
    # Outside the grid the steps of its outermost lines are used.
    rows, columns = ([0, *range(size - 2), size - 3] for size in grid.shape[:2])
    u, v = (np.gradient(grid[1:-1, 1:-1], axis=axis)[rows][:, columns, None, None] for axis in (1, 0))
    places = grid[..., None, None, :] + _QUARTERS[:, None] * u + _QUARTERS[:, None, None] * v
    inside = _inside(places, image.shape, 0.0)
    x, y = np.moveaxis(np.where(inside[..., None], places, 0.0).round().astype(int), -1, 0)
    levels = np.where(inside, image[y, x], np.nan) * np.sign(np.outer(_QUARTERS, _QUARTERS))
    return np.asarray(np.mean(levels, axis=(-2, -1)))


# ---- growing --------------------------------------------------------------------------------------------------------


def _grown(image: Image, seed: Array, most: int) -> Saddles:
    """Return all corners that are reached from the seed, at most `most` each way; all are measured once more at the
    end.
    """
    known = _trimmed(_clean(measure_saddles(image, seed), image.shape))
    for _ in range(2 * most):
        wider = Saddles(*map(_padded, vars(known).values()))
        unknown = np.isnan(wider.contrast)
        measured = _clean(fit_saddles(image, _foreseen(wider.grid), unknown), image.shape)
        fresh = unknown & _strong(measured.contrast, wider.contrast)
        if not np.any(fresh):
            break
        pairs = zip(vars(measured).values(), vars(wider).values(), strict=True)
        known = _trimmed(Saddles(*(np.where(fresh.T, new.T, old.T).T for new, old in pairs)))
    return _trimmed(_clean(measure_saddles(image, known.grid), image.shape))


def _clean(saddles: Saddles, shape: tuple[int, ...]) -> Saddles:
    """Leave out corners that are no saddle, or too near to the picture's border to be measured."""
    with np.errstate(invalid="ignore"):
        return saddles.without(~(_inside(saddles.grid, shape, _BORDER_PX) & (saddles.misfit < _MISFIT)))


def _padded(values: Array) -> Array:
    """Add one line of unknown corners on every side."""
    return np.pad(values, [(1, 1), (1, 1), *[(0, 0)] * (values.ndim - 2)], constant_values=np.nan)


def _trimmed(saddles: Saddles) -> Saddles:
    seen = ~np.isnan(saddles.contrast)
    if not np.any(seen):
        return saddles
    rows, columns = (np.flatnonzero(np.any(seen, axis=axis)) for axis in (1, 0))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    return Saddles(saddles.grid[part], saddles.contrast[part], saddles.misfit[part])


def _foreseen(grid: Array) -> Array:
    """Extrapolate unknown corners from the two or three corners before them on each line; the mean over the lines."""
    lines = [[_shifted(grid, axis, step * k) for k in (1, 2, 3)] for axis in (0, 1) for step in (1, -1)]
    bent = np.array([3.0 * first - 3.0 * second + third for first, second, third in lines])
    straight = np.array([2.0 * first - second for first, second, _ in lines])
    known = np.where(np.all(np.isnan(bent), axis=0), straight, bent)
    number = np.sum(~np.isnan(known), axis=0)
    return np.where(np.isnan(grid), np.nansum(known, axis=0) / np.where(number, number, np.nan), grid)


def _shifted(values: Array, axis: int, by: int) -> Array:
    """Shift values along an axis by `by` places; NaN beyond the ends."""
    moved = np.full_like(values, np.nan)
    to, of = (slice(by, None), slice(-by)) if by > 0 else (slice(by), slice(-by, None))
    moved.swapaxes(0, axis)[to] = values.swapaxes(0, axis)[of]
    return moved


def _strong(contrast: Array, known: Array) -> Mask:
    """Whether a corner's contrast is similar to that of a known corner beside it, with the opposite sign."""
    beside = np.array([-_shifted(known, axis, step) for axis in (0, 1) for step in (1, -1)])
    with np.errstate(invalid="ignore"):
        share = contrast / beside
        return np.asarray(np.any((share > _AS_STRONG) & (share < 1.0 / _AS_STRONG), axis=0))


def _inside(grid: Array, shape: tuple[int, ...], border_px: float) -> Mask:
    with np.errstate(invalid="ignore"):
        last = np.array([shape[1], shape[0]]) - 1.0 - border_px
        return np.asarray(np.all((grid >= border_px) & (grid <= last), axis=-1))


# ---- naming ---------------------------------------------------------------------------------------------------------


def _places(seen: Saddles, shape: tuple[int, ...], columns: int, rows: int) -> Iterator[tuple[tuple[int, ...], Array]]:
    """Yield every position on the board that the corners can have: the number of lines missing to the left, right, top
    and bottom of the picture's grid, and the board's grid.
    """
    ends = _ends(seen.grid, shape)
    height, width = seen.contrast.shape
    for turns in range(4):
        wide, high = (rows, columns) if turns % 2 else (columns, rows)
        for left, top in product(range(wide - width + 1), range(high - height + 1)):
            missing = (left, wide - width - left, top, high - height - top)
            if any(ended and lines for ended, lines in zip(ends, missing, strict=True)):
                continue
            around = ((top, missing[3]), (left, missing[1]))
            grid = np.rot90(np.pad(seen.grid, (*around, (0, 0)), constant_values=np.nan), turns)
            contrast = np.rot90(np.pad(seen.contrast, around, constant_values=np.nan), turns)
            # A quarter turn puts a bright square in place of a dark one.
            if (columns + rows) % 2 == 0 or is_begun_dark(contrast if turns % 2 == 0 else -contrast):
                yield missing, grid


def _ends(grid: Array, shape: tuple[int, ...]) -> list[bool]:
    """Whether the board ends to the left, right, top and bottom: the next line of corners would be well inside the
    picture, but is not there.
    """
    clear_px = _CLEAR * float(medians_known(steps_px(grid)))
    clear = _inside(_foreseen(_padded(grid)), shape, clear_px)
    return [bool(np.any(side)) for side in (clear[:, 0], clear[:, -1], clear[0], clear[-1])]
