"""Which views are asked how errors depend on each other: their equations in the directions of everything that is known.
 Some views are enough: what is sought are a few numbers (a
length, a share, a variance) that hold for all of them.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import AnyArray, Indices, Mask
from ceres_cal.effects.linearised import Linearised, equation_weights, linearise_within
from ceres_cal.effects.strands import evenly
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.problem.equations import Equations, equations_of
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.reduced import ReducedInformation
from ceres_cal.problem.residuals import Residuals

_MOST_VIEWS = 16  # of a camera
_MOST_ROWS = 1_500  # of a kind in a view


def sampled(
    observations: Observations, problem: Problem, there: Residuals, estimate: Estimate, reduced: ReducedInformation
) -> Linearised | None:
    """The equations of some views of every camera; None where there are no shared numbers.

    Args:
        problem: as it was solved, at the noise that was found. there: residuals at the estimate. reduced: what the
            problem says there.
    """
    sights = _shown(problem.sights, there)
    if not len(reduced.shared.matrix) or not len(sights):
        return None
    equations = equations_of(observations, _some(observations, sights), estimate, there)
    weights = equation_weights(observations, problem.weighting, equations, there).within_sigma
    return linearise_within(problem, estimate, equations, weights, reduced.shared)


def _shown(sights: Sights, there: Residuals) -> Sights:
    """Without the rows that have no residual: a lens in the middle of its valley may not reach as far."""
    points, curves = (np.isfinite(lengths) for lengths in there.lengths)
    if points[sights.point_rows].all() and curves[sights.curve_rows].all():
        return sights
    return sights.used(points, curves)


def _some(observations: Observations, sights: Sights) -> Sights:
    """Of each camera some views, evenly, and of each of them some rows."""
    chosen, shown = np.zeros((2, len(observations.views)), dtype=bool)
    shown[observations.points.view[sights.point_rows]] = True
    shown[observations.curves.view[sights.curve_rows]] = True
    for camera in sights.cameras:
        own = (views for key, views in zip(sights.keys, sights.views, strict=True) if key.camera == camera)
        views = np.array([view for views in own for view in views])
        views = views[shown[views]]
        chosen[views[evenly(len(views), _MOST_VIEWS)]] = True
    wanted = set(np.flatnonzero(chosen).tolist())
    sights = sights.take(np.flatnonzero([not wanted.isdisjoint(views) for views in sights.views]))
    rows = max(np.diff(sights.point_bounds).max(), np.diff(sights.curve_bounds).max())
    if rows <= _MOST_ROWS and all(wanted.issuperset(views) for views in sights.views):
        return sights
    points, curves = (_some_rows(column.view, chosen) for column in (observations.points, observations.curves))
    return sights.used(points, curves)


def _some_rows(view: AnyArray, chosen: Mask) -> Mask:
    """(N,) rows of the chosen views, of each view at most _MOST_ROWS."""
    rows = chosen[view]
    for number in np.flatnonzero(np.bincount(view[rows], minlength=len(chosen)) > _MOST_ROWS):
        own = np.flatnonzero(view == number)
        rows[own] = False
        rows[own[evenly(len(own), _MOST_ROWS)]] = True
    return rows


def views_or_placements(equations: Equations) -> Indices:
    """(E,) number of the view, or of the placement that several views show."""
    world = np.array([key.placement is None for key in equations.sights.keys])[equations.sight]
    numbers = np.where(world, equations.view, equations.view.max() + 1 + equations.sight)
    return np.asarray((np.cumsum(np.bincount(numbers) > 0) - 1)[numbers])
