"""Solve for targets that differ from their drawing, and for dimensions of targets that are not known.

The noise, the outliers and the explanations of whole lines and frames depend on the offsets of the features, and these
depend on them. So two steps alternate until the sigmas converge: the offsets are estimated from the residuals, and
everything else is solved for with the targets drawn as built, which costs no more than a calibration.

A few numbers move each of a board's corners and bows and of a field's lines, the same in all views. Their sizes are
estimated by `effects.evidence` under the prior AS_BUILT. Products of different views, of some views only, first show
whether there is anything to estimate. What smooth displacements of the image explain is projected out, since a lens
that is too simple would bend a board (a module that is cut off; Liu, Bayarri and Berger, Bayesian Analysis 4, 2009); so
a board's offsets are not solved for with the rest. The few offsets of a field, which only its cameras together
determine, are. In the posterior they have their sigmas as tolerances.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from ceres_cal.base import Array, DegenerateError, Frozen, Indices, field, inverse_of, replace, rms
from ceres_cal.effects import AsBuilt, Explanation, Linearised, SparseColumns, Weights, make_linear_model, smooth_image
from ceres_cal.effects.evidence import (
    AS_BUILT,
    HEIGHTS,
    LIKELY,
    STRETCHED,
    Others,
    RepeatedAmounts,
    SizePrior,
    agreement,
)
from ceres_cal.observations import Observations, Prior, Sights
from ceres_cal.problem import Estimate, Key, Options, Problem, gather_priors
from ceres_cal.problem.reduced import information
from ceres_cal.problem.residuals import Equations, equations_of, whole_structure
from ceres_cal.problem.structure import EXACT, Kind, Structure, Tolerance, make_structure, numbers_by_kind, redrawn
from ceres_cal.robust.competing import Solver, compete
from ceres_cal.robust.robust import RobustSolution, SolvedFrom, judge_at, solve_robustly
from ceres_cal.scene.targets import Target

_MOST_ROUNDS, _AT_REST = 3, 0.2  # change of the logarithm of a sigma below which it has converged


class ViewEffects(Frozen):
    """Displacements of single views, different in each, that are subtracted from the observations.

    Attributes:
        displacement: (N + M, 2) px. columns: of a linear model, those of the amounts, and their numbers with sigmas.
    """

    displacement: Array
    columns: Callable[[Linearised], tuple[SparseColumns, Others]]


class Construction(Frozen):
    """The likely construction of targets.

    Attributes:
        every: the kinds of features that differ from the drawing. whole: the structure with their likeliest offsets.
        moved: (Q,) numbers of the offsets that were found. covariance: (Q, Q) of these.
    """

    every: tuple[AsBuilt, ...] = ()
    whole: Structure = EXACT
    moved: Indices = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    covariance: Array = field(default_factory=lambda: np.empty((0, 0)))

    def held(self, sights: Sights) -> Sights:
        """The sights of targets that are drawn as they are built."""
        if not self.every:
            return sights
        own = make_structure(sights.observations.targets, tolerances_of(self.every))
        return own.carrying(self.whole).built_into(sights)


AS_DRAWN = Construction()


def solve_as_built(
    problem: Problem,
    end: RobustSolution,
    explanations: tuple[Explanation, ...],
    solver: Solver,
    built: Construction,
    views: ViewEffects | None = None,
    left_out: frozenset[tuple[str, Kind]] = frozenset(),
) -> tuple[RobustSolution, Problem, tuple[Explanation, ...], tuple[AsBuilt, ...]]:
    """Solve for everything that likely differs from its drawing. Returns end, problem, explanations and these kinds.

    Args:
        problem: of all the observations. end: of its rounds, without what the explanations left out, with targets drawn
            as `built`. solver: of a subset, see `compete`. views: what was subtracted from views.
        left_out: targets and kinds that are as drawn.
    """
    observations, options, stated, first = problem.observations, problem.options, end.estimate.structure, end

    def solved(there: Construction) -> RobustSolution:
        held = taking_part(_held(problem, there), explanations)
        return solve_robustly(held, replace(end.estimate, structure=stated), is_near=True)

    def freed(there: Construction) -> Structure:
        tolerances = {**options.tolerances, **tolerances_of(there.every)}
        structure = make_structure(observations.targets, tolerances, options.dimensions)
        return structure.carrying(there.whole, end.estimate.structure)

    now = estimate_as_built(problem, _freed(end, problem, freed(built)) if built.every else end, left_out)
    if not now.every:
        if built.every:
            end, explanations = compete(problem, solved(now), solver)
        return end, problem, explanations, ()
    before, rounds, change = now, 1, _change(now, built)
    end = solved(before)
    while change > 2.0 and rounds < _MOST_ROUNDS:  # the next change is less than half of this one
        now = estimate_as_built(problem, _freed(end, problem, freed(before)), left_out)
        change = _change(now, before) if now.every else 0.0
        if change > 1.0:
            before, rounds = now, rounds + 1
            end = solved(before)
    every, structure = before.every, freed(before)
    as_built = replace(problem, priors=gather_priors(observations, options, structure))
    held, asked, measured = end, taking_part(as_built, explanations), None
    if views is not None:
        measured = _as_measured(asked, end, structure)
        every = tuple(_beside_views(every, measured, stated, views))
        if unlikely := frozenset((one.target, one.kind) for one in every if one.probability < LIKELY):
            return solve_as_built(problem, first, explanations, solver, built, views, left_out | unlikely)
    if _change(before, built) > 1.0:
        end, explanations = compete(_held(problem, before), end, solver)
    explanations = tuple(replace(one, other=replace(one.other, structure=structure)) for one in explanations)
    part, problem = taking_part(as_built, explanations), as_built
    if _is_held(every, problem):
        if measured is None or end is not held or part is not asked:
            measured = _as_measured(part, end, structure)
        end = measured
    else:
        end = solve_robustly(part, replace(end.estimate, structure=structure), is_near=True)
    end, structure = end.moved_to(end.estimate, problem), end.estimate.structure
    return end, problem, explanations, tuple(_measured(every, structure, observations.targets))


def solve_held(solver: SolvedFrom, problem: Problem, estimate: Estimate, every: Sequence[AsBuilt]) -> RobustSolution:
    """Solve a problem from an estimate that has targets as they are built; offsets found of boards are held."""
    if not _is_held(every, problem):
        return solver(problem, estimate)
    built, stated = estimate.structure, problem.options.structure_of(problem.observations.targets)
    start = replace(estimate, structure=stated.carrying(built))
    end = solver(_held(problem, Construction(tuple(every), built)), start)
    return _as_measured(problem, end, built.carrying(built, end.estimate.structure))


def _is_held(every: Sequence[AsBuilt], problem: Problem) -> bool:
    """Whether offsets from the drawing are held while everything else is solved for: not if some are of the world."""
    world = {view.target for view in problem.observations.views if view.placement is None}
    return bool(every) and not world & {one.target for one in every}


def _as_measured(problem: Problem, end: RobustSolution, structure: Structure) -> RobustSolution:
    """The end of a solve with targets held as they are built, judged with their offsets free."""
    settled = replace(end.solution, estimate=replace(end.estimate, structure=structure))
    as_smooth = replace(problem, smoothness=end.problem.smoothness)
    return replace(judge_at(as_smooth, settled.estimate), solution=settled, rounds=end.rounds)


def _beside_views(
    every: Sequence[AsBuilt], end: RobustSolution, stated: Structure, views: ViewEffects
) -> Iterator[AsBuilt]:
    """The kinds with the probabilities that remain where single views may be displaced in their own ways, too.

    What was subtracted from the views depends on the offsets that were found and would confirm them: halves of a set of
    pictures with a rolling shutter found the board .4 % longer and .9 % shorter, each with probability 1.
    """
    most_sights = 40  # sights of a camera, since each has its own unknowns
    targets = end.problem.observations.targets
    structure = whole_structure(targets, {one.target for one in every if one.kind == "heights"})
    equations, weights = _equations(stated, end, some_sights(end.problem.sights, most_sights), views)
    model, numbers = _drawn(equations, weights, stated, end), numbers_by_kind(structure, targets)
    own, (of_views, sizes) = _columns(structure, equations, weights), views.columns(model)
    repeats = RepeatedAmounts.of(model, SparseColumns.side_by_side([own, of_views], len(equations)))
    kinds = {(one.target, one.kind): numbers[one.target, one.kind] for one in every}
    known = [(own.size + at, sigma) for at, sigma in sizes]
    found = repeats.sizes(kinds, _priors(kinds, targets), known)
    for one in every:  # unchanged where the views' own numbers leave too few degrees of freedom
        yield replace(one, probability=found.get((one.target, one.kind), (0.0, one.probability))[1])


def shifts_as_drawn(every: Sequence[AsBuilt], end: RobustSolution) -> tuple[Sequence[Key], list[Array]]:
    """Keys (K), and vectors (K,) by which they move if a doubtful kind of features is where it is drawn, times the root
    of the probability of that.

    Args:
        end: with everything solved for that likely differs from its drawing.
    """
    negligible = 0.01  # probability below which nothing is visibly wider
    doubtful = [one for one in every if 1.0 - one.probability > negligible]
    if not doubtful:
        return (), []
    known, structure = end.information.shared, end.estimate.structure
    numbers = numbers_by_kind(structure, end.problem.observations.targets)
    shifts = []
    for one in doubtful:
        own = numbers[one.target, one.kind]
        at = known.columns([structure.keys[number] for number in own])
        following = known.spread.covariance[:, at] @ np.linalg.inv(known.spread.covariance[np.ix_(at, at)])
        shifts.append((1.0 - one.probability) ** 0.5 * following @ structure.values[own])
    return known.keys, shifts


def tolerances_of(every: Sequence[AsBuilt]) -> dict[str, Tolerance]:
    """The estimated sigmas as tolerances."""
    sigmas: dict[str, dict[str, Any]] = {}
    for one in every:
        sigmas.setdefault(one.target, {})[f"{one.kind}_m"] = one.sigma_m
    return {target: Tolerance(**of) for target, of in sigmas.items()}


def words_of(every: Sequence[AsBuilt]) -> tuple[str, ...]:
    """One line for each target that differs from its drawing."""
    targets = dict.fromkeys(one.target for one in every)
    said = {target: " and ".join(one.words for one in every if one.target == target) for target in targets}
    return tuple(f"{target!r} is not as drawn: {words}; solved for" for target, words in said.items())


def _held(problem: Problem, built: Construction) -> Problem:
    """The problem with targets that are drawn as they are built."""
    return replace(problem, sights=built.held(problem.sights))


def _freed(end: RobustSolution, problem: Problem, structure: Structure) -> RobustSolution:
    """The end of a solve with targets held as built, as the end of a problem in which their offsets are free."""
    sights = problem.used(end.inliers.points, end.inliers.curves).sights
    estimate = replace(end.estimate, structure=structure)
    solution = replace(end.solution, estimate=estimate)
    return replace(end, problem=replace(end.problem, sights=sights), solution=solution)


def taking_part(problem: Problem, explanations: Sequence[Explanation]) -> Problem:
    """The problem without the observations that the explanations leave out."""
    rows = [one.rows for one in explanations if one.is_taken]
    if not rows:
        return problem
    kept, points = ~np.any(rows, axis=0), len(problem.observations.points)
    part = problem.used(kept[:points], kept[points:])
    return replace(part, layout=part.layout.of(part.sights.keys))


def _change(now: Construction, before: Construction) -> float:
    """The largest change of a sigma or of the offsets, relative to the change that counts as converged; infinite where
    the kinds differ.
    """
    sigmas = {(one.target, one.kind): one.sigma_m for one in before.every}
    if {(one.target, one.kind) for one in now.every} != set(sigmas):
        return np.inf
    # Standard deviations by which offsets may still move, as root mean square over the directions that are determined:
    # of a board's two sides, the difference is known to a hundredth of each.
    still = 0.5
    logs = [abs(float(np.log(one.sigma_m / sigmas[one.target, one.kind]))) for one in now.every]
    steps = (now.whole.values - now.whole.carrying(before.whole).values)[now.moved]
    moved = float(steps @ inverse_of(now.covariance) @ steps) / max(len(steps), 1)
    return float(max(max(logs, default=0.0) / _AT_REST, moved**0.5 / still))


def _measured(every: Sequence[AsBuilt], structure: Structure, targets: Mapping[str, Target]) -> Iterator[AsBuilt]:
    """The kinds with the offsets that resulted from the last solve."""
    numbers = numbers_by_kind(structure, targets)
    for one in every:
        values, size_m = structure.values[numbers[one.target, one.kind]], _longer_side_m(targets[one.target])
        # No view determines what both sides stretch alike, so the stretch has the scatter of their mean.
        stretch = (float(values[0] - values[1]) / size_m, one.sigma_m / size_m / 2.0**0.5)
        yield replace(one, rms_m=rms(values), stretch=stretch if one.kind == "stretch" else None)


def _longer_side_m(target: Target) -> float:
    return float(np.max(np.ptp(target.box, axis=0)))


# Relative standard deviation of a dimension above which it counts as not measured. It is infinite, except for rounding,
# where nothing measures the dimension.
_UNMEASURED = 0.3


def free_dimensions(observations: Observations, options: Options) -> tuple[Observations, Options]:
    """The observations of targets drawn with their stated dimensions, and options that name these dimensions and the
    tolerances of curves that are stated to be off their drawing.
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
    for prior in sorted(priors, key=lambda prior: not prior.is_open):  # better-known values come last and win
        if prior.dimension and prior.name in targets and prior.quantity in targets[prior.name].dimensions:
            stated.setdefault(prior.name, {})[prior.quantity] = prior.value[0]
    return {name: redrawn(target, stated.get(name, {})) for name, target in targets.items()}


