"""The linear model of a calibration: what its free numbers can absorb of the residuals, and what they must leave.

It is the linearised bundle at the end of a solve, in standard deviations: placements that one sight shows are projected
out sight by sight, everything shared by one triangular factor, and priors are equations of their own. A column over the
equations (an alternative to the model) then has a part that the calibration would have absorbed and a part that it
cannot absorb; the score test (Rao 1948) uses only the second. This is the only linear model: of all equations or of
those of some sights, in directions of what all equations know (`linearise_within`) or of what these know by themselves.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, cached_property, eigh, inverse_root_of, replace
from ceres_cal.observations.sights import STRUCTURE, ranges
from ceres_cal.problem import Information, Key, Problem, Weighting, columns_by_owner, robust_weights
from ceres_cal.problem.parameters import Estimate, intrinsic_names, intrinsics_scales
from ceres_cal.problem.quantities import free_keys, from_placement, from_station
from ceres_cal.problem.residuals import Equations, Residuals, of_observations, pairs_of

LEAST_LEFT = 1e-7
"""Share of a column's squared length that the free numbers must leave for the alternative to be testable."""
SINGULAR = 1e-12
"""Share of its own information that a number must keep beside the others to count as determined."""


class Weights(Frozen):
    """The weights of E equations.

    Attributes:
        inverse_sigma: (E,) 1 / standard deviation, px^-1. used: (E,) which equations take part. robust: (E,) rho' of
            the observation of each equation.
    """

    inverse_sigma: Array
    used: Mask
    robust: Array

    @property
    def within_sigma(self) -> Weights:
        """These weights with the robust ones included in the standard deviations, as the solver has them."""
        return Weights(self.inverse_sigma * np.sqrt(self.robust), self.used, np.ones_like(self.robust))


class AddedNumbers(Frozen):
    """The result of adding Q free numbers to a model.

    Attributes:
        rest: (E, Q) their columns, in standard deviations, beyond private placements. taken: (P, Q) the part of these
            columns along the model's shared directions. root: (Q, R) root of their covariance, where they are
            determined. step: (R,) minus their best values, in these directions.
    """

    rest: Array
    taken: Array
    root: Array
    step: Array

    @property
    def amount(self) -> Array:
        """(Q,) their best values; 0 where they cannot be determined."""
        return -self.root @ self.step

    @property
    def sd(self) -> Array:
        """(Q,) standard deviations of the best values; infinite where they cannot be determined."""
        return np.where(np.any(self.root != 0.0, axis=1), np.sqrt(np.sum(self.root**2, axis=1)), np.inf)

    def under(self, variances: Array) -> Array:
        """(Q,) their likeliest values, if variances (Q,) are expected of them."""
        within = np.eye(len(self.step)) + (self.root.T / variances) @ self.root
        return np.asarray(-self.root @ np.linalg.solve(within, self.step))

    @property
    def decrease(self) -> float:
        """The decrease of the sum of squared residuals."""
        return float(self.step @ self.step)


