"""How two cameras stand to each other: baseline and angle, with standard deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import rotation_log
from ceres_cal.model.keys import over
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.quantities import moved, natural_sizes
from ceres_cal.uncertainty.posterior import Posterior

_STEP = 1e-6  # of a number's natural size, either way, for derivatives


@dataclass(frozen=True)
class RigPair:
    """Two stations, and how the second stands to the first.

    Attributes:
        baseline_m, baseline_sd_m: between their positions. angle_rad, angle_sd_rad: between their orientations, about
            whichever axis; a standard deviation is infinite where nothing is known of one of them.
    """

    stations: tuple[str, str]
    baseline_m: float
    baseline_sd_m: float
    angle_rad: float
    angle_sd_rad: float


def rig_pairs(estimate: Estimate, posterior: Posterior) -> tuple[RigPair, ...]:
    """The first station with each one of another camera."""
    first, *others = estimate.stations
    camera = estimate.stations[first].camera
    return tuple(_pair(estimate, posterior, first, o) for o in others if estimate.stations[o].camera != camera)


def _pair(estimate: Estimate, posterior: Posterior, first: str, second: str) -> RigPair:
    at = [column for column, key in enumerate(posterior.keys) if key[:2] in (("station", first), ("station", second))]
    keys = [posterior.keys[column] for column in at]
    steps = _STEP * natural_sizes(estimate, keys)
    jacobian = np.zeros((2, len(posterior.keys)))
    for column, number, step in zip(at, range(len(keys)), steps, strict=True):
        along = step * (np.arange(len(keys)) == number)
        there = [_numbers(moved(estimate, keys, sign * along), first, second) for sign in (1.0, -1.0)]
        jacobian[:, column] = (there[0] - there[1]) / (2.0 * step)
    variance = np.diagonal(posterior.spread.through(jacobian))
    if posterior.bends is not None:
        ends = over(posterior.bends.excesses, posterior.bends.keys, posterior.keys) @ jacobian.T
        variance = variance + np.sum(ends**2, axis=0)
    sd = np.sqrt(variance)
    baseline, angle = _numbers(estimate, first, second).tolist()
    return RigPair((first, second), baseline, float(sd[0]), angle, float(sd[1]))


def _numbers(estimate: Estimate, first: str, second: str) -> Array:
    """Baseline (m) and angle (rad)."""
    a, b = (estimate.stations[name].cam_from_world for name in (first, second))
    turn = rotation_log(b.rotation @ a.rotation.T)
    return np.array([np.linalg.norm(b.position - a.position), np.linalg.norm(turn)])
