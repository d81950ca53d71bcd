"""Result for one photograph of a field with known truth: detected, calibrated, and compared."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import CalibrationError, InputError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.calibration import Calibration
from ceres_cal.detect.photographs import Auto, Clicks, detect_field
from ceres_cal.posterior.maps import PointSpread
from ceres_cal.problem.parameters import Options
from ceres_cal.report.grounds import judge_quality, promises
from ceres_cal.report.quality import quality_of
from ceres_cal.scene.targets import Target

USUAL_MM, MOVED_MM = 1.5, 3.0  # limits of the mean map error: usual; with several disturbances or motion
STATED = 1.6  # limit of the error over the stated one, and of its inverse
WRONG = 4.0  # with a larger ratio a calibration is wrong without saying so
BEYOND, MOST_BEYOND = 1.5, 0.02  # times the 95 % radius, and the share of places that may lie farther off


class Places(NamedTuple):
    """Pixels (N, 2), and the places (N, 2), m, that they show at a height."""

    pixels: Array
    places: Array
    height_m: float = 0.0


@dataclass(frozen=True)
class Outcome:
    """Seconds of the detection; mean, median and rms error of the map over the field, mm, and the stated error; the
    share of places far beyond their 95 % radius, on the field and outside it; the chosen lens, the verdict on the
    calibration, and whether it states an accuracy; or the reason of a refusal.
    """

    seconds: float
    mean_mm: float = np.nan
    median_mm: float = np.nan
    rms_mm: float = np.nan
    stated_mm: float = np.nan
    beyond: float = np.nan
    beyond_outside: float = np.nan
    lens: str = ""
    verdict: str = ""
    trusted: bool = False
    why: str = ""

    @property
    def over_stated(self) -> float:
        """Rms error over the stated one."""
        return self.rms_mm / self.stated_mm

    @property
    def certified(self) -> bool:
        """Whether the calibration is trusted although it is wrong."""
        return self.trusted and (self.over_stated > WRONG or self.beyond > MOST_BEYOND)


def outcome(
    path: Path, asked: Target, start: Auto | Clicks, truth: Places, lens: str = "auto", outside: Sequence[Places] = ()
) -> Outcome:
    """Detect, calibrate, and compare with the truth.

    Args:
        truth: of the field. outside: of what else the picture shows, at any heights.
    """
    began = time.perf_counter()
    try:
        found = detect_field([path], asked, start)
        seconds = time.perf_counter() - began
        calibration = calibrate(found.observations, Options(lens=lens))
    except (CalibrationError, InputError) as refusal:
        return Outcome(time.perf_counter() - began, why=str(refusal).partition(": ")[2] or str(refusal))
    error, located = _compared(calibration, truth)
    rms, stated = (float(np.sqrt(np.mean(one**2))) for one in (error, 1e3 * located.sd_m))
    beyond = float(np.mean(_is_far(error, located)))
    away = np.concatenate([_is_far(*_compared(calibration, places)) for places in outside] or [np.zeros(0, bool)])
    quality = quality_of(calibration, found.observations)
    said, trusted = judge_quality(quality).headline, promises(quality)
    mean, median = float(np.mean(error)), float(np.median(error))
    beside = float(np.mean(away)) if len(away) else np.nan
    return Outcome(seconds, mean, median, rms, stated, beyond, beside, calibration.options.lens, said, trusted)


def _compared(calibration: Calibration, truth: Places) -> tuple[Array, PointSpread]:
    """Errors (N,) of what pixels show, mm, and what is stated of them."""
    located = calibration.uncertainty.located(truth.pixels, truth.height_m)
    return 1e3 * np.linalg.norm(located.located - truth.places, axis=1), located


def _is_far(error_mm: Array, located: PointSpread) -> Mask:
    return np.asarray(error_mm > BEYOND * 1e3 * located.radius_95_m)
