"""The languages of others: one module for each format that a calibration can be exported to, and the table of them."""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
