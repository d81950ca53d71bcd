"""The result of a calibration, how it came about, and its file."""

from ceres_cal.calibration.calibration import Calibration
from ceres_cal.calibration.file import (
    COPY,
    FORMAT,
    CalibrationFile,
    Fit,
    LensChoice,
    Refitted,
    Rejected,
    TriedLens,
    package_versions,
)

__all__ = [
    "COPY",
    "FORMAT",
    "Calibration",
    "CalibrationFile",
    "Fit",
    "LensChoice",
    "Refitted",
    "Rejected",
    "TriedLens",
    "package_versions",
]
