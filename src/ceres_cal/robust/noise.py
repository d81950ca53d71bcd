"""Estimate the noise from the residuals, and decide which observations are outliers.

Residuals are taken in units of their stated sigma. The noise scale is the factor on the stated sigmas of a kind
(points, curves) that describes the residuals. Where residuals leave it in doubt, an outlier is judged by what the other
observations alone predict.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ceres_cal.base import NORMAL_95, Array, Frozen, Indices, Mask, median, mixture_95, replace
from ceres_cal.effects.linearised import equation_weights, shared_columns, studentised
from ceres_cal.observations import Observations
from ceres_cal.problem import Estimate, Options, Problem, ReducedInformation, Weighting, from_placement
from ceres_cal.problem.residuals import Equations, Residuals, equations_of, pairs_of, relative_lengths, residuals

if TYPE_CHECKING:
    from ceres_cal.problem.shares import Histogram

# Degrees of freedom below which the stated sigmas are taken as they are: at 8 the spread has an error of 25 %. Errors
# of fits to ten points are 1.16 of their stated sigmas with 8; with 4 they are 1.46, and with 16 they are 0.8, because
# then the stated sigmas are taken.
LEAST_SPARE = 8.0
# Degrees of freedom for which the noise of the other kind counts: a few points beside many curve observations, which
# the fit nearly goes through, must not seem exact (without it their scale fell to 0.04 of the truth and less).
_BORROWED = 4.0
# Degrees of freedom for which a noise scale known from earlier observations counts, so that a few exact observations do
# not make the scale 0. Halving or doubling changes nothing.
USUAL_EQUATIONS = 10.0
# Share by which the observations within the bound may grow when the bound follows their own scale, and still count as
# the tail of the same noise: 1 % for Student's t with two degrees of freedom, more for outliers.
_TAIL = 0.02
# Share of the square root of the number of observations. If no more of them at the rejection bound change sides, shared
# numbers move by less than 0.05 sd. Of fewer than 60 000 observations none may.
SAME = 4e-3
# Least noise scale. The stated sigma is usually a third of a pixel, and no image is measured to better than a
# thousandth of a pixel. With exact observations and a smaller scale, all prior knowledge is lost in rounding.
LEAST_SCALE = 3e-3
# Factor on the stated sigmas up to which noise counts as stated: sigmas are guessed to a tenth or two. Below 1 every
# sound scene would be a finding; at 2.3, noise of twice the stated one is missed.
LARGER = 1.15
# Logarithm of the ratio of noise scales up to which sds are right, as far as hundreds of runs can tell.
_ALIKE = float(np.log(1.25))
_BLOCK = 1 << 16  # lengths summed at once, so that intermediate arrays stay in the processor's cache
_RAYLEIGH_MEDIAN = 1.177410022515474  # median length of a two-dimensional standard normal vector
_NORMAL_MEDIAN = 0.674489750196082  # median absolute value of a standard normal variable

Redundancy = tuple[float, float]
"""Share of the equations of points, and of curves, that is left for the noise: 1 minus the mean leverage."""


def by_count(equations: int, unknowns: float) -> Redundancy:
    """The redundancy if every equation had the same leverage."""
    return (1.0 - unknowns / max(equations, 1),) * 2


def by_leverage(counts: tuple[int, int], leverages: tuple[float, float]) -> Redundancy:
    """The redundancy from the numbers of equations of points and of curves, and the sums of their leverages."""
    points, curves = (1.0 - taken / max(count, 1) for taken, count in zip(leverages, counts, strict=True))
    return points, curves


class Inliers(Frozen):
    """The observations that take part, and the noise scales by which they were judged.

    Attributes:
        points: (N,), curves: (M,) bool; True where an observation takes part.
        point_scale, curve_scale: noise scales, factors on the stated sigmas.
        point_sigmas, curve_sigmas: lengths of the residuals in standard deviations; infinite where the estimate cannot
            show the observation.
        degrees_of_freedom: of the noise scales; infinite where the stated sigmas were taken.
        bound: length in standard deviations beyond which an observation is an outlier.
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
        """Whether nothing changed that is worth another solve: neither scale by more than `relative`, and no row, or,
        if the comparison is not strict, only a few of very many.
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
        """The inliers among observations of these lengths, in stated sigmas, at a given noise."""
        p, c = noise.bounds
        scales, relative = (noise.points, noise.curves), (points / noise.points, curves / noise.curves)
        return cls(points <= p, curves <= c, *scales, *relative, noise.degrees_of_freedom, noise.reject_sigma)

    def of_rows(self, points: Indices, curves: Indices) -> Inliers:
        """The inliers of some observations, given by their rows, as if there were no others."""
        own = {"points": points, "curves": curves, "point_sigmas": points, "curve_sigmas": curves}
        return replace(self, **{name: getattr(self, name)[rows] for name, rows in own.items()})

    def weighting(self, options: Options) -> Weighting:
        """The weighting of the observations at these noise scales."""
        return Weighting(self.point_scale, self.curve_scale, options.loss, options.loss_scale)

    @property
    def rows(self) -> Mask:
        """(N + M,) bool, which observations take part: points by row, then curves by row."""
        return np.concatenate([self.points, self.curves])

    @property
    def sigmas(self) -> Array:
        """(N + M,) lengths of the residuals in standard deviations."""
        return np.concatenate([self.point_sigmas, self.curve_sigmas])

    def with_rows(self, rows: Mask) -> Inliers:
        """A copy in which the observations given by a mask (N + M,) take part."""
        return replace(self, points=rows[: len(self.points)], curves=rows[len(self.points) :])

    @property
    def scales(self) -> tuple[float, float]:
        """Noise scales of points and of curves."""
        return self.point_scale, self.curve_scale


def visible_from(observations: Observations, residuals: Residuals) -> Inliers:
    """All observations that the initial estimate can show, at the scale of the median residual, for the first solve."""
    points, curves = relative_lengths(observations, residuals)
    p, c = median_scales(points, curves)
    return Inliers(np.isfinite(points), np.isfinite(curves), p, c, points / p, curves / c)


def median_scales(points: Array, curves: Array) -> tuple[float, float]:
    """Noise scales of points and of curves by the medians of residual lengths in stated sigmas."""
    return _median_scale(EachLength(points), _RAYLEIGH_MEDIAN), _median_scale(EachLength(curves), _NORMAL_MEDIAN)


def _median_scale(lengths: Lengths, median_of_one: float) -> float:
    return max(lengths.middle() / median_of_one, LEAST_SCALE) if lengths.count else 1.0


def judge(
    observations: Observations,
    residuals: Residuals,
    redundancy: Redundancy,
    options: Options,
    usual: tuple[float, float] | None = None,
) -> Inliers:
    """Estimate the noise scales and the inliers at one estimate.

    The median gives a first scale, which outliers cannot spoil as long as they are less than half of the data. The
    spread of the inliers gives the final scale; where the noise has tails, more observations are inliers than lie
    within the bound of the first scale.

    Args:
        options: the rejection bound, and whether the stated sigmas hold (scale 1).
        usual: noise scales of points and of curves known from earlier observations; they count as `USUAL_EQUATIONS`
            degrees of freedom.
    """
    points, curves = relative_lengths(observations, residuals)
    noise = noise_of(EachLength(points), EachLength(curves), redundancy, options, usual)
    return Inliers.by_noise(points, curves, noise)


class NoiseScales(NamedTuple):
    """Noise scales of points and of curves, the outliers' bound in standard deviations, and the degrees of freedom of
    the scales, which are infinite where the stated sigmas were taken.
    """

    points: float
    curves: float
    reject_sigma: float
    degrees_of_freedom: float

    @property
    def bounds(self) -> tuple[float, float]:
        """Lengths in stated sigmas beyond which points and curve observations are outliers."""
        return self.points * self.reject_sigma, self.curves * self.reject_sigma


Lengths: TypeAlias = "EachLength | Histogram"
"""Lengths of residuals in stated sigmas, or a histogram of them; only of observations that the estimate can show."""


def noise_of(
    points: Lengths, curves: Lengths, redundancy: Redundancy, options: Options, usual: tuple[float, float] | None = None
) -> NoiseScales:
    """Noise scales from the lengths of residuals; see `judge`."""
    if options.noise_scale == "stated":
        return NoiseScales(1.0, 1.0, options.reject_sigma, np.inf)
    floor = usual or (0.0, 0.0)
    spare_of_all = 2.0 * redundancy[0] * points.count + redundancy[1] * curves.count
    known = spare_of_all + (USUAL_EQUATIONS if usual else 0.0)
    reject_sigma = options.reject_sigma if known < LEAST_SPARE else _as_rare(options.reject_sigma, known)
    p_sums = _spread(points, _RAYLEIGH_MEDIAN, reject_sigma, floor[0], 2.0 * redundancy[0])
    c_sums = _spread(curves, _NORMAL_MEDIAN, reject_sigma, floor[1], redundancy[1])
    spare = 2.0 * redundancy[0] * p_sums[0], redundancy[1] * c_sums[0]
    degrees = spare[0] + spare[1]
    if usual is not None:
        p, c = _scale_from(usual[0], p_sums, spare[0]), _scale_from(usual[1], c_sums, spare[1])
        degrees = max(degrees, 0.0) + USUAL_EQUATIONS
    elif degrees < LEAST_SPARE:
        p, c, degrees = 1.0, 1.0, np.inf
    else:
        p, c = _scale(p_sums, spare[0], c_sums, spare[1]), _scale(c_sums, spare[1], p_sums, spare[0])
    return NoiseScales(p, c, reject_sigma, degrees)


def _as_rare(sigmas: float, degrees: float) -> float:
    """The bound that is as rare at a scale estimated with these degrees of freedom as `sigmas` is at a known scale: (1
    + length^2 / degrees)^(-degrees / 2) = exp(-sigmas^2 / 2), Student's t in two dimensions.
    """
    beyond = 100.0  # exponent: no observation is so rare
    degrees = max(degrees, 1.0)
    return float(np.sqrt(degrees * np.expm1(min(sigmas**2 / degrees, beyond))))


_Sums = tuple[int, float]
"""Number and sum of squares of the lengths within the rejection bound."""


def _scale(sums: _Sums, spare: float, other: _Sums, other_spare: float) -> float:
    """The noise scale of a kind from its sums and degrees of freedom; the other kind counts for up to `_BORROWED`."""
    borrowed = min(_BORROWED, max(other_spare, 0.0))
    variance = borrowed * other[1] / max(other_spare, 1.0)
    return max(float(np.sqrt((sums[1] + variance) / max(spare + borrowed, 1.0))), LEAST_SCALE)


def _scale_from(usual: float, sums: _Sums, spare: float) -> float:
    """The noise scale where a usual one counts, too, so that few exact lengths do not make it 0."""
    return float(np.sqrt((sums[1] + USUAL_EQUATIONS * usual**2) / (max(spare, 0.0) + USUAL_EQUATIONS)))


class EachLength:
    """Residual lengths one by one. Infinite lengths, of observations that cannot be shown, are left out."""

    def __init__(self, lengths: Array) -> None:
        finite = np.isfinite(lengths)
        self._seen = lengths if finite.all() else lengths[finite]

    @property
    def count(self) -> int:
        """The number of lengths."""
        return len(self._seen)

    def middle(self) -> float:
        """The median of the lengths, of very many that of a subset; 0 if there are none."""
        enough = 5_000
        some = self._seen[:: max(1, len(self._seen) // enough)]  # its median is within .02 of the median of all
        return float(np.partition(some, len(some) // 2)[len(some) // 2]) if len(some) else 0.0

    def within(self, bound: float) -> _Sums:
        """Number and sum of squares of the lengths up to the bound."""
        count, squares = 0, 0.0
        for first in range(0, len(self._seen), _BLOCK):
            block = self._seen[first : first + _BLOCK]
            inside = block[block <= bound]
            count, squares = count + len(inside), squares + float(inside @ inside)
        return count, squares


def _spread(lengths: Lengths, median_of_one: float, reject_sigma: float, least: float, degrees: float) -> _Sums:
    """Number and sum of squares of the lengths within the rejection bound of their own scale.

    Args:
        least: lower limit of the scale. degrees: degrees of freedom that each length brings.
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


