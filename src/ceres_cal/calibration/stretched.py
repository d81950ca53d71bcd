"""Pictures stretched in one direction: an alternative for a camera whose pixels are square only by the usual prior.

A view of a field determines fy / fx to a hundredth, beside tilt and principal point. Pixels of cameras are square to
.0005, but some pictures were stretched. A solve that starts at 1 does not reach another aspect: the usual prior holds
it there up to some 13 standard deviations. So a calibration with a free aspect is made as well, where that is likely.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ceres_cal.base import CalibrationError, attempt
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.likelier import likelier
from ceres_cal.observations import Observations
from ceres_cal.problem.priors import USUAL_ASPECT

# Share of pictures that were stretched in one direction, and the standard deviation of the stretch: a guess, because
# nobody has counted them. At a share of .05 one of twelve square views was known four times worse; at .01 more
# stretched ones were trusted.
_STRETCHED, _BY = 0.03, 0.05
# The probability of stretching by the solve with square pixels from which on another solve is made. It is low because
# that solve says it only to first order: .994 +- .003 for a picture stretched to .975.
_WORTH_A_SOLVE = 0.01


def beside_stretched(
    square: Calibration, observations: Observations, with_any_aspect: Callable[[], Calibration]
) -> Calibration:
    """Return the likelier of a calibration with square pixels and one with any aspect, with the other as a component of
    its posterior by its probability.
    """
    if _probability(square.aspects_alone) < _WORTH_A_SOLVE or square.posterior is None:
        return square
    any_ = attempt(with_any_aspect)  # quiet: the warning says what the observations alone say
    if isinstance(any_, CalibrationError) or any_.posterior is None:
        return square
    likely = _probability({name: _told(any_, name) for name in square.aspects_alone})
    return likelier(square, any_, likely, observations)


def _told(any_: Calibration, camera: str) -> tuple[float, float]:
    """Return the aspect of a camera and its standard deviation, where no prior on it exists."""
    told = any_.uncertainty.verdict("camera", camera, "aspect")
    return told.value, told.sd


def _probability(alone: Mapping[str, tuple[float, float]]) -> float:
    """Return the probability that pictures were stretched, by what the observations alone say: those of one camera, or
    all in the same way, as with one type of camera and converter.
    """
    told = np.array([[value, sd] for value, sd in alone.values() if np.isfinite(sd) and sd > 0.0])
    if not len(told):
        return 0.0
    values, variances = told[:, 0], told[:, 1] ** 2 + USUAL_ASPECT**2
    pooled = np.average(values, weights=1.0 / variances), 1.0 / np.sum(1.0 / variances)
    each = zip(values, variances, strict=True)
    return max(_of_one(float(value), float(variance)) for value, variance in (*each, pooled))


def _of_one(value: float, variance: float) -> float:
    """Return this probability for one aspect, by its likelihood with a random stretch; 0 where it is farther from 1
    than pictures are stretched, as from lines that wander by pixels (1.19 +- .03 in a cropped photograph).

    Args:
        variance: of the aspect's difference from 1 with square pixels, by the usual prior and the observations.
    """
    farthest = 2.0  # standard deviations of the stretch
    if abs(value - 1.0) > farthest * _BY:
        return 0.0
    stretched = variance + _BY**2
    times = _STRETCHED / (1.0 - _STRETCHED) * (variance / stretched) ** 0.5
    log_odds = np.log(times) + 0.5 * (value - 1.0) ** 2 * (1.0 / variance - 1.0 / stretched)
    return float(1.0 / (1.0 + np.exp(-log_odds)))
