"""What is expected of effects before anything was seen: how probable each is, and how large it may be.

Where a probability is halved or doubled, the log odds of what is found change by 0.7 at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array


@dataclass(frozen=True)
class SizePrior:
    """What is expected of an effect's size before anything was seen.

    Attributes:
        absent: probability that there is no such effect. sizes: standard deviations of its amounts that may be, each
            as likely.
    """

    absent: float
    sizes: tuple[float, ...]

    @property
    def scatter(self) -> Array:
        """(1 + N,) no size, and the sizes."""
        return np.append(0.0, self.sizes)

    @property
    def probabilities(self) -> Array:
        """(1 + N,) of these."""
        return self.over(len(self.sizes))

    def over(self, count: int) -> Array:
        """(1 + N,) probabilities of none, and of so many that are as likely as one another."""
        return np.append(self.absent, np.full(count, (1.0 - self.absent) / max(count, 1)))

    def times(self, unit: float) -> SizePrior:
        """In another unit: sizes are so many times as large."""
        return SizePrior(self.absent, tuple(unit * size for size in self.sizes))


_FAR = (10.0, 40.0, 160.0)  # standard deviations of an observation: all that is no scatter, a factor of four apart
FEATURE_ASIDE = SizePrior(0.95, (3.0, *_FAR))
"""Of a feature that does not belong, in standard deviations of an observation: lines are painted by hand.

Of a line 3 px aside the log odds are 10 to 20. At a probability of 0.1 two of 200 sound fields come into doubt; at 0.01
a quarter of the lines four standard deviations aside go unseen that need not.
"""
VIEW_ASIDE = SizePrior(0.99, _FAR)
"""Of a view or placement that does not belong, in the same unit: it is one from elsewhere, or its target is another."""
OFFSETS_SCATTER = SizePrior(0.5, tuple(np.geomspace(0.1, 60.0, 14).tolist()))
"""Of the offsets that features or views have all alike, in the same unit: that errors go together along them is as
likely as not.
"""
AS_BUILT = SizePrior(0.5, tuple(np.geomspace(1e-5, 3e-2, 30).tolist()))
"""Of how far a target's features lie off its drawing, in its size: that it is as drawn is as likely as not."""
DEPENDENCE = SizePrior(0.8, ())
"""Of errors that go together within views, and of views that scatter more than their equations say: errors are
independent in four of five calibrations. The sizes are those of a grid, or of a factor.
"""
