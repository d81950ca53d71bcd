"""The observations that take part in the comparison of lenses, and each kind of lens near its best over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ceres_cal.base.errors import CalibrationError, DegenerateError
from ceres_cal.base.transforms import Poses
from ceres_cal.lens_choice.forms import Form, kinds
from ceres_cal.lens_choice.kinds import Kind
from ceres_cal.lens_choice.seen import MOST_ROUNDS, Seen, problem_of, profiles_of, require_groups, seen_through
from ceres_cal.model.parameters import Estimate, Options
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights, gather_sights
from ceres_cal.observations.thinning import thinned
from ceres_cal.solve import RobustSolution, solve_robustly
from ceres_cal.start.initialise import initialise

_LEAST_ROWS, _SHARE, _FEWEST_FRAMES = 1_000, 0.025, 24  # of the observations, how many take part
# What shows any direction and comes near to any lens but for its decentring: the first solve is with it.
_WIDEST = "kannala-brandt"
# Share of its squares: a kind that leaves less is solved instead, for it may have other inliers.
_QUIETER = 0.7
_SOUND_PX = 1.0  # noise beyond which a first solve may have ended in a wrong valley: others are tried from nothing


def compared_kinds(observations: Observations, options: Options, start: Estimate) -> tuple[Seen, list[Kind], float]:
    """The observations that take part, each kind near its best over them, at the noise of the one that explains the
    most, and their share of all.

    Raises:
        CalibrationError: too little to tell lenses apart, or no calibration.
    """
    every = sorted(kinds(), key=lambda forms: forms[0].lens != _WIDEST)
    total = len(observations.points) + len(observations.curves)
    few = thinned(observations, max(_LEAST_ROWS, int(_SHARE * total)), _FEWEST_FRAMES)
    sights = gather_sights(few)
    require_groups(sights)
    names = list(dict.fromkeys(key.placement for key in sights.keys if key.placement is not None))
    start = replace(start, placements=Poses.stacked(names, Poses.of(start.placements).of_names(names)))
    tried = every
    while True:
        end, used = _solved(few, options, sights, start, tried)
        seen = Seen(few, end, options)
        compared = [seen.kind(forms, is_solved=forms is used) for forms in every]
        best = min(compared, key=lambda one: one.least)
        least = next(one.least for one in compared if one.forms is used)
        if len(tried) == 1 or best.least > _QUIETER * least:
            return seen, compared, (len(few.points) + len(few.curves)) / total
        tried = [best.forms]


_Found = tuple[RobustSolution, tuple[Form, ...]]


def _solved(
    observations: Observations, options: Options, sights: Sights, start: Estimate, kinds: Sequence[tuple[Form, ...]]
) -> _Found:
    """The robust solve with the first of these kinds that explains the observations, or with the one that does it best,
    up to where the noise is known well enough.
    """
    failure: CalibrationError | None = None
    found: list[_Found] = []
    for forms, from_nothing in [(kinds[0], False), *((forms, True) for forms in kinds)]:
        own = forms[0].of(options)
        try:
            near = initialise(observations, sights, own).estimate if from_nothing else start
            near = seen_through(near, own, profiles_of(near, sights))
            problem = problem_of(observations, sights, own, near)
            most_rounds = MOST_ROUNDS if from_nothing else 1
            end = solve_robustly(problem, observations, near, most_rounds=most_rounds)
        except CalibrationError as error:  # quiet: the next lens is tried, and the failure raised where none is left
            failure = error
            continue
        if _noise_px(end) < _SOUND_PX:
            return end, forms
        found.append((end, forms))
    if not found:
        raise failure or DegenerateError("there is no lens")
    return min(found, key=lambda one: _noise_px(one[0]))


def _noise_px(end: RobustSolution) -> float:
    """Of a typical observation."""
    sights, inliers = end.problem.sights, end.inliers
    sigmas = inliers.point_scale * sights.sigma_px, inliers.curve_scale * sights.curve_sigma_px
    return float(np.exp(np.mean(np.log(np.concatenate(sigmas)))))
