"""Take the likelier of two calibrations of the same observations, with the other as a component by its probability.

A lens that was chosen while statements had little weight may be the only reason why a statement seems wrong: with one
coefficient, right heights of wide lenses seemed wrong by ten standard deviations. So where a statement is contradicted,
the lens is chosen once more with everything as stated. The odds that a statement is wrong are those of a whole feature
being an outlier, and each further coefficient has its price (Schwarz, Annals of Statistics 6, 1978).
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np

from ceres_cal.base import replace
from ceres_cal.calibration import Calibration, Fit
from ceres_cal.calibration.lens_comparison import PRICE
from ceres_cal.calibration.lens_forms import size_of
from ceres_cal.calibration.lens_seen import profiles_of
from ceres_cal.observations import Observations, gather_sights
from ceres_cal.posterior.other_lenses import OtherLenses, shifts_to_lenses
from ceres_cal.posterior.posterior import LEAST_PROBABILITY
from ceres_cal.problem import Key
from ceres_cal.robust.stated import DOUBTED, log_odds_wrong, may_be_wrong


def likelier(
    one: Calibration, other: Calibration, probability: float, observations: Observations, let_go: Collection[Key] = ()
) -> Calibration:
    """Return the likelier of two calibrations, with the other as a component of its posterior.

    Args:
        probability: of the other. let_go: statements that the other does not accept.
    """
    if probability > 0.5:
        one, other, probability = other, one, 1.0 - probability
    if probability < LEAST_PROBABILITY or one.posterior is None:
        return one
    profiles = profiles_of(one.estimate, gather_sights(observations))
    reach_px = {name: profile.reach_px for name, profile in profiles.items()}
    also, followed = OtherLenses(one.estimate, (other.estimate,), (probability,), reach_px), one.posterior.followed_phi
    keys = [key for key in one.posterior.keys if key.kind in ("camera", "station") and key not in followed]
    shift = shifts_to_lenses(also, keys, [one.estimate])[0]
    loose = replace(one.posterior, stated=one.posterior.stated.without(let_go))
    return replace(one, posterior=loose.with_alternatives(keys, shift, [probability]))


def with_lens_that_agrees(short: Calibration, agreeing: Calibration, observations: Observations) -> Calibration:
    """Return the likelier of a calibration that contradicts statements and one with another lens that agrees with them,
    with a warning where the statements may be wrong nevertheless.
    """
    log_odds = _misfit(agreeing.fit, short.fit) + sum(log_odds_wrong(one.sigmas) for one in short.conflicts)
    log_odds += 0.5 * np.log(observations.rows) * (_size_of(agreeing) - _size_of(short))
    wrong = float(1.0 / (1.0 + np.exp(-np.clip(log_odds, -700.0, 700.0))))
    if wrong < DOUBTED or agreeing.posterior is None:
        return agreeing
    # A statement that is in doubt is no longer part of what is stated.
    stated = {key[1:]: key for key in agreeing.posterior.stated.keys}
    named = {stated[one.number]: one for one in short.conflicts if one.number in stated}
    found = likelier(agreeing, short, wrong, observations, named)
    if found.conflicts:
        return found
    lens = " and ".join(dict.fromkeys(one.chosen for one in short.lens_choices.values()))
    words = (may_be_wrong(one, key, wrong, lens) for key, one in named.items())
    return replace(found, warnings=(*found.warnings, *words))


def _misfit(one: Fit, other: Fit) -> float:
    """Return the logarithm of how much likelier the observations are by the other fit, at the noise of that fit."""
    tiny = np.finfo(float).tiny
    each = (
        (2 * one.points, one.points_rms_px, 2 * other.points, other.points_rms_px),
        (one.curves, one.curves_rms_px, other.curves, other.curves_rms_px),
    )
    more = sum(count * (max(left, tiny) / max(less, tiny)) ** 2 - before for count, left, before, less in each)
    taken_out = sum(before - count for count, _, before, _ in each)
    return 0.5 * float(more + PRICE * taken_out)


def _size_of(found: Calibration) -> int:
    """Return the number of coefficients of its lenses, see `size_of`."""
    return sum(size_of(found.options.of_camera(name)) for name in found.cameras)
