"""Observations from photographs of a field: detection and refits of the camera alternate until they agree."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
