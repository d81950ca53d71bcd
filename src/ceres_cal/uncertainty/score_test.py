"""Is there any correlation to look for? Score tests at three lengths, which cost no likelihood.

That of a share a of nothing is r' K r with K = exp(-d / l) - 1, against its expectation -tr(K H) and its variance under
independent errors, of which the fit took up the part H = U U'. Summed over the strands of one shape first, r r' and H
serve all lengths.
"""

from __future__ import annotations

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.uncertainty.strands import Family

ASIDE = 20.0
"""Times the longest strand: the length of what moves it as a whole."""
# The likelihood is asked from so many standard deviations of a score test on (one in five of white noise), if the
# correlation that is likely by it would widen the variance of what is shared by so much.
_LOUD, _MATTERS = 0.85, 0.08
_NO_NOISE = 1e-6  # mean square, in squared standard deviations, below which residuals are rounding


def is_loud(family: Family) -> bool:
    """Whether neighbours, nearby rows or whole strands agree more than they do in one of five sets of white noise."""
    gap, longest, sums = family.gap, family.longest, np.diagonal(family.products)
    noise = sums[-1] / max(np.count_nonzero(family.filled) - np.sum(sums[:-1]), 1.0)
    if gap == 0.0 or noise < _NO_NOISE:
        return False
    residuals, private, shared = (family.squared(s) for s in (slice(-1, None), slice(6), slice(6, -1)))
    agreement, count = residuals / noise + private + shared, np.diff(family.bounds)
    for length in (gap, np.sqrt(gap * longest), ASIDE * longest):
        together = np.exp(-family.distance / length) * (family.distance > 0.0)
        squares = float(count @ np.sum(together**2, axis=(1, 2)))
        total = float(np.sum(together * agreement))
        widening = total / squares * float(np.sum(together * shared) / np.sum(sums[6:-1]))
        least = 0.2 * squares
        if widening <= _MATTERS or total <= _LOUD * np.sqrt(least):
            continue
        if total > _LOUD * np.sqrt(max(_variance(family, together, squares), least)):
            return True
    return False


def _variance(family: Family, together: Array, squares: float) -> float:
    """Of the score at the matrices (D, M, M), whose squared entries add up to so much over all strands."""
    taken, along = family.columns[..., :-1], family.applied(together)[..., :-1]
    inner = np.swapaxes(taken, 1, 2) @ along
    return float(2.0 * (squares - 2.0 * np.sum(along**2) + np.sum(inner**2)))
