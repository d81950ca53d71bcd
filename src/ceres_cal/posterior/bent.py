"""Where the quadratic picture bends: the least cost at the ends of weak directions, and by how much that widens.

A direction that is known to a few hundredths of its natural size reaches so far that the least cost there is a curve,
not a line: one board before a lens with tangential terms fits nearly as well with its principal point a quarter of the
image aside and all coefficients changed along. At both ends of each such direction the rest is solved for anew; what
the numbers do there makes the posterior a mixture of components along curves through these ends. Nothing is solved
where all directions are well known.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError, InputError
from ceres_cal.base.tails import normal_cdf
from ceres_cal.posterior.mixture import Mixture
from ceres_cal.problem.bundle import Solution, solve
from ceres_cal.problem.information import Information, Key, over
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.priors import GaussianPrior
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import difference, moved, natural_sizes

# Sigma in natural sizes from which on a direction is looked at.
BENDING = 0.01
_HELD = 0.005  # of a step: how closely its end is held
_FARTHEST = 4.0  # times as far as the normal equations have it: what is flatter than that is unknown
_FEW = 300  # equations beside which other minima are sought: not measured; the cases mended had under 200
_MOST_ITERATIONS = 30  # of each end: along a flat valley the solver creeps for hundreds that change nothing here
_NEAR = 1e-6  # of a variance: how nearly each end costs the least; by a thousandth of a standard deviation it is off
_FAR_OUT = 3.0  # times 95 %: where a search for another minimum starts
# Another minimum lies so far off, of the rise at an end, by what the normal equations say, and costs less than so much
# of that: the same one, not quite reached, costs all of it.
_OTHER, _SAME = 0.25, 0.25
_WITHIN = 0.25  # share of a weak direction's variance that each component along its curve has by itself
_LEAST_PAIRS = 12  # of components


@dataclass(frozen=True, eq=False)
class Ends:
    """What the numbers do at the ends of weak directions.

    Attributes:
        keys: (K). steps: (2 B, K) as far as the quadratic picture has the ends of the 95 % interval along each
            direction, upper ones first. ends: (2 B, K) where the least cost has risen there as much.
        half_width: standard deviations that a step is long. information: of the quadratic picture.
        minima: (M, K) others that fit as well. odds: (M,) theirs.
    """

    keys: tuple[Key, ...]
    steps: Array
    ends: Array
    half_width: float
    information: Information
    minima: Array
    odds: Array

    @property
    def excesses(self) -> Array:
        """(2 B, K) by how much the ends are farther off, in standard deviations' worth of half a direction each."""
        return np.asarray((self.ends - self.steps) / (self.half_width * np.sqrt(2.0)))

    def widened(self, information: Information) -> Information:
        """Information about some of the keys with the excesses as variances of their own."""
        return information.widened(over(self.excesses, self.keys, information.keys))

    def beside(self, stated: Information) -> Ends:
        """With ends no farther than what was stated lets them be.

        With L what the observations say, P what was stated, C = (L + P)^-1 and E the excesses, the covariance of L + P
        with L widened by E is C + G^T N^-1 G, where G = E L C and N = 1 + E L C P E^T: N^-1/2 G takes the place of E.
        """
        if not np.any(stated.matrix):
            return self
        moved = self.excesses @ self.information.less(stated).matrix @ self.information.inverse
        left = moved @ stated.matrix @ self.excesses.T
        values, vectors = np.linalg.eigh(np.eye(len(left)) + 0.5 * (left + left.T))
        excesses = (vectors / np.sqrt(np.maximum(values, 1.0))) @ vectors.T @ moved
        return replace(self, ends=self.steps + self.half_width * np.sqrt(2.0) * excesses)

    def mixture(self, information: Information) -> Mixture:
        """Components along the curves through the ends, of all directions at once: half of them the mirror images of
        the others, together as wide as the directions are, less what each is wide by itself.

        Args:
            information: of everything that is shared.
        """
        up, down = np.split(self.ends / self.half_width, 2)
        linear, square = 0.5 * (up - down), 0.5 * (up + down) / self.half_width
        along = np.sqrt(1.0 - _WITHIN) * _drawn(len(up))
        along = along[np.argsort(np.linalg.norm(along, axis=1), kind="stable")]
        keys, steps = information.keys, over(along @ linear + along**2 @ square, self.keys, information.keys)
        rows = np.split(self.steps / self.half_width, 2)[0] @ self.information.matrix
        rows = over(rows, self.keys, keys)
        known = Information(keys, information.matrix + (1.0 / _WITHIN - 1.0) * rows.T @ rows)
        return Mixture(keys, np.full(len(steps), 1.0 / len(steps)), steps, (known,) * len(steps))


