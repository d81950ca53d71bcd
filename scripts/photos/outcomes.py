"""Result for one photograph of a field with known truth: detected, calibrated, and compared, with the truth and with
what its own posterior foresees of that comparison.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from runner import Row

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import CalibrationError, InputError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.calibration import Calibration
from ceres_cal.detect.photographs import Auto, Clicks, detect_field
from ceres_cal.posterior.maps import PointSpread, located_by, of_components
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.quantities import moved
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


class Foreseen(NamedTuple):
    """By a calibration's own posterior, if every statement in it is right: the probabilities that the rms error is
    below or above the stated one by more than the limit, and that it is wrong as `Outcome.certified` says.
    """

    below: float = 0.0
    above: float = 0.0
    wrong: float = 0.0


UNFORESEEN = Foreseen()


@dataclass(frozen=True)
class Outcome:
    """Seconds of the detection; mean, median and rms error of the map over the field, mm, and the stated error; the
    share of places far beyond their 95 % radius, on the field and outside it; the chosen lens, the verdict on the
    calibration, and whether it states an accuracy; or the reason of a refusal; what is foreseen of the errors.
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
    foreseen: Foreseen = UNFORESEEN

    @property
    def over_stated(self) -> float:
        """Rms error over the stated one."""
        return self.rms_mm / self.stated_mm

    @property
    def certified(self) -> bool:
        """Whether the calibration is trusted although it is wrong."""
        return self.trusted and bool(_is_wrong(self.over_stated, self.beyond))


def _is_wrong(over_stated: ArrayLike, beyond: ArrayLike) -> Mask:
    return (np.asarray(over_stated) > WRONG) | (np.asarray(beyond) > MOST_BEYOND)


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
    lens, foreseen = calibration.options.lens, foreseen_of(calibration, truth, located)
    return Outcome(seconds, mean, median, rms, stated, beyond, beside, lens, said, trusted, foreseen=foreseen)


def foreseen_of(calibration: Calibration, truth: Places, located: PointSpread) -> Foreseen:
    """Compare draws from the posterior as the truth is compared, all places of a draw together."""
    known = np.isfinite(located.sd_m)
    if not known.all():
        return UNFORESEEN
    draws = np.linalg.norm(_drawn_m(calibration, truth, located.sd_m, 500), axis=2)
    ratio = np.sqrt(np.mean(draws**2, axis=1) / np.mean(located.sd_m**2))
    beyond = np.mean(draws > BEYOND * located.radius_95_m, axis=1)
    each = ratio < 1.0 / STATED, ratio > STATED, _is_wrong(ratio, beyond)
    return Foreseen(*(float(np.mean(one)) for one in each))


def _drawn_m(calibration: Calibration, truth: Places, sd_m: Array, count: int) -> Array:
    """(S, N, 2) m by which places are off in draws from the posterior, with the stated deviation `sd_m` (N,) of each.

    What is drawn are the components and the numbers within each; how places vary within a component and between those
    of a valley is linear here, so the draws of each place are scaled.
    """
    posterior, near, rng = calibration.uncertainty.posterior, calibration.estimate, np.random.default_rng(7)
    station = near.station_name(None)
    camera = near.stations[station].camera
    shown, mixture = located_by(near, station, *truth[::2]), posterior.mixture(camera)
    centres, _ = of_components(mixture, near, shown, posterior.lenses, posterior.half_width, camera)
    draws = list[Array]()
    for number, times in enumerate(rng.multinomial(count, mixture.weights / mixture.weights.sum())):
        about = mixture.information[mixture.at[number]]
        first = int(np.argmax(mixture.at == mixture.at[number]))  # where its slopes are those of the stated deviations
        slopes = shown.slopes(moved(near, mixture.keys, mixture.steps[first]), about.keys)
        steps = rng.multivariate_normal(np.zeros(len(about.keys)), about.spread.covariance, times, method="eigh")
        draws.append(centres[number] + np.einsum("nak,sk->sna", slopes, steps))
    every = np.nan_to_num(np.concatenate(draws))
    return np.asarray(every * (sd_m / np.sqrt(np.mean(np.sum(every**2, axis=2), axis=0)))[:, None])


def rows_of_foreseen(case: str, every: Sequence[Outcome]) -> Iterator[Row]:
    """Numbers of errors outside the limits, and of those trusted, beside what the posteriors foresee: a sum of so many
    probabilities, with three standard deviations on either side.
    """
    stated = [one for one in every if np.isfinite(one.stated_mm)]
    ratios = np.array([one.over_stated for one in stated])
    trusted = [one for one in stated if one.trusted]
    for what, seen, likely in (
        (f"rms error below 1/{STATED} of stated", ratios < 1.0 / STATED, [one.foreseen.below for one in stated]),
        (f"rms error above {STATED} of stated", ratios > STATED, [one.foreseen.above for one in stated]),
        ("wrong, but trusted", [one.certified for one in trusted], [one.foreseen.wrong for one in trusted]),
    ):
        mean, scatter = float(np.sum(likely)), float(np.sqrt(np.sum(np.array(likely) * (1.0 - np.array(likely)))))
        note = f"of {len(seen)}; the posteriors foresee {mean:.1f} +- {scatter:.1f}"
        yield Row(case, what, float(np.sum(seen)), most=mean + 3.0 * scatter, note=note)


def _compared(calibration: Calibration, truth: Places) -> tuple[Array, PointSpread]:
    """Errors (N,) of what pixels show, mm, and what is stated of them."""
    located = calibration.uncertainty.located(truth.pixels, truth.height_m)
    return 1e3 * np.linalg.norm(located.located - truth.places, axis=1), located


def _is_far(error_mm: Array, located: PointSpread) -> Mask:
    return np.asarray(error_mm > BEYOND * 1e3 * located.radius_95_m)