def require_measured(problem: Problem, estimate: Estimate) -> None:
    """Raise DegenerateError where nothing determines a dimension that is solved for.

    Raises:
        DegenerateError: it names the missing measurement.
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
            f"no observation depends on {unseen[0].quantity} of target {unseen[0].owner!r}: "
            "it cannot be solved for: leave it out"
        )
    open_ = [key for key, one in zip(keys, sd, strict=True) if not one < _UNMEASURED * lengths[key.structure_name]]
    if open_:
        names = ", ".join(key.quantity for key in open_)
        raise DegenerateError(
            f"the size of target {open_[0].owner!r} is unknown, because all of {names} are to be solved for: measure "
            f"one of them (--estimate {open_[0].quantity}=VALUE:SIGMA), another length of it, or a camera's height "
            "(--prior height_m=VALUE:SIGMA)"
        )


# Standard deviations of products of different views above which the likelihood is computed, which costs as much again.
_REPEATS = 2.0


def estimate_as_built(
    problem: Problem, end: RobustSolution, left_out: frozenset[tuple[str, Kind]] = frozenset()
) -> Construction:
    """The kinds of features that likely differ from the drawing, of targets without a stated tolerance; with the whole
    structure: their likeliest offsets, and those of stated tolerances unchanged.

    Args:
        problem: of all the observations. end: of its rounds. left_out: targets and kinds that count as drawn.
    """
    most_screened, most_sights = 12, 200  # sights of a camera: for the first test, and for the sigmas
    targets, tolerances = problem.observations.targets, problem.options.tolerances
    structure, dimensions = whole_structure(targets), problem.options.dimensions
    stated = make_structure(targets, tolerances, dimensions).carrying(end.estimate.structure)
    numbered = numbers_by_kind(structure, targets).items()
    kinds = {of: n for of, n in numbered if of[0] not in tolerances and of not in left_out}
    if len(end.problem.sights) < 2 or not kinds:
        return Construction((), structure.carrying(stated))
    sights = some_sights(end.problem.sights, most_screened)
    equations, weights = _equations(stated, end, sights)
    residuals = weights.robust * weights.inverse_sigma * weights.used * equations.residual
    scores = _columns(structure, equations, weights).gathered(residuals, equations.sight, len(sights))
    repeat = {of for of, numbers in kinds.items() if agreement(scores[:, numbers]) > _REPEATS}
    if not repeat:
        return Construction((), structure.carrying(stated))
    # What one kind leaves hides another: a board bowed by 0.1 mm was found only once its points had been moved. But
    # heights, as many as points, took up the errors of a wrong floor in eight views of a board: they must repeat.
    structure = whole_structure(targets, {target for target, kind in repeat if kind == "heights"})
    asked = numbers_by_kind(structure, targets)
    kinds, as_stated = {of: asked[of] for of in kinds if of in asked}, structure.carrying(stated)
    equations, weights = _equations(stated, end, some_sights(end.problem.sights, most_sights))
    model = _drawn(equations, weights, stated, end)
    repeats = RepeatedAmounts.of(model, _columns(structure, equations, weights))
    every = tuple(_likely(repeats, kinds, targets))
    numbers = [kinds[one.target, one.kind] for one in every]
    moved = np.concatenate([np.empty(0, dtype=np.int64), *numbers])
    sigmas = np.repeat([one.sigma_m for one in every], [len(own) for own in numbers])
    values = as_stated.values.copy()
    values[moved], covariance = repeats.amounts(moved, sigmas)
    return Construction(every, structure.with_values(values), moved, covariance)


def some_sights(sights: Sights, most: int) -> Sights:
    """All sights of the world, and at most `most` of the other sights of each camera, evenly."""
    chosen = [sights.numbers(placements=(None,))]
    world = set(chosen[0].tolist())
    for camera in sights.cameras:
        others = np.array([number for number in sights.numbers(camera).tolist() if number not in world], dtype=np.int64)
        chosen.append(others[:: max(1, -(-len(others) // most))])
    return sights.take(np.sort(np.concatenate(chosen)))


# ---- columns of the structure ---------------------------------------------------------------------------------------


def _equations(
    stated: Structure, end: RobustSolution, sights: Sights, views: ViewEffects | None = None
) -> tuple[Equations, Weights]:
    """Equations and weights of some sights with residuals to the drawing: neither offsets found before nor the views'
    displacements are subtracted.
    """
    estimate = end.estimate
    equations = equations_of(sights, estimate, end.residuals)
    stated_alone = stated.carrying(estimate.structure)
    before = estimate.structure.offsets - estimate.structure.carrying(stated_alone).offsets
    solved = np.append(before, 0.0)[equations.slots(estimate.structure)]
    weights = end.weights_of(equations)
    drawn = equations.residual - np.sum(equations.built * solved, axis=1)
    return replace(equations, residual=drawn - equations.along(views.displacement) if views else drawn), weights


def _columns(structure: Structure, equations: Equations, weights: Weights) -> SparseColumns:
    """The columns of the structure's numbers."""
    slots, scale = equations.slots(structure), weights.inverse_sigma * weights.used
    values = np.where(slots >= 0, equations.built * scale[:, None], 0.0)
    return SparseColumns(np.where(slots >= 0, slots, len(structure.names)), values, len(structure.names))


