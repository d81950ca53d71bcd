"""What to measure next: candidates, each with its reduction of the errors of a station's map, from the posterior."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