def _drawn(count: int) -> Array:
    """(2 H, count) normal variables, uncorrelated and of variance one: H and their mirror images."""
    half = max(_LEAST_PAIRS, 2 * count)
    grid = np.linspace(0.0, 4.0, 401)
    each = np.interp((np.arange(half) + 0.5) / half, 2.0 * normal_cdf(grid) - 1.0, grid)
    rng = np.random.default_rng(0)
    drawn = np.column_stack([rng.permutation(each) * rng.choice((-1.0, 1.0), half) for _ in range(count)])
    values, vectors = np.linalg.eigh(drawn.T @ drawn / half)
    drawn = drawn @ (vectors / np.sqrt(values)) @ vectors.T
    return np.asarray(np.concatenate([drawn, -drawn]))


def weak_axes(information: Information, estimate: Estimate, keys: Sequence[Key]) -> Array:
    """(K, A) directions of some of the keys whose sigma in natural sizes is above BENDING, one sigma long, in the units
    of the keys.

    Structure is not looked at, nor what is not known at all, nor a lens without a formula, which is a sum of what its
    numbers do.
    """
    sizes, at = natural_sizes(estimate, keys), information.columns(keys)
    sums = {(name, q) for name, one in estimate.cameras.items() for form in one.lens.roughness for q in form.names}
    plain = np.array([key.kind != "structure" and key[1:3] not in sums for key in keys], dtype=bool)
    scaled = information.spread.covariance[np.ix_(at, at)] / sizes[:, None] / sizes
    values, vectors = np.linalg.eigh(np.where(plain[:, None] & plain, scaled, 0.0))
    weak = values > BENDING**2
    return np.asarray(vectors[:, weak] * np.sqrt(values[weak]) * sizes[:, None])


def ends_of(
    problem: Problem, estimate: Estimate, information: Information, by_model: Information, half_width: float
) -> Ends | None:
    """What the numbers of the information do at the ends of its weak directions, and, of few observations, where other
    minima are that fit as well; None where it has no such direction.

    Args:
        problem: whose cost is least at the estimate. information: as the data scatter. by_model: as that cost says.
    """
    keys, sizes = information.keys, natural_sizes(estimate, information.keys)
    axes = weak_axes(information, estimate, keys)
    if not axes.shape[1]:
        return None
    least = 2.0 * solve(problem, estimate).cost
    few, minima = problem.sights.equations < _FEW, _Minima(by_model, sizes, least)
    steps, excesses = [], []
    for sign in (half_width, -half_width):
        for axis in axes.T:
            slopes = axis / sizes**2 / float(np.sum((axis / sizes) ** 2))
            # The cost rises as the model has it, which knows the direction better than the data scatter.
            rise = half_width**2 / float(slopes @ by_model.spread.covariance @ slopes)
            along, step = sign * axis, sign * (information.spread.covariance @ slopes) / sizes
            end = _end(problem, estimate, keys, along)
            found = [_excess(end, step, least, rise)]
            far = _end(problem, estimate, keys, _FAR_OUT * along) if few else None
            if far is not None:
                minima.look(_solved(problem, far.estimate), estimate, rise, half_width)
                # Where the cost rises ever less, the interval ends between; far ends by themselves tell nothing.
                nearer = _FAR_OUT * _reach(far, least, rise)
                if nearer > 1.0:
                    found.append(_excess(_end(problem, estimate, keys, nearer * along), step, least, rise, nearer))
            steps.append(step)
            excesses.append(max(found, key=lambda one: float(np.linalg.norm(np.clip(one, -1.0, 1.0)))))
    reached = np.array(steps)
    return Ends(keys, reached * sizes, (reached + excesses) * sizes, half_width, information, *minima.found)


