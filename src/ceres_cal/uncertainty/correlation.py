"""Errors that go together along a curve, or over a board, within one view or over all views of a sight.

The covariance of a strand's residuals is R = s^2 [(1 - a) 1 + a exp(-d / l)] with d the distances on the target, and
over boards, which bend smoothly, also with exp(-(d / l)^2 / 2). The
restricted likelihood (Patterson and Thompson, Biometrika 58, 1971) of a grid of lengths l and shares a, private
placements eliminated, weighs them against independent errors, and the covariance of the scores is averaged over all
(the best alone would be too sure of itself). One set of eigenvectors serves all shares of a length. Whether there is
anything to look for is asked first by score tests at three lengths, which cost no likelihood.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.base.tails import student_95
from ceres_cal.uncertainty.between import INDEPENDENT
from ceres_cal.uncertainty.sample import Sample, Strand, evenly

# To 0.995: with 0.95 at most, lines that bend over 2 m are covered in 84 to 88 %.
_SHARES = np.array([0.1, 0.25, 0.5, 0.75, 0.9, 0.97, 0.995])
_ASIDE = 20.0  # times the longest strand: the length of what moves it as a whole
_FEWEST_FREEDOM = 3.0  # degrees of freedom that a variance is given at least
_NEAR, _FAR = 30, 30  # rows of a strand for the likelihood: next to one another, and over all of it
# The grid is run from so many standard deviations of a score test on (one in five of white noise), if the correlation
# that is likely by it would widen the variance of what is shared by so much.
_LOUD, _MATTERS = 0.85, 0.08
_FEWEST_ROWS = 12
_NO_NOISE = 1e-6  # mean square, in squared standard deviations, below which residuals are rounding
_INDEFINITE, _BISECTIONS = 1e6, 50  # degrees of freedom that are as good as any number
_NEGLIGIBLE = 1e-3  # weight below which a place on the grid is left out


@dataclass(frozen=True)
class Correlation:
    """How the errors of one kind of observation go together.

    Attributes:
        kind: "points" or "curves". probability: that they do. length_m, share: the likeliest length over which, None
            where whole curves lie aside, and share of the variance that does. lasting: whether over all views of a
            sight, not anew in each of them.
    """

    kind: str
    probability: float
    length_m: float | None
    share: float
    lasting: bool


@dataclass(frozen=True, eq=False)
class Covariances:
    """What correlated errors make of the scores.

    Attributes:
        scores: (G, P, P) covariance of each group's score. private: factor on the variance of private placements.
        inverse_freedom: 1 / degrees of freedom of these covariances. kinds: those that are correlated.
    """

    scores: Array
    private: float
    inverse_freedom: float
    kinds: tuple[Correlation, ...] = ()


def correlated(sample: Sample) -> Covariances:
    """The covariance of each group's score, with what errors have in common."""
    scores, private, inverse, kinds = sample.informations.copy(), [1.0], 0.0, []
    for is_curve, kind in ((False, "points"), (True, "curves")):
        families = [_Family.of(sample, s, number > 0) for number, s in enumerate(sample.families(is_curve))]
        rows = sample.is_curve == is_curve
        if np.count_nonzero(rows) < _FEWEST_ROWS or not any(_is_loud(sample, family) for family in families):
            continue
        if not is_curve:  # bent boards and lenses err smoothly, edges along a line do not
            families += [replace(family, smooth=True) for family in families]
        average = _averaged(sample, families, rows)
        change, factor = average.change(sample)
        scores += change
        private.append(factor)
        inverse += average.inverse_freedom
        kinds.append(average.correlation(kind))
    return Covariances(scores, max(private), inverse, tuple(kinds))


