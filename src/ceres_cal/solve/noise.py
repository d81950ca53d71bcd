"""Reading the residuals: how large the noise is, and which observations do not belong.

Residuals are taken in units of their stated sigma; the noise scale is the factor by which the stated sigmas of a kind
(points, curves) must be multiplied to describe what is seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices, Mask
from ceres_cal.model.parameters import Options
from ceres_cal.model.residuals import Residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.solve.problem import Weighting

_BEYOND = 100.0  # an exponent: no observation is so rare
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
_MOST_WIDER = 5
_ENOUGH = 5_000
_LEAST_SCALE_PX = 1e-4  # no image is measured better than that
_RAYLEIGH_MEDIAN = 1.177410022515474  # of the length of a two-dimensional standard normal
_NORMAL_MEDIAN = 0.674489750196082  # of the absolute value of a standard normal


@dataclass(frozen=True)
class Redundancy:
    """The share of the equations of points and of curves that is left over for the noise: 1 less the mean leverage."""

    points: float
    curves: float

    @classmethod
    def by_count(cls, equations: int, unknowns: int) -> Redundancy:
        """As if every equation determined as much as any other."""
        share = 1.0 - unknowns / max(equations, 1)
        return cls(share, share)

    @classmethod
    def by_leverage(cls, sights: Sights, leverages: tuple[float, float]) -> Redundancy:
        """As the observations in the sights determine the free numbers.

        Args:
            leverages: equations of points and of curves that the free numbers take up.
        """
        counts = 2 * len(sights.point_rows), len(sights.curve_rows)
        points, curves = (1.0 - taken / max(count, 1) for taken, count in zip(leverages, counts, strict=True))
        return cls(points, curves)


@dataclass(frozen=True, eq=False)
class Inliers:
    """Which observations take part, and the noise scales they were judged by.

    Attributes:
        points: (N,), curves: (M,) bool. point_scale, curve_scale: factors on the stated sigmas.
        point_sigmas, curve_sigmas: how many standard deviations each residual is long; infinite where the estimate
            cannot show the observation.
        degrees_of_freedom: spare equations that the scales rest on; infinite where they are the stated ones.
    """

    points: Mask
    curves: Mask
    point_scale: float
    curve_scale: float
    point_sigmas: Array
    curve_sigmas: Array
    degrees_of_freedom: float = np.inf

    def same_as(self, other: Inliers, relative: float = 1e-2) -> bool:
        """Whether nothing worth another solve changed: the same rows, and scales by no more than `relative`."""
        return (
            np.array_equal(self.points, other.points)
            and np.array_equal(self.curves, other.curves)
            and abs(self.point_scale - other.point_scale) <= relative * other.point_scale
            and abs(self.curve_scale - other.curve_scale) <= relative * other.curve_scale
        )

    def of_rows(self, points: Indices, curves: Indices) -> Inliers:
        """Those of some of the observations, as if there were no others."""
        sigmas = self.point_sigmas[points], self.curve_sigmas[curves]
        both = Inliers(self.points[points], self.curves[curves], self.point_scale, self.curve_scale, *sigmas)
        return replace(both, degrees_of_freedom=self.degrees_of_freedom)

    def weighting(self, options: Options) -> Weighting:
        """Of the observations at these noise scales."""
        return Weighting(self.point_scale, self.curve_scale, options.loss, options.loss_scale)

    def much_below(self, other: Inliers, share: float) -> bool:
        """Whether a scale fell to less than a share of what it was."""
        return self.point_scale < share * other.point_scale or self.curve_scale < share * other.curve_scale


def relative_lengths(observations: Observations, residuals: Residuals) -> tuple[Array, Array]:
    """Lengths of the residuals of points and of curves in their stated sigmas; infinite where there is none."""
    points, curves = residuals.lengths
    points, curves = points / observations.points.sigma_px, curves / observations.curves.sigma_px
    return np.where(np.isfinite(points), points, np.inf), np.where(np.isfinite(curves), curves, np.inf)


def visible_from(observations: Observations, residuals: Residuals) -> Inliers:
    """Everything that a start can show, at the scale of its median residual: what the first solve works with."""
    points, curves = relative_lengths(observations, residuals)
    shown_points, shown_curves = np.isfinite(points), np.isfinite(curves)
    p = _median_scale(points[shown_points], _RAYLEIGH_MEDIAN)
    c = _median_scale(curves[shown_curves], _NORMAL_MEDIAN)
    return Inliers(shown_points, shown_curves, p, c, points / p, curves / c)


def _median_scale(lengths: Array, median_of_one: float) -> float:
    if not len(lengths):
        return 1.0
    some = lengths[:: max(1, len(lengths) // _ENOUGH)]  # its median is that of all within two hundredths
    middle = len(some) // 2
    return max(float(np.partition(some, middle)[middle]) / median_of_one, _LEAST_SCALE_PX)


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
    if options.noise_scale == "stated":
        inside = points <= options.reject_sigma, curves <= options.reject_sigma
        return Inliers(*inside, 1.0, 1.0, points, curves)
    floor = usual or (0.0, 0.0)
    finite = np.count_nonzero(np.isfinite(points)), np.count_nonzero(np.isfinite(curves))
    spare_of_all = 2.0 * redundancy.points * finite[0] + redundancy.curves * finite[1]
    reject_sigma = _as_rare(options.reject_sigma, spare_of_all + (USUAL_EQUATIONS if usual else 0.0))
    point_spread = _spread(points, _RAYLEIGH_MEDIAN, reject_sigma, floor[0], 2.0 * redundancy.points)
    curve_spread = _spread(curves, _NORMAL_MEDIAN, reject_sigma, floor[1], redundancy.curves)
    spare = 2.0 * redundancy.points * point_spread.count, redundancy.curves * curve_spread.count
    degrees = spare[0] + spare[1]
    if usual is not None:
        p, c = point_spread.scale_from(usual[0], spare[0]), curve_spread.scale_from(usual[1], spare[1])
        degrees = max(degrees, 0.0) + USUAL_EQUATIONS
    else:
        p, c = (
            point_spread.scale(spare[0], curve_spread, spare[1]),
            curve_spread.scale(spare[1], point_spread, spare[0]),
        )
        if degrees < _LEAST_SPARE:
            p, c, degrees = 1.0, 1.0, np.inf
    return Inliers(points <= reject_sigma * p, curves <= reject_sigma * c, p, c, points / p, curves / c, degrees)


def _as_rare(sigmas: float, degrees: float) -> float:
    """The length that is as rare among residuals over a scale that was estimated from so few spare equations as
    `sigmas` is over a known one: (1 + length^2 / degrees)^(-degrees / 2) = exp(-sigmas^2 / 2), that of Student's t in
    two dimensions. Where the stated sigmas are taken it is `sigmas`.
    """
    if degrees < _LEAST_SPARE:
        return sigmas
    return float(np.sqrt(degrees * np.expm1(min(sigmas**2 / degrees, _BEYOND))))


@dataclass(frozen=True)
class _Spread:
    """Number and sum of squares of the lengths within the rejection bound."""

    count: int
    squares: float

    def scale(self, spare: float, other: _Spread, other_spare: float) -> float:
        """Their scale, when they bring so many spare equations: that of the other kind counts as much as a few."""
        borrowed = min(_BORROWED, max(other_spare, 0.0))
        variance = borrowed * other.squares / max(other_spare, 1.0)
        return max(float(np.sqrt((self.squares + variance) / max(spare + borrowed, 1.0))), _LEAST_SCALE_PX)

    def scale_from(self, usual: float, spare: float) -> float:
        """Their scale, when the usual one counts as much as a few spare equations: few exact ones do not make it 0."""
        return float(np.sqrt((self.squares + USUAL_EQUATIONS * usual**2) / (max(spare, 0.0) + USUAL_EQUATIONS)))


def _spread(lengths: Array, median_of_one: float, reject_sigma: float, least: float, degrees: float) -> _Spread:
    """Of the lengths that the scale they have keeps.

    Args:
        least: a scale that theirs is no smaller than. degrees: spare equations of each.
    """
    finite = np.isfinite(lengths)
    seen = lengths if finite.all() else lengths[finite]
    spread = _within(seen, reject_sigma * max(_median_scale(seen, median_of_one), least))
    for _ in range(_MOST_WIDER):
        if degrees <= 0.0 or not spread.count:
            break
        wider = _within(seen, reject_sigma * float(np.sqrt(spread.squares / (degrees * spread.count))))
        if not spread.count < wider.count <= (1.0 + _TAIL) * spread.count:
            break
        spread = wider
    return spread


def _within(lengths: Array, bound: float) -> _Spread:
    inside = lengths[lengths <= bound]
    return _Spread(len(inside), float(inside @ inside))
