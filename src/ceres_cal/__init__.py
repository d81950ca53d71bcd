"""ceres-cal: calibrate a camera over a flat field, to the millimetre and honestly.

The names are loaded when they are first used, so that `import ceres_cal` costs nothing.
"""

import os

from ceres_cal.base.frozen import names_of

# For how many ticks of the clock, as a power of two, OpenBLAS's threads wait awake: 0.4 ms instead of the 0.1 s after
# NumPy is imported and after each call, on the cores that our own parts need.
os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "20")
__getattr__, __dir__, __all__ = names_of(__name__)
