"""The restricted likelihood of correlated errors (Patterson and Thompson, Biometrika 58, 1971), over a grid.

The covariance of a strand's residuals is R = s^2 [(1 - a) 1 + a exp(-d / l)]. One set of eigenvectors serves all shares
a of a length l, and all strands of one shape. Private placements are eliminated. All other rows and the priors enter as
prior information on the shared numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, eigh, parts_of, run_parts
from ceres_cal.effects.strands import ASIDE, StrandFamily, decay
from ceres_cal.kernels import strands_left
from ceres_cal.observations import joined
from ceres_cal.problem.costs import NORMAL_NS

# Shares a of the grid, up to 0.995: with at most 0.95, intervals for lines that bend over 2 m cover only 84 to 88 %.
_SHARES = np.array([0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.995])


class Likelihoods(Frozen):
    """The likelihood at N places on the grid.

    Attributes:
        family: (N,) number of the family. smooth: (N,) whether errors have no edges. length_m, share: (N,) l and a.
        log: (N,) logarithm of the likelihood. variance: (N,) s^2. trace: (N,) of the covariance of the scores.
        inverse_freedom: (N,) 1 / degrees of freedom of that trace.
    """

    family: Indices
    smooth: Mask
    length_m: Array
    share: Array
    log: Array
    variance: Array
    trace: Array
    inverse_freedom: Array


def likelihoods(families: Sequence[StrandFamily], may_be_smooth: bool, squared: float) -> Likelihoods:
    """The likelihood of independent errors first, then of errors that are correlated in one of the families.

    Args:
        may_be_smooth: whether errors without edges are considered, too.
        squared: sum of the squared shared columns over all rows, of which the families have some.
    """
    places = [(0, False, 0.0)]
    for smooth, (number, family) in product((False, True)[: 1 + may_be_smooth], enumerate(families)):
        places += [(number, smooth, length) for length in _lengths(family)]

    def part(first: int, last: int) -> Likelihoods:
        return joined([_of_shares(families[place[0]], place, squared) for place in places[first:last]])

    rows = len(places) * len(_SHARES) * max(family.filled.size for family in families)
    return joined(run_parts(part, parts_of(len(places), rows, NORMAL_NS)))


def _lengths(family: StrandFamily) -> list[float]:
    """The correlation lengths of a family's grid, m."""
    gap, longest = family.gap, family.longest
    if gap == 0.0:
        return []
    lengths = 0.5 * gap * 2.0 ** np.arange(np.ceil(np.log2(3.0 * longest / gap)))
    if not np.any(family.columns[:, 0, :6]):  # else a pose of its own absorbs errors of the whole strand
        lengths = np.append(lengths, ASIDE * longest)
    return list(lengths.tolist())


def _of_shares(family: StrandFamily, place: tuple[int, bool, float], squared: float) -> Likelihoods:
    """The restricted likelihood at one place for all shares.

    Args:
        place: number of the family, whether errors have no edges, and the length; a length of 0 stands for independent
            errors, which have no share.
    """
    shares = _SHARES if place[2] else np.zeros(1)
    fewest_freedom = 3.0  # least degrees of freedom of a variance
    size, count, many = family.columns.shape[2] - 7, int(np.count_nonzero(family.filled)), len(shares)
    values, vectors = eigh(decay(family.distance, place[2] or 1.0, place[1]))
    values, rows = np.maximum(values, 0.0), np.swapaxes(family.applied(np.swapaxes(vectors, 1, 2)), 0, 1)
    logs, weights = np.zeros(many), 1.0 / (1.0 - shares[:, None, None] * (1.0 - values))
    left = _left(family, rows[..., 6:], weights)
    taken = strands_left(values, family.bounds, family.group, rows, shares, logs, left)
    log, variance, freedom = _restricted(family, left, count - taken)
    sizes = np.add.reduceat(np.einsum("msz,msz->ms", *[rows[..., 6:-1]] * 2), family.bounds[:-1], axis=1)
    white, together = float(np.sum(sizes)), float(np.sum(values.T * sizes))
    parts = (1.0 - shares) * white, shares * together
    squares = float(np.diff(family.bounds) @ np.sum(values**2, axis=1))
    few = max(count**2 / squares - (0 if taken else size), fewest_freedom)
    inverse = (parts[0] ** 2 / freedom + parts[1] ** 2 / few) / np.maximum(parts[0] + parts[1], 1e-300) ** 2
    scale = squared / max(white, 1e-300)  # ratio of all rows to those in the families
    number, smooth, length_m = (np.full(many, one) for one in place)
    trace = scale * (parts[0] + parts[1])
    return Likelihoods(number, smooth, length_m, shares, log - 0.5 * logs, variance, trace, inverse)


def _left(family: StrandFamily, shared: Array, weights: Array) -> Array:
    """(A, Q, Q) X^T R^-1 X for shared columns (M, S, Q) along the eigenvectors, with weights (A, D, M) of each
    shape.
    """
    each = np.diff(family.bounds)
    if 8 * len(each) > shared.shape[1]:  # else products over the strands of a shape serve all shares, in half the time
        every, flat = np.repeat(np.swapaxes(weights, 1, 2), each, axis=2), shared.reshape(-1, shared.shape[2])
        halves = (flat * root.reshape(-1, 1) for root in np.sqrt(every))
        return np.array([half.T @ half for half in halves])  # BLAS computes this as a symmetric product
    products = (np.swapaxes(shared[:, own], 1, 2) @ shared[:, own] for own in family.of_shape)
    return np.asarray(sum(np.tensordot(weights[:, d], product, 1) for d, product in enumerate(products)))


def _restricted(family: StrandFamily, reduced: Array, count: int) -> tuple[Array, Array, float]:
    """Logarithm of the restricted likelihood (A,) without the determinant of R, s^2 (A,), and its degrees of freedom.

    All other rows and the priors enter as prior information on the shared numbers; the whole is at its optimum.
    """
    own = family.products[6:, 6:]
    normal = np.eye(len(own) - 1) - own[:-1, :-1] + reduced[:, :-1, :-1]
    slope = reduced[:, :-1, -1] - own[:-1, -1]
    squares = reduced[:, -1, -1] - np.einsum("ai,ai->a", slope, np.linalg.solve(normal, slope[..., None])[..., 0])
    freedom = max(count - float(np.trace(own[:-1, :-1])), 1.0)
    variance = np.maximum(squares, 1e-9) / freedom
    return -0.5 * (freedom * np.log(variance) + np.linalg.slogdet(normal)[1]), variance, freedom