# ---- strands side by side -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Family:
    """S strands side by side, of M rows each at most that the likelihood looks at.

    Attributes:
        lasting: whether they go over several views. smooth: whether errors have no edges: exp(-(d / l)^2 / 2).
        strands: with all their rows. rows: (S, M) of the sample; filled: (S, M) which there are. distance: (D, M, M) m,
            infinite where one is missing; same: (S,) which of them is each strand's. view: (S,) whose private
            placement it shows.
    """

    lasting: bool
    smooth: bool
    strands: Sequence[Strand]
    rows: Indices
    filled: Mask
    distance: Array
    same: Indices
    view: Indices

    @classmethod
    def of(cls, sample: Sample, strands: Sequence[Strand], lasting: bool) -> _Family:
        """Of the strands of one kind."""
        picked = [_near_and_far(len(strand.rows)) for strand in strands]
        shape = len(strands), max(len(p) for p in picked)
        rows, filled = np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=bool)
        known: dict[bytes, int] = {}
        distances: list[Array] = []
        same = np.zeros(len(strands), dtype=np.int64)
        for number, (strand, at) in enumerate(zip(strands, picked, strict=True)):
            rows[number, : len(at)], filled[number, : len(at)] = strand.rows[at], True
            places = strand.places[at]
            same[number] = known.setdefault(places.tobytes(), len(known))
            if same[number] == len(distances):
                whole = np.full((shape[1], shape[1]), np.inf)
                whole[: len(at), : len(at)] = distances_of(places)
                np.fill_diagonal(whole, 0.0)
                distances.append(whole)
        return cls(lasting, False, strands, rows, filled, np.array(distances), same, sample.group[rows[:, 0]])

    @property
    def gap(self) -> float:
        """Median distance to the nearest neighbour, m; 0 where no strand has two places."""
        apart = np.where(self.distance > 0.0, self.distance, np.inf).min(axis=2)
        apart = apart[np.isfinite(apart)]
        return float(np.median(apart)) if len(apart) else 0.0

    @property
    def longest(self) -> float:
        """Of all its distances, m."""
        return float(np.max(self.distance, where=np.isfinite(self.distance), initial=0.0))

    def columns(self, values: Array) -> Array:
        """(S, M, Q) of values (E, Q), 0 where there is no row."""
        return np.asarray(values[self.rows] * self.filled[:, :, None])


