"""The result of a calibration, how it was obtained, and its file."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
