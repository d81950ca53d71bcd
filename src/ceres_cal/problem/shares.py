"""Very many observations of the world, cut into shares that answer with sums.

A share is a part of the rows, in memory or in files, and is queried where it is: in this process, or on a worker. Its
answers are sums whose size does not grow with its rows: a compressed block (design, section 6), normal equations, a
histogram of residuals. No answer depends on anything that it keeps except its rows, so a lost share can be made again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import add
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from ceres_cal.base import AnyArray, Array, Frozen, Indices, Indices32, Mask, replace
from ceres_cal.observations import Curves, FileRows, Observations, Points, View, read_rows, rows_of
from ceres_cal.observations.files import Content
from ceres_cal.observations.sights import Owner, SightKey, Sights, column_of, shown_rows, sights_of
from ceres_cal.problem.costs import Run, SightCost
from ceres_cal.problem.parameters import Estimate, Layout
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.reduced import normals_of
from ceres_cal.problem.residuals import relative_lengths, residuals
from ceres_cal.scene.targets import Target

# Bins of a histogram of lengths in stated sigmas, up to 2e7: lower edge, logarithmic width, number of bins.
_LEAST, _WIDTH, _BINS = 1e-6, 0.00375, 8192


class Histogram(Frozen):
    """A histogram of lengths: (B,) numbers of lengths, and (B,) sums of their squares."""

    counts: Indices
    squares: Array

    @classmethod
    def of(cls, lengths: Array) -> Histogram:
        """The histogram of the finite lengths."""
        seen = lengths[np.isfinite(lengths)]
        bins = _bin_of(seen)
        squares = np.asarray(np.bincount(bins, seen**2, minlength=_BINS), dtype=float)
        return cls(np.bincount(bins, minlength=_BINS), squares)

    def __add__(self, other: Histogram) -> Histogram:
        return Histogram(self.counts + other.counts, self.squares + other.squares)

    @property
    def count(self) -> int:
        """The number of lengths."""
        return int(self.counts.sum())

    def middle(self) -> float:
        """The median of the lengths; 0 if there are none."""
        total = np.cumsum(self.counts)
        middle = np.searchsorted(total, total[-1] // 2 + 1)
        return float(_LEAST * np.exp((middle + 0.5) * _WIDTH)) if total[-1] else 0.0

    def within(self, bound: float) -> tuple[int, float]:
        """Number and sum of squares of the lengths up to the bound, to the width of a bin."""
        last = int(_bin_of(np.array([bound]))[0])
        return int(self.counts[:last].sum()), float(self.squares[:last].sum())


def _bin_of(lengths: Array) -> Indices32:
    """The number of the bin of each length."""
    with np.errstate(divide="ignore"):
        place = (np.log(lengths) - np.log(_LEAST)) / _WIDTH
    return np.asarray(np.clip(place, 0.0, _BINS - 1.0), dtype=np.int32)


class ResidualSummary(Frozen):
    """A summary of residuals.

    Attributes:
        points, curves: histograms of their lengths in stated sigmas.
        view: (n,) numbers of the views. equations, squares: (n,) number of equations within the bounds in each view,
            and sum of their squared lengths. beyond: (n,) number of observations beyond the bounds.
    """

    points: Histogram
    curves: Histogram
    view: Indices
    equations: Indices
    squares: Array
    beyond: Indices

    def __add__(self, other: ResidualSummary) -> ResidualSummary:
        each = zip(list(vars(self).values())[2:], list(vars(other).values())[2:], strict=True)
        return ResidualSummary(self.points + other.points, self.curves + other.curves, *map(np.concatenate, each))


class ByKey(Frozen):
    """Matrices by key, and the function that combines two of the same key; None if an observation cannot be
    projected.
    """

    of: Mapping[Any, Array] | None
    together: Callable[[Array, Array], Array]

    def __add__(self, other: ByKey) -> ByKey:
        if self.of is None or other.of is None:
            return replace(self, of=None)
        shared = {key: self.together(self.of[key], other.of[key]) for key in self.of.keys() & other.of.keys()}
        return replace(self, of={**self.of, **other.of, **shared})


class RowSelection(Frozen):
    """The rows that take part, as sums, and those that do not.

    Attributes:
        sums: (2, 3) of points and of curve observations that take part: their number, and the sums of squared residuals
            and of squared sigmas, px^2.
        rows, sigmas: of points and of curve observations that take no part: row numbers, and lengths in stated sigmas.
    """

    sums: Array
    rows: tuple[Indices, Indices]
    sigmas: tuple[Array, Array]

    def __add__(self, other: RowSelection) -> RowSelection:
        rows, sigmas = (
            tuple(np.concatenate(pair) for pair in zip(mine, theirs, strict=True))
            for mine, theirs in ((self.rows, other.rows), (self.sigmas, other.sigmas))
        )
        return RowSelection(self.sums + other.sums, (rows[0], rows[1]), (sigmas[0], sigmas[1]))


def compressed(*blocks: Array) -> Array:
    """(K + 1, K + 1) upper triangle with the same products as the stacked rows (N, K + 1) of the blocks."""
    rows = np.vstack(blocks)
    size = rows.shape[1]
    triangle = np.linalg.qr(np.vstack([rows, np.zeros((max(size - len(rows), 0), size))]), mode="r")
    return np.asarray(triangle)


# ---- requests -------------------------------------------------------------------------------------------------------

# Share of the outliers' bounds above which residuals are remembered one by one, so that the bounds may change.
_FAR = 0.5
_ROWS = 1 << 19  # rows of a share: the intermediate arrays of an answer take some 100 MB


class ShareRequest(NamedTuple):
    """The request to a share: what it needs to know of a problem.

    Attributes:
        estimate, layout, weighting: of the problem. judged_at: name and estimate whose residuals decide which rows take
            part.
        bounds: of points and of curve observations, lengths in stated sigmas beyond which they take no part.
        feet_along: names and estimates at which feet were searched, each from the feet before; the last feet serve all
            other searches.
    """

    estimate: Estimate
    layout: Layout
    weighting: Weighting
    judged_at: tuple[str, Estimate]
    bounds: tuple[float, float]
    feet_along: tuple[tuple[str, Estimate], ...]


class _RowBounds(Frozen):
    """The data that decide which rows take part at an estimate.

    Attributes:
        name: of the estimate. bounds: those that were requested. far: rows of points and of curve observations beyond
            the share _FAR of the bounds, and their lengths in stated sigmas. sums: (2, 3) of the other rows, see
            `RowSelection`.
    """

    name: str
    bounds: tuple[float, float]
    far: Sequence[tuple[Indices, Array]]
    sums: Array

    def will_do(self, asked: ShareRequest) -> bool:
        """Whether these data suffice for the estimate and the bounds of another request."""
        return self.name == asked.judged_at[0] and all(
            now >= _FAR * then for now, then in zip(asked.bounds, self.bounds, strict=True)
        )

    def taking_part(self, every: Content, asked: ShareRequest) -> tuple[Mask, Mask]:
        """(n,) and (m,) masks of the points and of the curve observations that take part."""
        points, curves = np.ones(len(every.points), dtype=bool), np.ones(len(every.curves), dtype=bool)
        for mask, bound, (rows, lengths) in zip((points, curves), asked.bounds, self.far, strict=True):
            mask[rows[~(lengths <= bound)]] = False
        return points, curves


def _sums(lengths_px: Array, sigma_px: Array) -> tuple[float, float, float]:
    """The number of rows, the sum of squared lengths and the sum of squared sigmas."""
    return float(len(lengths_px)), float(lengths_px @ lengths_px), float(sigma_px @ sigma_px)


# ---- a share --------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Share:
    """Consecutive rows of points and of curve observations.

    Attributes:
        targets: all targets. views: those that the share shows; the first has the number `first_view`. first_rows: the
            first row of points and of curve observations. points, curves: columns by name.
        left_out: (n,) of points and (m,) of curve observations: True for rows that do not count; None if all count.
    """

    targets: Mapping[str, Target]
    views: tuple[View, ...]
    first_view: int
    first_rows: tuple[int, int]
    points: Mapping[str, AnyArray | FileRows]
    curves: Mapping[str, AnyArray | FileRows]
    left_out: tuple[Mask, Mask] | None = None

    def __post_init__(self) -> None:
        self._feet: tuple[str, NDArray[np.float32]] | None = None  # name of the estimate, and the feet found there
        self._judged: _RowBounds | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_feet": None, "_judged": None}

    def _world(self) -> Sights:
        """The sights of the world in the share."""
        points, curves = (
            {name: read_rows(column) for name, column in columns.items()} for columns in (self.points, self.curves)
        )
        for columns in (points, curves):
            columns["view"] = columns["view"] - np.int32(self.first_view)
        content = Content(self.targets, {}, self.views, Points(**points), Curves(**curves))
        sights = sights_of(cast("Observations", content))  # they were checked when they were read
        return sights.take(sights.numbers(placements=(None,)))

    def _counted(self, world: Sights) -> Sights:
        """The sights without rows that do not count."""
        return world if self.left_out is None else world.used(*(~mask for mask in self.left_out))

    def _feet_of(self, sights: Sights, asked: ShareRequest) -> Array:
        """(m,) initial feet of a search, remembered or found again: no answer depends on which."""
        names = [name for name, _ in asked.feet_along]
        known = self._feet if self._feet is not None and self._feet[0] in names else None
        feet = None if known is None else known[1].astype(float)
        for name, estimate in asked.feet_along[names.index(known[0]) + 1 if known else 0 :]:
            kept = residuals(sights, estimate, feet).feet.astype(np.float32)
            self._feet, feet = (name, kept), kept.astype(float)
        assert feet is not None
        return feet

    def _lengths(self, sights: Sights, asked: ShareRequest) -> tuple[Array, Array]:
        """(n,) and (m,) lengths of the residuals, in stated sigmas, at the estimate at which rows are judged. The data
        that decide which rows take part are remembered.
        """
        name, estimate = asked.judged_at
        there = residuals(sights, estimate, self._feet_of(sights, asked))
        lengths, sums, far = relative_lengths(sights.observations, there), [], []
        columns = sights.observations.points, sights.observations.curves
        for column, px, own, bound in zip(columns, there.lengths, lengths, asked.bounds, strict=True):
            rows = np.flatnonzero(~(own <= _FAR * bound))
            far.append((rows, own[rows]))
            sums.append(_sums(np.delete(px, rows), np.delete(column.sigma_px, rows)))
        self._judged = _RowBounds(name, asked.bounds, far, np.array(sums))
        return lengths

    def _judged_by(self, sights: Sights, asked: ShareRequest) -> _RowBounds:
        """The data that decide which rows take part, remembered ones if they suffice."""
        known = self._judged
        if known is None or not known.will_do(asked):
            self._lengths(sights, asked)
        assert self._judged is not None
        return self._judged

    # ---- answers ----------------------------------------------------------------------------------------------------

    def looked(self, asked: ShareRequest) -> ResidualSummary:
        """The summary of the residuals at the estimate at which rows are judged."""
        sights = self._counted(self._world())
        points, curves = self._lengths(sights, asked)
        there, (p, c) = shown_rows(sights), asked.bounds
        view = column_of(sights.observations, "view")
        inside = np.concatenate([points <= p, curves <= c])
        relative = np.concatenate([points / asked.weighting.point_scale, curves / asked.weighting.curve_scale])[inside]
        count, size = np.where(np.arange(len(view)) < len(points), 2, 1), len(self.views)
        return ResidualSummary(
            Histogram.of(points),
            Histogram.of(curves),
            self.first_view + np.arange(size),
            np.bincount(view[inside], count[inside], size),
            np.asarray(np.bincount(view[inside], relative**2, size), dtype=float),
            np.bincount(view[there & ~inside], minlength=size),
        )

    def blocks(self, asked: ShareRequest, numbers: Mapping[Owner, Array]) -> ByKey:
        """Compressed blocks (K + 1, K + 1) by sight for some numbers, with the residual last."""
        answers: dict[SightKey, Array] = {}
        for sight, problem in self._problems(asked):
            cost = SightCost(Run(), sight, problem, asked.estimate)
            rows = cost.block([numbers[owner] for owner in cost.owners])
            if rows is None:
                return ByKey(None, compressed)
            answers[sight.key] = compressed(rows)
        return ByKey(answers, compressed)

    def normals(self, asked: ShareRequest) -> ByKey:
        """Normal equations, by sight and kind, of the rows that take part at the estimate, see `problem.reduced`."""
        every = ((sight, normals_of(sight, problem, asked.estimate)) for sight, problem in self._problems(asked))
        return ByKey({(sight.key, kind): own for sight, kinds in every for kind, own in kinds.items()}, add)

    def used(self, asked: ShareRequest) -> RowSelection:
        """The rows that take part, and how far off the others are."""
        world = self._world()
        content, judged = world.observations, self._judged_by(self._counted(world), asked)
        shown = np.split(shown_rows(world), [len(content.points)])
        sums, rows, sigmas = judged.sums.copy(), [], []
        for kind, column in enumerate((content.points, content.curves)):
            far, lengths = judged.far[kind]
            inside, sigma_px = lengths <= asked.bounds[kind], column.sigma_px[far]
            sums[kind] += _sums((lengths * sigma_px)[inside], sigma_px[inside])
            out = ~inside & shown[kind][far]
            rows.append(self.first_rows[kind] + far[out])
            sigmas.append(lengths[out])
        return RowSelection(sums, (rows[0], rows[1]), (sigmas[0], sigmas[1]))

    def _problems(self, asked: ShareRequest) -> Iterator[tuple[Sights, Problem]]:
        """Each sight with the rows that take part, and its problem."""
        sights = self._counted(self._world())
        part = sights.used(*self._judged_by(sights, asked).taking_part(sights.observations, asked))
        feet = self._feet_of(sights, asked)
        problem = Problem(part, asked.layout, (), asked.weighting, feet=feet)
        return ((sight, problem) for sight in part)


def cut(observations: Observations, left_out: tuple[Mask, Mask] | None = None) -> Iterator[Share]:
    """Cut the observations of targets that lie in the world into shares of whole views."""
    points, curves = observations.points, observations.curves
    for first, last in _ranges(observations):
        (p, q), (c, d) = ((int(ends[first]), int(ends[last])) for ends in observations.ends)
        own = [
            {name: rows_of(array, start, stop) for name, array in vars(column).items()}
            for column, start, stop in ((points, p, q), (curves, c, d))
        ]
        out = None if left_out is None else (left_out[0][p:q], left_out[1][c:d])
        yield Share(observations.targets, observations.views[first:last], first, (p, c), own[0], own[1], out)


def _ranges(observations: Observations) -> list[tuple[int, int]]:
    """First view of each share, and the one after its last."""
    before = observations.ends[0] + observations.ends[1]
    stops = np.searchsorted(before, np.arange(_ROWS, int(before[-1]), _ROWS))
    return list(pairwise(dict.fromkeys([0, *stops.tolist(), len(observations.views)])))
