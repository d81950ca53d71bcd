"""The evidence of random effects: whether, and by how much, something is off.

Q numbers that the model holds at zero (offsets of lines, bows of a board, bumps of a lens) are columns X beside its
free numbers. With P what the free numbers leave of the equations, the residuals r say of them V = X^T P X and u = X^T
P r. If the numbers have the covariance C, in variances of the noise, the residuals have 1 + X C X^T, and the restricted
likelihood of C (Patterson and Thompson, Biometrika 58, 1971) is a function of V, u and r^T P r alone. C is

    C = tau^2 1 + R R^T,

a scatter tau that all numbers share, and roots R of what some of them have besides. In the directions in which V is
diagonal, w = S^-1/2 U^T u with V = U S U^T, the scatter costs nothing, and R is small. Noise that is not known is
integrated out. Hypotheses are weighed by this evidence (Kass and Raftery, JASA 90, 1995).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.spread import known_inverses

_STEPS = 200
_ONE = 1.0  # directions of the least size that count along, so that few data do not make a size zero
_NO_SCATTER = np.zeros(1)


@dataclass(frozen=True, eq=False)
class RandomEffects:
    """What residuals say of Q numbers, in the R independent directions that they determine.

    Attributes:
        size: (R,) S of each direction. value: (R,) w. turn: (Q, R) U.
        rest: squared residuals that no amount of the numbers explains. freedom: equations left over for these and the
            numbers together; None where the noise is known to be one.
    """

    size: Array
    value: Array
    turn: Array
    rest: float = 0.0
    freedom: float | None = None

    @classmethod
    def of(
        cls, normal: Array, slope: Array, least: float, rest: float = 0.0, freedom: float | None = None
    ) -> RandomEffects:
        """From V (Q, Q) and u (Q,), without directions whose S is at most `least`."""
        size, turn = np.linalg.eigh(normal)
        kept = size > least
        size, turn = size[kept], turn[:, kept]
        return cls(size, (turn.T @ slope) / np.sqrt(size), turn, rest, freedom)

    def modes(self, root: Array) -> Array:
        """(..., R, Z) what roots (..., Q, Z) do to w."""
        return np.asarray(np.sqrt(self.size)[:, None] * (self.turn.T @ root))

    def log_evidence(self, modes: Array | None = None, scatter: Array = _NO_SCATTER) -> Array:
        """(H, T) logarithm of the restricted likelihood, up to a constant.

        Args:
            modes: (H, R, Z) of the roots of each hypothesis (see `modes`); none for that of scatter alone.
            scatter: (T,) tau, in standard deviations of the noise.
        """
        modes = np.zeros((1, len(self.size), 0)) if modes is None else modes
        precision, normal, slope = self._precisions(modes, scatter)
        explained = np.sum(self.value**2) - precision @ self.value**2
        logs = 0.5 * np.sum(np.log(precision), axis=1)
        if modes.shape[2]:
            inner = np.eye(modes.shape[2]) + normal
            explained = explained + np.sum(slope * np.linalg.solve(inner, slope[..., None])[..., 0], axis=-1)
            logs = logs - 0.5 * np.linalg.slogdet(inner)[1]
        if self.freedom is None:
            return np.broadcast_to(logs + 0.5 * explained, (len(modes), len(scatter)))
        left = self.rest + np.sum(self.value**2) - explained
        fit = -0.5 * self.freedom * np.log(left / max(self.freedom, 1.0))
        return np.broadcast_to(logs + fit, (len(modes), len(scatter)))

    def amounts(self, root: Array, scatter: float = 0.0) -> tuple[Array, Array]:
        """(Z,) likeliest amounts of a root (Q, Z), best linear unbiased predictions, and (Z,) standard deviations."""
        modes = self.modes(root)
        weighted = modes / (1.0 + scatter**2 * self.size)[:, None]
        covariance = np.linalg.inv(np.eye(root.shape[1]) + weighted.T @ modes)
        return -covariance @ (weighted.T @ self.value), np.sqrt(np.diagonal(covariance))

    def _precisions(self, modes: Array, scatter: Array) -> tuple[Array, Array, Array]:
        """(T, R) inverse variances of w by scatter; (H, T, Z, Z) and (H, T, Z) what they make of modes (H, R, Z)."""
        precision = 1.0 / (1.0 + np.multiply.outer(scatter**2, self.size))
        count, directions, width = modes.shape
        pairs = (modes[..., :, None] * modes[..., None, :]).reshape(count, directions, width * width)
        normal = (precision @ pairs).reshape(count, len(scatter), width, width)
        return precision, normal, precision @ (modes * self.value[:, None])


def logsum(logs: Array) -> Array:
    """(...) logarithm of the sum of hypotheses (..., N), whose prior probabilities are in their evidence."""
    most = np.max(logs, axis=-1, keepdims=True)
    return np.asarray((most + np.log(np.sum(np.exp(logs - most), axis=-1, keepdims=True)))[..., 0])


def agreement(scores: Array) -> float:
    """By how many standard deviations the scores (S, Q) of different groups agree, were they independent.

    The derivative of the evidence by a common variance at size zero, without what each group says by itself: products
    of different groups alone, over their standard deviation. A score test (Rao 1948); 0 of one group.
    """
    total, squares = scores.sum(axis=0), np.sum(scores**2, axis=0)
    variance = 2.0 * float(np.sum(squares**2) - np.sum(scores**4))
    return float(np.sum(total**2 - squares)) / np.sqrt(variance) if variance > 0.0 else 0.0


@dataclass(frozen=True, eq=False)
class Sizes:
    """The likeliest sizes of several effects, and what is then known of their numbers.

    Attributes:
        sigmas: (K,) of each effect. amount: (Q,) likeliest numbers. precision: (Q, Q) inverse of their covariance.
    """

    sigmas: Array
    amount: Array
    precision: Array


def likeliest_sizes(
    normal: Array, slope: Array, forms: Sequence[Array], sigmas: Array, least: Array, at_rest: float
) -> Sizes:
    """The standard deviations sigma of effects whose numbers c have the prior information sum F / sigma^2.

    The fixed point of MacKay (Neural Computation 4, 1992), sigma^2 = c^T F c / gamma, with gamma = rank F - tr(C F) /
    sigma^2 the number of directions that the data determine: the maximum of the restricted likelihood. One more
    direction of the least size counts along (an inverse gamma distribution beforehand).

    Args:
        normal, slope: (Q, Q) and (Q,) what data say of the numbers, whose best is normal^-1 slope. forms: (Q, Q) F of
            each. sigmas: (K,) to begin from. least: (K,) what data cannot talk a size below. at_rest: relative change
            of a size that ends the search.
    """
    ranks, unlimited = np.array([_rank(form) for form in forms]), np.full(len(slope), np.inf)
    for _ in range(_STEPS):
        precision = normal + sum(form / sigma**2 for form, sigma in zip(forms, sigmas, strict=True))
        covariance = known_inverses(precision, unlimited)
        amount = covariance @ slope
        known = ranks - np.array([np.sum(covariance * form) for form in forms]) / sigmas**2
        squares = np.array([amount @ form @ amount for form in forms])
        moved = np.sqrt((np.maximum(squares, 0.0) + _ONE * least**2) / (np.maximum(known, 0.0) + _ONE))
        done = np.max(np.abs(np.log(moved / sigmas))) < at_rest
        sigmas = moved
        if done:
            break
    return Sizes(sigmas, amount, np.asarray(precision))


def _rank(form: Array) -> int:
    rows = np.any(form != 0.0, axis=1)
    own = form[np.ix_(rows, rows)]
    diagonal = np.count_nonzero(own) == len(own)
    return len(own) if diagonal else int(np.linalg.matrix_rank(own, hermitian=True))
