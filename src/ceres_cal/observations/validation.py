"""Checks of observations: pixels outside their image, impossible sigmas and sizes, and repeated rows.

A few pixels outside an image are strays; many mean that the image size is wrong.

Observations may be repeated: the same rows again, the same frame under another name, one file given twice.

Two measurements of one thing never agree in every bit of a sub-pixel position, and two that are rounded to the same
number share the rounding error. In both cases the second adds no information, and counting it would shrink every
standard deviation. Copies are found bit for bit: a row that repeats a row of the same frame, or a whole view that
repeats an earlier view of the same target from the same station. A single row that is repeated in another frame is no
copy: a static camera and a detector of whole pixels may well produce it.

A board that is held still in a video hardly differs from frame to frame either: far less than the noise that is stated.
So most of the noise is the same in these frames, and they count once, too. Frames of a field are not looked at: a fixed
camera sees it in the same place each time, and if no noise was stated, 1 px may be far more than it is.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ceres_cal.base import Array, Frozen, Indices, InputError, Mask, cached_property, first_of, median, numbers_of
from ceres_cal.base.words import printable
from ceres_cal.observations.columns import Columns, Curves, Points, View, each_block, in_blocks, view_label
from ceres_cal.observations.files import Content

# The image ends half a pixel beyond the centres of its outermost ones; a detector that interpolates may go one further.
_MARGIN_PX = 1.5
# Largest share of a camera's observations outside its image; if there are more, the image has another size.
_FEW = 0.01
_FAR = 10.0  # image diagonals: a pixel farther off was not measured, and its square dominates what was
# Largest size of a target in metres. The largest playing fields have 126 m from corner to corner; a board of 200 mm has
# this size in millimetres.
_LARGE_M = 200.0
# Distance from the origin of a target's coordinates, m, beyond which digits are lost: one in eight solves over a
# parking lot does not converge at this distance, none at a tenth of it, three in eight at ten times as far.
_REMOTE_M = 1e5
# Largest ratio of the sigmas: from ten pixels for a click to a thousandth of a pixel for a large target in the image.
# Beyond it one observation decides alone, and nothing contradicts it.
_SIGMA_RATIO = 1e4


def require_names(names: Mapping[str, Iterable[str]]) -> None:
    """Raise InputError where a name is not UTF-8, as arguments of a command line may be (no file could hold it), or
    where that of a target contains "/": its numbers have names "target/feature". Cameras of ROS are "pair/left".

    Args:
        names: by what has them.
    """
    for what, every in names.items():
        text = "".join(every)
        if text != printable(text):
            odd = next(printable(name) for name in every if name != printable(name))
            raise InputError(f"{what} '{odd}': a name must be UTF-8: give another one")
        if "/" in text and what == "target":
            odd = next(name for name in every if "/" in name)
            raise InputError(f"target {odd!r}: '/' separates a target from its features: give a name without it")


def require_alike(content: Content) -> None:
    """Raise InputError where a sigma differs so much from the others that its observation, or the others, have no
    effect.
    """
    columns = content.points, content.curves
    ends = [end for column in columns for end in each_block(_extremes, column.sigma_px)]
    if max(high for _, high in ends) <= _SIGMA_RATIO * min(low for low, _ in ends):
        return
    sigmas = np.concatenate([column.sigma_px for column in columns])
    usual_px = median(sigmas)
    row = int(np.argmax(np.abs(np.log(sigmas / usual_px))))
    raise InputError(
        f"{_label(content, row)}: its sigma_px is {sigmas[row]:g}, but {usual_px:g} is usual: sigmas may differ by a "
        f"factor of {_SIGMA_RATIO:.0f} at most: correct it, or leave the observation out"
    )


def _label(content: Content, row: int) -> str:
    """Name of an observation in messages, by its row among the points and then the curve observations."""
    kind, number = ("point", row) if row < len(content.points) else ("curve", row - len(content.points))
    column: Columns = content.points if kind == "point" else content.curves
    return f"{view_label(column.view[number], content.views)}, {kind} {content.feature_name(kind, number)!r}"


def _extremes(_: int, block: Array) -> tuple[float, float]:
    """Return the smallest and the largest value of a block."""
    return (float(block.min()), float(block.max())) if len(block) else (np.inf, 0.0)


def stray_pixels(content: Content) -> tuple[str, ...]:
    """Return one line for each camera of which a few observations lie outside its image.

    Raises:
        InputError: naming the first of them, where they are more than one in a hundred (and not a single one).
    """
    if _all_inside(content):
        return ()
    sizes = np.array([content.cameras[view.camera] for view in content.views])
    owners = np.array([view.camera for view in content.views])
    columns = content.points, content.curves
    view, pixels = np.concatenate([one.view for one in columns]), np.concatenate([one.pixels for one in columns])
    outside = np.any((pixels < -_MARGIN_PX) | (pixels > _end(sizes[view])), axis=1)
    lines = []
    for camera, size in content.cameras.items():
        mine = (owners == camera)[view]
        count, total = np.count_nonzero(outside & mine), np.count_nonzero(mine)
        if not count:
            continue
        far = mine & np.any(np.abs(pixels) > _FAR * float(np.hypot(*size)), axis=1)
        first = _label_at(content, int(np.argmax(far if far.any() else outside & mine)), pixels)
        if far.any():
            raise InputError(
                f"camera {camera!r}: its image is {size[0]} x {size[1]} px, but {first} lies {_FAR:.0f} image "
                "diagonals away: correct or remove it"
            )
        text = f"camera {camera!r}: {count} of {total} observations lie outside its image"
        if count > max(1.0, _FEW * total):
            raise InputError(f"{text}: {_cause(pixels[mine], size)}; the first is {first}")
        lines.append(f"{text} of {size[0]} x {size[1]} px, the first is {first}: correct or remove what lies outside")
    return tuple(lines)


def _all_inside(content: Content) -> bool:
    """Whether no pixel lies outside the smallest image."""
    ends = _end(np.min(list(content.cameras.values()), axis=0))

    def inside(_: int, pixels: Array) -> bool:
        each = zip(pixels.T, ends, strict=True)
        return not len(pixels) or all(own.min() >= -_MARGIN_PX and own.max() <= end for own, end in each)

    return all(all(each_block(inside, column.pixels)) for column in (content.points, content.curves))


def _end(size: Sequence[int] | Array) -> Array:
    return np.asarray(size) - 1.0 + _MARGIN_PX


def _cause(pixels: Array, size: Sequence[int]) -> str:
    """Return what the pixels show to be wrong with the image size, or with themselves."""
    (left, top), (right, bottom) = pixels.min(axis=0), pixels.max(axis=0)
    width, height = size
    if left < -_MARGIN_PX or top < -_MARGIN_PX:
        reach = f"pixels begin at ({left:.0f}, {top:.0f})"
        return f"{reach}, but (0, 0) is the centre of the top-left pixel, x to the right, y downwards: correct them"
    reach = f"pixels reach {right:.0f} x {bottom:.0f} but image_size is {width} x {height}"
    if width != height and np.all((right, bottom) <= _end((height, width))):
        return f"{reach}: width and height, or x and y, are swapped: correct that"
    return f"{reach}: give the size of the pictures in which the pixels were measured"


def _label_at(content: Content, row: int, pixels: Array) -> str:
    """Name of an observation with its pixel."""
    long = 1e6  # px: printed with an exponent
    at = ", ".join(f"{value:.1f}" if abs(value) < long else f"{value:g}" for value in pixels[row])
    return f"{_label(content, row)}: pixel ({at})"


def require_filled(content: Content) -> None:
    """Raise InputError where the observations of a camera all lie within a tenth of its image's width and height; the
    factor is that by which a pixel may lie outside. A solve with such a picture depends on rounding.
    """
    for odd in unfilled(content, 1.0 / _FAR):
        raise InputError(odd)


def unfilled(content: Content, corner: float = 0.25) -> Iterator[str]:
    """Yield one line for each camera whose observations all lie in a small corner of its image.

    Args:
        corner: share of either side; a board that is always held so far from the middle of the image is rare.
    """
    reach = dict.fromkeys(content.cameras, np.zeros(2))
    owners = np.array([view.camera for view in content.views])
    for column in (content.points, content.curves):
        for _, block in in_blocks(column):
            for camera in _within(content, reach, corner):  # for most cameras the first block is enough
                seen = block.pixels[(owners == camera)[block.view]]
                reach[camera] = np.maximum(reach[camera], np.max(seen, axis=0, initial=0.0))
    for camera in _within(content, reach, corner):
        (width, height), size = reach[camera], content.cameras[camera]
        yield (
            f"camera {camera!r}: observations reach only {width:.0f} x {height:.0f} px of an image of {size[0]} x "
            f"{size[1]}: check that image_size is the size of the pictures"
        )


def _within(content: Content, reach: Mapping[str, Array], corner: float) -> list[str]:
    """Return the cameras whose observations do not extend beyond a corner of their images."""
    return [name for name, size in content.cameras.items() if np.all(reach[name] < corner * np.array(size))]


def odd_sizes(content: Content) -> Iterator[str]:
    """Yield one line for each target so large that its numbers may be mm or cm, or so far from their origin that
    digits are lost.
    """
    for name, target in content.targets.items():
        size_m = float(np.linalg.norm(np.ptp(target.places, axis=0)))
        if size_m > _LARGE_M:
            yield f"target {name!r} is {size_m:.0f} m large: are its numbers metres, not cm or mm?"
        elif target.reach_m > _REMOTE_M:
            away = f"{1e-3 * target.reach_m:.0f} km from its coordinate origin"
            yield f"target {name!r} lies {away}, which loses precision: use an origin near it"


# ---- observations that are there twice ------------------------------------------------------------------------------

Hashes = NDArray[np.uint64]

# Large odd numbers without pattern, those of splitmix64, by which the parts of a row are multiplied.
_X, _FEATURE, _FRAME = (np.uint64(n) for n in (0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB))


class Copies(Frozen):
    """Which observations repeat others.

    Attributes:
        points, curves: (N,) and (M,) number of the view that each row is copied from; -1 for rows that are no copies.
    """

    points: Indices
    curves: Indices

    @property
    def are_there(self) -> bool:
        """Whether there are any copies."""
        return any(len(source) and source.strides[0] and np.any(source >= 0) for source in (self.points, self.curves))

    @cached_property
    def originals(self) -> tuple[Mask, Mask]:
        """(N,) and (M,) masks of the points and curve observations that count."""
        return self.points < 0, self.curves < 0

    def words(self, views: Sequence[View], columns: tuple[Columns, Columns]) -> Iterator[str]:
        """Yield what was counted once: a line for copied frames, and one for rows repeated within their frame."""
        if not self.are_there:
            return
        rows: Counter[tuple[str, str]] = Counter()
        for column, source in zip(columns, (self.points, self.curves), strict=True):
            copied = source >= 0
            for (view, first), count in Counter(zip(column.view[copied], source[copied], strict=True)).items():
                rows[views[view].frame, views[first].frame] += count
        frames = [pair for pair in rows if pair[0] != pair[1]]
        if frames:
            more = f", and so do {len(frames) - 1} other frames" if len(frames) > 1 else ""
            yield f"frame {frames[0][0]!r} repeats frame {frames[0][1]!r} far within the noise{more}: counted once"
        twice = {frame: count for (frame, first), count in rows.items() if frame == first}
        if twice:
            frame = first_of(list(map(repr, twice)))
            yield f"{sum(twice.values())} observations of frame {frame} are repeated: counted once"


def find_copies(views: Sequence[View], points: Points, curves: Curves) -> Copies:
    """Return which observations repeat earlier ones.

    Hashes of the rows show in half a millisecond for 1000 frames that there are none; where hashes agree, the rows
    themselves are compared.
    """
    columns: tuple[Columns, Columns] = (points, curves)
    least_rows = 4  # least number of rows of a copied view: fewer whole pixels agree by chance
    place = numbers_of((view.station, view.target, view.placement is None) for view in views)
    boards = np.array([view.placement is not None for view in views], dtype=bool)
    still = _still(columns, place, boards, least_rows)
    if not any(_may_repeat(column, place) for column in columns) and not still:
        none = [np.broadcast_to(np.int64(-1), len(column)) for column in columns]
        return Copies(none[0], none[1])
    sources = tuple(np.full(len(column), -1, dtype=np.int64) for column in columns)
    hashes = [_row_hashes(column) for column in columns]
    frame = numbers_of((view.frame, number) for view, number in zip(views, place, strict=True))
    for column, own, source in zip(columns, hashes, sources, strict=True):
        _mark_rows(column, own, frame, source)
    _mark_views(columns, hashes, place, sources, least_rows)
    for view, first in still.items():
        for column, source in zip(columns, sources, strict=True):
            rows = source[_rows_of(column, view)]
            rows[rows < 0] = first
    return Copies(*sources)


def _may_repeat(column: Columns, place: Indices) -> bool:
    """Whether rows within a block agree, or whole views anywhere."""
    of_views, repeat = np.zeros(len(place), dtype=np.uint64), False
    for views, sums, some in each_block(_looked_at, column):
        np.add.at(of_views, views, sums)
        repeat |= some
    if repeat:
        return True
    with_rows = np.flatnonzero(of_views)
    of_views = np.sort(of_views[with_rows] + place[with_rows].astype(np.uint64) * _FRAME)
    return bool(np.any(of_views[1:] == of_views[:-1]))


def _looked_at(_: int, block: Columns) -> tuple[Indices, Hashes, bool]:
    """Return the views of a block, the sum of the hashes of each one's rows, and whether any rows agree."""
    hashes = _row_hashes(block)
    if not len(hashes):
        return np.empty(0, dtype=np.int64), hashes, False
    starts = np.flatnonzero(np.diff(block.view, prepend=-1))
    sums = np.add.reduceat(hashes, starts)
    hashes.sort()
    return block.view[starts].astype(np.int64), sums, bool(np.any(hashes[1:] == hashes[:-1]))


