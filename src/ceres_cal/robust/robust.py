"""The robust loop: solve, estimate the noise, reject outliers, and solve again until nothing changes.

One loop serves rows in memory and sums over shares of very many rows; the two engines differ in how they do each step.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Generic, Self, TypeVar

import numpy as np

from ceres_cal.base import DegenerateError, Frozen, Indices, Mask, cached_property, numerical, replace
from ceres_cal.effects.linearised import Weights, equation_weights
from ceres_cal.observations.sights import SightKey, Sights
from ceres_cal.problem import Estimate, Problem, Solution, SolveProgress, Weighting, solve, with_placements_at_best
from ceres_cal.problem.reduced import ReducedInformation, information
from ceres_cal.problem.residuals import Equations, Residuals, residuals, residuals_alone
from ceres_cal.robust.noise import (
    InlierFit,
    Inliers,
    Redundancy,
    by_count,
    by_deleted_residuals,
    by_leverage,
    judge,
    median_scales,
    visible_from,
)
from ceres_cal.robust.other_minima import (
    lost_rows,
    rows_among_outliers,
    with_lost_boards_posed,
    without_mirrored_poses,
)

MOST_ROUNDS = 15
# Relative changes of a noise scale that count as no change. Halving or doubling the first moves the answer by less than
# 1 % of its error. The second is for a refit, which must give the same answer to the same question; halving or doubling
# it changes nothing.
AT_REST, AT_REST_AGAIN = 1e-2, 1e-5


class RobustSolution(Frozen):
    """The state after one round, and after the last one.

    Attributes:
        problem: the problem of the inliers at this estimate, weighted by their noise. The next round solves it; at the
            end it is what was solved.
        solution: the result of the last solve. inliers, residuals: those of all observations at its estimate.
        rounds: the number of solves so far.
        reduced: the information of observations and priors at the estimate, once nothing changes; None before, and
            where the rounds ran out.
        by_chance: (N + M,) observations that take no part because they agree with any lens by chance.
    """

    problem: Problem
    solution: Solution
    inliers: Inliers
    residuals: Residuals
    rounds: int
    reduced: ReducedInformation | None = None
    by_chance: Mask | None = None

    @property
    def estimate(self) -> Estimate:
        """The estimate of the last solve."""
        return self.solution.estimate

    @cached_property
    def information(self) -> ReducedInformation:
        """The information of observations and priors at the estimate."""
        return self.reduced or information(self.problem, self.estimate)

    def judged_like(self, before: Self, no_change: float) -> bool:
        """Whether nothing that is worth another solve has changed since the round `before`."""
        return self.inliers.same_as(before.inliers, no_change)

    def weights_of(self, equations: Equations) -> Weights:
        """The weights of these equations in the solve."""
        taking_part = self.inliers.points, self.inliers.curves
        return equation_weights(self.problem.weighting, equations, self.residuals, taking_part)

    def moved_to(self, estimate: Estimate, problem: Problem) -> RobustSolution:
        """A copy with another estimate and its residuals. `problem`: that of all the observations."""
        there = residuals(problem.sights, estimate, self.residuals.feet)
        return replace(self, solution=replace(self.solution, estimate=estimate), residuals=there)


SolvedFrom = Callable[[Problem, Estimate], RobustSolution]
"""A function that solves a problem from an initial estimate."""
_Round = TypeVar("_Round", bound=RobustSolution)


class Rounds(ABC, Generic[_Round]):
    """The loop over rounds. A subclass is an engine that solves and judges."""

    no_change = AT_REST

    @abstractmethod
    def next(self, state: _Round) -> _Round:
        """Solve once more for the current inliers, and judge the result."""

    @abstractmethod
    def with_leverages(self, state: _Round) -> _Round:
        """The state with its information, judged by the leverages; `reduced` is None where this judgement asks for
        another round.
        """

    def mended(self, state: _Round, undecided: frozenset[SightKey]) -> tuple[_Round, int, frozenset[SightKey]]:
        """The state with poses changed that a solve cannot leave by itself, their number, and the undecided sights."""
        return state, 0, undecided

    def without_agreeing_by_chance(self, state: _Round) -> _Round:
        """The state without observations that agree with any lens by chance; itself where none do."""
        return state

    def refined(self, state: _Round) -> _Round:
        """The state after the first solve, brought nearer to convergence."""
        return state

    def to_rest(self, state: _Round, most_rounds: int = MOST_ROUNDS, *, is_near: bool = False) -> _Round:
        """Run rounds until nothing changes, or until `most_rounds` solves were made."""
        undecided: frozenset[SightKey] = frozenset(state.problem.sights.keys)
        before: _Round | None = None
        rested: _Round | None = None
        while state.rounds < most_rounds:
            at_rest = before is not None and state.judged_like(before, self.no_change)
            if not at_rest and before is not None:
                undecided = frozenset(state.problem.sights.keys)  # another lens had decided about mirrored poses
            if at_rest or before is None:
                if rested is not None and state.judged_like(rested, self.no_change):
                    state = self.without_agreeing_by_chance(state)  # what was mended there came back
                rested = state if at_rest else None
                state, changed, undecided = self.mended(state, undecided)
                if before is None and not is_near:
                    state = self.refined(state)
                if at_rest and not changed:
                    as_is, state = state, self.without_agreeing_by_chance(state)
                    state = self.with_leverages(state) if state is as_is else state
                    if state.reduced is not None:
                        break
            before, state = state, self.next(state)
        return state


# Private placements per camera in a rough solve: with these the camera is known well enough to place all others. Fewer
# cost another round, more cost time. Halving or doubling changes nothing.
_ENOUGH_PLACEMENTS = 20
_MOST_REFINED = 3  # further rough solves at most
# Share of the residuals' scale. Where a rough solve leaves a scale below this share of the one before, another rough
# solve follows at the new scale: a misplaced line differs from noise only at a scale near that of the noise.
_MUCH_LESS = 0.3


@numerical("the solve")
def solve_robustly(
    problem: Problem,
    estimate: Estimate,
    usual: tuple[float, float] | None = None,
    progress: SolveProgress | None = None,
    most_rounds: int = MOST_ROUNDS,
    *,
    is_near: bool = False,
) -> RobustSolution:
    """Solve for the inliers, weighted by the noise that they show.

    An initial estimate is off by more than the noise, so the first solve rejects nothing that the initial estimate can
    show: a redescending loss at the median residual keeps gross errors from dominating.

    Args:
        problem: the problem of all the observations; its weighting is ignored.
        usual: noise scales of points and of curves known from earlier observations, if any.
        most_rounds: the maximum number of solves, the rough one included; after 2 the estimate is near the minimum.
        is_near: whether the initial estimate is near the minimum except for private placements; if so, there is no
            rough solve.
    Raises:
        CalibrationError: see `solve`.
    """
    rounds = _RowRounds(problem, usual, progress)
    state = rounds.posed(estimate) if is_near else rounds.first(estimate)
    return rounds.to_rest(state, most_rounds, is_near=is_near)


def judge_at(problem: Problem, estimate: Estimate) -> RobustSolution:
    """Estimate noise and outliers by the leverages at an estimate, without a solve."""
    rounds = _RowRounds(problem, None, None)
    return rounds.by_leverages(rounds.at(estimate))


class _RowRounds(Rounds[RobustSolution]):
    """The rounds over rows in memory."""

    def __init__(self, problem: Problem, usual: tuple[float, float] | None, progress: SolveProgress | None) -> None:
        self._problem, self._usual, self._progress = problem, usual, progress
        self._redundancy: Redundancy | None = None
        self._moving = 0.0
        self._scales = (1.0, 1.0)  # scales of points and of curves by which the last rough solve was weighted
        self._last: tuple[Inliers, Sights] | None = None
        self._by_chance: Mask = np.zeros(problem.observations.rows, dtype=bool)
        self.no_change = AT_REST if usual is None else AT_REST_AGAIN
        # Relative change of the cost at which the rough solves end, and at which all further ones do.
        self._rough_end, self._end = 1e-3, 1e-14
        options = problem.options
        lenses = {name: options.of_camera(name).blank_lens for name in problem.layout.free}
        if options.is_rough and not any(problem.knows_lens(name, lens) for name, lens in lenses.items()):
            # From a rougher end, the next solve, whose lens is as smooth as the data say, begins with rejected steps.
            # The remaining cost may be a hundredth of a variance: no number is then off by more than 0.1 of its
            # standard deviation. Measured: a hundredth of that cost, and 0.01 standard deviations.
            self._rough_end, self._end = 1e-4, 1e-2 / max(problem.equations, 1)

    def first(self, estimate: Estimate) -> RobustSolution:
        """Run the rough solve from an initial estimate."""
        there = residuals(self._problem.sights, estimate, self._problem.feet)
        return self._rough(estimate, there, visible_from(self._problem.observations, there), 1)

    def at(self, estimate: Estimate) -> RobustSolution:
        """The state at an estimate that is taken as it is, judged."""
        there = residuals(self._problem.sights, estimate, self._problem.feet)
        solution = Solution(estimate, np.nan, False, "", ())
        return self._with(self._judge(solution, there), solution, there, 0)

    def posed(self, estimate: Estimate) -> RobustSolution:
        """The state at an initial estimate near the minimum, with its private placements solved for."""
        there = residuals(self._problem.sights, estimate, self._problem.feet)
        visible = visible_from(self._problem.observations, there)
        weighting = Weighting(visible.point_scale, visible.curve_scale, "cauchy", loss_scale=1.0)
        problem = replace(self._problem.used(visible.points, visible.curves), weighting=weighting, feet=there.feet)
        estimate = with_placements_at_best(problem, estimate)
        return self._judged(Solution(estimate, np.nan, False, "", ()), there, 0)

    def refined(self, state: RobustSolution) -> RobustSolution:
        """Repeat the rough solve, each time at the residuals' scale of the last one, while that scale falls."""
        for _ in range(_MOST_REFINED):
            visible = visible_from(self._problem.observations, state.residuals)
            if not _much_below(visible.scales, self._scales):
                break
            state = self._rough(state.estimate, state.residuals, visible, state.rounds + 1)
        # With one kind of observations and no priors, `by_count` suffices: leverages sum to the number of unknowns.
        stated = any(not prior.is_usual for prior in self._problem.priors_at(state.estimate))
        if self._problem.smoothness:  # it was estimated from fewer sights by their leverages, which say as much
            return state
        mixed = stated or all(kind.equations for kind in self._problem.sights.by_kind)
        return self.by_leverages(state) if mixed and len(state.problem.sights) else state

    def _rough(self, estimate: Estimate, there: Residuals, visible: Inliers, rounds: int) -> RobustSolution:
        """A rough solve of a few placements that gross errors do not dominate; the others are placed afterwards."""
        self._scales = visible.scales
        # A misplaced line is an outlier under a redescending loss, but not under Huber's with its tolerance.
        loss = "huber" if len(estimate.structure.values) else "cauchy"
        weighting = Weighting(visible.point_scale, visible.curve_scale, loss, loss_scale=1.0)
        problem = replace(self._problem.rough(weighting), feet=there.feet).used(visible.points, visible.curves)
        if not len(problem.sights):
            raise DegenerateError(
                "the observations determine no pose that explains them: add points or lines of the targets"
            )
        few = problem.of_sights(_evenly(problem))
        if problem.options.is_rough and len(few.sights) < len(problem.sights):
            of_few = _RowRounds(few, self._usual, self._progress)
            end = of_few.to_rest(of_few.first(estimate), most_rounds=2)
            self._scales = of_few._scales  # those of the last rough solve, not those at the initial estimate
            self._problem = replace(self._problem, smoothness=end.problem.smoothness)
            solution = end.solution
        else:
            solution = self._of_few(few, estimate, len(few.sights) < len(problem.sights))
        if len(few.sights) < len(problem.sights):
            solution = replace(solution, estimate=with_placements_at_best(problem, solution.estimate))
        return self._judged(solution, there, rounds)

    def _of_few(self, few: Problem, estimate: Estimate, others_follow: bool) -> Solution:
        """A rough solve. Where others are placed afterwards, which takes time, it is repeated while the scale falls."""
        solution = solve(few, estimate, self._progress, precision=self._rough_end, is_near=False)
        for _ in range(_MOST_REFINED if others_follow else 0):
            points, curves = residuals_alone(few.sights, solution.estimate, few.feet).lengths
            scales = median_scales(points / few.sights.sigma_px, curves / few.sights.curve_sigma_px)
            if not _much_below(scales, self._scales):
                break
            self._scales = scales
            few = replace(few, priors=self._problem.priors)
            few = few.rough(replace(few.weighting, point_scale=scales[0], curve_scale=scales[1]))
            estimate, *_ = without_mirrored_poses(few, solution.estimate, frozenset(few.sights.keys))
            solution = solve(few, estimate, self._progress, precision=self._rough_end, is_near=False)
        return solution

    def next(self, state: RobustSolution) -> RobustSolution:
        """Solve once more for the inliers, from the last estimate, and judge. The same rows take part again where the
        new ones are as good.
        """
        solution = solve(state.problem, state.estimate, self._progress, precision=self._end)
        return self._judged(solution, state.residuals, state.rounds + 1, state.inliers)

    def mended(
        self, state: RobustSolution, undecided: frozenset[SightKey]
    ) -> tuple[RobustSolution, int, frozenset[SightKey]]:
        """The state with lost boards posed anew and mirrored poses turned over, the number of both, and the sights
        whose two poses still compete.
        """
        weighting = state.problem.weighting
        everything = self._problem.weighted(replace(weighting, loss="cauchy"))
        estimate, lost = with_lost_boards_posed(everything, state.inliers, state.estimate)
        estimate, turned, undecided = without_mirrored_poses(state.problem, estimate, undecided)
        if lost + turned:
            state = self._judged(replace(state.solution, estimate=estimate), state.residuals, state.rounds)
        return state, lost + turned, undecided

    def without_agreeing_by_chance(self, state: RobustSolution) -> RobustSolution:
        """Seven of 54 corners of one lost board of 16 moved phi by 3 standard deviations; one of 31 outliers in the
        corner of a picture moved places there by 12.
        """
        inliers = self._judge(state.solution, state.residuals)
        among_outliers = rows_among_outliers(inliers, self._problem, lambda: self._fit(state, state.information))
        by_chance = lost_rows(self._problem, inliers) | among_outliers
        if np.array_equal(by_chance, self._by_chance):
            return state
        self._by_chance = by_chance
        return self._judged(state.solution, state.residuals, state.rounds)

    def with_leverages(self, state: RobustSolution) -> RobustSolution:
        """The state with its information, where the leverages confirm the noise and the smoothness of lenses moves
        nothing; else the state judged by the leverages, for another round.
        """
        # Variances by which numbers may still move with the smoothness of lenses: none is off by more than 0.23 sd.
        still = 0.05
        anew, reduced = self._anew(state)
        if self._moving > still or not anew.same_as(state.inliers, self.no_change):
            return self._with(anew, state.solution, state.residuals, state.rounds)
        problem = replace(state.problem, smoothness=self._problem.smoothness)
        inliers = replace(state.inliers, degrees_of_freedom=anew.degrees_of_freedom)
        return replace(state, problem=problem, inliers=inliers, reduced=reduced)

    def by_leverages(self, state: RobustSolution) -> RobustSolution:
        """The state judged by the leverages at its estimate."""
        return self._with(self._anew(state)[0], state.solution, state.residuals, state.rounds)

    def _anew(self, state: RobustSolution) -> tuple[Inliers, ReducedInformation]:
        """Noise and inliers by the leverages at the estimate, and the information that the leverages come from."""
        reduced = state.information
        if any(camera.lens.roughness for camera in state.estimate.cameras.values()):
            from ceres_cal.effects.smoothness import with_smoothness

            self._problem, reduced, self._moving = with_smoothness(self._problem, state.estimate, reduced)
        sights = state.problem.sights
        points, curves = reduced.leverages
        taken = points + self._problem.taken_up, curves
        self._redundancy = by_leverage((2 * len(sights.point_rows), len(sights.curve_rows)), taken)
        inliers = self._judge(state.solution, state.residuals)
        return self._without(by_deleted_residuals(inliers, self._fit(state, reduced))), reduced

    def _fit(self, state: RobustSolution, reduced: ReducedInformation) -> InlierFit:
        return InlierFit(self._problem, state.estimate, state.residuals, state.inliers.rows, reduced)

    def _judged(
        self, solution: Solution, before: Residuals, rounds: int, inliers: Inliers | None = None
    ) -> RobustSolution:
        """The state where a solve of these inliers ended, with the inliers and the problem judged there."""
        there = residuals(self._problem.sights, solution.estimate, before.feet)
        anew = self._without(self._judge(solution, there))
        if inliers is not None and anew.same_as(inliers, self.no_change):
            anew = anew.with_rows(inliers.rows)
        return self._with(anew, solution, there, rounds)

    def _without(self, inliers: Inliers) -> Inliers:
        """The inliers without those that agree by chance."""
        return inliers.with_rows(inliers.rows & ~self._by_chance) if np.any(self._by_chance) else inliers

    def _judge(self, solution: Solution, there: Residuals) -> Inliers:
        problem = self._problem
        redundancy = self._redundancy or by_count(
            problem.sights.equations, problem.unknowns(solution.estimate) + problem.taken_up
        )
        return judge(problem.observations, there, redundancy, problem.options, self._usual)

    def _with(self, inliers: Inliers, solution: Solution, there: Residuals, rounds: int) -> RobustSolution:
        """The state with the problem of these inliers. The sights are reused where the same rows took part before."""
        last = self._last
        if last is None or not np.array_equal(inliers.rows, last[0].rows):
            self._last = last = inliers, self._problem.sights.used(inliers.points, inliers.curves)
        weighting = inliers.weighting(self._problem.options)
        problem = replace(self._problem, sights=last[1], weighting=weighting, feet=there.feet)
        return RobustSolution(problem, solution, inliers, there, rounds, by_chance=self._by_chance)


def _much_below(scales: tuple[float, float], before: tuple[float, float]) -> bool:
    """Whether the scale of points or that of curves fell below the share _MUCH_LESS of what it was."""
    return any(now < _MUCH_LESS * then for now, then in zip(scales, before, strict=True))


def _evenly(problem: Problem) -> Indices:
    """Numbers of sights that determine each camera well enough for a rough solve: not all private placements."""
    # Placements for a lens without a formula, which says nothing of places where it was not observed. They are solved
    # until convergence, and its smoothness is estimated from them.
    enough_without_formula = 100
    # At least one in 25 placements takes part: a camera known from 20 of very many puts so many rows of the others on
    # the wrong side of the rejection bound that another solve follows.
    share_of_placements = 25
    private = problem.private
    chosen: list[int] = []
    for camera in problem.sights.cameras:
        boards = problem.sights.numbers(camera, placements=private).tolist()
        is_rough = problem.options.of_camera(camera).is_rough
        enough = enough_without_formula if is_rough else _ENOUGH_PLACEMENTS
        chosen += boards[:: max(1, min(len(boards) // enough, share_of_placements))]
        chosen += set(problem.sights.numbers(camera).tolist()) - set(boards)
    return np.array(sorted(chosen), dtype=np.int64)
