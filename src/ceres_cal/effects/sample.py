"""Some views' equations at the optimum, in directions in which everything shared is known to one standard deviation.

What the residuals say of dependence is read off them. Some views are enough: what is sought are a few numbers (a
length, a share, a variance) that hold for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import AnyArray, Array, Indices, Mask
from ceres_cal.base.cached import cached_property
from ceres_cal.effects.linearised import equation_weights, inverse_root, without_shared
from ceres_cal.effects.strands import Strand, StrandFamily, evenly, strands_of
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.problem.equations import Equations, equations_of
from ceres_cal.problem.information import Information
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.reduced import ReducedInformation
from ceres_cal.problem.residuals import Residuals

_MOST_VIEWS = 16  # of a camera
_MOST_ROWS = 1_500  # of a kind in a view
_DETERMINED = 1e-11  # eigenvalue, at unit diagonal, from which on a direction counts as determined


@dataclass(frozen=True, eq=False)
class Sample:
    """E equations in standard deviations, robust weights in.

    Attributes:
        shared: (E, P) what the directions do to them in which the shared numbers are known: with `prior` and what the
            views say that are not among them, shared^T shared is the unit matrix. left: (E,) the residuals.
        private: (E, 6) basis of what each private placement does to its own view, 0 elsewhere.
        root: (K, P) from these directions to the K shared numbers. prior: (P, P) what was known before, in them.
        group: (E,) of the G views or placements that are compared with one another. is_curve: (E,).
        within, lasting: the strands of each view, and those over all views of one sight, where these are others.
    """

    shared: Array
    left: Array
    private: Array
    root: Array
    prior: Array
    group: Indices
    is_curve: Mask
    within: tuple[Strand, ...]
    lasting: tuple[Strand, ...]

    @property
    def groups(self) -> int:
        """How many views or placements there are."""
        return int(self.group.max()) + 1

    @cached_property
    def _products(self) -> Array:
        """(G, P + 1, P + 1) of `shared` and `left` within each group."""
        order = np.argsort(self.group, kind="stable")
        columns = self.columns[order, 6:]
        ends = np.cumsum(np.bincount(self.group))[:-1]
        return np.array([part.T @ part for part in np.split(columns, ends)])

    @property
    def informations(self) -> Array:
        """(G, P, P) of each group, were errors independent."""
        return self._products[:, :-1, :-1]

    @property
    def scores(self) -> Array:
        """(G, P) derivative of half the squared residuals of each group."""
        return self._products[:, :-1, -1]

    @cached_property
    def is_shared(self) -> bool:
        """Whether some strand goes over several groups."""
        return any(np.any(self.group[strand.rows] != self.group[strand.rows[0]]) for strand in self.lasting)

    @cached_property
    def columns(self) -> Array:
        """(E, 6 + P + 1) private, shared and left."""
        return np.column_stack([self.private, self.shared, self.left])

    def families(self, curves: bool) -> list[StrandFamily]:
        """The strands of curves or of points, within views and then, where there are others, over all views."""
        families = []
        for strands, lasting in ((self.within, False), (self.lasting, True)):
            if own := [strand for strand in strands if self.is_curve[strand.rows[0]] == curves]:
                families.append(StrandFamily.of(own, lasting, self.columns, self.group))
        return families


def take_sample(
    observations: Observations, problem: Problem, there: Residuals, estimate: Estimate, reduced: ReducedInformation
) -> Sample | None:
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
    blank, columns = without_shared(problem, estimate, equations, weights)
    placed = blank.beyond_private(np.column_stack([columns, blank.score]))
    root = known_root(reduced.shared)
    curves, grouped = equations.is_curve, _groups(equations)
    return Sample(
        placed[:, :-1] @ root,
        placed[:, -1],
        blank.private,
        root,
        root.T @ reduced.priors.over(reduced.shared.keys).matrix @ root,
        grouped,
        curves,
        tuple(strands_of(equations, equations.view)),
        tuple(strands_of(equations, equations.sight)) if _lasting(equations) else (),
    )


def known_root(shared: Information) -> Array:
    """(K, P) from directions in which all but the structure is known to one, which follows, to the shared numbers.

    How far the targets were built from their drawings has a scatter of its own (see `robust.as_built`).
    """
    size, matrix = len(shared.keys), shared.matrix
    rest = np.array([key.kind != "structure" for key in shared.keys])
    if rest.all():
        return inverse_root(matrix, np.diagonal(matrix), _DETERMINED)
    follows = np.zeros((size, int(np.count_nonzero(rest))))
    follows[rest] = np.eye(follows.shape[1])
    follows[~rest] = -np.linalg.solve(matrix[np.ix_(~rest, ~rest)], matrix[np.ix_(~rest, rest)])
    left = matrix[rest] @ follows
    return np.asarray(follows @ inverse_root(0.5 * (left + left.T), np.diagonal(left), _DETERMINED))


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


def _groups(equations: Equations) -> Indices:
    """(E,) number of the view, or of the placement that several views show."""
    world = np.array([key.placement is None for key in equations.sights.keys])[equations.sight]
    numbers = np.where(world, equations.view, equations.view.max() + 1 + equations.sight)
    return np.asarray((np.cumsum(np.bincount(numbers) > 0) - 1)[numbers])


def _lasting(equations: Equations) -> bool:
    """Whether some sight has several views."""
    sight_of_view = np.full(int(equations.view.max()) + 1, -1)
    sight_of_view[equations.view] = equations.sight
    return bool(np.max(np.bincount(sight_of_view[sight_of_view >= 0])) > 1)
