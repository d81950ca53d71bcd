"""ceres-cal: calibration of cameras above a flat field, to the millimetre and with honest uncertainties.

The names are loaded when they are first used, so that `import ceres_cal` costs nothing.
"""

import os

from ceres_cal.base.frozen import names_of

# OpenBLAS's threads stay awake for 2^20 clock ticks, 0.4 ms, instead of 0.1 s after NumPy is imported and after each
# call: until then they occupy the cores that our own threads need.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "20")
__getattr__, __dir__, __all__ = names_of(__name__)