class _Minima:
    """Other minima that fit as well, each once, with their odds."""

    def __init__(self, information: Information, sizes: Array, least: float) -> None:
        self._information, self._sizes, self._least = information, sizes, least
        self._steps: list[Array] = []
        self._odds: list[float] = []

    def look(self, other: Solution | None, estimate: Estimate, rise: float, half_width: float) -> None:
        """Keep it where it costs no more than an end of an interval, and is no part of the same one."""
        if other is None:
            return
        step = difference(other.estimate, estimate, self._information.keys)
        above = max(2.0 * other.cost - self._least, 0.0)
        apart = float(step @ self._information.matrix @ step)
        known = any(np.max(np.abs(step - one) / self._sizes) < BENDING for one in self._steps)
        if above <= rise and apart > max(_OTHER * rise, above / _SAME) and not known:
            self._steps.append(step)
            self._odds.append(float(np.exp(-0.5 * above * half_width**2 / rise)))

    @property
    def found(self) -> tuple[Array, Array]:
        """(M, K) from the estimate, and (M,) odds against it."""
        return np.array(self._steps).reshape(-1, len(self._sizes)), np.array(self._odds)


@dataclass(frozen=True, eq=False)
class _End:
    """Where the numbers are (K,), in natural sizes from the estimate, and twice the cost there."""

    estimate: Estimate
    off: Array
    cost: float


def _end(problem: Problem, estimate: Estimate, keys: tuple[Key, ...], step: Array) -> _End | None:
    """The least cost where the part of the numbers along a step is as long as it; None where it is not found."""
    sizes = natural_sizes(estimate, keys)
    row = step / sizes**2 / float(np.sum((step / sizes) ** 2)) / _HELD
    with suppress(InputError):  # quiet: no camera there; the end counts as far away as any
        held = GaussianPrior.about(Information(keys, np.outer(row, row)), moved(estimate, keys, step))
        solution = _solved(replace(problem, priors=(*problem.priors, held)), estimate)
        if solution is not None:
            pulled = float(np.sum(held.residuals(solution.estimate) ** 2))
            off = difference(solution.estimate, estimate, keys) / sizes
            return _End(solution.estimate, off, 2.0 * solution.cost - pulled)
    return None


def _solved(problem: Problem, start: Estimate) -> Solution | None:
    short = replace(problem.options, max_iterations=min(_MOST_ITERATIONS, problem.options.max_iterations))
    try:
        solution = solve(replace(problem, options=short), start, precision=_NEAR / max(problem.equations, 1))
    except CalibrationError:  # quiet: the end counts as far away as any
        return None
    return None if solution.failed else solution


def _reach(end: _End, least: float, rise: float) -> float:
    """How many times as far as an end the cost has risen as it should, if it is a parabola up to there."""
    return float(np.clip(np.sqrt(rise / max(end.cost - least, 1e-12)), 1.0 / _FARTHEST, _FARTHEST))


def _excess(end: _End | None, step: Array, least: float, rise: float, factor: float = 1.0) -> Array:
    """(K,) in natural sizes: an end that is so many steps away, brought to where the cost has risen as it should by
    one, less that.
    """
    if end is None:
        return (_FARTHEST - 1.0) * step if factor == 1.0 else np.zeros(len(step))
    excess = end.off * _reach(end, least, rise) - step
    along = step / np.linalg.norm(step)
    return np.asarray(excess - min(float(along @ excess), 0.0) * along)  # that it ends earlier narrows nothing
