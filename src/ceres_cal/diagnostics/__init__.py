"""Reading what is left over: a table, what it says of the model, the choice of lens by held-out error."""

from ceres_cal.diagnostics.diagnose import FALSE_ALARM_RATE, Diagnosis, diagnose
from ceres_cal.diagnostics.diagnostic import Amount, Case, Diagnostic, Evidence, Finding, ScoreTest, Tested, Words
from ceres_cal.diagnostics.leftover import Noise
from ceres_cal.diagnostics.registry import DIAGNOSTICS
from ceres_cal.diagnostics.scores import Family
from ceres_cal.diagnostics.summaries import RadiusTrend, Summaries, Summary
from ceres_cal.diagnostics.table import ResidualTable

__all__ = [
    "DIAGNOSTICS",
    "FALSE_ALARM_RATE",
    "Amount",
    "Case",
    "Diagnosis",
    "Diagnostic",
    "Evidence",
    "Family",
    "Finding",
    "Noise",
    "RadiusTrend",
    "ResidualTable",
    "ScoreTest",
    "Summaries",
    "Summary",
    "Tested",
    "Words",
    "diagnose",
]
