"""Pictures that were stretched one way: what a camera whose pixels are square by what is usual alone may be instead.

A view of a field tells fy / fx to a hundredth, beside its tilt and middle; that pixels are square is known to .0005 of
cameras, but some pictures were stretched. From 1 the solve does not come to another aspect: what is usual holds it
there up to some 13 standard deviations. So the calibration with any aspect is made as well, where that is likely.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from ceres_cal.base import CalibrationError, attempt
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.likelier import likelier
from ceres_cal.observations import Observations
from ceres_cal.problem.priors import USUAL_ASPECT

# Of pictures, the share that was stretched one way, and the standard deviation of by how much: a guess, for nobody has
# counted them. At a share of .05 one of twelve square views was known four times worse, at .01 more stretched ones were
# trusted.
_STRETCHED, _BY = 0.03, 0.05
# The same by what the solve with square pixels says, from which on another is made: that is to first order, and said
# .994 +- .003 of a picture stretched to .975.
_WORTH_A_SOLVE = 0.01


def beside_stretched(
    square: Calibration, observations: Observations, with_any_aspect: Callable[[], Calibration]
) -> Calibration:
    """The likelier one of a calibration with square pixels and of that with any, the other in what is known of it as
    far as it is probable.
    """
    if _probability(square.aspects_alone) < _WORTH_A_SOLVE or square.posterior is None:
        return square
    any_ = attempt(with_any_aspect)  # quiet: the warning says what the observations alone say
    if isinstance(any_, CalibrationError) or any_.posterior is None:
        return square
    likely = _probability({name: _told(any_, name) for name in square.aspects_alone})
    return likelier(square, any_, likely, observations)


def _told(any_: Calibration, camera: str) -> tuple[float, float]:
    """The aspect of a camera and its standard deviation, where nothing is known of it beforehand."""
    told = any_.uncertainty.verdict("camera", camera, "aspect")
    return told.value, told.sd


def _probability(alone: Mapping[str, tuple[float, float]]) -> float:
    """That pictures were stretched, by what the observations alone say: those of one camera, or all in the same way, as
    one kind of camera and of converter would have it.
    """
    told = np.array([[value, sd] for value, sd in alone.values() if np.isfinite(sd) and sd > 0.0])
    if not len(told):
        return 0.0
    values, variances = told[:, 0], told[:, 1] ** 2 + USUAL_ASPECT**2
    pooled = np.average(values, weights=1.0 / variances), 1.0 / np.sum(1.0 / variances)
    each = zip(values, variances, strict=True)
    return max(_of_one(float(value), float(variance)) for value, variance in (*each, pooled))


def _of_one(value: float, variance: float) -> float:
    """The same of one aspect, by how much likelier it is in a picture stretched by any; 0 where that is more than
    pictures are stretched by, as of lines that wander by pixels (1.19 +- .03 of a cropped photograph).

    Args:
        variance: by which it differs from 1 where pixels are square, of what is usual and of the observations.
    """
    farthest = 2.0  # standard deviations of by how much
    if abs(value - 1.0) > farthest * _BY:
        return 0.0
    stretched = variance + _BY**2
    times = _STRETCHED / (1.0 - _STRETCHED) * (variance / stretched) ** 0.5
    log_odds = np.log(times) + 0.5 * (value - 1.0) ** 2 * (1.0 / variance - 1.0 / stretched)
    return float(1.0 / (1.0 + np.exp(-log_odds)))
