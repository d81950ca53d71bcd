"""Which numbers there are, what is minimised, and the one solve.

The only package that imports pyceres. Placements that a single station sees are eliminated inside one block per camera,
over its free intrinsics alone; every other sight is one compressed block over its camera's free intrinsics, its station
and its placement; each prior is one small block. What Ceres minimises is the same function either way.
"""

from ceres_cal.base.threads import kept_signals

with kept_signals():
    from pyceres import __version__ as solver_version

__all__ = ["solver_version"]