@lru_cache(maxsize=256)
def _near_and_far(count: int) -> Indices:
    """Rows of a strand: some next to one another in its middle, and some over all of it."""
    middle = max(0, (count - _NEAR) // 2)
    return np.union1d(np.arange(middle, min(count, middle + _NEAR)), evenly(count, _FAR))


def _decay(distance: Array, length: float, smooth: bool) -> Array:
    """Correlation at distances: of a rough random function, or of a smooth one."""
    relative = distance / length
    return np.asarray(np.exp(-0.5 * relative**2 if smooth else -relative))


def distances_of(places: Array) -> Array:
    """(N, N) m between places (N, 3)."""
    squared = np.sum((places[:, None] - places[None]) ** 2, axis=2)
    return np.asarray(np.sqrt(squared))


# ---- is there anything to look for? ---------------------------------------------------------------------------------


def _is_loud(sample: Sample, family: _Family) -> bool:
    """Whether neighbours, nearby rows or whole strands agree more than they do in one of five sets of white noise.

    The score test of a share a of nothing: r' K r with K = exp(-d / l) - 1, against its expectation and variance under
    independent errors, of which the fit took up the part U U'.
    """
    gap, longest = family.gap, family.longest
    columns = family.columns(np.column_stack([sample.private, sample.shared, sample.left]))
    taken, left = columns[..., :-1], columns[..., -1]
    noise = np.sum(left**2) / max(np.count_nonzero(family.filled) - np.sum(taken**2), 1.0)
    if gap == 0.0 or noise < _NO_NOISE:
        return False
    left /= np.sqrt(noise)
    private = sample.private.shape[1]
    for length in (gap, np.sqrt(gap * longest), _ASIDE * longest):
        together = np.exp(-family.distance / length) * (family.distance > 0.0)
        squares = np.sum(together**2, axis=(1, 2))[family.same].sum()
        together = together if len(together) == 1 else together[family.same]
        along = together @ columns
        hat = taken * along[..., :-1]
        total = float(np.sum(left * along[..., -1]) + np.sum(hat))
        along = along[..., :-1]
        inner = np.swapaxes(taken, 1, 2) @ along
        variance = 2.0 * (squares - 2.0 * np.sum(along**2) + np.sum(inner**2))
        sd = float(np.sqrt(max(variance, 0.2 * squares)))
        widening = total / squares * float(np.sum(hat[..., private:]) / np.sum(taken[..., private:] ** 2))
        if total > _LOUD * sd and widening > _MATTERS:
            return True
    return False


# ---- the likelihood, averaged ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Grid:
    """One family at one length, and all shares A.

    Attributes:
        family: its number. length_m. shares: (A,). likelihood: (A,) its logarithm. variance: (A,) s^2.
        trace: (A,) of the scores' covariance. inverse_freedom: (A,) of that.
    """

    family: int
    length_m: float
    shares: Array
    likelihood: Array
    variance: Array
    trace: Array
    inverse_freedom: Array


@dataclass(frozen=True, eq=False)
class _Average:
    """The mean over the grid: the first place is independence, its weight first.

    Attributes:
        families: of strands. family, length_m, share, variance, weight: (N,) of each place on the grid.
        inverse_freedom: of what is averaged.
    """

    families: Sequence[_Family]
    family: Indices
    length_m: Array
    share: Array
    variance: Array
    weight: Array
    inverse_freedom: float

    def correlation(self, kind: str) -> Correlation:
        """What is likeliest."""
        best = 1 + int(np.argmax(self.weight[1:])) if len(self.weight) > 1 else 0
        length, longest = float(self.length_m[best]), max(family.longest for family in self.families)
        aside, probability = length > 2.0 * longest, float(1.0 - self.weight[0])
        share, lasting = float(self.share[best]), self.families[int(self.family[best])].lasting
        return Correlation(kind, probability, None if aside else length, share, lasting)

    def change(self, sample: Sample) -> tuple[Array, float]:
        """(G, P, P) what is added to the covariance of each group's score, and the factor on private placements."""
        both, used = np.hstack([sample.shared, sample.private]), self.weight > 0.0
        size, scores, private = sample.shared.shape[1], np.zeros_like(sample.informations), np.zeros(2)
        for number, family in enumerate(self.families):
            here = used & (self.family == number)
            alone = float(np.sum((self.weight * self.variance * (1.0 - self.share))[here]))
            together = (self.weight * self.variance * self.share)[here]
            lengths, kernels = self.length_m[here], {}
            for strand in family.strands:
                x = both[strand.rows]
                name = strand.places.tobytes()
                if name not in kernels:
                    kernels[name] = _kernel(strand.places, lengths, together, family.smooth)
                product = alone * (x.T @ x) + x.T @ (kernels[name] @ x)
                if number == 0:
                    product -= x.T @ x
                    private[1] += np.trace(x[:, size:].T @ x[:, size:])
                common = float(kernels[name].min()) * float(np.sum(x[:, size:].sum(axis=0) ** 2))
                private[0] += float(np.trace(product[size:, size:])) - common  # what moves all of it is not its scatter
                scores[sample.group[strand.rows[0]]] += product[:size, :size]
        return scores, float(1.0 + max(private[0], 0.0) / private[1]) if private[1] > 0.0 else 1.0


def _kernel(places: Array, lengths: Array, weights: Array, smooth: bool) -> Array:
    """(N, N) sum of weights exp(-d / length)."""
    distance, kernel = distances_of(places), np.zeros((len(places), len(places)))
    for length in np.unique(lengths[weights > 0.0]):
        kernel += float(np.sum(weights[lengths == length])) * _decay(distance, length, smooth)
    return kernel


def _averaged(sample: Sample, families: Sequence[_Family], rows: Mask) -> _Average:
    """The grid, weighed by likelihood and prior."""
    grids = [_likelihoods(sample, families[0], rows, 0, None)]
    grids += [g for number, family in enumerate(families) for g in _over_lengths(sample, family, rows, number)]
    family = np.repeat([g.family for g in grids], [len(g.shares) for g in grids])
    lengths = np.repeat([g.length_m for g in grids], [len(g.shares) for g in grids])
    share, variance = np.concatenate([g.shares for g in grids]), np.concatenate([g.variance for g in grids])
    likelihood, trace = np.concatenate([g.likelihood for g in grids]), np.concatenate([g.trace for g in grids])
    inverse = np.concatenate([g.inverse_freedom for g in grids])
    weight = np.full(len(share), (1.0 - INDEPENDENT) / max(len(share) - 1, 1))
    weight[0] = INDEPENDENT
    variance /= variance[0]  # the noise scale is that of independent errors
    weight *= np.exp(likelihood - likelihood.max())
    weight /= weight.sum()
    weight[weight < _NEGLIGIBLE] = 0.0
    weight /= weight.sum()
    rest = float(np.trace(_rest(sample, rows)))
    mixed = 1.0 / _freedom_of_mixture(weight[weight > 0.0], (rest + variance * trace)[weight > 0.0])
    return _Average(families, family, lengths, share, variance, weight, mixed + float(weight @ inverse))


def _rest(sample: Sample, rows: Mask) -> Array:
    """(P, P) what all but these rows say."""
    own = sample.shared[rows]
    return np.asarray(np.eye(own.shape[1]) - own.T @ own)


def _over_lengths(sample: Sample, family: _Family, rows: Mask, number: int) -> Iterator[_Grid]:
    gap, longest = family.gap, family.longest
    if gap == 0.0:
        return
    lengths = 0.5 * gap * 2.0 ** np.arange(np.ceil(np.log2(3.0 * longest / gap)))
    if not np.any(sample.private[family.rows[:, 0]]):  # a pose of its own takes up what moves the whole
        lengths = np.append(lengths, _ASIDE * longest)
    for length in lengths.tolist():
        yield _likelihoods(sample, family, rows, number, length)


def _likelihoods(sample: Sample, family: _Family, rows: Mask, number: int, length: float | None) -> _Grid:
    """The restricted likelihood at one length and all shares; without a length, of independent errors."""
    z = family.columns(np.column_stack([sample.private, sample.shared, sample.left]))
    if length is None:
        shares, values = np.zeros(1), family.filled.astype(float)
    else:
        shares = _SHARES
        eigenvalues, vectors = np.linalg.eigh(_decay(family.distance, length, family.smooth))
        z = np.swapaxes(vectors, 1, 2)[family.same] @ z
        values = np.maximum(eigenvalues, 0.0)[family.same]
    diagonal = 1.0 - shares[:, None, None] + shares[:, None, None] * values
    if length is None:
        diagonal = np.ones_like(diagonal)
    size, count = sample.shared.shape[1], int(family.filled.sum())
    products = np.swapaxes(z, 1, 2) @ (z / diagonal[..., None])
    logs, reduced, taken = _without_private(products, family.view)
    likelihood, variance, freedom = _restricted(sample, family, reduced, count - taken)
    likelihood -= 0.5 * (np.log(diagonal).sum(axis=(1, 2)) + logs)
    white = np.sum(z[..., 6 : 6 + size] ** 2, axis=2)
    parts = (1.0 - shares) * white.sum(), shares * np.sum(white * values)
    few = max(count**2 / float(np.sum(values**2)) - (0 if taken else size), _FEWEST_FREEDOM)
    inverse = (parts[0] ** 2 / freedom + parts[1] ** 2 / few) / np.maximum(parts[0] + parts[1], 1e-300) ** 2
    scale = np.sum(sample.shared[rows] ** 2) / max(float(white.sum()), 1e-300)  # of all rows to those looked at
    return _Grid(number, length or 0.0, shares, likelihood, variance, scale * (parts[0] + parts[1]), inverse)


def _without_private(products: Array, view: Indices) -> tuple[Array, Array, int]:
    """The private placement of each view eliminated from products (A, S, Z, Z): logarithms of the determinants (A,),
    what is left over of all (A, P + 1, P + 1), and how many numbers were eliminated.
    """
    order = np.argsort(view, kind="stable")
    first = np.flatnonzero(np.diff(view[order], prepend=-1))
    whole = np.add.reduceat(products[:, order], first, axis=1)
    own, coupling, rest = whole[..., :6, :6], whole[..., :6, 6:], whole[..., 6:, 6:]
    there = np.diagonal(own, axis1=2, axis2=3) > 1e-9
    taken = int(np.count_nonzero(there[0]))
    if not taken:
        return np.zeros(len(products)), np.sum(rest, axis=1), 0
    own = np.where(there[..., :, None] & there[..., None, :], own, np.eye(6))
    coupling = np.where(there[..., :, None], coupling, 0.0)
    rest = rest - np.swapaxes(coupling, 2, 3) @ np.linalg.solve(own, coupling)
    return np.linalg.slogdet(own)[1].sum(axis=1), rest.sum(axis=1), taken


def _restricted(sample: Sample, family: _Family, reduced: Array, count: int) -> tuple[Array, Array, float]:
    """Logarithm of the restricted likelihood (A,) without the determinant of R, s^2 (A,), and its degrees of freedom.

    What all other rows and the priors say of the shared numbers is a prior here; the whole is at its optimum.
    """
    used = family.rows[family.filled]
    x, r = sample.shared[used], sample.left[used]
    normal = np.eye(x.shape[1]) - x.T @ x + reduced[:, :-1, :-1]
    slope = reduced[:, :-1, -1] - x.T @ r
    squares = reduced[:, -1, -1] - np.einsum("ai,ai->a", slope, np.linalg.solve(normal, slope[..., None])[..., 0])
    freedom = max(count - float(np.sum(x**2)), 1.0)
    variance = np.maximum(squares, 1e-9) / freedom
    likelihood = -0.5 * (freedom * np.log(variance) + np.linalg.slogdet(normal)[1])
    return likelihood, variance, freedom


# ---- degrees of freedom of a mixture --------------------------------------------------------------------------------


def _freedom_of_mixture(weights: Array, variances: Array) -> float:
    """Degrees of freedom at which Student's t is as wide at 95 % as a mixture of normals of these variances, once both
    have the same mean variance.
    """
    mean = float(weights @ variances)

    def beyond(width: float) -> float:
        inside = [math.erf(width * math.sqrt(0.5 * mean / v)) for v in variances.tolist()]
        return 0.05 - (1.0 - float(weights @ inside))

    width = _root_of(beyond, 1.0, 12.0)
    return math.exp(_root_of(lambda log: width - student_95(math.exp(log)), 0.0, math.log(_INDEFINITE)))


def _root_of(rising: Callable[[float], float], low: float, high: float) -> float:
    """Where a rising function changes its sign, by bisection; one of the ends where it does not."""
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if rising(middle) < 0.0 else (low, middle)
    return 0.5 * (low + high)
