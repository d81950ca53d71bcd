"""How smooth a lens without a formula is: the likeliest size of its roughness (`effects.evidence`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np

from ceres_cal.effects.evidence import likeliest_sizes
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import values_of
from ceres_cal.problem.reduced import ReducedInformation
from ceres_cal.scene.lens.base import Roughness

_AT_REST = 1e-3  # relative change of a standard deviation


def with_smoothness(
    problem: Problem, estimate: Estimate, reduced: ReducedInformation
) -> tuple[Problem, ReducedInformation, float]:
    """The problem with its lenses as smooth as the data say, what it then says, and the largest squared step, in
    variances, that a lens is then off its least cost.

    Args:
        estimate: where the problem was solved. reduced: what it says there.
    """
    found, moving = {}, 0.0
    for name, camera in estimate.cameras.items():
        forms = camera.lens.roughness
        free = {key.quantity: key for key in reduced.shared.keys if key[:2] == ("camera", name)}
        if (
            not forms
            or problem.knows_lens(name, camera.lens)
            or not all(quantity in free for form in forms for quantity in form.names)
        ):
            continue
        before = problem.smoothness.get(name, tuple(form.loose for form in forms))
        found[name], step = _sigmas(forms, before, free, estimate, reduced)
        moving = max(moving, step)
    if not found:
        return problem, reduced, 0.0
    smooth = replace(problem, smoothness={**problem.smoothness, **found})
    priors = [prior.information for prior in smooth.priors_at(estimate)]
    known = reduce(add, priors, Information.nothing(reduced.shared.keys))
    return smooth, replace(reduced, priors=known), moving


def _sigmas(
    forms: Sequence[Roughness],
    before: tuple[float, ...],
    keys: Mapping[str, Key],
    estimate: Estimate,
    reduced: ReducedInformation,
) -> tuple[tuple[float, ...], float]:
    """The standard deviation of each form, px, and the squared step to the least cost under them, in variances."""
    own = tuple(keys[quantity] for form in forms for quantity in form.names)
    every = [Information(tuple(keys[q] for q in form.names), form.matrix).over(own).matrix for form in forms]
    whole = reduced.shared.marginal(own).matrix
    data = whole - sum(form / sigma**2 for form, sigma in zip(every, before, strict=True))
    here = values_of(estimate, own)
    least = np.array([form.least for form in forms])
    sizes = likeliest_sizes(data, whole @ here, every, np.array(before), least, _AT_REST)
    away = sizes.amount - here
    return tuple(sizes.sigmas.tolist()), float(away @ sizes.precision @ away)
