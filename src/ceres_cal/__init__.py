"""ceres-cal: calibrate a camera over a flat field, to the millimetre and honestly.

The names are loaded when they are first used, so that `import ceres_cal` costs nothing.
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
