"""What a solve without each group of equations would leave of them, by the normal equations of each group alone.

With A_g the normal equations of a group, u_g its gradient and M the sum of all, leaving the group out moves the free
numbers by (M - A_g)^-1 u_g. As everything is quadratic, some of the numbers may be held elsewhere instead: a shorter
lens is the longer one with coefficients at 0, and needs no solve of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.cached import cached_property
from ceres_cal.base.spread import known_inverses
from ceres_cal.effects.linearised import SINGULAR, inverse_root, prior_equations
from ceres_cal.observations.sights import SightKey, Sights
from ceres_cal.problem.information import Key
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import free_keys
from ceres_cal.problem.reduced import normals_with_residuals, owned_columns, steps_of

_ROUNDING = 1e-12  # of a sum over a group's rows
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

        Each group's residuals are taken as large as without its own share in the fit (CR2: Bell and McCaffrey, Survey
        Methodology 28, 2002), so that it is 1 on average where errors are independent, however few groups there are.
        The jackknife divides by that share twice, and overshoots where one group nearly alone tells a direction.
        """
        axes = np.linalg.qr(self._root[numbers].T)[0]
        gradient = (self.gradient + self.normal @ self._least_step) @ self._root
        rest, turn = np.linalg.eigh(self._split(self._root)[1])
        along = (gradient[:, None, :] @ turn) / np.sqrt(rest)[:, None, :]
        moved = (along @ np.swapaxes(turn, 1, 2))[:, 0] @ axes
        return float(len(moved) * np.mean(moved**2))

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
        own, rest = self._split(root)
        without = np.linalg.solve(rest, gradient[:, :, None])[:, :, 0]
        squares += np.einsum("gk,gk->g", 2.0 * gradient + np.einsum("gkl,gl->gk", own, without), without)
        return squares, step

    def _split(self, root: Array) -> tuple[Array, Array]:
        """(G, R, R) each group's share of the information along a root of everything's, and that of all others."""
        own = root.T @ self.normal @ root
        return np.asarray(own), np.asarray((1.0 + _RIDGE) * np.eye(root.shape[1]) - own)

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
    """The normal equations of each group.

    Args:
        groups: a sight is a group; several may have the same pose. alone: the private placements that one group alone
            shows: each is posed from it.

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
            whole, before = _posed(whole), whole[:, :-7, :-7]
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
    """Numbers of the groups that depend on the same numbers in the same way."""
    every: dict[SightKey | str, list[int]] = {}
    for number, key in enumerate(groups.keys):
        every.setdefault(key.camera if key.placement in alone else key, []).append(number)
    return (np.array(numbers) for numbers in every.values())


def _drop_rounding(columns: Mapping[tuple[str, str], Indices], sizes: Array, products: Array) -> None:
    """Take what is left of a turn that nothing tells, which is rounding of the others, out of sizes and products."""
    for (kind, _), own in columns.items():
        for alike in (own[:3], own[3:]) if kind in ("station", "placement") else ():
            lost = alike[sizes[alike] <= _ROUNDING * np.max(sizes[alike])]
            sizes[lost], products[:, lost], products[:, :, lost] = 0.0, 0.0, 0.0


def _posed(normals: Array) -> Array:
    """(G, K - 6, K - 6) what normal equations (G, K, K) leave where each pose is at its best."""
    pose, rest = slice(-7, -1), np.r_[: normals.shape[1] - 7, normals.shape[1] - 1]
    inverse = known_inverses(normals[:, pose, pose], np.full(6, np.inf))
    across = normals[:, pose][:, :, rest]
    return np.asarray(normals[:, rest[:, None], rest] - np.swapaxes(across, 1, 2) @ inverse @ across)
