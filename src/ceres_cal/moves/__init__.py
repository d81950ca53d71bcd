"""Calibrations and new observations: refit, check, score, audit and compare."""

from ceres_cal.moves.agreement import FALSE_ALARMS, Agreement, Agreements
from ceres_cal.moves.audits import audit
from ceres_cal.moves.checks import check
from ceres_cal.moves.comparisons import compare, compare_cameras
from ceres_cal.moves.refit_plan import RefitOptions
from ceres_cal.moves.refits import movements, refit
from ceres_cal.moves.scores import score

__all__ = [
    "FALSE_ALARMS",
    "Agreement",
    "Agreements",
    "RefitOptions",
    "audit",
    "check",
    "compare",
    "compare_cameras",
    "movements",
    "refit",
    "score",
]
