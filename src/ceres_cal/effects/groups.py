"""Compare groups of equations: what a solve without one of them would leave of it, and how the groups scatter.

With A_g the normal equations of a group, u_g its gradient and M the sum over all groups, leaving the group out moves
the free numbers by (M - A_g)^-1 u_g. As everything is quadratic, some of the numbers may be held elsewhere instead: a
shorter lens is the longer one with coefficients at 0, and needs no solve of its own.

Do views scatter as their own equations say? At the optimum their gradients sum to zero. With A_g the information of
each view if errors are independent, M_g the covariance of its gradient and M that of all of them, in directions in
which the information of everything is the unit matrix, the optimum leaves

    Cov(u_g, u_h) = d_gh M_g - A_g M_h - M_g A_h + A_g M A_h.

The mean square of the gradients over its expectation is the factor c on the variance, whose own spread follows from the
same matrices (Satterthwaite). The jackknife (1 - A_g)^-1 u_g, by which the optimum moves without a view, shows in which
directions views scatter (CR3; Bell and McCaffrey, Survey Methodology 28, 2002). With few views, or one that dominates,
it is singular and overshoots. So its weight is the probability that views disagree at all, times (G - 1) / (G - 1 + P)
for P numbers, with G the number of equally informative views that would say as much.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence, Set

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, cached_property, eigh, known_inverses
from ceres_cal.effects.evidence import DEPENDENCE
from ceres_cal.effects.linearised import SINGULAR, Linearised, inverse_root, inverse_roots, prior_equations
from ceres_cal.observations.sights import Owner, SightKey, Sights
from ceres_cal.problem import Estimate, Information, Key, Problem, free_keys
from ceres_cal.problem.reduced import normals_with_residuals, owned_columns, steps_of

_RIDGE = 1e-3  # share added to the total information: a group that alone determines a direction cannot be left out


FEWEST_GROUPS = 3
# Expected squares between groups, in degrees of freedom, below which they cannot be compared. Views that each determine
# their own numbers, as of cameras side by side, leave only rounding: the ratio to that was 17 000 where nothing was
# wrong.
_LEAST_LEFT = 1.0
_LOG_C = np.linspace(0.02, 6.0, 300)  # log c of either sign; exponential prior of mean 1 if views scatter otherwise


class GroupNormals(Frozen):
    """Normal equations of G groups of equations over K numbers, in standard deviations.

    Attributes:
        keys: the numbers; empty for directions. normal: (G, K, K). gradient: (G, K) half the derivative of the sum of
            squared residuals. squares: (G,) that sum.
        counts: (G,) numbers of equations. known, known_gradient: (K, K), (K,) of priors. sizes: (K,) squared lengths of
            the columns before anything was eliminated.
    """

    keys: tuple[Key, ...]
    normal: Array
    gradient: Array
    squares: Array
    counts: Array
    known: Array
    known_gradient: Array
    sizes: Array

    @classmethod
    def of(cls, model: Linearised, group: Indices, known: Array) -> GroupNormals:
        """Those of the shared directions of a linear model, by group (E,), with prior information (P, P) on them."""
        order = np.argsort(group, kind="stable")
        columns = model.columns[order, 6:]
        counts = np.bincount(group)
        products = np.array([part.T @ part for part in np.split(columns, np.cumsum(counts)[:-1])])
        normal, gradient, squares = products[:, :-1, :-1], products[:, :-1, -1], products[:, -1, -1]
        sizes = np.sum(model.shared**2, axis=0) + np.diagonal(known)
        return cls((), normal, gradient, squares, counts.astype(float), known, np.zeros(len(known)), sizes)

    @property
    def least(self) -> float:
        """The least sum of squares, with everything free."""
        return self.squares_at(self._least_step)

    def squares_at(self, step: Array) -> float:
        """The sum of all squares at a step from the present numbers, to second order."""
        return float(self.squares.sum() + 2.0 * (self._slope @ step) + step @ self._whole @ step)

    def scatter_of(self, numbers: Indices) -> float:
        """Mean variance of some of the numbers by the scatter of groups, over that by the noise alone.

        Each group's residuals are enlarged by its own share in the fit (CR2: Bell and McCaffrey, Survey Methodology 28,
        2002), so that the result is 1 on average where errors are independent, however few groups there are. The
        jackknife divides by that share twice, and overshoots where one group nearly alone determines a direction.
        """
        axes = np.linalg.qr(self._root[numbers].T)[0]
        gradient = (self.gradient + self.normal @ self._least_step) @ self._root
        rest, turn = eigh(self._split(self._root)[1])
        along = (gradient[:, None, :] @ turn) / np.sqrt(rest)[:, None, :]
        moved = (along @ np.swapaxes(turn, 1, 2))[:, 0] @ axes
        return float(len(moved) * np.mean(moved**2))

    def held_out(self, every: Sequence[Mapping[Key, float]]) -> tuple[Array, Array, Array, Array]:
        """Predict each group from all others, if some numbers are held at given distances from their present values.

        Returns one row for each of F choices: (F, G) squared errors; (F, G) those in variances of noise and prediction
        together, and (F, G) the logarithm of the determinant of these variances; (F, K) the steps to the least squares.
        """
        steps = np.array([[held.get(key, 0.0) for key in self.keys] for held in every])
        roots = self._roots(every)
        steps -= (roots @ (np.swapaxes(roots, 1, 2) @ (self._slope + steps @ self._whole)[:, :, None]))[:, :, 0]
        moved = np.swapaxes(steps @ self.normal, 0, 1)
        squares = self.squares + 2.0 * steps @ self.gradient.T + np.einsum("fgk,fk->fg", moved, steps)
        gradient = ((self.gradient + moved) @ roots)[:, :, :, None]
        own, rest = self._split(roots)
        without = np.linalg.solve(rest, gradient)
        foreseen = squares + np.sum(gradient * without, axis=(2, 3))
        squares += np.sum((2.0 * gradient + own @ without) * without, axis=(2, 3))
        return squares, foreseen, -np.linalg.slogdet(rest)[1], steps

    def information(self, held: Collection[Key], stated: Information) -> Information:
        """Return what is known of a camera and its stations if some numbers are held, with further information."""
        every = Information(self.keys, self._whole) + stated.marginal(stated.among(self.keys))
        return every.given([key for key in self.keys if key not in held]).of_cameras

    def root(self, held: Collection[Key], stated: Array | float = 0.0) -> Array:
        """(K, K) a root of the covariance of the numbers, if some are held.

        Args:
            stated: (K, K) further information on the numbers.
        """
        return np.asarray(self._roots([held], stated)[0])

    def _roots(self, every: Sequence[Collection[Key]], stated: Array | float = 0.0) -> Array:
        """(F, K, K) the roots for each of F choices of held numbers."""
        free = np.array([[key not in held for key in self.keys] for held in every])
        normals = (self._whole + stated) * (free[:, :, None] & free[:, None, :])
        return np.asarray(inverse_roots(normals, self.sizes, SINGULAR)[0] * free[:, :, None])

    def _split(self, roots: Array) -> tuple[Array, Array]:
        """(..., G, R, R) the share of each group in the information along roots (..., K, R) of the whole, and that of
        all other groups.
        """
        each = roots[..., None, :, :]
        own = np.swapaxes(each, -1, -2) @ self.normal @ each
        return np.asarray(own), np.asarray((1.0 + _RIDGE) * np.eye(own.shape[-1]) - own)

    @cached_property
    def _whole(self) -> Array:
        return np.asarray(self.normal.sum(axis=0) + self.known)

    @cached_property
    def _slope(self) -> Array:
        return np.asarray(self.gradient.sum(axis=0) + self.known_gradient)

    @cached_property
    def _root(self) -> Array:
        return inverse_root(self._whole, self.sizes, SINGULAR)

    @cached_property
    def _least_step(self) -> Array:
        return np.asarray(-self._root @ (self._root.T @ self._slope))


def group_normals(problem: Problem, estimate: Estimate, groups: Sights, alone: Set[str | None]) -> GroupNormals:
    """Compute the normal equations of each group.

    Args:
        groups: each sight is a group; several may have the same pose. alone: the private placements that only one group
            shows; each pose is determined by its group.

    Raises:
        SolutionError: an observation cannot be projected.
    """
    keys = free_keys(estimate, problem.layout, alone)
    columns, last = owned_columns(keys), len(keys)
    products, sizes = np.zeros((len(groups), last + 1, last + 1)), np.zeros(last)
    poses = estimate.pose_stack(groups.keys)
    for numbers in _alike(groups, alone):
        own = groups.take(numbers)
        whole = normals_with_residuals(own, problem, estimate)
        steps, at = steps_of(own.keys[0], poses[numbers[0]], estimate, columns)
        if own.keys[0].placement in alone:
            steps, at = steps[:, : len(steps) - 6], at[: len(steps) - 6]
            whole, before = posed(whole), whole[:, :-7, :-7]
        else:
            before = steps.T @ whole[:, :-1, :-1] @ steps
        sizes[at] += np.einsum("gkk->k", before)
        chain = np.zeros((whole.shape[1], len(at) + 1))
        chain[:-1, :-1], chain[-1, -1], at = steps[: len(chain) - 1], 1.0, np.append(at, last)
        products[np.ix_(numbers, at, at)] = chain.T @ whole @ chain
    _drop_rounding(columns, sizes, products)
    rows, values = prior_equations(problem, estimate, keys)
    return GroupNormals(
        keys,
        products[:, :-1, :-1],
        products[:, :-1, -1],
        products[:, -1, -1],
        2 * np.diff(groups.point_bounds) + np.diff(groups.curve_bounds),
        rows.T @ rows,
        rows.T @ values,
        sizes + np.sum(rows**2, axis=0),
    )


def _alike(groups: Sights, alone: Set[str | None]) -> Iterator[Indices]:
    """Numbers of the groups that depend on the same numbers in the same way, together."""
    every: dict[SightKey | str, list[int]] = {}
    for number, key in enumerate(groups.keys):
        every.setdefault(key.camera if key.placement in alone else key, []).append(number)
    return (np.array(numbers) for numbers in every.values())


def _drop_rounding(columns: Mapping[Owner, Indices], sizes: Array, products: Array) -> None:
    """Set to 0 in sizes and products what is left of a rotation that nothing determines: it is rounding of the
    others.
    """
    rounding = 1e-12  # share of a sum over the rows of a group
    for (kind, _), own in columns.items():
        for alike in (own[:3], own[3:]) if kind in ("station", "placement") else ():
            lost = alike[sizes[alike] <= rounding * np.max(sizes[alike])]
            sizes[lost], products[:, lost], products[:, :, lost] = 0.0, 0.0, 0.0


def posed(normals: Array) -> Array:
    """(G, K - 6, K - 6) what normal equations (G, K, K) leave when each pose is at its best value."""
    pose, rest = slice(-7, -1), np.r_[: normals.shape[1] - 7, normals.shape[1] - 1]
    inverse = known_inverses(normals[:, pose, pose], np.full(6, np.inf))
    across = normals[:, pose][:, :, rest]
    return np.asarray(normals[:, rest[:, None], rest] - np.swapaxes(across, 1, 2) @ inverse @ across)


# ---- how groups scatter ---------------------------------------------------------------------------------------------


class GroupScatter(Frozen, eq=True):
    """The scatter of views or placements.

    Attributes:
        groups: number of groups compared. variance: factor on the variance, beyond the effect of errors within groups.
        probability: that the factor is not 1. degrees_of_freedom: those of the factor.
    """

    groups: int
    variance: float
    probability: float
    degrees_of_freedom: float


def compare_groups(groups: GroupNormals, scatter: Array, whole: Array) -> tuple[GroupScatter, Array] | None:
    """Compare groups: their scatter, and the covariance (P, P) of the whole score that includes it; None where they
    have too little in common.

    Args:
        groups: in directions in which the information of everything is the unit matrix.
        scatter: (G, P, P) covariance of each group's score due to errors within it.
        whole: (P, P) that of all groups and of the priors.
    """
    values, vectors = eigh(whole)
    values = np.maximum(values, 1e-12 * values[-1])
    white, root = (vectors * values**-0.5) @ vectors.T, (vectors * values**0.5) @ vectors.T
    seen = _seen_by(groups)  # placements of a rig count only in the sampled views
    turn, own_white = np.linalg.qr(white @ seen)
    normal, gradient = seen.T @ groups.normal @ seen, groups.gradient @ seen
    expected, spread = _expected(normal, seen.T @ scatter @ seen, seen.T @ whole @ seen, own_white.T)
    mean = float(np.sum(np.trace(expected, axis1=1, axis2=2)))
    if mean < _LEAST_LEFT:
        return None
    ratio, degrees = float(np.sum((gradient @ own_white.T) ** 2)) / mean, 2.0 * mean**2 / spread
    variance, probability = _averaged(ratio, degrees, float(np.trace(whole)) / len(whole))
    size, traces = len(whole), np.trace(groups.normal, axis1=1, axis2=2)
    alike = (
        float(np.sum(traces) ** 2 / np.sum(traces**2)) - 1.0
    )  # number of equally informative groups beyond the first
    weight = probability * alike / (alike + size)
    jackknife = size * turn @ _jackknife(normal, gradient, expected, own_white.T) @ turn.T
    factor = (1.0 - weight) * variance * np.eye(size) + weight * jackknife
    widened = _widened(factor, white @ (whole - groups.known) @ white)
    return GroupScatter(len(scatter), variance, probability, degrees), root @ widened @ root


def _seen_by(groups: GroupNormals) -> Array:
    """(P, R) an orthonormal basis of the directions that any of the groups determines."""
    rounding = 1e-13  # share of the largest eigenvalue
    values, vectors = eigh(groups.normal.sum(axis=0))
    return np.asarray(vectors[:, values > rounding * values[-1]])


def _expected(informations: Array, scatter: Array, whole: Array, white: Array) -> tuple[Array, float]:
    """(G, R, R) covariance of each group's score, whitened, and the variance of the sum of the scores' squared
    lengths.
    """
    a, m, size = informations @ white, scatter @ white, len(white)
    left = np.concatenate([a, -m], axis=1)  # Cov(g_i, g_j) is left_i^T right_j for others, and more for i = j
    right = np.concatenate([whole @ a - m, a], axis=1)
    cross = np.swapaxes(left, 1, 2) @ right
    own = cross + white.T @ m
    lefts, rights = (np.swapaxes(part, 0, 1).reshape(2 * size, -1) for part in (left, right))
    pairs = float(np.sum((lefts @ lefts.T) * (rights @ rights.T)))
    return own, 2.0 * (pairs - float(np.sum(cross**2)) + float(np.sum(own**2)))


def _averaged(ratio: float, degrees: float, widened: float) -> tuple[float, float]:
    """Posterior mean of the factor on the variance, given a chi-squared ratio, and the probability that it is not 1.

    Args:
        widened: factor on the variance due to errors within the views. Where views agree better than that, no more than
            this is taken back: an apparent error of each view is then one of all views.
    """
    logs = np.concatenate([[0.0], _LOG_C, -_LOG_C])
    prior = np.exp(-np.abs(logs)) * (logs >= -np.log(max(widened, 1.0)))
    weights = (1.0 - DEPENDENCE.absent) / prior[1:].sum() * prior
    weights[0] = DEPENDENCE.absent
    likelihood = -0.5 * degrees * (logs + ratio * np.exp(-logs))
    weights *= np.exp(np.minimum(likelihood - likelihood[weights > 0.0].max(), 0.0))
    weights /= weights.sum()
    return float(weights @ np.exp(logs)), float(1.0 - weights[0])


def _jackknife(normal: Array, gradient: Array, expected: Array, white: Array) -> Array:
    """(R, R) jackknife covariance from leaving out each group, whitened; its mean trace is 1 where the groups agree."""
    moves = white.T @ np.linalg.inv((1.0 + _RIDGE) * np.eye(len(white)) - normal)
    steps = np.einsum("gij,gj->gi", moves, gradient)
    turned = moves @ np.linalg.inv(white.T)
    return np.asarray(steps.T @ steps / float(np.sum(turned * (turned @ expected))))


def _widened(factor: Array, observed: Array) -> Array:
    """The unit matrix with the factor applied to the part that observations determine; priors are not affected."""
    values, vectors = eigh(observed)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    return np.asarray(np.eye(len(factor)) + root @ (factor - np.eye(len(factor))) @ root)
