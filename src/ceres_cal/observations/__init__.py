"""Observations: what the frames show, as columns, in memory and in files; and `sights`, as the method takes them.

A view is what one frame shows of one target; a sight is what one camera at one station sees of one rigid frame, over
all its views, and so what one pose projects (see `observations.sights`).
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
