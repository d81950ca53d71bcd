"""The report: one HTML page that says whether a calibration may be trusted, for what, and to how many mm.

The only package that imports the plotting library. The page is loaded when it is first used: every command asks for the
quality of a calibration, few for the page.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ceres_cal.base.frozen import names_of

if TYPE_CHECKING:
    from ceres_cal.report.material import FramePhotographs as FramePhotographs
    from ceres_cal.report.report import make_report as make_report
    from ceres_cal.report.report import write_report as write_report

__all__ = ["FramePhotographs", "make_report", "write_report"]
__getattr__: Callable[[str], Any] = names_of(
    __name__, {"FramePhotographs": "material", "make_report": "report", "write_report": "report"}
)
