"""Choose a lens by too few observations to compare predictions: by what lenses of equally many coefficients leave.

From six corners of a wide picture, the paper's lens alone gave a principal point with a standard deviation of 3 px that
was 5.5 standard deviations off.
"""

from __future__ import annotations

from collections.abc import Collection
from functools import partial

import numpy as np

from ceres_cal.base import CalibrationError, attempt, replace
from ceres_cal.calibration.lens_forms import PAPER, Form, undecentred
from ceres_cal.calibration.lens_seen import found, profiles_of, seen_through
from ceres_cal.observations import Observations, gather_sights
from ceres_cal.posterior.other_lenses import OtherLenses
from ceres_cal.problem import Estimate, Information, Options, Solution, problem_of, solve
from ceres_cal.problem.reduced import information

# Natural logarithm of how much likelier another kind must be than the paper's: strong evidence (Kass and Raftery,
# Journal of the American Statistical Association 90, 1995).
_STRONG = 3.0


def likeliest_of_few(
    observations: Observations, options: Options, near: Estimate, failed: Collection[str] = ()
) -> tuple[Form, Estimate] | None:
    """Return the kind that is far likelier than the paper's lens, and the estimate with it; None where none is.

    Args:
        failed: labels of lenses with which all of the observations could not be calibrated.
    """
    each = {form: end for form, end in _with_each_kind(observations, options, near).items() if form.label not in failed}
    least = min((end.cost for end in each.values()), default=np.inf)
    form, end = next((one for one in each.items() if one[1].cost < least + _STRONG), (None, None))
    return None if form is None or end is None or form.label == PAPER else (form, end.estimate)


def others_of_few(observations: Observations, label: str, options: Options, near: Estimate) -> OtherLenses:
    """Return the estimates of one camera with the other kinds, weighted by what each leaves beside the lens of that
    label. The options are those of all cameras.
    """
    (camera,) = observations.cameras
    options = replace(options.of_camera(camera), priors=observations.about_shown(options.priors))
    solved = _with_each_kind(observations, options, near)
    each = {form.label: end for form, end in solved.items()}
    own = each.pop(label, None)
    if own is None:
        return OtherLenses(near, (), (), {})
    costs = np.array([own.cost, *(end.cost for end in each.values())])
    likely = np.exp(costs.min() - costs)
    weights = tuple((likely / likely.sum())[1:].tolist())
    sights = gather_sights(observations)
    reach_px = {name: one.reach_px for name, one in profiles_of(near, sights).items()}

    def known(form: Form, there: Estimate) -> Information:
        return information(problem_of(sights, form.of(options), there), there).shared.of_cameras

    others = {form: end.estimate for form, end in solved.items() if form.label != label}
    every = tuple(known(form, there) for form, there in others.items())
    return OtherLenses(own.estimate, tuple(others.values()), weights, reach_px, known=every)


def _with_each_kind(observations: Observations, options: Options, near: Estimate) -> dict[Form, Solution]:
    """Solve with the paper's lens and with one of each other kind. The result is empty for many observations, whose
    lenses could not be compared for another reason.
    """
    few = 1_000
    if observations.rows > few:
        return {}
    sights = gather_sights(observations)
    profiles = profiles_of(near, sights)

    def solved(form: Form) -> Solution:
        own = form.of(options)
        there = seen_through(near, own, profiles)
        return found(solve(problem_of(sights, own, there), there, is_near=False))

    # quiet: a lens that cannot be solved for is no alternative
    ends = {form: attempt(partial(solved, form)) for form in undecentred()}
    return {form: end for form, end in ends.items() if not isinstance(end, CalibrationError)}
