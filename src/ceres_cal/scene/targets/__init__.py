"""Targets: rigid things of known geometry; the table of their kinds, and the target that a file describes."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