def squares_beside(lengths: Sequence[Array], taken_up: float, reject_sigma: float) -> tuple[float, float]:
    """Sum of squares of some lengths of points and of curves without outliers, and their degrees of freedom.

    A pose may go through some of few clicks, and the others would then seem to be outliers. So as many of the shortest
    lengths have no part in the scale by which outliers are told (Rousseeuw and Leroy 1987, Robust Regression and
    Outlier Detection, 3.4).

    Args:
        taken_up: share of their equations that unknowns take up. reject_sigma: the outliers' bound at a known scale.
    """
    firsts, each = [int(taken_up * len(one)) for one in lengths], (2.0, 1.0)  # equations of each
    spare = sum(e * (len(one) - first) for e, one, first in zip(each, lengths, firsts, strict=True))
    bound = _as_rare(reject_sigma, spare)
    squares = freedom = 0.0
    for one, first, middle, e in zip(lengths, firsts, (_RAYLEIGH_MEDIAN, _NORMAL_MEDIAN), each, strict=True):
        ordered = np.sort(one)
        count, longest = _spread(EachLength(ordered[first:]), middle, bound, 0.0, e)
        squares, freedom = squares + longest + float(ordered[:first] @ ordered[:first]), freedom + e * count
    return squares, freedom


def noise_of_cameras(problem: Problem, estimate: Estimate, judged: Mask) -> dict[str, float]:
    """The noise of each name in `Observations.noise_names` (a camera, or a target that a camera sees), as a factor on
    the stated sigmas of its observations; unchanged where all are about equally noisy.

    It differs, for example, in a photograph out of focus, or in a field that was clicked beside detected boards. At the
    mean noise, the noisiest would seem too certain and the others too uncertain. The unknowns of a camera are divided
    among its observations by number of equations, those of a pose among the observations that show it. The factor of
    few observations includes that it is hardly known.

    Args:
        problem: weighted by the noise of all together. judged: (N + M,) observations that are not known outliers.
    """
    observations, layout = problem.observations, problem.layout
    views = observations.points.view, observations.curves.view
    every = relative_lengths(observations, residuals(problem.sights, estimate, problem.feet))
    lengths = [length / scale for length, scale in zip(every, problem.weighting.scales, strict=True)]
    seen = [own & np.isfinite(one) for own, one in zip(np.split(judged, [len(views[0])]), lengths, strict=True)]
    counts = [np.bincount(view[own], minlength=len(observations.views)) for view, own in zip(views, seen, strict=True)]
    equations = 2 * counts[0] + counts[1]
    names, cameras = np.array(observations.noise_names), np.array([view.camera for view in observations.views])
    before = np.array([observations.noise.get(name, 1.0) for name in names.tolist()])
    before /= median(np.repeat(before, equations))
    noise, spare = dict[str, float](), 0.0
    for name in dict.fromkeys(names.tolist()):
        own = names == name
        count, shown = int(equations[own].sum()), [observations.views[view] for view in np.flatnonzero(own)]
        if not count:  # all of its observations are left out, or cannot be shown
            continue
        camera, now = shown[0].camera, float(before[own][0])
        poses = len(layout.stations & {view.station for view in shown})
        poses += len(layout.placements & {view.placement for view in shown})
        free = len(layout.free.get(camera, ())) / equations[cameras == camera].sum()
        taken_up, parts = min(free + 6 * poses / count, 1.0), zip(lengths, seen, views, strict=True)
        relative = [now * length[used & own[view]] for length, used, view in parts]
        squares, freedom = squares_beside(relative, taken_up, problem.options.reject_sigma)
        noise[name], spare = _scale_of_few(squares, freedom), spare + freedom
    # What is common to all does not count: the scale of all together, estimated with the next solve, would cancel it.
    # Of fewer equations the stated sigmas are taken: factors of a rig of few clicks grew to 50.
    after = np.array([noise.get(name, np.nan) for name in names.tolist()])
    usual = median(np.repeat(after, equations))
    changes = (np.abs(np.log(one / before))[equations > 0] > _ALIKE for one in (after, after / usual))
    return noise if spare >= LEAST_SPARE and all(map(np.any, changes)) else dict(observations.noise)


