"""Reading what is left over: a table, what it says of the model, the choice of lens by held-out error."""

from ceres_cal.diagnostics.diagnose import FALSE_ALARM_RATE, Diagnosis, diagnose
from ceres_cal.diagnostics.findings import Amount, Finding
from ceres_cal.diagnostics.held_out import Choice, HeldOut, choose, cross_validate
from ceres_cal.diagnostics.leftover import Noise
from ceres_cal.diagnostics.summaries import RadiusTrend, Summaries, Summary
from ceres_cal.diagnostics.table import ResidualTable

__all__ = [
    "FALSE_ALARM_RATE",
    "Amount",
    "Choice",
    "Diagnosis",
    "Finding",
    "HeldOut",
    "Noise",
    "RadiusTrend",
    "ResidualTable",
    "Summaries",
    "Summary",
    "choose",
    "cross_validate",
    "diagnose",
]
