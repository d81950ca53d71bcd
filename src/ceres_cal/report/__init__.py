"""The report: one HTML page that says whether a calibration may be trusted, for what, and to how many mm.

The only package that imports the plotting library. The page is loaded when it is first used: every command asks for the
quality of a calibration, few for the page.
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