class Linearised(Frozen):
    """Equations in standard deviations, with an orthonormal basis of how the free numbers move them.

    Attributes:
        weight: (E,) 1 / standard deviation, px^-1. used: (E,) which equations take part.
        score: (E,) robust residuals, in standard deviations; 0 where an equation is not used.
        private: (E, 6) basis of how each private placement moves its sight's equations, 0 elsewhere.
        shared: (E, P) basis of how shared numbers move the equations beyond that; less than unit length with priors.
        root: (K, P) maps these directions to the K shared numbers.
        step: (P,) distance of each direction of `shared` from its best value, in standard deviations.
        unknowns: number of free numbers that the equations determine. prior_equations: number of equations of priors.
        known_noise: number of equations for which prior knowledge of the noise counts.
    """

    equations: Equations
    weight: Array
    used: Mask
    score: Array
    private: Array
    shared: Array
    root: Array
    step: Array
    unknowns: int
    prior_equations: int
    known_noise: float = 0.0

    @property
    def spare(self) -> int:
        """Degrees of freedom, with the equations of priors."""
        return int(np.count_nonzero(self.used)) + self.prior_equations - self.unknowns

    def beyond_private(self, columns: Array) -> Array:
        """Columns (E, Q), in standard deviations, without what private placements absorb."""
        if not self._private_ranges:
            return columns
        rest = columns.copy()
        inside = columns if self.used.all() else columns * self.used[:, None]
        for start, stop in self._private_ranges:
            basis = self.private[start:stop]
            rest[start:stop] -= basis @ (basis.T @ inside[start:stop])
        return rest

    @cached_property
    def _is_private(self) -> Mask:
        """(S,) whether each sight's placement is projected out."""
        return np.asarray(np.any(self.private[self.equations.bounds[:-1]] != 0.0, axis=1))

    @cached_property
    def _private_ranges(self) -> list[tuple[int, int]]:
        bounds = self.equations.bounds
        return [(int(bounds[i]), int(bounds[i + 1])) for i in np.flatnonzero(self._is_private)]

    @cached_property
    def of_private(self) -> Mask:
        """(E,) the equations of sights whose placement is projected out."""
        return self.equations.of_sights(self._is_private)

    @cached_property
    def placed_score(self) -> Array:
        """(E,) `score` with every private placement at its best value."""
        return self.beyond_private(self.score[:, None])[:, 0]

    @cached_property
    def columns(self) -> Array:
        """(E, 6 + P + 1) the columns of `private` and `shared`, and `placed_score`."""
        return np.column_stack([self.private, self.shared, self.placed_score])

    @cached_property
    def left_over(self) -> Array:
        """(E,) the residuals, in standard deviations, with every free number at its best value; 0 where not used."""
        return np.where(self.used, self.placed_score - self.shared @ self.step, 0.0)

    def freed(self, columns: Array, sigma: float = np.inf) -> AddedNumbers:
        """Add numbers, with columns (E, Q) in px per unit, that are free, or normal about 0 with a given sigma."""
        scaled = columns * self.weight[:, None]
        rest, taken = self._projected(scaled)
        normal, slope = self._normal(rest, taken)
        normal += np.eye(len(normal)) / sigma**2
        root = inverse_root(normal, np.sum(scaled[self.used] ** 2, axis=0), LEAST_LEFT)
        return AddedNumbers(rest, taken, root, root.T @ slope)

    def left_of(self, columns: Array) -> tuple[Array, Array]:
        """Normal equations (Q, Q) of more numbers, with columns (E, Q) in px per unit, after everything free has
        followed them, and half the derivative (Q,) of the sum of squared residuals by them.
        """
        return self._normal(*self._projected(columns * self.weight[:, None]))

    def _normal(self, rest: Array, taken: Array) -> tuple[Array, Array]:
        inside = rest[self.used]
        return inside.T @ inside - taken.T @ taken, inside.T @ self.score[self.used] - taken.T @ self.step

    def beside_prior(self, prior: Array) -> Linearised:
        """The model if these equations and a prior (P, P) in the directions of `shared` are all that is known: in
        directions in which their information is the unit matrix, with steps from the least squares of the equations.
        """
        back = inverse_root_of(self.shared.T @ self.shared + prior).T
        shared = self.shared @ back
        return replace(self, shared=shared, root=self.root @ back, step=shared.T @ self.placed_score)

    def with_columns(self, columns: Array, sigma: float = np.inf) -> Linearised:
        """The model with more numbers free, or normal about 0 with a given sigma; columns (E, Q) in px per unit."""
        more = self.freed(columns, sigma)
        basis = (more.rest - self.shared @ more.taken) @ more.root
        return replace(
            self,
            shared=np.hstack([self.shared, basis]),
            root=np.hstack([self.root, -self.root @ more.taken @ more.root]),
            step=np.concatenate([self.step, more.step]),
            unknowns=self.unknowns + more.root.shape[1],
        )

    def decreases(self, columns: Array) -> Array:
        """(Q,) by how much the sum of squared residuals falls with each single one of columns (E, Q), px per unit."""
        normal, slope = self.left_of(columns)
        left, scaled = np.diagonal(normal), columns[self.used] * self.weight[self.used, None]
        determined = left > LEAST_LEFT * np.sum(scaled**2, axis=0)
        return np.where(determined, slope**2 / np.where(determined, left, 1.0), 0.0)

    def taken_by(self, columns: Array) -> Array:
        """(K, Q) by how much the shared numbers move per unit of more numbers, with columns (E, Q) in px per unit."""
        return -self.root @ self._projected(columns * self.weight[:, None])[1]

    def left_of_column(self, column: Array) -> Array:
        """(E,) what is left of a column, in standard deviations, after everything free has followed it."""
        rest, taken = self._projected(column[:, None])
        return np.asarray(rest[:, 0] - self.shared @ taken[:, 0])

    def _projected(self, columns: Array) -> tuple[Array, Array]:
        """Columns (E, Q), in standard deviations, beyond private placements, and their part (P, Q) along `shared`."""
        rest = self.beyond_private(columns)
        return rest, self.shared.T @ (rest * self.used[:, None])

    @cached_property
    def leverage(self) -> Array:
        """(E,) leverage of each equation; for unused ones, what the uncertainty of the fit adds to the variance."""
        return np.asarray(np.sum(self.private**2, axis=1) + np.sum(self.shared**2, axis=1))

    @cached_property
    def studentised(self) -> tuple[Indices, Array]:
        """The numbers of all observations, and the lengths of their deleted residuals; see `studentised`."""
        pairs = pairs_of(self.equations)
        residual = self.weight * self.equations.residual
        return studentised(self.equations, residual, self.used.astype(float), self.leverage, self.overlap(*pairs))

    def spare_of(self, rows: Mask) -> float:
        """Degrees of freedom of some equations (E,): their number less their leverages."""
        return float(np.sum(1.0 - self.leverage[rows]))

    def variance(self, rows: Mask) -> float:
        """Mean square per degree of freedom of what is left of some equations (E,), in squared standard deviations."""
        return float(np.sum(self.left_over[rows] ** 2)) / max(self.spare_of(rows), 1e-9)

    def overlap(self, first: Indices, second: Indices) -> Array:
        """(N,) entries of the hat matrix between pairs of equations of one sight."""
        private = np.sum(self.private[first] * self.private[second], axis=1)
        return np.asarray(private + np.sum(self.shared[first] * self.shared[second], axis=1))


