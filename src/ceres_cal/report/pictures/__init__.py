"""Pictures made of photographs: straightened, seen from above to scale, and with the model drawn into them.

The names are loaded when they are first used; everything here needs OpenCV.
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