def _still(columns: tuple[Columns, Columns], place: Indices, boards: Mask, least_rows: int) -> dict[int, int]:
    """Return views among `boards` (V,) that show what an earlier view of the same station and target shows, by the
    number of that view.
    """
    moved = 4.0  # standard deviations between two views' rows from which on the second surely shows another place
    views = np.arange(len(place))
    order = np.lexsort((views, place))
    before: Indices = np.full(len(place), -1, dtype=np.int64)
    before[order[1:]] = np.where(place[order[1:]] == place[order[:-1]], order[:-1], -1)
    near = np.zeros(len(place), dtype=bool)
    for column in columns:  # a look at one row of each view tells for most that they differ
        ends = np.searchsorted(column.view, np.arange(len(place) + 1))
        pairs = views[boards & (before >= 0) & (ends[1:] > ends[:-1]) & (ends[before + 1] > ends[before])]
        for row, other in ((ends[pairs], ends[before[pairs]]), (ends[pairs + 1] - 1, ends[before[pairs] + 1] - 1)):
            far_px = np.abs(column.pixels[row] - column.pixels[other]).max(axis=1, initial=0.0)
            near[pairs] |= (far_px < moved * column.sigma_px[row]) & (column.feature[row] == column.feature[other])
    first: dict[int, int] = {}
    for view in np.flatnonzero(near).tolist():
        earlier = first.get(int(before[view]), int(before[view]))
        if _shows_the_same(columns, view, earlier, least_rows):
            first[view] = earlier
    return first


