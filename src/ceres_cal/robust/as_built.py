"""Targets that are not where they are drawn, solved for.

How large the noise is, what is an outlier and what explanations say of whole lines and frames change with the offsets,
and these with all that. So in turns the offsets are read off the residuals (`repeats`) and everything else is solved
for with the targets drawn as they were found to be, which costs no more than a calibration, until the sigmas stay.

A board's offsets are not solved for with all the rest: a lens that is too simple would bend it instead. What smooth
displacements of the image explain has no say in them (a module that is cut off; Liu, Bayarri and Berger, Bayesian
Analysis 4, 2009). The few of a field, which nothing but its cameras together tell, are. The posterior has them under
their sigmas like any tolerance.

Dimensions of targets that are not known: where their solve starts, and which of them nothing measures.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ceres_cal.base.errors import DegenerateError
from ceres_cal.effects.amounts import AsBuilt
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.parameters import Estimate, Options
from ceres_cal.problem.priors import gather_priors
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.reduced import information
from ceres_cal.problem.structure import Structure, Tolerance, make_structure, numbers_by_kind, redrawn
from ceres_cal.robust.competing import Explanation, Solver, compete
from ceres_cal.robust.repeats import estimate_as_built
from ceres_cal.robust.robust import RobustSolution, judge_at, solve_robustly
from ceres_cal.scene.targets import Target

_MOST_ROUNDS, _AT_REST = 3, 0.2  # of the logarithm of a sigma: by less it is no other one


def solve_as_built(
    problem: Problem,
    observations: Observations,
    end: RobustSolution,
    explanations: tuple[Explanation, ...],
    solver: Solver,
) -> tuple[RobustSolution, Problem, tuple[Explanation, ...], tuple[AsBuilt, ...]]:
    """The end, problem and explanations with everything solved for that is likely not where it is drawn; and what is.

    Args:
        problem: of all the observations. end: of its rounds, without what the explanations took out. solver: of some
            of the observations, see `compete`.
    """
    every: tuple[AsBuilt, ...] = ()
    now, whole = estimate_as_built(problem, observations, end)
    if not now:
        return end, problem, explanations, ()
    stated, options, rounds = end.solution.estimate.structure, problem.options, 0
    while now and not _alike(now, every) and rounds < _MOST_ROUNDS:
        every, rounds = now, rounds + 1
        held = _held(problem, make_structure(observations.targets, tolerances_of(every)).carrying(whole))
        start = replace(end.solution.estimate, structure=stated)
        end = solve_robustly(taking_part(held, observations, explanations), observations, start, is_near=True)
        tolerances = {**options.tolerances, **tolerances_of(every)}
        structure = make_structure(observations.targets, tolerances, options.dimensions)
        structure = structure.carrying(whole, end.solution.estimate.structure)
        now, whole = estimate_as_built(problem, observations, _freed(end, problem, structure))
    end, explanations = compete(held, observations, end, solver)
    explanations = tuple(replace(one, other=replace(one.other, structure=structure)) for one in explanations)
    problem = replace(problem, priors=gather_priors(observations, options, structure))
    estimate = replace(end.solution.estimate, structure=structure)
    part = taking_part(problem, observations, explanations)
    if {view.target for view in observations.views if view.placement is None} & {one.target for one in every}:
        end = solve_robustly(part, observations, estimate, is_near=True)
    else:
        settled = replace(end.solution, estimate=estimate)
        end = replace(judge_at(part, observations, estimate), solution=settled, rounds=end.rounds)
    end, structure = end.moved_to(end.solution.estimate, observations, problem), end.solution.estimate.structure
    return end, problem, explanations, tuple(_measured(every, structure, observations))


def tolerances_of(every: Sequence[AsBuilt]) -> dict[str, Tolerance]:
    """The sigmas as tolerances."""
    sigmas: dict[str, dict[str, Any]] = {}
    for one in every:
        sigmas.setdefault(one.target, {})[f"{one.kind}_m"] = one.sigma_m
    return {target: Tolerance(**of) for target, of in sigmas.items()}


def words_of(every: Sequence[AsBuilt]) -> tuple[str, ...]:
    """One line for each target that is not as drawn."""
    targets = dict.fromkeys(one.target for one in every)
    said = {target: " and ".join(one.words for one in every if one.target == target) for target in targets}
    return tuple(f"{target!r} is not as drawn: {words}; solved for" for target, words in said.items())


def _held(problem: Problem, built: Structure) -> Problem:
    """The problem of targets that are drawn as they are built."""
    return replace(problem, sights=built.built_into(problem.sights))


def _freed(end: RobustSolution, problem: Problem, structure: Structure) -> RobustSolution:
    """The end of a problem that was held, as one of targets that are built like that."""
    sights = problem.used(end.inliers.points, end.inliers.curves).sights
    estimate = replace(end.solution.estimate, structure=structure)
    solution = replace(end.solution, estimate=estimate)
    return replace(end, problem=replace(end.problem, sights=sights), solution=solution)


def taking_part(problem: Problem, observations: Observations, explanations: Sequence[Explanation]) -> Problem:
    """The problem without what they took out."""
    rows = [one.rows for one in explanations if one.is_taken]
    if not rows:
        return problem
    kept, points = ~np.any(rows, axis=0), len(observations.points)
    part = problem.used(kept[:points], kept[points:])
    return replace(part, layout=part.layout.of(part.sights.keys))


def _alike(some: Sequence[AsBuilt], others: Sequence[AsBuilt]) -> bool:
    """Whether they are of the same kinds, at nearly the same sigmas."""
    sigmas = {(one.target, one.kind): one.sigma_m for one in others}
    return {(one.target, one.kind) for one in some} == set(sigmas) and all(
        abs(np.log(one.sigma_m / sigmas[one.target, one.kind])) < _AT_REST for one in some
    )


def _measured(every: Sequence[AsBuilt], structure: Structure, observations: Observations) -> Iterator[AsBuilt]:
    """The same with the offsets that came out."""
    numbers = numbers_by_kind(structure, observations.targets)
    for one in every:
        yield replace(one, rms_m=float(np.sqrt(np.mean(structure.values[numbers[one.target, one.kind]] ** 2))))


# Of a dimension, its standard deviation from which on it is not measured. What nothing measures has an infinite one,
# but for rounding.
_UNMEASURED = 0.3


def free_dimensions(observations: Observations, options: Options) -> tuple[Observations, Options]:
    """The observations of targets drawn with the lengths that are stated of them, and options that name those, and the
    tolerances of curves that lie beside their drawing.
    """
    priors = (*observations.priors, *options.priors)
    names = dict.fromkeys((*options.dimensions, *(prior.dimension for prior in priors if prior.dimension)))
    drawn = observations.with_targets(drawn_as_stated(observations.targets, priors))
    tolerances = dict(options.tolerances)
    for prior in priors:
        if prior.curve:
            known = tolerances.get(prior.name, Tolerance())
            sigma_m = max(prior.sigma[0], known.lines_m)
            tolerances[prior.name] = replace(known, curve_m={**known.curve_m, prior.curve: sigma_m})
    return drawn, replace(options, dimensions=tuple(names), tolerances=tolerances)


def drawn_as_stated(targets: Mapping[str, Target], priors: Sequence[Prior]) -> dict[str, Target]:
    """The targets with the dimensions that priors state."""
    stated: dict[str, dict[str, float]] = {}
    for prior in sorted(priors, key=lambda prior: not prior.is_open):  # what is known better comes last
        if prior.dimension and prior.name in targets and prior.quantity in targets[prior.name].dimensions:
            stated.setdefault(prior.name, {})[prior.quantity] = prior.value[0]
    return {name: redrawn(target, stated.get(name, {})) for name, target in targets.items()}


def require_measured(problem: Problem, estimate: Estimate) -> None:
    """Raise DegenerateError where nothing says how long something is that is solved for.

    Raises:
        DegenerateError: which measurement is missing.
    """
    lengths = estimate.structure.dimensions
    if not lengths:
        return
    known = information(problem, estimate).shared
    keys = estimate.structure.keys[estimate.structure.own :]
    alone = np.diagonal(known.given(keys).matrix)
    sd = known.spread.sd[known.columns(keys)]
    with np.errstate(divide="ignore"):
        unseen = [
            key for key, says in zip(keys, alone, strict=True) if says**-0.5 > _UNMEASURED * lengths[key.structure_name]
        ]
    if unseen:
        raise DegenerateError(
            f"nothing that was observed depends on {unseen[0].quantity} of target {unseen[0].owner!r}: "
            "it cannot be solved for: leave it out"
        )
    open_ = [key for key, one in zip(keys, sd, strict=True) if not one < _UNMEASURED * lengths[key.structure_name]]
    if open_:
        names = ", ".join(key.quantity for key in open_)
        raise DegenerateError(
            f"nothing says how large target {open_[0].owner!r} is, since all of {names} are to be solved for: measure "
            f"one of them (--estimate {open_[0].quantity}=VALUE:SIGMA), another length of it, or a camera's height "
            "(--prior height_m=VALUE:SIGMA)"
        )
