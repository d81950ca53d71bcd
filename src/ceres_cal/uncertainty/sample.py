"""Some views' equations at the optimum, in directions in which everything shared is known to one standard deviation.

What the residuals say of dependence is read off them. Some views are enough: what is sought are a few numbers (a
length, a share, a variance) that hold for all of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ceres_cal import kernels
from ceres_cal.base.arrays import AnyArray, Array, Indices, Mask
from ceres_cal.model.equations import Equations, equations_of, of_observations
from ceres_cal.model.information import Information
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.residuals import Residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.solve import Problem, ReducedInformation
from ceres_cal.solve.linear_model import Weights, inverse_root, without_shared

_MOST_VIEWS = 16  # of a camera
_MOST_ROWS = 1_500  # of a kind in a view
_DETERMINED = 1e-11  # eigenvalue, at unit diagonal, from which on a direction counts as determined


@dataclass(frozen=True, eq=False)
class Strand:
    """Equations whose errors may go together: of one curve, or of one image axis at one target's points.

    Attributes:
        rows: (N,) of the sample. places: (N, 3) m, where they lie on the target.
    """

    rows: Indices
    places: Array


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
    def informations(self) -> Array:
        """(G, P, P) of each group, were errors independent."""
        parts = (self.shared[self.group == g] for g in range(self.groups))
        return np.array([part.T @ part for part in parts])

    @cached_property
    def scores(self) -> Array:
        """(G, P) derivative of half the squared residuals of each group."""
        scores = np.zeros((self.groups, self.shared.shape[1]))
        np.add.at(scores, self.group, self.shared * self.left[:, None])
        return scores

    @cached_property
    def is_shared(self) -> bool:
        """Whether some strand goes over several groups."""
        return any(np.any(self.group[strand.rows] != self.group[strand.rows[0]]) for strand in self.lasting)

    def families(self, curves: bool) -> list[list[Strand]]:
        """The strands of curves or of points, within views and then, where there are others, over all views."""
        families = (
            [s for s in strands if self.is_curve[s.rows[0]] == curves] for strands in (self.within, self.lasting)
        )
        return [family for family in families if family]


def take_sample(
    observations: Observations, problem: Problem, there: Residuals, estimate: Estimate, reduced: ReducedInformation
) -> Sample | None:
    """The equations of some views of every camera; None where there are no shared numbers.

    Args:
        problem: as it was solved, at the noise that was found. there: residuals at the estimate. reduced: what the
            problem says there.
    """
    information = reduced.shared.matrix
    if not len(information):
        return None
    equations = equations_of(observations, _some(observations, problem.sights), estimate, there)
    weights = robust_weights(observations, problem, equations, there)
    blank, columns = without_shared(problem, estimate, equations, weights)
    placed = blank.beyond_private(np.column_stack([columns, blank.score]))
    root = _root(reduced.shared)
    curves, grouped = equations.is_curve, _groups(equations)
    return Sample(
        placed[:, :-1] @ root,
        placed[:, -1],
        blank.private,
        root,
        root.T @ reduced.priors.over(reduced.shared.keys).matrix @ root,
        grouped,
        curves,
        tuple(_strands(equations, equations.view)),
        tuple(_strands(equations, equations.sight)) if _lasting(equations) else (),
    )


def _root(shared: Information) -> Array:
    """(K, P) from directions in which all but the structure is known to one, which follows, to the shared numbers.

    How far the targets were built from their drawings has a scatter of its own (see `solve.as_built`).
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


def _some(observations: Observations, sights: Sights) -> Sights:
    """Of each camera some views, evenly, and of each of them some rows."""
    chosen, shown = np.zeros((2, len(observations.views)), dtype=bool)
    shown[observations.points.view[sights.point_rows]] = True
    shown[observations.curves.view[sights.curve_rows]] = True
    for camera in sights.cameras:
        own = (views for key, views in zip(sights.keys, sights.views, strict=True) if key.camera == camera)
        views = [view for views in own for view in views if shown[view]]
        chosen[np.array(views)[evenly(len(views), _MOST_VIEWS)]] = True
    sights = sights.take(np.flatnonzero([chosen[list(views)].any() for views in sights.views]))
    rows = max(np.diff(sights.point_bounds).max(), np.diff(sights.curve_bounds).max())
    if rows <= _MOST_ROWS and all(chosen[list(views)].all() for views in sights.views):
        return sights
    points, curves = (_some_rows(column.view, chosen) for column in (observations.points, observations.curves))
    return sights.used(points, curves)


def evenly(count: int, most: int) -> Indices:
    """At most so many of `count` numbers, evenly."""
    taken = min(count, most)
    return np.asarray((np.arange(taken) * (count - 1)) // max(taken - 1, 1))


def _some_rows(view: AnyArray, chosen: Mask) -> Mask:
    """(N,) rows of the chosen views, of each view at most _MOST_ROWS."""
    rows = chosen[view]
    for number in np.flatnonzero(np.bincount(view[rows], minlength=len(chosen)) > _MOST_ROWS):
        own = np.flatnonzero(view == number)
        rows[own] = False
        rows[own[evenly(len(own), _MOST_ROWS)]] = True
    return rows


def robust_weights(observations: Observations, problem: Problem, equations: Equations, there: Residuals) -> Weights:
    """Of each equation, the root of its robust weight in its standard deviation."""
    weighting, at = problem.weighting, equations.observation
    scale = np.where(equations.is_curve, weighting.curve_scale, weighting.point_scale)
    sigma = scale * of_observations(at, observations.points.sigma_px, observations.curves.sigma_px)
    squared = (of_observations(at, *there.lengths) / sigma) ** 2
    robust = kernels.loss_weights(kernels.Loss(kernels.LOSS_CODES[weighting.loss], weighting.loss_scale), squared)
    everything = np.ones(len(equations))
    return Weights(np.sqrt(robust) / sigma, everything > 0.0, everything)


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


def _strands(equations: Equations, owner: Indices) -> Iterator[Strand]:
    """The curves, and the image axes of points, of each owner (E,): a view or a sight."""
    axis = (equations.direction[:, 1] > 0.5).astype(np.int64)
    what = np.where(equations.is_curve, equations.feature + 2, axis)
    name = owner * (what.max() + 1) + what
    order = np.argsort(name, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(name[order])) + 1):
        places = equations.place[rows]
        along = np.argsort(places @ _along(places), kind="stable") if equations.is_curve[rows[0]] else slice(None)
        yield Strand(rows[along], places[along])


def _along(places: Array) -> Array:
    """(3,) from the first place towards the farthest."""
    away = places - places[0]
    return np.asarray(away[np.argmax(np.sum(away**2, axis=1))])
