"""The robust solve: rounds, noise, outliers, misplaced features, other minima, targets as built, tests of priors."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
