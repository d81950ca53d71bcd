"""Observations: what the frames show, as columns in memory and in files, and as `sights`, which the method uses.

A view is what one frame shows of one target. A sight is what one camera at one station sees of one rigid frame, over
all its views, so that one pose projects all of it (see `observations.sights`).
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
