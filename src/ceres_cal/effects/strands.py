"""Strands: equations whose errors may be correlated, of one curve, or of one image axis at one target's points.

Some views are enough: only a few numbers (a length, a share, a variance) that hold for all strands are estimated.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import pairwise

import numpy as np

from ceres_cal.base import AnyArray, Array, Frozen, Indices, Mask, cached_property, distinct, evenly, median
from ceres_cal.effects.linearised import Linearised, equation_weights, linearise_within
from ceres_cal.observations.sights import Sights, bounds_of
from ceres_cal.problem import Equations, Estimate, Problem, ReducedInformation, Residuals, equations_of

_MOST_ROWS = 1_500  # rows of a kind in a view


class Strand(Frozen):
    """Equations whose errors may be correlated: of one curve, or of one image axis at one target's points.

    Attributes:
        rows: (N,) equations of the sample. places: (N, 3) m, their places on the target.
    """

    rows: Indices
    places: Array

    @cached_property
    def shape(self) -> bytes:
        """A value that is equal for strands with equal places."""
        return self.places.tobytes()


def strands_of(equations: Equations, owner: Indices, rows: Indices) -> Iterator[Strand]:
    """The strands of each owner (E,), a view or a sight, in some rows: its curves, and image axes of its points."""
    name = strand_names(equations, owner)[rows]
    order = np.lexsort((equations.feature[rows], name))  # what one point shows in several views is side by side
    ends = np.flatnonzero(np.diff(name[order], append=-1)) + 1
    start = 0
    for end in ends.tolist():
        own, start = rows[order[start:end]], end
        places = equations.place[own]
        if equations.is_curve[own[0]]:
            along = np.argsort(places @ _along(places), kind="stable")
            own, places = own[along], places[along]
        yield Strand(own, places)


def strand_names(equations: Equations, owner: Indices) -> Indices:
    """(E,) number of the strand to which each equation belongs; owner: (E,) its view or sight."""
    axis = (equations.direction[:, 1] > 0.5).astype(np.int64)
    what = np.where(equations.is_curve, equations.feature + 2, axis)
    return np.asarray(owner * (what.max() + 1) + what)


def go_over_groups(equations: Equations, group: Indices) -> bool:
    """Whether a strand of some sight covers several groups (E,)."""
    names = strand_names(equations, equations.sight)
    return len(distinct(names * (int(group.max()) + 1) + group)) > len(distinct(names))


def families_of(model: Linearised, group: Indices, chosen: Mask) -> list[StrandFamily]:
    """The strands of curves or of points: within views and, where some sight has several views, over each whole sight.

    Args:
        group: (E,) the views or placements that are compared with one another. chosen: (E,) which equations.
    """
    equations = model.equations
    families, rows = [], np.flatnonzero(chosen)
    for lasting, owner in ((False, equations.view), (True, equations.sight)):
        if lasting and not _has_several_views(equations):
            continue
        if strands := list(strands_of(equations, owner, rows)):
            families.append(StrandFamily.of(strands, lasting, model.columns, group))
    return families


def _has_several_views(equations: Equations) -> bool:
    """Whether some sight has several views."""
    sight_of_view = np.full(int(equations.view.max()) + 1, -1)
    sight_of_view[equations.view] = equations.sight
    return bool(np.max(np.bincount(sight_of_view[sight_of_view >= 0])) > 1)


def _along(places: Array) -> Array:
    """(3,) vector from the first place to the farthest."""
    away = places - places[0]
    return np.asarray(away[np.argmax(np.sum(away**2, axis=1))])


def distances_of(places: Array, others: Array) -> Array:
    """(N, M) distances in m between places (N, 3) and others (M, 3)."""
    squared = np.zeros((len(places), len(others)))
    for here, there in zip(places.T, others.T, strict=True):
        squared += (here[:, None] - there) ** 2
    return np.asarray(np.sqrt(squared))


def decay(distance: Array, length: float, smooth: bool) -> Array:
    """Correlation at distances: of a rough random function, or of a smooth one."""
    # Less is rounding beside a correlation of 1; and where squares underflow, LAPACK's eigenvalue search may not end.
    no_correlation = 1e-30
    relative = distance / length
    correlation = np.exp(-0.5 * relative**2 if smooth else -relative)
    correlation *= correlation >= no_correlation
    return np.asarray(correlation)


def decays(distance: Array, places: Sequence[tuple[float, bool]]) -> Iterator[Array]:
    """Correlations at distances for lengths and smoothness, the longest first: half the length gives the square."""
    last: dict[bool, tuple[float, Array]] = {}
    for length, smooth in places:
        before, correlation = last.get(smooth, (0.0, distance))
        times = float(np.log2(before / length)) if before else np.inf
        if times.is_integer():
            for _ in range(int(times) * (2 if smooth else 1)):
                correlation = correlation * correlation
        else:
            correlation = decay(distance, length, smooth)
        last[smooth] = length, correlation
        yield correlation


class StrandFamily(Frozen):
    """S strands side by side, with at most M rows each.

    Attributes:
        lasting: whether the strands cover several views.
        strands: the strands with all their rows, shape by shape. filled: (S, M) which rows exist.
        columns: (S, M, Z) their columns: six of private placements, those of shared numbers, the residual; 0 where
            there is no row.
        distance: (D, M, M) m for each shape, infinite where a row is missing. bounds: (D + 1,) where the strands of
            each shape begin.
        group: (S,) the view or placement of each strand.
    """

    lasting: bool
    strands: Sequence[Strand]
    filled: Mask
    columns: Array
    distance: Array
    bounds: Indices
    group: Indices

    @classmethod
    def of(cls, strands: Sequence[Strand], lasting: bool, columns: Array, group: Indices) -> StrandFamily:
        """Make the family of the strands of one kind from columns (E, Z) and groups (E,) of all equations."""
        shapes: dict[bytes, int] = {}
        same = [shapes.setdefault(strand.shape, len(shapes)) for strand in strands]
        strands = [strands[number] for number in np.argsort(same, kind="stable")]
        starts = bounds_of(np.bincount(same))
        picked = [_near_and_far(len(strand.rows)) for strand in strands]
        shape = len(strands), max(len(p) for p in picked)
        rows, filled = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=bool)
        for number, (strand, at) in enumerate(zip(strands, picked, strict=True)):
            rows[number, : len(at)], filled[number, : len(at)] = strand.rows[at], True
        distance = np.full((len(shapes), shape[1], shape[1]), np.inf)
        for whole, first in zip(distance, starts[:-1].tolist(), strict=True):
            places = strands[first].places[picked[first]]
            whole[: len(places), : len(places)] = distances_of(places, places)
            np.fill_diagonal(whole, 0.0)
        # Rows come first in memory, so that those of all strands of one shape are multiplied as one matrix.
        side_by_side = columns[rows.T]
        side_by_side[~filled.T] = 0.0
        return cls(lasting, strands, filled, np.swapaxes(side_by_side, 0, 1), distance, starts, group[rows[:, 0]])

    @cached_property
    def of_shape(self) -> list[slice]:
        """The strands of each shape."""
        return [slice(*ends) for ends in pairwise(self.bounds.tolist())]

    @cached_property
    def gap(self) -> float:
        """Median distance (m) between nearest neighbours; 0 where no strand has two places."""
        apart = np.where(self.distance > 0.0, self.distance, np.inf).min(axis=2)
        apart = apart[np.isfinite(apart)]
        return median(apart) if len(apart) else 0.0

    @cached_property
    def longest(self) -> float:
        """The longest of all distances, m."""
        return float(np.max(self.distance, where=np.isfinite(self.distance), initial=0.0))

    @cached_property
    def products(self) -> Array:
        """(Z, Z) products of the columns, summed over all rows."""
        flat = np.swapaxes(self.columns, 0, 1).reshape(-1, self.columns.shape[2])
        return np.asarray(flat.T @ flat)

    def applied(self, matrices: Array) -> Array:
        """(S, M, Z) the columns multiplied by the matrix (D, M, M) of each shape."""
        if len(matrices) == len(self.columns):
            return np.asarray(matrices @ self.columns)
        rows_first = np.swapaxes(self.columns, 0, 1)
        product = np.empty(rows_first.shape)
        for own, matrix in zip(self.of_shape, matrices, strict=True):
            part = rows_first[:, own]
            product[:, own] = (matrix @ part.reshape(len(part), -1)).reshape(part.shape)
        return np.swapaxes(product, 0, 1)

    def squared(self, chosen: slice) -> Array:
        """(D, M, M) sum of x x^T over the strands of each shape, with x (M, Q) some of the columns."""
        columns = self.columns[..., chosen]
        if len(self.distance) == len(columns):
            return np.asarray(columns @ np.swapaxes(columns, 1, 2))
        parts = (np.swapaxes(columns[own], 0, 1).reshape(columns.shape[1], -1) for own in self.of_shape)
        return np.array([part @ part.T for part in parts])


@lru_cache(maxsize=256)
def _near_and_far(count: int) -> Indices:
    """Chosen rows of a strand: all of a short one; else some neighbours in its middle, and some over all of it."""
    each = 30  # rows of either sort
    if count <= each + each:
        return np.arange(count)
    return distinct(np.append((count - each) // 2 + np.arange(each), evenly(count, each)))


# ---- the sampled views ----------------------------------------------------------------------------------------------


def sampled(
    problem: Problem, there: Residuals, estimate: Estimate, reduced: ReducedInformation, most_views: int
) -> Linearised | None:
    """The linear model of at most `most_views` views of every camera; None where there are no shared numbers.

    Args:
        problem: as it was solved, at the estimated noise. there: residuals at the estimate. reduced: its information at
            the estimate.
    """
    sights = _shown(problem.sights, there)
    if not len(reduced.shared.matrix) or not len(sights):
        return None
    equations = equations_of(_some(sights, most_views), estimate, there)
    weights = equation_weights(problem.weighting, equations, there).within_sigma
    return linearise_within(problem, estimate, equations, weights, reduced.shared)


def _shown(sights: Sights, there: Residuals) -> Sights:
    """The sights without rows that have no residual: the lens in the middle of its valley may not reach them."""
    points, curves = (np.isfinite(lengths) for lengths in there.lengths)
    if points[sights.point_rows].all() and curves[sights.curve_rows].all():
        return sights
    return sights.used(points, curves)


def _some(sights: Sights, most_views: int) -> Sights:
    """At most `most_views` views of each camera, evenly, and some rows of each of them."""
    observations = sights.observations
    chosen, shown = np.zeros((2, len(observations.views)), dtype=bool)
    shown[observations.points.view[sights.point_rows]] = True
    shown[observations.curves.view[sights.curve_rows]] = True
    for camera in sights.cameras:
        own = (views for key, views in zip(sights.keys, sights.views, strict=True) if key.camera == camera)
        views = np.array([view for views in own for view in views])
        views = views[shown[views]]
        chosen[views[evenly(len(views), most_views)]] = True
    wanted = set(np.flatnonzero(chosen).tolist())
    sights = sights.take(np.flatnonzero([not wanted.isdisjoint(views) for views in sights.views]))
    rows = max(np.diff(sights.point_bounds).max(), np.diff(sights.curve_bounds).max())
    if rows <= _MOST_ROWS and all(wanted.issuperset(views) for views in sights.views):
        return sights
    points, curves = (_some_rows(column.view, chosen) for column in (observations.points, observations.curves))
    return sights.used(points, curves)


def _some_rows(view: AnyArray, chosen: Mask) -> Mask:
    """(N,) mask of rows of the chosen views, at most _MOST_ROWS of each view."""
    rows = chosen[view]
    for number in np.flatnonzero(np.bincount(view[rows], minlength=len(chosen)) > _MOST_ROWS):
        own = np.flatnonzero(view == number)
        rows[own] = False
        rows[own[evenly(len(own), _MOST_ROWS)]] = True
    return rows


def views_or_placements(equations: Equations) -> Indices:
    """(E,) number of the view, or of the placement where several views show it."""
    world = np.array([key.placement is None for key in equations.sights.keys])[equations.sight]
    numbers = np.where(world, equations.view, equations.view.max() + 1 + equations.sight)
    return np.asarray((np.cumsum(np.bincount(numbers) > 0) - 1)[numbers])


# ---- is there any correlation? --------------------------------------------------------------------------------------

# Score tests at three lengths need no likelihood. The score of a share a at a = 0 is r' K r with K = exp(-d / l) - 1.
# It is compared with its expectation -tr(K H) and its variance under independent errors, of which the fit absorbed the
# part H = U U'. Summed over the strands of one shape first, r r' and H serve all lengths.

ASIDE = 20.0
"""Correlation length, in lengths of the longest strand, that stands for errors that move a strand as a whole."""
# The likelihood is computed where a score test exceeds LOUD standard deviations (one in five for white noise), and the
# correlation that it suggests would widen the variance of the shared numbers by more than the share _MATTERS.
LOUD, _MATTERS = 0.85, 0.08


def is_loud(family: StrandFamily) -> bool:
    """Whether errors of neighbours, nearby rows or whole strands agree more than in one of five sets of white noise."""
    no_noise = 1e-6  # mean square, in squared standard deviations, below which residuals are only rounding
    gap, longest, sums = family.gap, family.longest, np.diagonal(family.products)
    noise = sums[-1] / max(np.count_nonzero(family.filled) - np.sum(sums[:-1]), 1.0)
    if gap == 0.0 or noise < no_noise:
        return False
    residuals, private, shared = (family.squared(s) for s in (slice(-1, None), slice(6), slice(6, -1)))
    agreement, count = residuals / noise + private + shared, np.diff(family.bounds)
    for length in (gap, np.sqrt(gap * longest), ASIDE * longest):
        together = np.exp(-family.distance / length) * ~np.eye(family.distance.shape[1], dtype=bool)
        squares = float(count @ np.sum(together**2, axis=(1, 2)))
        total = float(np.sum(together * agreement))
        widening = total / squares * float(np.sum(together * shared) / np.sum(sums[6:-1]))
        least = 0.2 * squares
        if widening <= _MATTERS or total <= LOUD * np.sqrt(least):
            continue
        if total > LOUD * np.sqrt(max(_variance(family, together, squares), least)):
            return True
    return False


def _variance(family: StrandFamily, together: Array, squares: float) -> float:
    """Variance of the score with matrices (D, M, M), whose squared entries sum to `squares` over all strands."""
    taken, along = family.columns[..., :-1], family.applied(together)[..., :-1]
    inner = np.swapaxes(taken, 1, 2) @ along
    return float(2.0 * (squares - 2.0 * np.sum(along**2) + np.sum(inner**2)))
