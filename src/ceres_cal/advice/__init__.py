"""What to measure next: each candidate with what it would take off a station's map, from the posterior."""

from ceres_cal.advice.advise import Advice, Promise, advise, promised
from ceres_cal.advice.measurements import Ground, Measurement
from ceres_cal.advice.outlook import Errors, Outlook

__all__ = ["Advice", "Errors", "Ground", "Measurement", "Outlook", "Promise", "advise", "promised"]