def _scale_of_few(squares: float, freedom: float) -> float:
    """The noise scale at which a normal distribution has the 95 % interval of all scales that may be, relative to a
    usual scale. Half of all scales are within `_ALIKE` of the usual one, and the logarithms of the others follow
    Cauchy's distribution.

    Args:
        squares: sum of squared residuals over the usual scale. freedom: their degrees of freedom.
    """
    steps, reach, most = 200, 8.0, 6.0  # of the grid; to either side in standard errors of a scale, and at most
    best = max(float(np.sqrt(squares / freedom)), LEAST_SCALE) if freedom > 0.0 else 1.0
    logs = np.log(best) + min(reach / (2.0 * max(freedom, 1.0)) ** 0.5, most) * np.linspace(-1.0, 1.0, steps + 1)
    likely = -freedom * logs - 0.5 * squares * np.exp(-2.0 * logs) - np.log1p((logs / _ALIKE) ** 2)
    weights = np.exp(likely - likely.max())
    return mixture_95(weights / weights.sum(), np.exp(2.0 * logs)) / NORMAL_95


# ---- outliers by deleted residuals ----------------------------------------------------------------------------------


class InlierFit(Frozen):
    """An estimate from some of the observations, and its information.

    Attributes:
        problem: of all the observations. used: (N + M,) those that took part. residuals: of all observations.
        reduced: the information of those that took part and of the priors.
    """

    problem: Problem
    estimate: Estimate
    residuals: Residuals
    used: Mask
    reduced: ReducedInformation