def _shows_the_same(columns: tuple[Columns, Columns], view: int, earlier: int, least_rows: int) -> bool:
    """Whether most points of a view, and all its curve observations, are where they were in an earlier view."""
    # Most of the noise is the same in both: an eighth of its variance differs, all of it between other frames. Twins of
    # photographs with a noise of 2 grey levels differ by a seventh of the noise, other frames by 1.3 times it or more.
    still, most = 0.5, 0.8
    squares = []
    for column in columns:
        rows, others = (_rows_of(column, one) for one in (view, earlier))
        if isinstance(column, Curves):
            if column.feature[rows].tolist() != column.feature[others].tolist():
                return False
            own, other = np.arange(len(column.feature[rows])), np.arange(len(column.feature[others]))
        else:
            _, own, other = np.intersect1d(column.feature[rows], column.feature[others], return_indices=True)
            if len(own) < most * max(len(column.feature[rows]), len(column.feature[others])):
                return False
        moved = column.pixels[rows][own] - column.pixels[others][other]
        squares.append(np.sum(moved**2, axis=1) / (2.0 * column.sigma_px[rows][own] ** 2))
    both = np.concatenate(squares)
    return len(both) >= least_rows and float(np.mean(both)) < still**2


def _rows_of(column: Columns, view: int) -> slice:
    """The rows of a view."""
    return slice(*np.searchsorted(column.view, (view, view + 1)).tolist())


