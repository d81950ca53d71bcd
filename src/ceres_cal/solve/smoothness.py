"""How smooth a lens without a formula is: the variance of its roughness, by the likelihood of the data (MacKay 1992).

Of a quadratic form R with prior R / sigma^2, and A what the data say of its numbers c, sigma^2 = c^T R c / gamma with
gamma = rank - tr((A + R / sigma^2)^-1 R) / sigma^2, the number of directions that the data determine: the fixed point
is the restricted maximum of the likelihood. One more direction of the least size counts along (an inverse gamma
distribution beforehand), so that few data do not make a lens perfect.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import reduce
from operator import add

import numpy as np

from ceres_cal.base.spread import known_inverses
from ceres_cal.model.information import Information
from ceres_cal.model.keys import Key
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.quantities import values_of
from ceres_cal.scene.lens.base import Roughness
from ceres_cal.solve.information import ReducedInformation
from ceres_cal.solve.problem import Problem

_STEPS = 200
_AT_REST = 1e-3  # relative change of a standard deviation
_ONE = 1.0  # directions of the least size


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
    pulled = whole @ here
    sigmas = np.array(before)
    least = np.array([form.least for form in forms])
    ranks = np.array([np.linalg.matrix_rank(form.matrix, hermitian=True) for form in forms])
    for _ in range(_STEPS):
        posterior = data + sum(form / sigma**2 for form, sigma in zip(every, sigmas, strict=True))
        covariance = known_inverses(posterior, np.full(len(own), np.inf))
        values = covariance @ pulled
        known = ranks - np.array([np.sum(covariance * form) for form in every]) / sigmas**2
        sizes = np.array([values @ form @ values for form in every])
        moved = np.sqrt((np.maximum(sizes, 0.0) + _ONE * least**2) / (np.maximum(known, 0.0) + _ONE))
        done = np.max(np.abs(np.log(moved / sigmas))) < _AT_REST
        sigmas = moved
        if done:
            break
    return tuple(sigmas.tolist()), float((values - here) @ posterior @ (values - here))