def _drawn(equations: Equations, weights: Weights, stated: Structure, end: RobustSolution) -> Linearised:
    """The linear model of targets as drawn, in which smooth displacements of the image are free as well."""
    estimate = replace(end.estimate, structure=stated)
    problem = end.problem.of_sights(np.flatnonzero([key in equations.sights.keys for key in end.problem.sights.keys]))
    model = make_linear_model(problem, estimate, equations, weights)
    return model.with_columns(smooth_image(equations, estimate))


# ---- the sigmas -----------------------------------------------------------------------------------------------------


def _likely(
    repeats: RepeatedAmounts, kinds: Mapping[tuple[str, Kind], Indices], targets: Mapping[str, Target]
) -> Iterator[AsBuilt]:
    """The kinds that more likely scatter than not, each estimated beside the others that do."""
    sizes = repeats.sizes(kinds, _priors(kinds, targets))
    for target, kind in kinds:
        sigma, probability = sizes.get((target, kind), (0.0, 0.0))
        if probability > LIKELY:
            yield AsBuilt(target, kind, sigma, probability)


def _priors(kinds: Iterable[tuple[str, Kind]], targets: Mapping[str, Target]) -> dict[tuple[str, Kind], SizePrior]:
    """The prior on the size of each kind."""
    rare = {"heights": HEIGHTS, "stretch": STRETCHED}
    return {of: rare.get(of[1], AS_BUILT).times(_longer_side_m(targets[of[0]])) for of in kinds}
