"""A posterior as a mixture of normal distributions: weight, position and information of each component.

One component is enough where the cost is quadratic and there is no alternative. Along a valley of phi there is one at
each node, in the order of phi; between two nodes values are interpolated. Curves through the ends of weak directions,
other explanations, other minima and other lenses are components, too. Bounds are quantiles of the mixture, standard
deviations its moments.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from ceres_cal.base import (
    NORMAL_95,
    NORMAL_95_ONE_SIDED,
    Array,
    Frozen,
    Indices,
    Mask,
    cached_property,
    dots,
    field,
    replace,
    tail_root,
)
from ceres_cal.kernels import mixture_above, normal_cdf
from ceres_cal.problem.information import Information, Key, over

FARTHER = 3.0
"""Standard deviations up to which valleys are followed: where one widens out there, this counts in standard deviations
and radii, not only what lies within 95 %."""
# Share of a flat prior on log phi in the weights along a valley. The rest is by the signed root of the rise, which is
# normal for any parameter of the valley, but says nothing where the valley is flat.
_FLAT = 0.1
_TWICE = (np.log(2.0), np.log(4.0))
# Standard deviations across: a number that changes by less over the last factor two of phi is bounded by the data. From
# straight above 32 % of the intervals are open, 55 % at half, 18 % at double this value; all contain the truth.
_BOUNDED = 1.0
# Ratio of the changes over two successive factors two of phi: 1/2 for numbers that decrease with phi towards 0, 1 for
# numbers that change without end. Nothing changes from 0.6 to 0.86.
_SHRINKING = 0.75
_REACH = 8.0  # standard deviations beyond which no quantile lies


class Chain(NamedTuple):
    """Components along the phi of one camera, in the order of phi.

    Attributes:
        at: (N,) indices of the components. roots: (N,) signed roots of twice the rise of the cost there: the height on
            either side of the valley, in standard deviations.
    """

    at: Indices
    roots: Array


class Mixture(Frozen):
    """The joint distribution of some numbers.

    Attributes:
        keys: (K) the numbers, phi first where it was followed. weights: (C,) probabilities.
        steps: (C, K) from the estimate to the centre of each component.
        information: (I) about the numbers; keys that it lacks are held. at: (C,) index of each component's information.
        chains: of components along phi. phi_px: phi of the estimate; 0 where there is no chain.
        open_below, open_above: whether the valley does not rise to the 95 % bound within the range of lenses.
        lenses: component with another lens -> that lens, and the component that differs only by the lens: their steps
            show how the numbers follow it.
    """

    keys: tuple[Key, ...]
    weights: Array
    steps: Array
    information: tuple[Information, ...]
    at: Indices
    chains: tuple[Chain, ...] = ()
    phi_px: float = 0.0
    open_below: bool = False
    open_above: bool = False
    lenses: Mapping[int, tuple[int, int]] = field(default_factory=dict)

    @classmethod
    def of_one(cls, information: Information, step: Array | float = 0.0) -> Mixture:
        """Return a normal distribution centred at the estimate, or so far (K,) from it."""
        steps = np.zeros((1, len(information.keys))) + step
        return cls(information.keys, np.ones(1), steps, (information,), np.zeros(1, dtype=np.int64))

    @classmethod
    def along_phi(
        cls, keys: tuple[Key, ...], phi_px: float, steps: Array, rises: Array, across: Sequence[Information],
        is_open: tuple[bool, bool],
    ) -> Mixture:  # fmt: skip
        """Return a valley, from twice the rise of the cost and the information about all keys but phi at each node."""
        side = np.where(np.arange(len(steps)) < np.argmin(rises), -1.0, 1.0)
        chain = Chain(np.arange(len(steps)), side * np.sqrt(np.asarray(rises)))
        numbers = np.zeros(len(steps)), np.asarray(steps), tuple(across), chain.at
        mixture = cls(keys, *numbers, (chain,), phi_px, *is_open)
        weights, between, _ = mixture._between(chain)
        each = weights @ between
        return replace(mixture, weights=each / each.sum())

    @property
    def phi(self) -> Array:
        """(C,) px of each component, where phi was followed."""
        return np.asarray(self.phi_px + self.steps[:, 0])

    @property
    def is_followed(self) -> bool:
        """Whether phi was followed along its profile."""
        return bool(self.chains)

    @property
    def chosen(self) -> Mixture:
        """The distribution if the chosen lens is the right one."""
        return self.of(~np.isin(np.arange(len(self.weights)), list(self.lenses))) if self.lenses else self

    def of(self, own: Mask) -> Mixture:
        """Return the distribution if one of these components (C,) is right; lenses are no longer distinguished."""
        place, weights = np.cumsum(own) - 1, self.weights[own] / self.weights[own].sum()
        chains = tuple(Chain(place[chain.at], chain.roots) for chain in self.chains if own[chain.at].all())
        numbers = {"weights": weights, "steps": self.steps[own], "at": self.at[own]}
        return replace(self, **numbers, chains=chains, lenses={})

    def marginal(self, keys: Sequence[Key]) -> Mixture:
        """Return the distribution of some of the numbers, in their order here."""
        wanted = set(keys)
        at = [number for number, key in enumerate(self.keys) if key in wanted]
        each = tuple(one.marginal([key for key in one.keys if key in wanted]) for one in self.information)
        return replace(self, keys=tuple(self.keys[number] for number in at), steps=self.steps[:, at], information=each)

    @cached_property
    def variances(self) -> Array:
        """(C, K) within each component; 0 for held numbers, infinite where unknown."""
        return np.array([over(one.spread.sd**2, one.keys, self.keys) for one in self.information])[self.at]

    @cached_property
    def sd(self) -> Array:
        """(K,) root mean squares about the estimate; along a valley no more than its bounds imply, so that a thin tail
        beyond these has no effect.
        """
        read = self.refined(self.steps, self.variances)
        if not self.is_followed:
            return moments(*read)
        reach = [np.max(np.abs(quantiles(*read, width)), axis=0) / width for width in (NORMAL_95, FARTHER)]
        return np.asarray(np.minimum(moments(*read), np.max(reach, axis=0)))

    @property
    def covariance(self) -> Array:
        """(K, K) second moments about the estimate; open valleys count as far as they were followed, and what is
        unknown in components is left out.
        """
        every = ((one.keys, one.spread.covariance) for one in self.information)
        within = np.array([over(over(matrix, keys, self.keys).T, keys, self.keys) for keys, matrix in every])
        closed = replace(self, open_below=False, open_above=False)
        weights, steps, known = closed.refined(self.steps, within[self.at])
        return np.asarray(np.tensordot(weights, known, axes=1) + (weights * steps.T) @ steps)

    def bounds(self, half_width: float) -> Array:
        """(K, 2) bounds outside which, on either side, lies as much as of a normal variable beyond so many sigmas."""
        return np.column_stack(quantiles(*self.refined(self.steps, self.variances), half_width))

    def with_information(self, how: Callable[[Information], Information]) -> Mixture:
        """Return a copy with other information in each component."""
        return replace(self, information=tuple(map(how, self.information)))

    def shifted_also(self, weights: Array, shifts: Array, lenses: Sequence[int] = ()) -> Mixture:
        """Return a mixture that also has a copy of itself for each of the weights (S,), shifted by (S, C, K) or (S, 1,
        K). For shifts to other lenses, these are the lenses' numbers (S,).
        """
        every, count = [1.0 - weights.sum(), *weights], len(self.weights)
        shown = {
            copy * count + component: (lens, copy * count + alike)
            for copy in range(len(every))
            for component, (lens, alike) in self.lenses.items()
        }
        shown |= {
            copy * count + component: (lens, component)
            for copy, lens in enumerate(lenses, 1)
            for component in range(count)
            if component not in self.lenses
        }
        steps = np.concatenate([self.steps, *(self.steps + shift for shift in shifts)])
        chains = tuple(
            Chain(chain.at + copy * count, chain.roots) for copy in range(len(every)) for chain in self.chains
        )
        of_all = np.concatenate([weight * self.weights for weight in every])
        at = np.tile(self.at, len(every))
        return replace(self, weights=of_all, steps=steps, at=at, chains=chains, lenses=shown)

    def beside(self, other: Mixture, weight: float) -> Mixture:
        """Return a mixture with another one of the same numbers, from the same estimate, by the other's weight."""
        weights = np.concatenate([(1.0 - weight) * self.weights, weight * other.weights])
        steps, known = np.concatenate([self.steps, other.steps]), (*self.information, *other.information)
        at = np.concatenate([self.at, len(self.information) + other.at])
        chains = (*self.chains, *(Chain(len(self.at) + chain.at, chain.roots) for chain in other.chains))
        return replace(self, weights=weights, steps=steps, information=known, at=at, chains=chains)

    def off_valley(self, shifts: Array) -> Array:
        """(S, K) parts of shifts (S, K) off the first chain, with phi held: shifts along it change nothing."""
        steps = self.steps[self.chains[0].at]
        along = np.array([[np.interp(d[0], steps[:, 0], column) for column in steps.T] for d in shifts])
        return np.asarray((shifts - along.reshape(shifts.shape)) * (np.arange(len(self.keys)) > 0))

    # ---- between the nodes of a valley ------------------------------------------------------------------------------

    def refined(self, values: Array, variances: Array) -> tuple[Array, Array, Array]:
        """Return weights (F,), values (F, ...) and variances (F, ...), including those between the nodes of chains, and
        beyond open ends: infinite where values grow without end.

        Args:
            values: (C, ...) of the components. variances: (C, ...) as many, or matrices of the last axis.
        """
        if not self.chains:
            return self.weights, values, variances
        alone = np.ones(len(self.weights), dtype=bool)
        alone[np.concatenate([chain.at for chain in self.chains])] = False
        parts = [(self.weights[alone], values[alone], variances[alone])]
        parts += [part for chain in self.chains for part in self._along(chain, values, variances)]
        weights, means, widths = (np.concatenate(column) for column in zip(*parts, strict=True))
        return weights, means, widths

    def _along(self, chain: Chain, values: Array, variances: Array) -> Iterator[tuple[Array, Array, Array]]:
        """Yield the parts of `refined` along a chain."""
        overlap = 0.5  # width of each interpolated place, as a share of the way to the next: avoids steps
        whole = float(self.weights[chain.at].sum())
        weights, between, across = self._between(chain)
        share = whole / weights.sum()
        own, widths = values[chain.at], variances[chain.at]
        ends = ((self.open_below, 0), (self.open_above, -1))
        kept = np.array([not ends[0][0], *[True] * (len(weights) - 2), not ends[1][0]])
        jump = overlap * _mixed(across[kept], own)
        jumps = jump[..., :, None] * jump[..., None, :] if widths.ndim > own.ndim else jump**2
        yield share * weights[kept], _mixed(between[kept], own), _mixed(between[kept], widths) + jumps
        for is_open, end in ends:
            if is_open:
                sds = np.sqrt(np.diagonal(widths[end], axis1=-2, axis2=-1) if widths.ndim > own.ndim else widths[end])
                yield share * weights[[end]], self._limit(chain, own, sds, end)[None], widths[[end]]

    def _between(self, chain: Chain) -> tuple[Array, Array, Array]:
        """Return weights (F,) of places along the valley, ends included; shares (F, N) of nodes, and steps of these."""
        fine = 0.25  # standard deviations from one interpolated place to the next; nothing changes from half to double
        roots, log_phi = chain.roots, np.log(self.phi[chain.at])
        near, each = np.clip(roots, -_REACH, _REACH), np.eye(len(roots))  # farther up weights are negligible
        beyond, whole = near - roots, np.where(np.diff(roots) == 0.0, 1.0, np.diff(roots))
        counts = np.maximum(np.ceil(np.abs(np.diff(near)) / fine), 2).astype(int)
        share = (1.0 + np.diff(beyond) / whole) / counts
        node = np.repeat(np.arange(len(counts)), counts)
        done = np.concatenate([np.arange(n) + 0.5 for n in counts])
        part = np.clip((beyond[:-1] / whole)[node] + share[node] * done, 0.0, 1.0)  # also where both nodes are too far
        places = np.zeros((len(node), len(roots)))
        places[np.arange(len(node)), node], places[np.arange(len(node)), node + 1] = 1.0 - part, part
        long = (1.0 - _FLAT) * np.abs(np.diff(roots)) + _FLAT * np.abs(np.diff(log_phi))
        weights = np.exp(-0.5 * (places @ roots) ** 2) * (long * share)[node]
        ends = np.sqrt(2.0 * np.pi) * normal_cdf(-np.abs(roots[[0, -1]]))
        weights, places = np.concatenate([ends[:1], weights, ends[1:]]), np.concatenate([each[:1], places, each[-1:]])
        return weights, places, np.pad((each[node + 1] - each[node]) * share[node][:, None], ((1, 1), (0, 0)))

    def _limit(self, chain: Chain, values: Array, sds: Array, end: int) -> Array:
        """Return the limit of numbers (N, ...) beyond an open end: by a geometric series with a term for each further
        factor two of phi, infinite where the last two terms do not shrink.
        """
        phi = self.phi[chain.at]
        away = np.abs(np.log(phi / phi[end]))
        order = np.argsort(away)
        flat = values.reshape(len(values), -1)
        each = np.eye(len(phi))[:, order]  # shares of the nodes are the same for all numbers: a map has thousands
        halves = _mixed(np.array([[np.interp(d, away[order], one) for one in each] for d in _TWICE]), flat)
        last, before = flat[end] - halves[0], halves[0] - halves[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = np.abs(last / before)
            limit = flat[end] + last * ratio / (1.0 - ratio)
        going = np.where(np.abs(last) > _BOUNDED * sds.ravel(), np.copysign(np.inf, last), flat[end] + last)
        return np.asarray(np.where(ratio < _SHRINKING, limit, going)).reshape(values.shape[1:])


def _mixed(between: Array, values: Array) -> Array:
    """(F, ...) weighted sums of values (N, ...); infinite where a value with a weight is infinite."""
    flat = values.reshape(len(values), -1)
    finite = np.isfinite(flat)
    mixed = between @ np.where(finite, flat, 0.0)
    if not finite.all():
        mixed[between @ ~finite > 0.0] = np.inf
    return np.asarray(mixed).reshape(len(between), *values.shape[1:])


# ---- readings of a mixture ------------------------------------------------------------------------------------------


def moments(weights: Array, means: Array, variances: Array) -> Array:
    """(...) root mean squares about the estimate, from means and variances (F, ...)."""
    return np.asarray(np.sqrt(_mixed(weights[None], variances + means**2)[0]))


def are_unbounded(weights: Array, means: Array, variances: Array, half_width: float) -> Mask:
    """(...) whether either of the `quantiles` is infinite, for a mixture's means and variances (F, ...)."""
    tail = float(normal_cdf(-half_width))
    lost = [0.5 * np.isinf(variances), means == np.inf, means == -np.inf]
    return np.asarray(np.any([np.tensordot(weights, one.astype(float), axes=1) > tail for one in lost], axis=0))


def quantiles(weights: Array, means: Array, variances: Array, half_width: float) -> tuple[Array, Array]:
    """(...) below and above which as much of a mixture lies, by means and variances (F, ...), as of a normal variable
    beyond so many sigmas. Components without a variance lie half beyond any place: infinite where that is more.
    """
    nowhere = 0.5 * np.tensordot(weights, np.isinf(variances).astype(float), axes=1)
    unknown = nowhere > normal_cdf(-half_width)
    sds = np.sqrt(np.where(unknown, 1.0, variances))
    low, high = (_quantile(weights, sign * means, sds, half_width) for sign in (-1.0, 1.0))
    return np.where(unknown, -np.inf, -low), np.where(unknown, np.inf, high)


def _quantile(weights: Array, means: Array, sds: Array, half_width: float) -> Array:
    """(...) value above which as much of the mixture lies."""
    if len(weights) == 1:
        return np.asarray(means[0] + half_width * sds[0])
    finite, tail = np.isfinite(means) & np.isfinite(sds), float(normal_cdf(-half_width))
    beyond = np.tensordot(weights, (means == np.inf).astype(float), axes=1) > tail
    low = np.where(beyond, 0.0, np.min(np.where(finite, means - _REACH * sds, np.inf), axis=0))
    high = np.where(beyond, 0.0, np.max(np.where(finite, means + _REACH * sds, -np.inf), axis=0))
    scales = 1.0 / np.maximum(sds, np.finfo(float).tiny).reshape(len(weights), -1)
    above = partial(mixture_above, weights, means.reshape(len(weights), -1), scales)
    return np.where(beyond, np.inf, tail_root(above, low.ravel(), high.ravel(), tail).reshape(low.shape))


def normal_quantile(tail: float) -> float:
    """Return how many standard deviations have this probability of a normal variable above them."""
    return float(tail_root(lambda x, _: normal_cdf(-x), np.zeros(1), np.full(1, _REACH), tail)[0])


def radii(weights: Array, means: Array, covariances: Array, tails: Sequence[float] = (0.05,)) -> Iterator[Array]:
    """Yield for each tail the (N,) radius of the circle about the estimate outside which that share of a mixture lies,
    with means (F, N, 2) and covariances (F, N, 2, 2).

    The squared length is approximated by a scaled chi-squared variable of the same mean and variance: within 1 %.
    """
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        square = covariances[..., 0, 0] + covariances[..., 1, 1] + dots(means, means)
        finite = np.nan_to_num(covariances, nan=0.0)
        across = finite[..., 0] * means[..., :1] + finite[..., 1] * means[..., 1:]
        variance = 2.0 * np.einsum("fnij,fnij->fn", finite, finite) + 4.0 * dots(means, across)
        cubed = variance / (9.0 * square**2)  # 2 / (9 degrees of freedom); Wilson and Hilferty
    sized = np.isfinite(square) & np.isfinite(variance) & (square > 0.0)
    unsized = np.where(square == 0.0, 0.0, np.inf)
    square, cubed = np.where(sized, square, 1.0), np.where(sized, np.maximum(cubed, 1e-30), 1e-30)
    lost = np.tensordot(weights, (~sized & (unsized > 0.0)).astype(float), axes=1)

    # The cube root of a squared length is normal; components of size 0 lie within any circle, unknown ones outside.
    cube, spread = np.cbrt(square), np.sqrt(cubed)
    middles = np.where(sized, (1.0 - cubed) * cube, np.where(unsized > 0.0, np.inf, -np.inf))
    scales = np.where(sized, 1.0 / (cube * spread), 1.0)

    def above(radius: Array, columns: Indices) -> Array:
        return mixture_above(weights, middles, scales, np.cbrt(radius**2), columns)

    for tail in tails:
        away = NORMAL_95_ONE_SIDED if tail == 0.05 else normal_quantile(tail)
        each = np.where(sized, np.sqrt(square * (1.0 - cubed + away * spread) ** 3), unsized)
        if len(weights) == 1:
            yield each[0]
            continue
        nowhere = lost > tail
        # Unknown components use up some of the tail, so the radius may be larger than that of each other component.
        reach = np.where(lost > 0.0, _REACH * np.sqrt(square), each)
        largest = np.max(np.where(np.isfinite(each) & ~nowhere, reach, 0.0), axis=0)
        yield np.where(nowhere, np.inf, tail_root(above, np.zeros_like(largest), largest, tail))


_LARGER = 0.5  # share of the radius at FARTHER that counts, where a valley widens out there


class Reading(Frozen):
    """The distribution of N pairs of numbers by a posterior, relative to the estimate.

    Attributes:
        weights: (F,) of components. means, known: (F, N, 2), (F, N, 2, 2) moments of each. lost: (N,) not shown by one.
        width: standard deviations from the middle to either end of a 95 % interval. is_followed: along a valley.
    """

    weights: Array
    means: Array
    known: Array
    lost: Mask
    width: float
    is_followed: bool

    @property
    def low(self) -> Array:
        """(N, 2) lower 95 % bound of each number; infinite where unknown."""
        return self._bounds[0]

    @property
    def high(self) -> Array:
        """(N, 2) upper 95 % bound of each number; infinite where unknown."""
        return self._bounds[1]

    @cached_property
    def _bounds(self) -> tuple[Array, Array]:
        low, high = quantiles(self.weights, self.means, self._variances, self.width)
        return np.where(self.lost[:, None], -np.inf, low), np.where(self.lost[:, None], np.inf, high)

    @property
    def _variances(self) -> Array:
        return np.diagonal(self.known, axis1=-2, axis2=-1)

    @cached_property
    def _is_open(self) -> Mask:
        """(N,) whether a bound is infinite."""
        return self.lost | are_unbounded(self.weights, self.means, self._variances, self.width).any(axis=1)

    @cached_property
    def radius_95(self) -> Array:
        """(N,) radius within which 95 % of the errors lie."""
        far = 2.0 * float(normal_cdf(-FARTHER))
        tails = (0.05, far) if self.is_followed else (0.05,)
        near, *farther = radii(self.weights, self.means, self.known, tails)
        radius = near * self.width / NORMAL_95
        for one in farther:  # for a normal it is 0.7 of the radius, without effect; 5 % of a valley may show nothing
            radius = np.maximum(radius, np.where(np.isfinite(one), _LARGER * one, 0.0))
        return np.where(self._is_open, np.inf, radius)

    @cached_property
    def _moments(self) -> tuple[Array, Array]:
        """`covariance` and `sd`."""
        of_round = 2.447 / np.sqrt(2.0)  # 95 % radius of an isotropic error over its rms length
        covariance = np.asarray(np.einsum("f,fnij->nij", self.weights, self.known))
        with np.errstate(invalid="ignore"):
            weighted = np.transpose(self.weights[:, None, None] * self.means, (1, 2, 0))
            covariance = covariance + weighted @ np.swapaxes(self.means, 0, 1)
        covariance[self._is_open] = np.diag([np.inf, np.inf])
        sd = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
        sd = np.minimum(sd, self.radius_95 / of_round) if self.is_followed else sd
        thin = ~np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(sd)  # a thin tail is unknown
        covariance[thin] = 0.5 * sd[thin, None, None] ** 2 * np.eye(2)
        return covariance, sd

    @property
    def covariance(self) -> Array:
        """(N, 2, 2) second moments."""
        return self._moments[0]

    @property
    def sd(self) -> Array:
        """(N,) root mean square length of the errors; along a valley no more than the radius implies, so that a thin
        tail beyond it has no effect.
        """
        return self._moments[1]
