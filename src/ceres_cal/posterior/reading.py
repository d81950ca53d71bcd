"""What a posterior says of anything that a calibration shows: places on the field, pixels, the seam of two cameras.

One path for all of it: where each component of the mixture shows it, and how sure it is of that.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.base.frozen import Frozen
from ceres_cal.base.tails import NORMAL_95, normal_cdf
from ceres_cal.posterior.bent import weak_axes
from ceres_cal.posterior.mixture import FARTHER, Mixture, quantiles, radii
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.quantities import moved

_ROUND = 2.447 / np.sqrt(2.0)  # radius that 95 % of errors alike in all directions lie within, over their rms length
_LARGER = 0.5  # share of the radius at FARTHER that counts, where a valley widens out there


class Functional(Frozen):
    """Something that is read off an estimate: N pairs of numbers, and how they move.

    Attributes:
        values: by an estimate, (N, 2); NaN where nothing is shown. slopes: by it and some keys (K), (N, 2, K).
    """

    values: Callable[[Estimate], Array]
    slopes: Callable[[Estimate, Sequence[Key]], Array]


class Reading(Frozen):
    """What a posterior says of N pairs of numbers, from where the estimate has them.

    Attributes:
        low, high: (N, 2) 95 % bounds of each number; infinite where unknown. covariance: (N, 2, 2) second moments.
        radius_95: (N,) 95 % of the errors are shorter. sd: (N,) root mean square length of the errors; along a valley
            no more than the radius has it, which a thin tail beyond does not move.
    """

    low: Array
    high: Array
    covariance: Array
    radius_95: Array
    sd: Array


def read(posterior: Posterior, estimate: Estimate, shown: Functional, camera: str = "") -> Reading:
    """What is known of something shown.

    Args:
        camera: which alone it depends on; "" where it depends on several.
    """
    mixture, width = posterior.mixture(camera), posterior.half_width
    values, covariances = _of_components(mixture, estimate, shown, width)
    _show_lenses(values, mixture, posterior.lenses, shown)
    lost = np.asarray(np.isnan(values).any(axis=(0, 2)))
    weights, means, known = mixture.refined(np.where(lost[:, None], 0.0, values), covariances)
    variances = np.diagonal(known, axis1=-2, axis2=-1)
    low, high = quantiles(weights, means, variances, width)
    radius = radii(weights, means, known) * width / NORMAL_95
    if mixture.is_followed:
        tail = 2.0 * float(normal_cdf(-FARTHER))
        radius = np.maximum(radius, _LARGER * radii(weights, means, known, tail))  # of what is normal, 0.7 of it
    covariance = np.asarray(np.einsum("f,fnij->nij", weights, known))
    with np.errstate(invalid="ignore"):
        covariance = covariance + np.einsum("f,fni,fnj->nij", weights, means, means)
    open_ = lost | np.isinf(low).any(axis=1) | np.isinf(high).any(axis=1)
    radius = np.where(open_, np.inf, radius)
    low, high = np.where(lost[:, None], -np.inf, low), np.where(lost[:, None], np.inf, high)
    covariance[open_] = np.diag([np.inf, np.inf])
    sd = np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    sd = np.minimum(sd, radius / _ROUND) if mixture.is_followed else sd
    return Reading(low, high, covariance, radius, sd)


def _of_components(mixture: Mixture, estimate: Estimate, shown: Functional, width: float) -> tuple[Array, Array]:
    """(C, N, 2) values from those of the estimate, and (C, N, 2, 2) covariances."""
    here, known = shown.values(estimate), dict[int, Array]()
    values, covariances = [], []
    for step, number in zip(mixture.steps, mixture.at.tolist(), strict=True):
        there, off = estimate, np.full(here.shape, np.nan)
        with suppress(InputError):  # reads: "unknown" at these places of the map
            there = moved(estimate, mixture.keys, step) if np.any(step) else estimate
            off = shown.values(there) - here
        if number not in known:
            far = width if mixture.is_followed else 0.0
            known[number] = _covariance(mixture.information[number], there, shown, far)
        values.append(off)
        covariances.append(known[number])
    return np.array(values), np.array(covariances)


def _show_lenses(values: Array, mixture: Mixture, lenses: Sequence[Estimate], shown: Functional) -> None:
    """Values (C, N, 2) of components that are another lens: by how much it shows them elsewhere, wherever it shows
    anything.
    """
    if mixture.lenses:
        near = shown.values(lenses[0])
        for component, number in mixture.lenses.items():
            off = shown.values(lenses[number]) - near
            values[component] = np.where(np.isfinite(off), off, values[component])


def _covariance(information: Information, there: Estimate, shown: Functional, width: float) -> Array:
    """(N, 2, 2) within a component; where it is a node of a valley, with what bends across it.

    Args:
        width: standard deviations at which that is looked at; 0 for none.
    """
    slopes = shown.slopes(there, information.keys)
    covariance = information.spread.through(slopes)
    if width > 0.0:
        axes = width * weak_axes(information, there, information.keys).T
        here = shown.values(there)
        for step in (*axes, *-axes):
            off = np.full(here.shape, np.inf)
            with suppress(InputError):  # reads: "unknown" at these places of the map
                there_too = shown.values(moved(there, information.keys, step))
                off = np.nan_to_num(there_too - here - slopes @ step, nan=np.inf)
            far = np.isinf(off).any(axis=1)
            off[far] = 0.0
            covariance = covariance + 0.5 * off[:, :, None] * off[:, None, :] / width**2
            covariance[far] = np.diag([np.inf, np.inf])
    return covariance
