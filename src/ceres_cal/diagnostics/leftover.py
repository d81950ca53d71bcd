"""What is left once every named cause is taken off: how large the noise is, and whether neighbours agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import AnyArray, Indices, Mask
from ceres_cal.base.tails import log_chi2_tail
from ceres_cal.effects.linearised import Linearised
from ceres_cal.observations import Observations
from ceres_cal.problem.noise import Inliers
from ceres_cal.scene.curves import nearest_on_track

# Noise within so much of what was stated is as stated: sigmas are guessed to a tenth or two. Below 1 every sound
# scene is a finding; at 2.3 noise of twice the stated one is missed.
LARGER = 1.15
# Pairs of neighbours: the correlation of 20 is known to 0.2. Nothing changes from half to double.
_FEWEST_PAIRS = 20


@dataclass(frozen=True)
class Noise:
    """The noise of one kind, with the named causes taken off.

    Attributes:
        kind: "points" or "curves". observations: inliers. sigma_px: typical standard deviation (of each coordinate of a
            point, of the distance to a curve). scale: factor on the stated sigmas; stated_px: their root mean square,
            NaN where nobody stated one (all are 1).
        log_p: natural logarithm of the probability of so much, were the noise LARGER times what was stated.
        correlation: of neighbouring residuals (along a line, between a board's corners), NaN where there are too few.
        correlation_log_p: of so much correlation in white noise. effective: observations that would say as much if
            they were independent.
    """

    kind: str
    observations: int
    sigma_px: float
    scale: float
    stated_px: float
    log_p: float
    correlation: float
    correlation_log_p: float
    effective: float

    @property
    def inflation(self) -> float:
        """How many observations weigh as much as one independent one."""
        return self.observations / self.effective if self.observations else 1.0


def measure_noise(
    observations: Observations, model: Linearised, before: Linearised, inliers: Inliers
) -> tuple[Noise, ...]:
    """The noise of points and of curves, where there are any.

    Args:
        model: with the named causes taken off. before: the calibration's own. inliers: with its noise scales.
    """
    answer = []
    for is_curve, kind, scale in ((False, "points", inliers.point_scale), (True, "curves", inliers.curve_scale)):
        rows = model.used & (model.equations.is_curve == is_curve)
        if np.any(rows):
            own = before.variance(before.used & (before.equations.is_curve == is_curve))
            answer.append(_noise_of(observations, model, kind, rows, scale, own))
    return tuple(answer)


def _noise_of(
    observations: Observations, model: Linearised, kind: str, rows: Mask, own_scale: float, own_variance: float
) -> Noise:
    column = observations.curves if kind == "curves" else observations.points
    variance, spare = model.variance(rows), model.spare_of(rows)
    scale = own_scale * float(np.sqrt(variance / own_variance)) if own_variance > 0.0 else own_scale
    count = int(np.count_nonzero(rows)) // (1 if kind == "curves" else 2)
    stated = float("nan") if np.all(column.sigma_px == 1.0) else float(np.sqrt(np.mean(column.sigma_px**2)))
    log_p = 0.0
    if np.isfinite(stated) and spare >= 1.0:
        log_p = float(log_chi2_tail(variance * spare * own_scale**2 / LARGER**2, spare))
    typical = scale * float(np.sqrt(np.mean(column.sigma_px**2)))
    correlation, pairs_log_p = _correlation(model, _neighbours(observations, model, kind), variance)
    agree = max(correlation, 0.0) if np.isfinite(correlation) and pairs_log_p < np.log(0.01) else 0.0
    effective = count * (1.0 - agree) / (1.0 + agree)  # of a first-order autoregression
    return Noise(kind, count, typical, scale, stated, log_p, correlation, pairs_log_p, effective)


def _neighbours(observations: Observations, model: Linearised, kind: str) -> tuple[Indices, Indices]:
    """Pairs of used equations: next to one another along a line of one view, or on one row of a board."""
    equations = model.equations
    if kind == "curves":
        rows = np.flatnonzero(model.used & equations.is_curve)
        track = equations.feature[rows]
        along = nearest_on_track(equations.sights.tracks[track], equations.sights.is_arc[track], equations.place[rows])
        first, second = _successive(rows, along, track, equations.view[rows])
        near = equations.feature[first] == equations.feature[second]
    else:
        grids = [observations.targets[view.target].grid for view in observations.views]
        columns = np.array([0 if grid is None else grid.columns for grid in grids])
        rows = np.flatnonzero(model.used & ~equations.is_curve & (columns[equations.view] > 0))
        component = (equations.direction[rows, 1] > 0.5).astype(int)
        first, second = _successive(rows, equations.feature[rows], component, equations.view[rows])
        near = equations.feature[second] - equations.feature[first] == 1
        near &= np.all(equations.direction[first] == equations.direction[second], axis=1)
        column = observations.points.feature[equations.observation[second]] % columns[equations.view[second]]
        near &= column > 0  # not from the end of a row to the next one
    near &= equations.view[first] == equations.view[second]
    return first[near], second[near]


def _successive(rows: Indices, *keys: AnyArray) -> tuple[Indices, Indices]:
    """Rows and their successors in the order of the last key, then the one before it, and so on."""
    order = rows[np.lexsort(keys)]
    return order[:-1], order[1:]


def _correlation(model: Linearised, pairs: tuple[Indices, Indices], variance: float) -> tuple[float, float]:
    """Correlation of neighbouring residuals beyond what the fit makes of white noise, and log P of so much."""
    first, second = pairs
    if len(first) < _FEWEST_PAIRS:
        return float("nan"), 0.0
    left, leverage = model.left_over, np.minimum(model.leverage, 1.0)
    overlap = model.overlap(first, second)
    total = float(np.sum(left[first] * left[second] + variance * overlap))
    kept = (1.0 - leverage[first]) * (1.0 - leverage[second])
    z = total / (variance * np.sqrt(np.sum(kept + overlap**2)))
    log_p = log_chi2_tail(z * z, 1.0) - np.log(2.0) if z > 0.0 else 0.0
    return float(total / (variance * max(float(np.sum(np.sqrt(kept))), 1e-9))), float(log_p)
