"""Which numbers there are, what is minimised, and the one solve.

The only package that imports pyceres. Placements that a single station sees are eliminated inside one block per camera,
over its free intrinsics alone; every other sight is one compressed block over its camera's free intrinsics, its station
and its placement; each prior is one small block. What Ceres minimises is the same function either way.
"""

from ceres_cal.base import kept_signals, names_of

with kept_signals():
    from pyceres import __version__ as solver_version  # noqa: F401

__getattr__, __dir__, __all__ = names_of(__name__)
