"""After a move: refit, check and compare calibrations."""

from ceres_cal.moves.auditing import StationAudit, audit
from ceres_cal.moves.carried import RefitOptions
from ceres_cal.moves.checking import FALSE_ALARMS, Check, StationCheck, check
from ceres_cal.moves.comparison import StationComparison, compare
from ceres_cal.moves.refitting import movements, refit

__all__ = [
    "FALSE_ALARMS",
    "Check",
    "RefitOptions",
    "StationAudit",
    "StationCheck",
    "StationComparison",
    "audit",
    "check",
    "compare",
    "movements",
    "refit",
]
