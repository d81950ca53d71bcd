"""The observations that are asked whether a group of them lies aside, as a problem of their own.

Whether one does not belong rests on a few rows of a few views: of those that stand out, and of others, evenly. So of
very many observations a part is compared, with all rows of the views that stand out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask, distinct, median
from ceres_cal.base.frozen import Frozen, replace
from ceres_cal.effects.aside import ObservationGroups
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import column_of, some_views, thinned_by_key
from ceres_cal.problem.problem import Problem
from ceres_cal.robust.robust import RobustSolution

FEWEST = 3  # observations of a group: two numbers of a line's offset, and one left over

# Share of a group's observations in use below which it is compared in any case: its other rows are good by chance.
_LEFT = 0.5
# Observations that are asked, and views of them: what the free numbers take up is projected out of the few rows that
# are compared, so a solve has but to end in the right valley.
_MOST_ASKED, _FEWEST_ASKED = 200_000, 200


class Subproblem(Frozen):
    """The observations that are asked, with their problem and its end.

    Attributes:
        kinds: of groups, numbered as among all of them.
    """

    problem: Problem
    observations: Observations
    end: RobustSolution
    kinds: Sequence[ObservationGroups]

    def of_rows(self, rows: Mask) -> Problem:
        """The problem of these (n + m,)."""
        points = len(self.observations.points)
        return self.problem.used(rows[:points], rows[points:])

    def without(self, rows: Mask) -> Problem:
        """The problem of the others: no placement that they do not show is free."""
        others = self.of_rows(~rows)
        return replace(others, layout=others.layout.of(others.sights.keys))


def compared_part(every: Subproblem) -> Subproblem:
    """All observations, or of very many some: of views that stand out, and of others evenly."""
    most_rejected = 4  # such groups of a kind, whose views are asked
    observations, sights = every.observations, every.problem.sights
    if len(sights.point_rows) + len(sights.curve_rows) <= _MOST_ASKED:
        return every
    points = len(observations.points)
    there = np.zeros(points + len(observations.curves), dtype=bool)
    there[sights.point_rows] = there[points + sights.curve_rows] = True
    view = column_of(observations, "view")
    chosen = np.zeros(len(observations.views), dtype=bool)
    chosen[some_views(np.bincount(view[there], minlength=len(chosen)), _MOST_ASKED, _FEWEST_ASKED)] = True
    for groups in every.kinds:
        gone = mostly_rejected(groups, every.end, there)
        worst = np.argsort(-gone, kind="stable")[: min(most_rejected, np.count_nonzero(gone))]
        chosen |= views_compared(groups, every.end, there, groups.among(worst) & there)
    there &= chosen[view]
    rows = np.flatnonzero(there)[:: max(1, int(np.count_nonzero(there)) // (2 * _MOST_ASKED))]
    return _part(every, rows, int(np.searchsorted(rows, points)))


def _part(every: Subproblem, rows: Indices, split: int) -> Subproblem:
    """Some rows (n + m,) of all, the first of them points, as if there were no others."""
    p, c = rows[:split], rows[split:] - len(every.observations.points)
    observations, problem = every.observations.part(p, c), every.problem.of_rows(p, c)
    there, inliers = every.end.residuals.of_rows(p, c), every.end.inliers.of_rows(p, c)
    weighting = every.end.problem.weighting
    used = replace(problem.used(inliers.points, inliers.curves), weighting=weighting, feet=there.feet)
    end = replace(every.end, problem=used, inliers=inliers, residuals=there)
    kinds = [replace(groups, observations=observations, of=groups.of[rows]) for groups in every.kinds]
    return Subproblem(problem, observations, end, kinds)


# ---- what is compared ----------------------------------------------------------------------------------------------


def rows_compared(groups: ObservationGroups, end: RobustSolution, taking_part: Mask, recalled: Mask) -> Mask:
    """(N + M,) of some views, and of each group in them some.

    Args:
        taking_part: (N + M,) all that may be. recalled: (N + M,) what is compared whether or not it is an inlier.
    """
    most_rows = 40  # of a group in one view
    inside, view = taking_part & (end.inliers.rows | recalled), column_of(groups.observations, "view")
    rows = np.flatnonzero(inside & views_compared(groups, end, inside, recalled)[view])
    inside[:] = False
    key = groups.of[rows].astype(np.int64) * len(groups.frames) + view[rows]
    inside[thinned_by_key(rows, key, groups.of[rows] >= 0, most_rows)] = True
    return inside


def views_compared(groups: ObservationGroups, end: RobustSolution, taking_part: Mask, recalled: Mask) -> Mask:
    """(V,) those with what is recalled, those that stand out, some of the others, and some without any group."""
    most_others = 16  # views besides, which tell the lens
    view = column_of(groups.observations, "view")
    shows_some = np.bincount(view[taking_part & (groups.of >= 0)], minlength=len(groups.frames))
    largest, most = standing_out(groups, end, taking_part), groups.most_views
    with_some, others = np.flatnonzero(shows_some), np.flatnonzero(shows_some == 0)
    chosen = np.zeros(len(shows_some), dtype=bool)
    chosen[distinct(view[recalled])[:most]] = True
    chosen[with_some[np.argsort(-largest[with_some], kind="stable")][: most // 2]] = True
    chosen[with_some[:: max(1, 2 * len(with_some) // most)]] = True
    chosen[others[:: max(1, len(others) // most_others)]] = True
    return chosen


def groups_compared(
    groups: ObservationGroups, end: RobustSolution, rows: Mask, recalled: Sequence[int]
) -> tuple[Indices, float]:
    """The numbers of those that have enough of the rows (N + M,), and which share of them that is.

    Of very many those that are recalled, those that stand out, and others evenly.
    """
    most_together = 256  # groups, at the cube of the number: 8 views of a field of 32 lines; 1350 took 25 s
    every = np.flatnonzero(groups.count(rows) >= FEWEST)
    if len(every) <= most_together:
        return every, 1.0
    standing_out = every[np.argsort(-excess(groups, end, rows)[every], kind="stable")]
    some = every[:: -(-2 * len(every) // most_together)]
    back = np.intersect1d(every, np.array(recalled, dtype=np.int64))
    chosen = distinct(np.concatenate([back, standing_out[: most_together // 2], some]))
    return chosen, len(chosen) / len(every)


def mostly_rejected(groups: ObservationGroups, end: RobustSolution, taking_part: Mask) -> Indices:
    """(size,) how many observations of each group are outliers, where most of them are; else 0."""
    counts, used = groups.count(taking_part), groups.count(end.inliers.rows & taking_part)
    return np.where((counts > FEWEST) & (used < _LEFT * counts), counts - used, 0)


def excess(groups: ObservationGroups, end: RobustSolution, taking_part: Mask) -> Array:
    """(size + 1,) by how many standard deviations the mean square residual of each view or placement is above the
    median one.
    """
    lengths = end.inliers.sigmas
    points, size = len(groups.observations.points), groups.size + 1
    of = np.where(end.inliers.rows & taking_part & (groups.of >= 0), groups.of, np.int64(groups.size))
    spare = 2.0 * np.bincount(of[:points], minlength=size) + np.bincount(of[points:], minlength=size)
    square = np.bincount(of, lengths**2, minlength=size)
    spare[-1] = square[-1] = 0.0  # of what is in none
    square, there = square / np.maximum(spare, 1.0), spare > 0.0
    middle = median(square[there]) if np.any(there) else 1.0
    return np.asarray((square / max(middle, 1e-12) - 1.0) / np.sqrt(2.0 / np.maximum(spare, 1.0)) * there)


def standing_out(groups: ObservationGroups, end: RobustSolution, taking_part: Mask) -> Array:
    """(V,) the largest excess of the groups that each view shows."""
    largest, rows = np.full(len(groups.frames), -np.inf), np.flatnonzero(groups.of >= 0)
    above, view = excess(groups, end, taking_part), column_of(groups.observations, "view")
    np.maximum.at(largest, view[rows], above[groups.of[rows]])
    return largest
