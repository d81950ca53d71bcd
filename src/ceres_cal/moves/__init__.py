"""Calibrations and new observations: refit, check, score and compare."""

from ceres_cal.moves.auditing import StationAudit, audit
from ceres_cal.moves.carried import RefitOptions
from ceres_cal.moves.checking import FALSE_ALARMS, Check, StationCheck, check
from ceres_cal.moves.comparison import CameraComparison, StationComparison, compare, compare_cameras
from ceres_cal.moves.refitting import movements, refit
from ceres_cal.moves.scoring import Score, ScorePart, score

__all__ = [
    "FALSE_ALARMS",
    "CameraComparison",
    "Check",
    "RefitOptions",
    "Score",
    "ScorePart",
    "StationAudit",
    "StationCheck",
    "StationComparison",
    "audit",
    "check",
    "compare",
    "compare_cameras",
    "movements",
    "refit",
    "score",
]
