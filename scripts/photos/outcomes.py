"""What comes of one photograph of a field whose truth is known: detected, calibrated, and compared."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import CalibrationError, InputError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.photographs import Auto, Clicks, detect_field
from ceres_cal.problem.parameters import Options
from ceres_cal.scene.targets import Target

USUAL_MM, MOVED_MM = 1.5, 3.0  # mean error of a map, as small pictures allow; of several disturbances, or motion
STATED = 1.6  # of errors over what is stated, either way


@dataclass(frozen=True)
class Outcome:
    """Seconds of the detection; mean, median and rms error of the map over the field, mm, and the stated one; the lens
    that was chosen; or why there is none.
    """

    seconds: float
    mean_mm: float = np.nan
    median_mm: float = np.nan
    rms_mm: float = np.nan
    stated_mm: float = np.nan
    lens: str = ""
    why: str = ""

    @property
    def over_stated(self) -> float:
        """Rms error over the stated one."""
        return self.rms_mm / self.stated_mm


def outcome(path: Path, asked: Target, start: Auto | Clicks, truth: tuple[Array, Array], lens: str = "auto") -> Outcome:
    """Detect, calibrate, and compare with the truth.

    Args:
        truth: pixels (N, 2), and where on the field they lie (N, 2), m.
    """
    began = time.perf_counter()
    try:
        found = detect_field([path], asked, start)
        seconds = time.perf_counter() - began
        calibration = calibrate(found.observations, Options(lens=lens))
    except (CalibrationError, InputError) as refusal:
        return Outcome(time.perf_counter() - began, why=str(refusal).partition(": ")[2] or str(refusal))
    pixels, places = truth
    error = 1e3 * np.linalg.norm(calibration.station().locate(pixels) - places, axis=1)
    sd = 1e3 * calibration.uncertainty.located(pixels).sd_m
    rms, stated = (float(np.sqrt(np.mean(one**2))) for one in (error, sd))
    return Outcome(seconds, float(np.mean(error)), float(np.median(error)), rms, stated, calibration.options.lens)
