"""What a solve without each group of equations would leave of them, by the normal equations of each group alone.

With A_g the normal equations of a group, u_g its gradient and M the sum of all, leaving the group out moves the free
numbers by (M - A_g)^-1 u_g. As everything is quadratic, some of the numbers may be held elsewhere instead: a shorter
lens is the longer one with coefficients at 0, and needs no solve of its own.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.spread import known_inverses
from ceres_cal.model.equations import Equations
from ceres_cal.model.keys import Key
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.quantities import free_keys
from ceres_cal.solve.linear_model import SINGULAR, Weights, inverse_root, prior_equations, shared_columns
from ceres_cal.solve.problem import Problem

_RIDGE = 1e-3  # of everything's information: a group that tells a direction alone cannot be left out


@dataclass(frozen=True, eq=False)
class GroupNormals:
    """Normal equations of G groups of equations over K numbers, in standard deviations.

    Attributes:
        normal: (G, K, K). gradient: (G, K) half the derivative of the squared residuals. squares: (G,) these.
        counts: (G,) equations. known, known_gradient: (K, K), (K,) of priors. sizes: (K,) squared lengths of the
            columns, before anything was eliminated.
    """

    keys: tuple[Key, ...]
    normal: Array
    gradient: Array
    squares: Array
    counts: Array
    known: Array
    known_gradient: Array
    sizes: Array

    @property
    def least(self) -> float:
        """The least squares, everything free."""
        return self.squares_at(self._least_step)

    def squares_at(self, step: Array) -> float:
        """All squares, so far from where the numbers stand, to second order."""
        return float(self.squares.sum() + 2.0 * (self._slope @ step) + step @ self._whole @ step)

    def scatter_of(self, numbers: Indices) -> float:
        """Mean of the variances of some of the numbers as groups scatter, over those by the noise alone.

        The delete-one jackknife (Efron and Stein, Annals of Statistics 9, 1981), which overshoots where groups are few.
        """
        axes = np.linalg.qr(self._root[numbers].T)[0]
        gradient = (self.gradient + self.normal @ self._least_step) @ self._root
        without = self._left_out(self._root, gradient)[1] @ axes
        return float((len(without) - 1.0) * np.mean(np.var(without, axis=0)))

    def held_out(self, held: Mapping[Key, float]) -> tuple[Array, Array]:
        """(G,) squared errors of each group predicted from all others, and the step (K,) to where the least squares
        are, when some of the numbers are held so far from where they stand.
        """
        free = np.array([i for i, key in enumerate(self.keys) if key not in held], dtype=np.int64)
        step = np.array([held.get(key, 0.0) for key in self.keys])
        of_free = inverse_root(self._whole[np.ix_(free, free)], self.sizes[free], SINGULAR)
        root = np.zeros((len(self.keys), of_free.shape[1]))
        root[free] = of_free
        step -= root @ (root.T @ (self._slope + self._whole @ step))
        moved = self.normal @ step
        squares = self.squares + 2.0 * (self.gradient @ step) + moved @ step
        gradient = (self.gradient + moved) @ root
        own, without = self._left_out(root, gradient)
        squares += np.einsum("gk,gk->g", 2.0 * gradient + np.einsum("gkl,gl->gk", own, without), without)
        return squares, step

    def _left_out(self, root: Array, gradient: Array) -> tuple[Array, Array]:
        """Each group's share (G, R, R) of the information, and where the others are without it (G, R), along a root."""
        own = root.T @ self.normal @ root
        rest = (1.0 + _RIDGE) * np.eye(root.shape[1]) - own
        return np.asarray(own), np.asarray(np.linalg.solve(rest, gradient[:, :, None])[:, :, 0])

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


def group_normals(
    problem: Problem,
    estimate: Estimate,
    equations: Equations,
    weights: Weights,
    groups: tuple[Indices, Collection[str | None]],
) -> GroupNormals:
    """The normal equations of each group.

    Args:
        groups: (E,) number of the group of each equation, and the private placements that one group alone shows: each
            is posed from it.
    """
    group, alone = groups
    keys = tuple(free_keys(estimate, problem.layout, frozenset(alone)))
    size = len(keys)
    columns = np.hstack([shared_columns(equations, estimate, keys), equations.pose, equations.residual[:, None]])
    columns *= (weights.inverse_sigma * weights.used)[:, None]
    columns[:, -1] *= weights.robust
    order = np.argsort(group, kind="stable")
    first = np.concatenate([[0], 1 + np.flatnonzero(np.diff(group[order]))])
    products = np.array([part.T @ part for part in np.split(columns[order], first[1:])])
    sizes = np.einsum("gkk->k", products)[:size]
    is_alone = np.array([key.placement in alone for key in equations.sights.keys])[equations.sight[order[first]]]
    pose, rest = slice(size, size + 6), np.r_[0:size, size + 6]
    inverse = known_inverses(products[is_alone, pose, pose], np.full(6, np.inf))
    across = products[is_alone, pose][:, :, rest]
    products = products[:, rest[:, None], rest]
    products[is_alone] -= np.swapaxes(across, 1, 2) @ inverse @ across
    rows, values = prior_equations(problem, estimate, keys)
    return GroupNormals(
        keys,
        products[:, :-1, :-1],
        products[:, :-1, -1],
        products[:, -1, -1],
        np.diff([*first, len(group)]),
        rows.T @ rows,
        rows.T @ values,
        sizes + np.sum(rows**2, axis=0),
    )
