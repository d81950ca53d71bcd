"""What to measure next: each candidate with what it would take off a station's map, from the posterior."""

from ceres_cal.diagnostics.advice.candidates import Ground, Measurement
from ceres_cal.diagnostics.advice.outlook import Errors, Outlook
from ceres_cal.diagnostics.advice.ranking import Advice, Promise, advise, promised

__all__ = ["Advice", "Errors", "Ground", "Measurement", "Outlook", "Promise", "advise", "promised"]