def studentised(
    equations: Equations, residual: Array, share: Array, leverage: Array, overlap: Array
) -> tuple[Indices, Array]:
    """Studentised deleted residuals: the distance of each observation from the prediction of all others, in standard
    deviations (Cook and Weisberg 1982, 2.2).

    With M the variance that the covariance of the fit adds, and a weight w in the fit, the squared length is e' (I - w
    M)^-1 (I + (1 - w) M)^-1 e: e' (I - M)^-1 e for an observation of full weight, e' (I + M)^-1 e for one that took no
    part.

    Args:
        residual: (E,) in standard deviations. share: (E,) w. leverage, overlap: the diagonal (E,) of M, and (P,) its
            entry between the two equations of each point.

    Returns:
        (N,) the observations, and (N,) the lengths.
    """
    curves, (first, second) = equations.is_curve, pairs_of(equations)
    square = leverage**2
    square[first] += overlap**2
    square[second] += overlap**2
    variance = np.maximum(1.0 + (1.0 - 2.0 * share) * leverage - share * (1.0 - share) * square, 1e-9)
    w, p, q = share[first], residual[first], residual[second]
    cross = overlap * ((1.0 - 2.0 * w) - w * (1.0 - w) * (leverage[first] + leverage[second]))
    determinant = np.maximum(variance[first] * variance[second] - cross**2, 1e-18)
    squared = (variance[second] * p * p - 2.0 * cross * p * q + variance[first] * q * q) / determinant
    return (
        np.concatenate([equations.observation[first], equations.observation[curves]]),
        np.concatenate([np.sqrt(np.maximum(squared, 0.0)), (residual / np.sqrt(variance))[curves]]),
    )


def inverse_root(normal: Array, sizes: Array, least: float) -> Array:
    """W (Q, rank) with W W^T = normal^-1 over the directions that are determined.

    Directions that keep less than `least` of `sizes`, their squared lengths before anything was projected out, are left
    out.
    """
    root, rank = inverse_roots(normal, sizes, least)
    return np.asarray(root[:, len(sizes) - int(rank) :])


