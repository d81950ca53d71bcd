"""The report: one HTML page that says whether a calibration can be trusted, for what, and to how many mm.

All pictures are drawn here, except by `plot()` of public objects. The page is imported when it is first used: every
command needs the quality of a calibration, few need the page.
"""

from ceres_cal.base.frozen import names_of

__getattr__, __dir__, __all__ = names_of(__name__)