def _row_hashes(column: Columns) -> Hashes:
    """(N,) hash of each row without view and sigma: feature, side and both coordinates, to the last bit.

    Hashes of equal rows are equal; those of different rows hardly ever.
    """
    x, y = np.ascontiguousarray(column.pixels).view(np.uint64).T
    hashes = column.feature.astype(np.uint64)
    if isinstance(column, Curves):
        hashes += column.side.astype(np.uint64) << np.uint64(32)
    hashes *= _FEATURE
    hashes += y
    hashes += x * _X
    return hashes


def _repeated(hashes: Hashes) -> Mask:
    """(N,) whether the same hash occurs again."""
    _, number, count = np.unique(hashes, return_inverse=True, return_counts=True)
    return np.asarray(count[number] > 1)


def _parts(column: Columns, rows: Indices) -> tuple[NDArray[np.generic], ...]:
    """Return the content of these rows, each part as a column."""
    side = column.side[rows] if isinstance(column, Curves) else np.zeros(len(rows), np.int8)
    return (*column.pixels[rows].T, side, column.feature[rows])


def _mark_rows(column: Columns, hashes: Hashes, frame: Indices, source: Indices) -> None:
    """Mark rows that repeat an earlier one of the same frame; `frame` (V,) is the number of each view's frame."""
    rows = np.flatnonzero(_repeated(hashes + frame[column.view].astype(np.uint64) * _FRAME))
    said = (*_parts(column, rows), frame[column.view[rows]])
    order = np.lexsort(said)  # a stable sort: the earliest of equal rows comes first
    if not len(rows):
        return
    same = np.all([part[order][1:] == part[order][:-1] for part in said], axis=0)
    first = np.maximum.accumulate(np.where(np.concatenate([[False], same]), 0, np.arange(len(rows))))
    later = np.flatnonzero(first != np.arange(len(rows)))
    source[rows[order[later]]] = column.view[rows[order[first[later]]]]


