"""Diagnosis of residuals: a table, summaries, and what they show about the model."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
