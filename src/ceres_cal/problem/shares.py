"""Very many observations of the world in shares, each of which answers with sums.

A share is some of the rows, in memory or in files, and is asked where it is: by this process, or by a worker that has
it. What it answers are sums, which do not grow with its rows: a compressed block (design, section 6), normal equations,
a histogram of residuals. It keeps nothing that an answer depends on but its rows, so one that is lost is made again.
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

# Bins of a histogram of lengths in stated sigmas, to 2e7: from which on one is, and how much wider than the last.
_LEAST, _WIDTH, _BINS = 1e-6, 0.00375, 8192


class Histogram(Frozen):
    """Lengths by their size: (B,) how many, and (B,) the sum of their squares."""

    counts: Indices
    squares: Array

    @classmethod
    def of(cls, lengths: Array) -> Histogram:
        """Of those that are finite."""
        seen = lengths[np.isfinite(lengths)]
        bins = _bin_of(seen)
        squares = np.asarray(np.bincount(bins, seen**2, minlength=_BINS), dtype=float)
        return cls(np.bincount(bins, minlength=_BINS), squares)

    def __add__(self, other: Histogram) -> Histogram:
        return Histogram(self.counts + other.counts, self.squares + other.squares)

    @property
    def count(self) -> int:
        """How many there are."""
        return int(self.counts.sum())

    def middle(self) -> float:
        """Their median; 0 of none."""
        total = np.cumsum(self.counts)
        middle = np.searchsorted(total, total[-1] // 2 + 1)
        return float(_LEAST * np.exp((middle + 0.5) * _WIDTH)) if total[-1] else 0.0

    def within(self, bound: float) -> tuple[int, float]:
        """Of those that are no longer, to the width of a bin: how many, and the sum of their squares."""
        last = int(_bin_of(np.array([bound]))[0])
        return int(self.counts[:last].sum()), float(self.squares[:last].sum())


def _bin_of(lengths: Array) -> Indices32:
    """Number of the bin of each."""
    with np.errstate(divide="ignore"):
        place = (np.log(lengths) - np.log(_LEAST)) / _WIDTH
    return np.asarray(np.clip(place, 0.0, _BINS - 1.0), dtype=np.int32)


class ResidualSummary(Frozen):
    """What residuals are like.

    Attributes:
        points, curves: their lengths in stated sigmas.
        view: (n,) numbers of the views. equations, squares: (n,) of what lies within the bounds in each, how many and
            their squared lengths. beyond: (n,) how many do not.
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
    """Matrices by key, and how two of one key become one; None where an observation cannot be projected."""

    of: Mapping[Any, Array] | None
    together: Callable[[Array, Array], Array]

    def __add__(self, other: ByKey) -> ByKey:
        if self.of is None or other.of is None:
            return replace(self, of=None)
        shared = {key: self.together(self.of[key], other.of[key]) for key in self.of.keys() & other.of.keys()}
        return replace(self, of={**self.of, **other.of, **shared})


