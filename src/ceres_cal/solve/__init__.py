"""The one nonlinear least-squares problem, in Ceres: blocks, losses, priors, solve (design, sections 5 and 6).

The only package that imports pyceres. Placements that a single station sees are eliminated inside one block per camera,
over its free intrinsics alone; every other sight is one compressed block over its camera's free intrinsics, its station
and its placement; each prior is one small block. What Ceres minimises is the same function either way.
"""

from ceres_cal.base.native import kept_signals

with kept_signals():
    from pyceres import __version__ as solver_version

from ceres_cal.solve.as_built import words_of
from ceres_cal.solve.bundle import Progress, Solution, placement_costs, solve, with_placements_at_best
from ceres_cal.solve.conflicts import Conflicts, find_conflicts
from ceres_cal.solve.elsewhere import least_of_few, shifts_to
from ceres_cal.solve.information import Eliminated, ReducedInformation, information
from ceres_cal.solve.problem import Problem, Weighting
from ceres_cal.solve.repeats import AsBuilt
from ceres_cal.solve.robust import RobustSolution, solve_robustly
from ceres_cal.solve.stated import Conflict

__all__ = [
    "AsBuilt",
    "Conflict",
    "Conflicts",
    "Eliminated",
    "Problem",
    "Progress",
    "ReducedInformation",
    "RobustSolution",
    "Solution",
    "Weighting",
    "find_conflicts",
    "information",
    "least_of_few",
    "placement_costs",
    "shifts_to",
    "solve",
    "solve_robustly",
    "solver_version",
    "with_placements_at_best",
    "words_of",
]
