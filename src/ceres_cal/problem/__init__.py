"""The free numbers, the function that is minimised, and the one solve.

This is the only package that imports pyceres. Placements that a single station sees are eliminated within one block per
camera, which depends only on the camera's free intrinsics. Every other sight is one compressed block over its camera's
free intrinsics, its station and its placement. Each prior is one small block. Ceres minimises the same function either
way.
"""

from ceres_cal.base import kept_signals, names_of

with kept_signals():
    from pyceres import __version__ as solver_version  # noqa: F401

__getattr__, __dir__, __all__ = names_of(__name__)
