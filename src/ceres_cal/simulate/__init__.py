"""Simulation of scenes: observations with noise, outliers and hidden stretches, and their true values.

A scene may also describe how photographs of it look, for scripts/rendering, which draws them.
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
