"""What belongs: rounds of the solve, noise and outliers, features aside, other minima, targets as built."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