class RowSelection(Frozen):
    """The rows that take part, and those that do not.

    Attributes:
        sums: (2, 3) of points and of curve observations that take part: how many, squared lengths and sigmas, px.
        rows, sigmas: of those that do not, points and curve observations: numbers, and lengths in stated sigmas.
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
    """(K + 1, K + 1) upper triangle with the same products as the rows (N, K + 1) of blocks."""
    rows = np.vstack(blocks)
    size = rows.shape[1]
    triangle = np.linalg.qr(np.vstack([rows, np.zeros((max(size - len(rows), 0), size))]), mode="r")
    return np.asarray(triangle)


# ---- what is asked --------------------------------------------------------------------------------------------------

# Of the bounds of outliers: longer residuals are remembered, so that bounds may move.
_FAR = 0.5
_ROWS = 1 << 19  # of a share: what is made of them for an answer takes some 100 MB


class ShareRequest(NamedTuple):
    """What a share needs to know of a problem to answer.

    Attributes:
        estimate, layout, weighting: of the problem. judged_at: where residuals say which rows take part, and its name.
        bounds: of points and of curve observations, the lengths in stated sigmas from which on they do not.
        feet_along: places, by name, at each of which feet were sought from those before: from the last, all others are.
    """

    estimate: Estimate
    layout: Layout
    weighting: Weighting
    judged_at: tuple[str, Estimate]
    bounds: tuple[float, float]
    feet_along: tuple[tuple[str, Estimate], ...]


class _RowBounds(Frozen):
    """What decides which rows take part at a place.

    Attributes:
        name: of the place. bounds: that were asked for. far: rows of points and of curve observations beyond a share of
            them, and their lengths in stated sigmas. sums: (2, 3) of the others, see `RowSelection`.
    """

    name: str
    bounds: tuple[float, float]
    far: Sequence[tuple[Indices, Array]]
    sums: Array

    def will_do(self, asked: ShareRequest) -> bool:
        """Whether other bounds in the same place need nothing else."""
        return self.name == asked.judged_at[0] and all(
            now >= _FAR * then for now, then in zip(asked.bounds, self.bounds, strict=True)
        )

    def taking_part(self, every: Content, asked: ShareRequest) -> tuple[Mask, Mask]:
        """(n,) of points and (m,) of curve observations."""
        points, curves = np.ones(len(every.points), dtype=bool), np.ones(len(every.curves), dtype=bool)
        for mask, bound, (rows, lengths) in zip((points, curves), asked.bounds, self.far, strict=True):
            mask[rows[~(lengths <= bound)]] = False
        return points, curves


def _sums(lengths_px: Array, sigma_px: Array) -> tuple[float, float, float]:
    """How many there are, and the sums of squares."""
    return float(len(lengths_px)), float(lengths_px @ lengths_px), float(sigma_px @ sigma_px)


# ---- a share --------------------------------------------------------------------------------------------------------


@dataclass(eq=False)
class Share:
    """Consecutive rows of points and of curve observations.

    Attributes:
        targets: of all. views: that it shows, the first of them with the number `first_view`. first_rows: of points and
            of curve observations. points, curves: columns by name. left_out: (n,) of points, (m,) of curve
            observations: True for what does not count; None where all of them do.
    """

    targets: Mapping[str, Target]
    views: tuple[View, ...]
    first_view: int
    first_rows: tuple[int, int]
    points: Mapping[str, AnyArray | FileRows]
    curves: Mapping[str, AnyArray | FileRows]
    left_out: tuple[Mask, Mask] | None = None

    def __post_init__(self) -> None:
        self._feet: tuple[str, NDArray[np.float32]] | None = None  # and the name of where they are
        self._judged: _RowBounds | None = None

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_feet": None, "_judged": None}

    def _world(self) -> Sights:
        """The sights of the world in it."""
        points, curves = (
            {name: read_rows(column) for name, column in columns.items()} for columns in (self.points, self.curves)
        )
        for columns in (points, curves):
            columns["view"] = columns["view"] - np.int32(self.first_view)
        content = Content(self.targets, {}, self.views, Points(**points), Curves(**curves))
        sights = sights_of(cast("Observations", content))  # which were checked when they were read
        return sights.take(sights.numbers(placements=(None,)))

    def _counted(self, world: Sights) -> Sights:
        """The same without what does not count."""
        return world if self.left_out is None else world.used(*(~mask for mask in self.left_out))

    def _feet_of(self, sights: Sights, asked: ShareRequest) -> Array:
        """(m,) where the search for feet starts, known from before or found again: no answer depends on which."""
        names = [name for name, _ in asked.feet_along]
        known = self._feet if self._feet is not None and self._feet[0] in names else None
        feet = None if known is None else known[1].astype(float)
        for name, estimate in asked.feet_along[names.index(known[0]) + 1 if known else 0 :]:
            kept = residuals(sights, estimate, feet).feet.astype(np.float32)
            self._feet, feet = (name, kept), kept.astype(float)
        assert feet is not None
        return feet

    def _lengths(self, sights: Sights, asked: ShareRequest) -> tuple[Array, Array]:
        """(n,) and (m,) lengths of the residuals where the rows are judged, in stated sigmas; what decides which take
        part is remembered.
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
        """What decides which rows take part, from before where that will do."""
        known = self._judged
        if known is None or not known.will_do(asked):
            self._lengths(sights, asked)
        assert self._judged is not None
        return self._judged

    # ---- answers ----------------------------------------------------------------------------------------------------

    def looked(self, asked: ShareRequest) -> ResidualSummary:
        """What the residuals are like where the rows are judged."""
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
        """Compressed blocks (K + 1, K + 1) by sight at some numbers, the residual last."""
        answers: dict[SightKey, Array] = {}
        for sight, problem in self._problems(asked):
            cost = SightCost(Run(), sight, problem, asked.estimate)
            rows = cost.block([numbers[owner] for owner in cost.owners])
            if rows is None:
                return ByKey(None, compressed)
            answers[sight.key] = compressed(rows)
        return ByKey(answers, compressed)

    def normals(self, asked: ShareRequest) -> ByKey:
        """Normal equations by sight and kind of the rows that take part, at the estimate, see `problem.reduced`."""
        every = ((sight, normals_of(sight, problem, asked.estimate)) for sight, problem in self._problems(asked))
        return ByKey({(sight.key, kind): own for sight, kinds in every for kind, own in kinds.items()}, add)

    def used(self, asked: ShareRequest) -> RowSelection:
        """Which rows take part, and how far off the others are."""
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
    """The observations of targets that lie in the world, in shares of whole views."""
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
    """First view and the one after the last of each share."""
    before = observations.ends[0] + observations.ends[1]
    stops = np.searchsorted(before, np.arange(_ROWS, int(before[-1]), _ROWS))
    return list(pairwise(dict.fromkeys([0, *stops.tolist(), len(observations.views)])))
