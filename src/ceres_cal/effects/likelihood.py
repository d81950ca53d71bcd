"""The restricted likelihood of correlated errors (Patterson and Thompson, Biometrika 58, 1971), over a grid.

The covariance of a strand's residuals is R = s^2 [(1 - a) 1 + a exp(-d / l)]. One set of eigenvectors serves all shares
a of a length l, and all strands of one shape. Private placements are eliminated, and what all other rows and the priors
say of the shared numbers is a prior here.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.frozen import Frozen
from ceres_cal.effects.strands import ASIDE, StrandFamily, decay
from ceres_cal.observations import joined

# To 0.995: with 0.95 at most, lines that bend over 2 m are covered in 84 to 88 %. In parts: the next one is left out
# where the likelihood falls over the one before it to nothing.
_SHARES = np.array([0.1, 0.25, 0.5]), np.array([0.75, 0.9, 0.97, 0.995])

_Place = tuple[int, bool, float]  # number of the family, whether errors have no edges, length


class Likelihoods(Frozen):
    """N places on the grid.

    Attributes:
        family: (N,) its number. smooth: (N,) whether errors have no edges. length_m, share: (N,).
        log: (N,) the likelihood's logarithm. variance: (N,) s^2. trace: (N,) of the scores' covariance.
        inverse_freedom: (N,) of that.
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
    """Of independent errors first, then of those that go together in one of the families.

    Args:
        may_be_smooth: whether errors without edges are looked for, too.
        squared: sum of the squared shared columns over all rows, of which the families show some.
    """
    nothing = 6.0  # nats below the best: less than the share of a place that is left out
    parts = [_independent(families[0], squared)]
    best = float(parts[0].log[0])
    for smooth, (number, family) in product((False, True)[: 1 + may_be_smooth], enumerate(families)):
        for length in _lengths(family):
            at, falls = _eigenbasis(family, length, smooth), False
            for shares in _SHARES:
                place = number, smooth, length
                part = (_impossible if falls else _of_shares)(family, at, shares, squared, place)
                parts.append(part)
                best = max(best, float(part.log.max()))
                falls = bool(part.log[-1] < min(best - nothing, part.log[-2]))
    return joined(parts)


def _lengths(family: StrandFamily) -> list[float]:
    """The lengths of a family's grid, m."""
    gap, longest = family.gap, family.longest
    if gap == 0.0:
        return []
    lengths = 0.5 * gap * 2.0 ** np.arange(np.ceil(np.log2(3.0 * longest / gap)))
    if not np.any(family.columns[:, 0, :6]):  # a pose of its own takes up what moves the whole
        lengths = np.append(lengths, ASIDE * longest)
    return list(lengths.tolist())


_Diagonal = tuple[Array, Array]
"""A family where its correlation is diagonal: (S, M) eigenvalues, and (S, M, Z) the columns along its eigenvectors."""


def _eigenbasis(family: StrandFamily, length: float, smooth: bool) -> _Diagonal:
    """At one length."""
    values, vectors = np.linalg.eigh(decay(family.distance, length, smooth))
    return family.per_strand(np.maximum(values, 0.0)), family.applied(np.swapaxes(vectors, 1, 2))


def _independent(family: StrandFamily, squared: float) -> Likelihoods:
    """The likelihood of independent errors."""
    at = family.filled.astype(float), family.columns
    return _of_shares(family, at, np.zeros(1), squared, (0, False, 0.0))


def _of_shares(family: StrandFamily, at: _Diagonal, shares: Array, squared: float, place: _Place) -> Likelihoods:
    """The restricted likelihood at one place for some shares (A,)."""
    fewest_freedom = 3.0  # degrees of freedom that a variance is given at least
    values, columns = at
    diagonal, white = 1.0 - shares[:, None, None] * (1.0 - values), np.einsum("smz,smz->sm", *[columns[..., 6:-1]] * 2)
    logs, reduced, taken = _without_private(columns / np.sqrt(diagonal)[..., None], family.group)
    size, count = columns.shape[2] - 7, int(np.count_nonzero(family.filled))
    log, variance, freedom = _restricted(family, reduced, count - taken)
    parts = (1.0 - shares) * white.sum(), shares * np.sum(white * values)
    few = max(count**2 / float(np.sum(values**2)) - (0 if taken else size), fewest_freedom)
    inverse = (parts[0] ** 2 / freedom + parts[1] ** 2 / few) / np.maximum(parts[0] + parts[1], 1e-300) ** 2
    scale = squared / max(float(white.sum()), 1e-300)  # of all rows to those looked at
    number, smooth, length_m = (np.full(len(shares), one) for one in place)
    return Likelihoods(
        number,
        smooth,
        length_m,
        shares,
        log - 0.5 * (np.log(diagonal).sum(axis=(1, 2)) + logs),
        variance,
        scale * (parts[0] + parts[1]),
        inverse,
    )


def _impossible(family: StrandFamily, at: _Diagonal, shares: Array, squared: float, place: _Place) -> Likelihoods:
    """Shares that need not be looked at."""
    number, smooth, length = (np.full(len(shares), one) for one in place)
    one = np.ones(len(shares))
    return Likelihoods(number, smooth, length, shares, -np.inf * one, one, one, one)


def _without_private(columns: Array, group: Indices) -> tuple[Array, Array, int]:
    """The private placement of each view eliminated from products of columns (A, S, M, Z): logarithms of the
    determinants (A,), what is left over of all (A, P + 1, P + 1), and how many numbers were eliminated.
    """
    count, size = len(columns), columns.shape[-1] - 6
    shared = columns[..., 6:].reshape(count, -1, size)
    rest = np.swapaxes(shared, 1, 2) @ shared
    views, view = np.unique(group, return_inverse=True)
    products = (np.swapaxes(columns[..., :6], 2, 3) @ columns).reshape(count, len(view), -1)
    whole = ((np.arange(len(views))[:, None] == view).astype(float) @ products).reshape(count, -1, 6, 6 + size)
    own, coupling = whole[..., :6], whole[..., 6:]
    there = np.diagonal(own, axis1=2, axis2=3) > 1e-9
    taken = int(np.count_nonzero(there[0]))
    if not taken:
        return np.zeros(count), rest, 0
    own = np.where(there[..., :, None] & there[..., None, :], own, np.eye(6))
    coupling = np.where(there[..., :, None], coupling, 0.0)
    eliminated = np.linalg.solve(own, coupling).reshape(count, -1, size)
    rest -= np.swapaxes(coupling.reshape(count, -1, size), 1, 2) @ eliminated
    return np.linalg.slogdet(own)[1].sum(axis=1), rest, taken


def _restricted(family: StrandFamily, reduced: Array, count: int) -> tuple[Array, Array, float]:
    """Logarithm of the restricted likelihood (A,) without the determinant of R, s^2 (A,), and its degrees of freedom.

    What all other rows and the priors say of the shared numbers is a prior here; the whole is at its optimum.
    """
    own = family.products[6:, 6:]
    normal = np.eye(len(own) - 1) - own[:-1, :-1] + reduced[:, :-1, :-1]
    slope = reduced[:, :-1, -1] - own[:-1, -1]
    squares = reduced[:, -1, -1] - np.einsum("ai,ai->a", slope, np.linalg.solve(normal, slope[..., None])[..., 0])
    freedom = max(count - float(np.trace(own[:-1, :-1])), 1.0)
    variance = np.maximum(squares, 1e-9) / freedom
    return -0.5 * (freedom * np.log(variance) + np.linalg.slogdet(normal)[1]), variance, freedom
