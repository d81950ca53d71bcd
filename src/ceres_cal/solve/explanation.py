"""What is said of a whole that may not belong: how far it lies aside, how surely, and what else may be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Mask
from ceres_cal.base.words import two_digits
from ceres_cal.model.parameters import Estimate

# Log odds between which both explanations are named: 19 to 1.
DOUBTFUL = 3.0


@dataclass(frozen=True, eq=False)
class Explanation:
    """That a whole does not belong.

    Attributes:
        name: of the whole. rows: (N + M,) its observations, points by row and then curves by row. aside_px: how far it
            lies aside, the median. log_odds: natural logarithm of the odds that it does not belong.
        instead: what the next best explanation says. other: the estimate of the less probable one of the two.
    """

    name: str
    rows: Mask
    aside_px: float
    log_odds: float
    instead: str
    other: Estimate

    @property
    def doubt(self) -> float:
        """Probability of the less probable explanation."""
        return float(1.0 / (1.0 + np.exp(abs(self.log_odds))))

    @property
    def is_doubtful(self) -> bool:
        """Whether both explanations are to be named."""
        return abs(self.log_odds) < DOUBTFUL

    @property
    def is_taken(self) -> bool:
        """Whether it is the more probable one, and its observations are taken out."""
        return self.log_odds > 0.0

    @property
    def words(self) -> str:
        """What it says."""
        return f"the whole of {self.name}: {np.count_nonzero(self.rows)} rows, {two_digits(self.aside_px)} px aside"

    @property
    def warning(self) -> str:
        """What to know before the calibration is used."""
        if not self.is_doubtful:
            return (
                f"{self.words} of where all others put it: taken out as one; check its label, and where it is painted"
            )
        chosen, other = (self.words, self.instead) if self.is_taken else ("all of it belongs", self.words)
        return (
            f"in doubt about {self.name}: {chosen}, or {other} ({100.0 * self.doubt:.0f} %); standard deviations hold "
            "for either: look at it in the picture, or observe more"
        )
