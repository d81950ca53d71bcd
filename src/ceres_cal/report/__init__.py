"""The report: one HTML page that says whether a calibration may be trusted, for what, and to how many mm.

The only package that imports the plotting library.
"""

from ceres_cal.report.material import FramePhotographs
from ceres_cal.report.report import make_report, write_report

__all__ = ["FramePhotographs", "make_report", "write_report"]