def inverse_roots(normals: Array, sizes: Array, least: float) -> tuple[Array, Indices]:
    """`inverse_root` of a stack (..., Q, Q): roots (..., Q, Q), with columns of 0 first where left out, and ranks."""
    scale = 1.0 / np.sqrt(np.where(sizes > 0.0, sizes, 1.0))
    values, vectors = eigh(scale[..., :, None] * normals * scale[..., None, :])
    kept = values > least
    roots = scale[..., :, None] * vectors / np.sqrt(np.where(kept, values, np.inf))[..., None, :]
    return np.asarray(roots), np.asarray(np.count_nonzero(kept, axis=-1))


def equation_weights(
    weighting: Weighting, equations: Equations, there: Residuals, taking_part: tuple[Mask, Mask] | None = None
) -> Weights:
    """The weights of equations at a noise and a loss.

    Args:
        there: residuals at the estimate of the equations. taking_part: masks of points (N,) and of curve observations
            (M,); by default all take part.
    """
    at, scale = equations.observation, np.where(equations.is_curve, weighting.curve_scale, weighting.point_scale)
    observations = equations.sights.observations
    sigma = scale * of_observations(at, observations.points.sigma_px, observations.curves.sigma_px)
    squared = (of_observations(at, *there.lengths) / sigma) ** 2
    used = np.ones(len(at), dtype=bool) if taking_part is None else of_observations(at, *taking_part)
    return Weights(1.0 / sigma, used, robust_weights(weighting, squared))


def make_linear_model(problem: Problem, estimate: Estimate, equations: Equations, weights: Weights) -> Linearised:
    """The linear model of a calibration, with its priors."""
    keys = free_keys(estimate, problem.layout, problem.private)
    blank, columns = without_shared(problem, estimate, equations, weights, keys)
    rest = blank.beyond_private(columns)
    prior_rows, prior_values = prior_equations(problem, estimate, keys)
    inside = rest[weights.used]
    before = inside if rest is columns else columns[weights.used]
    normal = inside.T @ inside + prior_rows.T @ prior_rows
    sizes = np.einsum("ep,ep->p", before, before) + np.sum(prior_rows**2, axis=0)
    root = inverse_root(normal, sizes, SINGULAR)
    gradient = inside.T @ blank.score[weights.used] + prior_rows.T @ prior_values
    return replace(
        blank,
        shared=rest @ root,
        root=root,
        step=root.T @ gradient,
        unknowns=blank.unknowns + root.shape[1],
        prior_equations=len(prior_rows),
    )


def linearise_within(
    problem: Problem, estimate: Estimate, equations: Equations, weights: Weights, known: Information
) -> Linearised:
    """The linear model of some equations, in directions in which the information of everything is the unit matrix.

    Args:
        known: information on the shared numbers, of all equations and priors. `step` is 0: the whole is at its optimum.
    """
    root, built = known_root(known), np.array([key.is_structure for key in known.keys], dtype=bool)
    blank, columns = without_shared(
        problem, estimate, equations, weights, [k for k in known.keys if not k.is_structure]
    )
    shared = blank.beyond_private(columns) @ root[~built]
    if built.any():  # no matrix is made for a board's thousand corners, each of which moves two equations a view
        moved = equations.built_along(estimate.structure, root[built]) * blank.weight[:, None]
        shared += blank.beyond_private(moved)
    return replace(blank, shared=shared, root=root, step=np.zeros(root.shape[1]))


def known_root(shared: Information) -> Array:
    """(K, P) maps directions in which the information on all but the structure is the unit matrix, with the structure
    at its best value, to the shared numbers.

    The offsets of targets from their drawings have a scatter of their own (see `robust.as_built`).
    """
    determined = 1e-11  # eigenvalue at unit diagonal above which a direction counts as determined
    size, matrix = len(shared.keys), shared.matrix
    rest = np.array([key.kind != "structure" for key in shared.keys])
    if rest.all():
        return inverse_root(matrix, np.diagonal(matrix), determined)
    follows = np.zeros((size, int(np.count_nonzero(rest))))
    follows[rest] = np.eye(follows.shape[1])
    follows[~rest] = -np.linalg.solve(matrix[np.ix_(~rest, ~rest)], matrix[np.ix_(~rest, rest)])
    left = matrix[rest] @ follows
    return np.asarray(follows @ inverse_root(0.5 * (left + left.T), np.diagonal(left), determined))


