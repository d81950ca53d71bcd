"""Reading the residuals: how large the noise is, and which observations do not belong.

Residuals are taken in units of their stated sigma; the noise scale is the factor by which the stated sigmas of a kind
(points, curves) must be multiplied to describe what is seen. Where it is in doubt, an outlier is what the others alone
predict elsewhere.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, replace
from ceres_cal.effects.linearised import equation_weights, shared_columns, studentised
from ceres_cal.observations import Observations
from ceres_cal.problem import Estimate, Options, Problem, ReducedInformation, Weighting, from_placement
from ceres_cal.problem.residuals import Equations, Residuals, equations_of, pairs_of, relative_lengths, residuals

if TYPE_CHECKING:
    from ceres_cal.problem.shares import Histogram

# Spare equations below which a spread says nothing: its own error is 25 % at 8. At 4 the errors of fits to ten points
# are 1.46 of their stated sigmas, at 16 they are 0.8 (1.16 at 8), because the stated sigmas are then taken.
_LEAST_SPARE = 8.0
# Spare equations that the other kind's noise counts as: a handful of points beside many curve observations, which the
# fit nearly goes through, must not seem exact (without it their scale fell to 0.04 of the truth and less).
_BORROWED = 4.0
# Spare equations that a scale seen before stands for: few exact ones must not make it 0. Nothing changes from half to
# double.
USUAL_EQUATIONS = 10.0
# Share by which rows kept may outnumber those that their scale was taken from, and still be the tail of the same noise:
# of Student's t with two degrees of freedom it is 1 %, of outliers more.
_TAIL = 0.02
# Of the root of how many there are: so many outliers more or fewer, at the bound, move what is shared by no 0.05 sd.
# None of fewer than 60 000.
SAME = 4e-3
# Over what is stated, usually a third of a pixel: no image is measured to better than a thousandth of one. Of exact
# observations at less all that is known beforehand drowns in rounding.
_LEAST_SCALE = 3e-3
# Noise within so much of what was stated is as stated: sigmas are guessed to a tenth or two. Below 1 every sound
# scene is a finding; at 2.3 noise of twice the stated one is missed.
LARGER = 1.15
_BLOCK = 1 << 16  # lengths at once: what is made of them stays where the processor is quick
_RAYLEIGH_MEDIAN = 1.177410022515474  # of the length of a two-dimensional standard normal
_NORMAL_MEDIAN = 0.674489750196082  # of the absolute value of a standard normal


Redundancy = tuple[float, float]
"""The share of the equations of points and of curves that is left over for the noise: 1 less the mean leverage."""


def by_count(equations: int, unknowns: float) -> Redundancy:
    """As if every equation determined as much as any other."""
    return (1.0 - unknowns / max(equations, 1),) * 2


def by_leverage(counts: tuple[int, int], leverages: tuple[float, float]) -> Redundancy:
    """Of so many equations of points and of curves, of which the free numbers take up so many."""
    points, curves = (1.0 - taken / max(count, 1) for taken, count in zip(leverages, counts, strict=True))
    return points, curves


class Inliers(Frozen):
    """Which observations take part, and the noise scales they were judged by.

    Attributes:
        points: (N,), curves: (M,) bool. point_scale, curve_scale: factors on the stated sigmas.
        point_sigmas, curve_sigmas: how many standard deviations each residual is long; infinite where the estimate
            cannot show the observation.
        degrees_of_freedom: spare equations that the scales rest on; infinite where they are the stated ones.
        bound: standard deviations from which on an observation is an outlier.
    """

    points: Mask
    curves: Mask
    point_scale: float
    curve_scale: float
    point_sigmas: Array
    curve_sigmas: Array
    degrees_of_freedom: float = np.inf
    bound: float = np.inf

    def same_as(self, other: Inliers, relative: float = 1e-2) -> bool:
        """Whether nothing worth another solve changed: scales by no more than `relative`, and rows by none, or by a few
        of very many where that is no strict comparison.
        """
        changed = self.rows != other.rows
        few = SAME * len(changed) ** 0.5 if relative >= SAME else 0.0
        return bool(
            np.count_nonzero(changed) <= few
            and abs(self.point_scale - other.point_scale) <= relative * other.point_scale
            and abs(self.curve_scale - other.curve_scale) <= relative * other.curve_scale
        )

    @classmethod
    def by_noise(cls, points: Array, curves: Array, noise: NoiseScales) -> Inliers:
        """Of these lengths at a noise."""
        p, c = noise.bounds
        scales, relative = (noise.points, noise.curves), (points / noise.points, curves / noise.curves)
        return cls(points <= p, curves <= c, *scales, *relative, noise.degrees_of_freedom, noise.reject_sigma)

    def of_rows(self, points: Indices, curves: Indices) -> Inliers:
        """Those of some of the observations, as if there were no others."""
        own = {"points": points, "curves": curves, "point_sigmas": points, "curve_sigmas": curves}
        return replace(self, **{name: getattr(self, name)[rows] for name, rows in own.items()})

    def weighting(self, options: Options) -> Weighting:
        """Of the observations at these noise scales."""
        return Weighting(self.point_scale, self.curve_scale, options.loss, options.loss_scale)

    @property
    def rows(self) -> Mask:
        """(N + M,) which observations take part, points by row and then curves by row."""
        return np.concatenate([self.points, self.curves])

    @property
    def sigmas(self) -> Array:
        """(N + M,) how many standard deviations each residual is long."""
        return np.concatenate([self.point_sigmas, self.curve_sigmas])

    def with_rows(self, rows: Mask) -> Inliers:
        """The same with other observations (N + M,) taking part."""
        return replace(self, points=rows[: len(self.points)], curves=rows[len(self.points) :])

    @property
    def scales(self) -> tuple[float, float]:
        """Of points and of curves."""
        return self.point_scale, self.curve_scale


def visible_from(observations: Observations, residuals: Residuals) -> Inliers:
    """Everything that a start can show, at the scale of its median residual: what the first solve works with."""
    points, curves = relative_lengths(observations, residuals)
    p, c = median_scales(points, curves)
    return Inliers(np.isfinite(points), np.isfinite(curves), p, c, points / p, curves / c)


def median_scales(points: Array, curves: Array) -> tuple[float, float]:
    """Noise scales by the medians of lengths of points and of curves in their stated sigmas."""
    return _median_scale(EachLength(points), _RAYLEIGH_MEDIAN), _median_scale(EachLength(curves), _NORMAL_MEDIAN)


def _median_scale(lengths: Lengths, median_of_one: float) -> float:
    return max(lengths.middle() / median_of_one, _LEAST_SCALE) if lengths.count else 1.0


def _middle(lengths: Array) -> float:
    """The median, of some of very many."""
    enough = 5_000
    some = lengths[:: max(1, len(lengths) // enough)]  # its median is that of all within two hundredths
    middle = len(some) // 2
    return float(np.partition(some, middle)[middle]) if len(some) else 0.0


def judge(
    observations: Observations,
    residuals: Residuals,
    redundancy: Redundancy,
    options: Options,
    usual: tuple[float, float] | None = None,
) -> Inliers:
    """Noise scales and inliers at one estimate.

    The median gives a first scale that half the data may not spoil, the spread of the inliers the final one: where the
    noise has tails, these are more than lie within the bound by the first scale.

    Args:
        options: how far off an outlier is, and whether the stated sigmas hold (scale 1).
        usual: scales of points and curves seen before; they count as much as a few spare equations do.
    """
    points, curves = relative_lengths(observations, residuals)
    noise = noise_of(EachLength(points), EachLength(curves), redundancy, options, usual)
    return Inliers.by_noise(points, curves, noise)


class NoiseScales(NamedTuple):
    """Noise scales of points and of curves, the length in them from which on an observation is an outlier, and the
    spare equations that they rest on; infinite where they are the stated ones.
    """

    points: float
    curves: float
    reject_sigma: float
    degrees_of_freedom: float

    @property
    def bounds(self) -> tuple[float, float]:
        """Lengths in stated sigmas from which on points and curve observations are outliers."""
        return self.points * self.reject_sigma, self.curves * self.reject_sigma


Lengths: TypeAlias = "EachLength | Histogram"
"""Lengths of residuals in their stated sigmas, or what was added up of them: of all that can be shown."""


def noise_of(
    points: Lengths, curves: Lengths, redundancy: Redundancy, options: Options, usual: tuple[float, float] | None = None
) -> NoiseScales:
    """The noise that lengths show; see `judge`."""
    if options.noise_scale == "stated":
        return NoiseScales(1.0, 1.0, options.reject_sigma, np.inf)
    floor = usual or (0.0, 0.0)
    spare_of_all = 2.0 * redundancy[0] * points.count + redundancy[1] * curves.count
    reject_sigma = _as_rare(options.reject_sigma, spare_of_all + (USUAL_EQUATIONS if usual else 0.0))
    p_sums = _spread(points, _RAYLEIGH_MEDIAN, reject_sigma, floor[0], 2.0 * redundancy[0])
    c_sums = _spread(curves, _NORMAL_MEDIAN, reject_sigma, floor[1], redundancy[1])
    spare = 2.0 * redundancy[0] * p_sums[0], redundancy[1] * c_sums[0]
    degrees = spare[0] + spare[1]
    if usual is not None:
        p, c = _scale_from(usual[0], p_sums, spare[0]), _scale_from(usual[1], c_sums, spare[1])
        degrees = max(degrees, 0.0) + USUAL_EQUATIONS
    elif degrees < _LEAST_SPARE:
        p, c, degrees = 1.0, 1.0, np.inf
    else:
        p, c = _scale(p_sums, spare[0], c_sums, spare[1]), _scale(c_sums, spare[1], p_sums, spare[0])
    return NoiseScales(p, c, reject_sigma, degrees)


def _as_rare(sigmas: float, degrees: float) -> float:
    """The length that is as rare among residuals over a scale that was estimated from so few spare equations as
    `sigmas` is over a known one: (1 + length^2 / degrees)^(-degrees / 2) = exp(-sigmas^2 / 2), that of Student's t in
    two dimensions. Where the stated sigmas are taken it is `sigmas`.
    """
    beyond = 100.0  # an exponent: no observation is so rare
    if degrees < _LEAST_SPARE:
        return sigmas
    return float(np.sqrt(degrees * np.expm1(min(sigmas**2 / degrees, beyond))))


_Sums = tuple[int, float]
"""Number and sum of squares of the lengths within the rejection bound."""


def _scale(sums: _Sums, spare: float, other: _Sums, other_spare: float) -> float:
    """The scale of lengths that bring so many spare equations: that of the other kind counts as much as a few."""
    borrowed = min(_BORROWED, max(other_spare, 0.0))
    variance = borrowed * other[1] / max(other_spare, 1.0)
    return max(float(np.sqrt((sums[1] + variance) / max(spare + borrowed, 1.0))), _LEAST_SCALE)


def _scale_from(usual: float, sums: _Sums, spare: float) -> float:
    """The same when the usual one counts as much as a few spare equations: few exact ones do not make it 0."""
    return float(np.sqrt((sums[1] + USUAL_EQUATIONS * usual**2) / (max(spare, 0.0) + USUAL_EQUATIONS)))


class EachLength:
    """Lengths one by one; infinite ones are of what cannot be shown."""

    def __init__(self, lengths: Array) -> None:
        finite = np.isfinite(lengths)
        self._seen = lengths if finite.all() else lengths[finite]

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self._seen)

    def middle(self) -> float:
        """Their median; 0 of none."""
        return _middle(self._seen)

    def within(self, bound: float) -> _Sums:
        """Of those that are no longer."""
        count, squares = 0, 0.0
        for first in range(0, len(self._seen), _BLOCK):
            block = self._seen[first : first + _BLOCK]
            inside = block[block <= bound]
            count, squares = count + len(inside), squares + float(inside @ inside)
        return count, squares


def _spread(lengths: Lengths, median_of_one: float, reject_sigma: float, least: float, degrees: float) -> _Sums:
    """Of the lengths that the scale they have keeps.

    Args:
        least: a scale that theirs is no smaller than. degrees: spare equations of each.
    """
    most_wider = 5
    first = _median_scale(lengths, median_of_one)
    spread = lengths.within(reject_sigma * max(first, least))
    for _ in range(most_wider):
        count, squares = spread
        if degrees <= 0.0 or not count:
            break
        wider = lengths.within(reject_sigma * float(np.sqrt(squares / (degrees * count))))
        if not count < wider[0] <= (1.0 + _TAIL) * count:
            break
        spread = wider
    return spread


def noise_of_cameras(problem: Problem, estimate: Estimate, judged: Mask) -> dict[str, float]:
    """Name of `Observations.noise_names` -> factor on the stated sigmas of its observations; none where all are about
    as noisy as each other.

    A photograph out of focus, a camera of fewer pixels or another detector, a field that was clicked beside boards that
    were detected: at the mean noise what is stated by the noisiest is too sure, and by the others too unsure. Of few
    observations the mean counts as much as in `judge`. A camera's own numbers are counted against what it sees by the
    number of equations, poses against what shows them; as many of the shortest residuals say nothing, for a pose may go
    through some of few clicks, and the others then seem to be outliers (Rousseeuw and Leroy 1987, Robust Regression and
    Outlier Detection, 3.4).

    Args:
        problem: at the noise of all together. judged: (N + M,) those that are not known to be something else.
    """
    alike = 1.25  # ratio up to which sds are right within what statistics of hundreds of runs tell
    by_chance = 3.0  # standard errors of a scale
    observations, layout, usual = problem.observations, problem.layout, problem.weighting.scales
    lengths = relative_lengths(observations, residuals(problem.sights, estimate, problem.feet))
    kinds, columns = np.split(judged, [len(observations.points)]), (observations.points, observations.curves)
    owners, noise, differ = np.array(observations.noise_names), dict[str, float](), False
    seen = {str(name): [observations.views[row] for row in np.flatnonzero(owners == name)] for name in owners}
    rows = {name: [own & (owners == name)[c.view] for own, c in zip(kinds, columns, strict=True)] for name in seen}
    each = {name: [at[own & np.isfinite(at)] for at, own in zip(lengths, rows[name], strict=True)] for name in seen}
    counts = {name: (2 * len(points), len(curves)) for name, (points, curves) in each.items()}
    for name, views in seen.items():
        if not any(counts[name]):  # all of it is something else, or cannot be shown
            continue
        camera, equations = views[0].camera, sum(counts[name])
        of_camera = sum(sum(counts[other]) for other, shown in seen.items() if shown[0].camera == camera)
        poses = len(layout.stations & {view.station for view in views})
        poses += len(layout.placements & {view.placement for view in views})
        taken_up = min(len(layout.free.get(camera, ())) / of_camera + 6 * poses / equations, 1.0)
        points, curves = (EachLength(np.sort(one)[int(taken_up * len(one)) :]) for one in each[name])
        found = noise_of(points, curves, (1.0, 1.0), problem.options, usual)
        ratios = np.maximum(found[:2], _LEAST_SCALE) / usual
        ratio = float(np.sqrt(np.average(ratios**2, weights=counts[name])))
        differ |= abs(np.log(ratio)) > max(np.log(alike), by_chance / (2.0 * found.degrees_of_freedom) ** 0.5)
        noise[name] = ratio * observations.noise.get(name, 1.0)
    return noise if differ else dict(observations.noise)


# ---- outliers by deleted residuals ----------------------------------------------------------------------------------


# How far off an observation is where the others alone predict it. A residual that the fit has taken up is short whether
# or not it belongs, and one that only a guess predicts is long though it belongs: the only corner at a picture's rim,
# once left out, would stay out. So where nothing changes any more those in doubt are judged by what the others say of
# them, at the standard deviation of that (Cook and Weisberg 1982, Residuals and Influence in Regression, 2.2).


class InlierFit(Frozen):
    """An estimate of some observations, and what these say there.

    Attributes:
        problem: of all the observations. used: (N + M,) which took part. residuals: of all. reduced: what those that
            took part, and what was known before, say there.
    """

    problem: Problem
    estimate: Estimate
    residuals: Residuals
    used: Mask
    reduced: ReducedInformation


def by_deleted_residuals(inliers: Inliers, fitted: InlierFit) -> Inliers:
    """The inliers by deleted residuals, where the residuals alone, by which these are, leave it in doubt."""
    # Share of the bound from which on an inlier is asked about: a shorter one is an outlier only where it says more of
    # its place than all others, and then nobody knows which of the two is wrong.
    doubted = 0.5**0.5
    doubtful = np.isfinite(inliers.sigmas) & (inliers.sigmas > doubted * inliers.bound)
    if not np.any(doubtful):
        return inliers
    rows = inliers.rows
    observation, length = deleted_lengths(doubtful, inliers.weighting(fitted.problem.options), fitted)
    rows[observation] = length <= inliers.bound
    return inliers.with_rows(rows)


def deleted_lengths(rows: Mask, weighting: Weighting, fitted: InlierFit) -> tuple[Indices, Array]:
    """Of some of the observations (N + M,), whose residuals are finite: which one each is, and the length of its
    deleted residual in that one's standard deviations.
    """
    estimate = fitted.estimate
    sights = fitted.problem.sights.used(*np.split(rows, [len(fitted.problem.observations.points)]))
    equations = equations_of(sights, estimate, fitted.residuals)
    weights = equation_weights(weighting, equations, fitted.residuals)
    share = np.where(fitted.used[equations.observation], weights.robust, 0.0)
    leverage, overlap = _leverages(equations, weights.inverse_sigma, estimate, fitted.reduced)
    residual = weights.inverse_sigma * equations.residual
    observation, length = studentised(equations, residual, share, leverage, overlap)
    return observation, np.abs(length)


def _leverages(
    equations: Equations, weight: Array, estimate: Estimate, reduced: ReducedInformation
) -> tuple[Array, Array]:
    """(E,) what the estimate's covariance adds to the variance of equations of this weight, in theirs, and (P,) to the
    covariance of the two of each point.

    How targets were built is held: what it would add is its own scatter.
    """
    keys = [key for key in reduced.shared.keys if not key.is_structure]
    covariance = reduced.shared.given(keys).inverse
    shared = shared_columns(equations, estimate, keys) * weight[:, None]
    private, own = np.zeros((2, len(equations), 6))
    for part in reduced.eliminated:
        at = {name: number for number, name in enumerate(part.names)}
        placed = np.array([at.get(str(key.placement), -1) for key in equations.sights.keys])[equations.sight]
        rows = np.flatnonzero(placed >= 0)
        world = estimate.stations[part.station].cam_from_world
        chain = from_placement(equations.poses, world)[equations.sight[rows]]
        private[rows] = np.einsum("ei,eij->ej", equations.pose[rows], chain) * weight[rows, None]
        own[rows] = np.einsum("ei,eij->ej", private[rows], part.inverses[placed[rows]])
        told = [column for column, key in enumerate(part.keys) if not key.is_structure]
        followed = [keys.index(part.keys[column]) for column in told]
        shared[rows[:, None], followed] -= np.einsum("ei,eij->ej", private[rows], part.gains[:, :, told][placed[rows]])
    along, (first, second) = shared @ covariance, pairs_of(equations)
    return (
        np.sum(along * shared, axis=1) + np.sum(own * private, axis=1),
        np.sum(along[first] * shared[second], axis=1) + np.sum(own[first] * private[second], axis=1),
    )
