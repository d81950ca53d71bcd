"""Reading what is left over: a table, what it says of the model, the choice of lens by held-out error."""

from ceres_cal.diagnostics.checks import CHECKS, Check, DiagnosisCase, Noise, TestResults
from ceres_cal.diagnostics.diagnose import FALSE_ALARM_RATE, Diagnosis, diagnose
from ceres_cal.diagnostics.summaries import RadiusTrend, Summaries, Summary
from ceres_cal.diagnostics.table import ResidualTable
from ceres_cal.effects.effect import Amount, Finding

__all__ = [
    "CHECKS",
    "FALSE_ALARM_RATE",
    "Amount",
    "Check",
    "Diagnosis",
    "DiagnosisCase",
    "Finding",
    "Noise",
    "RadiusTrend",
    "ResidualTable",
    "Summaries",
    "Summary",
    "TestResults",
    "diagnose",
]