def without_shared(
    problem: Problem, estimate: Estimate, equations: Equations, weights: Weights, keys: Sequence[Key]
) -> tuple[Linearised, Array]:
    """The model with only private placements, and the columns (E, P) of shared numbers, in standard deviations."""
    used, weight = weights.used, weights.inverse_sigma
    score = np.where(used, weights.robust * weight * equations.residual, 0.0)
    private, count = _private_basis(equations, problem, weight, used)
    columns = shared_columns(equations, estimate, keys)
    shared, root = np.zeros((len(equations), 0)), np.zeros((columns.shape[1], 0))
    blank = Linearised(equations, weight, used, score, private, shared, root, np.zeros(0), count, 0)
    return blank, columns * weight[:, None]


def _private_basis(equations: Equations, problem: Problem, weight: Array, used: Mask) -> tuple[Array, int]:
    """(E, 6) the private bases, see `Linearised`, and the number of unknowns that they stand for."""
    basis = np.zeros((len(equations), 6))
    numbers = equations.sights.numbers(placements=problem.private)
    if not len(numbers):
        return basis, 0
    columns = equations.pose * weight[:, None]
    inside = columns if used.all() else columns * used[:, None]
    parts = [slice(equations.bounds[number], equations.bounds[number + 1]) for number in numbers]
    normal = np.array([inside[part].T @ inside[part] for part in parts])
    sizes = np.diagonal(normal, axis1=1, axis2=2)
    roots, ranks = inverse_roots(normal, sizes, SINGULAR)
    for part, root in zip(parts, roots, strict=True):
        np.matmul(columns[part], root, out=basis[part])
    return basis, int(np.sum(ranks))


def shared_columns(equations: Equations, estimate: Estimate, keys: Sequence[Key]) -> Array:
    """(E, P) px per unit of each key: by how much the equations move with the shared numbers."""
    columns, owned = np.zeros((len(equations), len(keys))), columns_by_owner(keys)
    cameras = equations.sights.cameras
    for name in cameras:
        camera, own = estimate.cameras[name], owned.get(("camera", name), [])
        if not own:
            continue
        at = [intrinsic_names(camera.lens).index(keys[column].quantity) for column in own]
        here: slice | Indices = slice(None)
        if len(cameras) > 1:
            here = ranges(equations.bounds, equations.sights.numbers(name))
        columns[here, own[0] : own[-1] + 1] = equations.intrinsics[here][:, at] * intrinsics_scales(camera)[at]
    posed = any(kind in ("station", "placement") for kind, _ in owned)
    for number, key in enumerate(equations.sights.keys if posed else ()):
        here = slice(equations.bounds[number], equations.bounds[number + 1])
        pose = equations.poses[number : number + 1]
        world = estimate.stations[key.station].cam_from_world
        if own := owned.get(("station", key.station), []):
            columns[here, own] = equations.pose[here] @ from_station(pose, world)[0]
        if own := owned.get(("placement", str(key.placement)), []):
            columns[here, own] = equations.pose[here] @ from_placement(pose, world)[0]
    if structure := owned.get(STRUCTURE, []):
        columns[:, structure] = equations.structure_columns(estimate.structure)
    return columns


def prior_equations(problem: Problem, estimate: Estimate, keys: Sequence[Key]) -> tuple[Array, Array]:
    """The priors on the shared numbers as equations: rows (K, P) and values (K,) in their sigmas."""
    place = {key: column for column, key in enumerate(keys)}
    rows, values = [np.zeros((0, len(keys)))], [np.zeros(0)]
    for prior in problem.priors_at(estimate):
        root = prior.information.root
        row = np.zeros((len(root), len(keys)))
        row[:, [place[key] for key in prior.keys]] = root
        rows.append(row)
        values.append(root @ prior.offsets(estimate))
    return np.vstack(rows), np.concatenate(values)