def _mark_views(
    columns: tuple[Columns, Columns],
    hashes: Sequence[Hashes],
    place: Indices,
    sources: tuple[Indices, ...],
    least_rows: int,
) -> None:
    """Mark rows of views that repeat an earlier view of the same station and target entirely; `place` (V,) numbers
    these.
    """
    contents: list[list[Hashable]] = [[int(number)] for number in place]
    sizes, differs = np.zeros(len(place), dtype=np.int64), np.zeros(len(place), dtype=bool)
    own = [source < 0 for source in sources]
    for column, values, counts in zip(columns, hashes, own, strict=True):
        sizes += np.bincount(column.view[counts], minlength=len(place))
        differs[column.view[counts][~_repeated(values[counts])]] = True
    whole = np.flatnonzero((sizes >= least_rows) & ~differs)
    for column, counts in zip(columns, own, strict=True):
        rows = np.flatnonzero(counts & np.isin(column.view, whole))
        said = _parts(column, rows)
        order = np.lexsort((*said, column.view[rows]))
        ends = np.searchsorted(column.view[rows], whole), np.searchsorted(column.view[rows], whole, side="right")
        for view, start, stop in zip(whole, *ends, strict=True):
            contents[view] += [part[order[start:stop]].tobytes() for part in said]
    seen: dict[Hashable, int] = {}
    first = np.arange(len(place))
    for view in whole:
        first[view] = seen.setdefault(tuple(contents[view]), int(view))
    for column, counts, source in zip(columns, own, sources, strict=True):
        copied = counts & (first[column.view] != column.view)
        source[copied] = first[column.view[copied]]
