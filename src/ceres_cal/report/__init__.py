"""The report: one HTML page that says whether a calibration may be trusted, for what, and to how many mm.

The only package that imports the plotting library. The page is loaded when it is first used: every command asks for the
quality of a calibration, few for the page.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ceres_cal.report.material import FramePhotographs as FramePhotographs
    from ceres_cal.report.report import make_report as make_report
    from ceres_cal.report.report import write_report as write_report

__all__ = ["FramePhotographs", "make_report", "write_report"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from ceres_cal.report import report

    return getattr(report, name)
