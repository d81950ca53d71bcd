"""By how much targets lie off their drawings: what residuals repeat at the same features, and the sigma that it shows.

A board's corners and bows, a field's lines: a few numbers move each of them, the same in all views (`effects.sizes`).
The free numbers take out smooth displacements that stay in the image besides: what repeats there is the lens'. Whether
there is anything to look for is asked first of some views, by products of different views alone.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.effects.amounts import AsBuilt
from ceres_cal.effects.columns import SparseColumns
from ceres_cal.effects.evidence import SizePrior, agreement
from ceres_cal.effects.linearised import Linearised, Weights, equation_weights, make_linear_model
from ceres_cal.effects.sizes import LIKELY, RepeatedAmounts
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import Sights
from ceres_cal.problem.equations import Equations, equations_of, whole_structure
from ceres_cal.problem.parameters import Estimate, unit_px
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.structure import Kind, Structure, make_structure, numbers_by_kind
from ceres_cal.robust.robust import RobustSolution

_MOST_SCREENED, _MOST_SIGHTS = 12, 200  # of a camera: that are asked first, and that tell the sigma
# Standard deviations of products of different views from which on the likelihood is asked, which costs as much again.
_REPEATS = 2.0
AS_BUILT = SizePrior(0.5, tuple(np.geomspace(1e-5, 3e-2, 30).tolist()))
"""Of how far a target's features lie off its drawing, in its size: that it is as drawn is as likely as not."""
_DEGREE, _POWERS = 3, (0.5, 1.5, 2.0, 2.5, 3.0, 4.0)  # of smooth displacements of the image; of r^2 along the radius


def estimate_as_built(
    problem: Problem, observations: Observations, end: RobustSolution
) -> tuple[tuple[AsBuilt, ...], Structure]:
    """The kinds of features that are likely not where they are drawn, of targets without a stated tolerance; and the
    whole structure with their likeliest offsets, and those of stated tolerances as they are.

    Args:
        problem: of all the observations. end: of its rounds.
    """
    structure, tolerances = whole_structure(observations.targets), problem.options.tolerances
    dimensions = problem.options.dimensions
    stated = make_structure(observations.targets, tolerances, dimensions).carrying(end.solution.estimate.structure)
    as_stated = structure.carrying(stated)
    kinds = {of: n for of, n in numbers_by_kind(structure, observations.targets).items() if of[0] not in tolerances}
    if len(end.problem.sights) < 2 or not kinds:
        return (), as_stated
    sights = _some(end.problem.sights, _MOST_SCREENED)
    equations, weights = _equations(stated, observations, end, sights)
    residuals = weights.robust * weights.inverse_sigma * weights.used * equations.residual
    scores = _columns(structure, equations, weights).gathered(residuals, equations.sight, len(sights))
    loud = {of: numbers for of, numbers in kinds.items() if agreement(scores[:, numbers]) > _REPEATS}
    if not loud:
        return (), as_stated
    equations, weights = _equations(stated, observations, end, _some(end.problem.sights, _MOST_SIGHTS))
    model = _drawn(equations, weights, stated, end)
    repeats = RepeatedAmounts.of(model, _columns(structure, equations, weights))
    every = tuple(_likely(repeats, loud, observations))
    numbers = [loud[one.target, one.kind] for one in every]
    moved = np.concatenate([np.empty(0, dtype=np.int64), *numbers])
    sigmas = np.repeat([one.sigma_m for one in every], [len(own) for own in numbers])
    values = as_stated.values.copy()
    values[moved] = repeats.amounts(moved, sigmas)[0]
    return every, structure.with_values(values)


def _some(sights: Sights, most: int) -> Sights:
    """All of the world, and of each camera's others at most so many, evenly."""
    chosen = [sights.numbers(placements=(None,))]
    for camera in sights.cameras:
        others = np.setdiff1d(sights.numbers(camera), chosen[0])
        chosen.append(others[:: max(1, -(-len(others) // most))])
    return sights.take(np.sort(np.concatenate(chosen)))


# ---- columns of the structure ---------------------------------------------------------------------------------------


def _equations(
    stated: Structure, observations: Observations, end: RobustSolution, sights: Sights
) -> tuple[Equations, Weights]:
    """Of some sights, with the residuals to the drawing, offsets that were found before taken off."""
    estimate = end.solution.estimate
    equations = equations_of(observations, sights, estimate, end.residuals)
    stated_alone = stated.carrying(estimate.structure)
    before = estimate.structure.offsets - estimate.structure.carrying(stated_alone).offsets
    solved = np.append(before, 0.0)[equations.slots(estimate.structure)]
    weights = _weights(observations, end, equations)
    return replace(equations, residual=equations.residual - np.sum(equations.built * solved, axis=1)), weights


def _columns(structure: Structure, equations: Equations, weights: Weights) -> SparseColumns:
    """Of the structure's numbers."""
    slots, scale = equations.slots(structure), weights.inverse_sigma * weights.used
    values = np.where(slots >= 0, equations.built * scale[:, None], 0.0)
    return SparseColumns(np.where(slots >= 0, slots, len(structure.names)), values, len(structure.names))


def _weights(observations: Observations, end: RobustSolution, equations: Equations) -> Weights:
    """How the equations counted at the end."""
    taking_part = end.inliers.points, end.inliers.curves
    return equation_weights(observations, end.problem.weighting, equations, end.residuals, taking_part)


def _drawn(equations: Equations, weights: Weights, stated: Structure, end: RobustSolution) -> Linearised:
    """The linear model of the targets as drawn, smooth displacements of the image free besides."""
    estimate = replace(end.solution.estimate, structure=stated)
    problem = end.problem.of_sights(np.flatnonzero([key in equations.sights.keys for key in end.problem.sights.keys]))
    model = make_linear_model(problem, estimate, equations, weights)
    return model.with_columns(np.column_stack(list(_of_image(equations, estimate))))


def _of_image(equations: Equations, estimate: Estimate) -> Iterator[Array]:
    """(E, K) smooth displacements of each camera's image, of order one at its corners: polynomials, and powers of the
    radius.
    """
    owner = np.array([key.camera for key in equations.sights.keys])[equations.sight]
    for name in equations.sights.cameras:
        camera = estimate.cameras[name]
        place = (equations.pixel - camera.principal_point) / unit_px(camera)
        x, y = place.T
        smooth = [x**i * y**j for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
        along = np.sum(place * equations.direction, axis=1)
        radial = [np.sum(place**2, axis=1) ** power * along for power in _POWERS]
        every = [*(equations.direction[:, axis] * one for one in smooth for axis in range(2)), *radial]
        yield np.column_stack(every) * (owner == name)[:, None]


# ---- the sigmas -----------------------------------------------------------------------------------------------------


def _likely(
    repeats: RepeatedAmounts, kinds: Mapping[tuple[str, Kind], Indices], observations: Observations
) -> Iterator[AsBuilt]:
    """The kinds that more likely scatter than not, each beside those of the others that do."""
    extents = {target: float(np.max(np.ptp(observations.targets[target].box, axis=0))) for target, _ in kinds}
    priors = {of: AS_BUILT.times(extents[of[0]]) for of in kinds}
    for (target, kind), (sigma, probability) in repeats.sizes(kinds, priors).items():
        if probability > LIKELY:
            yield AsBuilt(target, kind, sigma, probability)