def by_deleted_residuals(inliers: Inliers, fitted: InlierFit) -> Inliers:
    """Judge the doubtful ones among the observations by deleted residuals; the others stay as their residuals say.

    A deleted residual is the distance of an observation from what the others alone predict. A residual that the fit has
    taken up is short whether or not the observation is an outlier. A residual that is hardly predicted is long even if
    the observation is an inlier: the only corner at the rim of a picture would, once rejected, stay rejected (Cook and
    Weisberg 1982, Residuals and Influence in Regression, 2.2).
    """
    # Share of the bound beyond which an inlier is doubtful. A shorter residual belongs to an outlier only if it says
    # more about its place than all others do, and then it cannot be known which of the two is wrong.
    doubted = 0.5**0.5
    doubtful = np.isfinite(inliers.sigmas) & (inliers.sigmas > doubted * inliers.bound)
    if not np.any(doubtful):
        return inliers
    rows = inliers.rows
    observation, length = deleted_lengths(doubtful, inliers.weighting(fitted.problem.options), fitted)
    rows[observation] = length <= inliers.bound
    return inliers.with_rows(rows)


def deleted_lengths(rows: Mask, weighting: Weighting, fitted: InlierFit) -> tuple[Indices, Array]:
    """The observation numbers of some observations (N + M,) with finite residuals, and the lengths of their deleted
    residuals in standard deviations.
    """
    sights = fitted.problem.sights.used(*np.split(rows, [len(fitted.problem.observations.points)]))
    equations = equations_of(sights, fitted.estimate, fitted.residuals)
    weights = equation_weights(weighting, equations, fitted.residuals)
    share = np.where(fitted.used[equations.observation], weights.robust, 0.0)
    leverage, overlap = _leverages(equations, weights.inverse_sigma, fitted.estimate, fitted.reduced)
    observation, length = studentised(equations, weights.inverse_sigma * equations.residual, share, leverage, overlap)
    return observation, np.abs(length)


def _leverages(
    equations: Equations, weight: Array, estimate: Estimate, reduced: ReducedInformation
) -> tuple[Array, Array]:
    """(E,) what the covariance of the estimate adds to the variance of equations of this weight, in units of that
    variance, and (P,) what it adds to the covariance of the two equations of each point.

    Structure is held as it is: letting it vary would only add the scatter of the targets' construction.
    """
    keys = [key for key in reduced.shared.keys if not key.is_structure]
    covariance = reduced.shared.given(keys).inverse
    shared = shared_columns(equations, estimate, keys) * weight[:, None]
    private, own = np.zeros((2, len(equations), 6))
    for part in reduced.eliminated:
        at = {name: number for number, name in enumerate(part.names)}
        placed = np.array([at.get(str(key.placement), -1) for key in equations.sights.keys])[equations.sight]
        rows = np.flatnonzero(placed >= 0)
        chain = from_placement(equations.poses, estimate.stations[part.station].cam_from_world)[equations.sight[rows]]
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
