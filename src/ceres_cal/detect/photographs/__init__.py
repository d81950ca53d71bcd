"""From photographs of a field to its observations: detection and refitting of the camera, in turn, until they agree."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
