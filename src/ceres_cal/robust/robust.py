"""Solve, judge the noise and the outliers, solve again, until nothing changes.

One loop for rows that are at hand and for sums over shares of very many: what an engine does in each step differs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Generic, Self, TypeVar

import numpy as np

from ceres_cal.base import DegenerateError, Frozen, Indices, cached_property, numerical, replace
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
from ceres_cal.robust.other_minima import with_lost_boards_posed, without_mirrored_poses

MOST_ROUNDS = 15
# Relative change of a noise scale that is no change. From half to double the answer moves by under 1 % of its error;
# a refit must give the same answer to the same question, and nothing changes from half to double there.
AT_REST, AT_REST_AGAIN = 1e-2, 1e-5


class RobustSolution(Frozen):
    """Where a round ended, and where all of them did.

    Attributes:
        problem: of the inliers there alone, at their noise: what is to be solved next, and at the end what was solved.
        solution: of the last one. inliers, residuals: of all observations there. rounds: how many solves there were.
        reduced: what observations and priors say there, once nothing changes; None before, and where the rounds ran
            out.
    """

    problem: Problem
    solution: Solution
    inliers: Inliers
    residuals: Residuals
    rounds: int
    reduced: ReducedInformation | None = None

    @property
    def estimate(self) -> Estimate:
        """Where it is."""
        return self.solution.estimate

    @cached_property
    def information(self) -> ReducedInformation:
        """What observations and priors say there."""
        return self.reduced or information(self.problem, self.estimate)

    def judged_like(self, before: Self, no_change: float) -> bool:
        """Whether nothing worth another solve changed since another round."""
        return self.inliers.same_as(before.inliers, no_change)

    def weights_of(self, equations: Equations) -> Weights:
        """How the equations counted."""
        taking_part = self.inliers.points, self.inliers.curves
        return equation_weights(self.problem.weighting, equations, self.residuals, taking_part)

    def moved_to(self, estimate: Estimate, problem: Problem) -> RobustSolution:
        """The same with another estimate. `problem`: of all the observations."""
        there = residuals(problem.sights, estimate, self.residuals.feet)
        return replace(self, solution=replace(self.solution, estimate=estimate), residuals=there)


SolvedFrom = Callable[[Problem, Estimate], RobustSolution]
"""How a problem is solved from an estimate."""
_Round = TypeVar("_Round", bound=RobustSolution)


class Rounds(ABC, Generic[_Round]):
    """An engine that solves and judges."""

    no_change = AT_REST

    @abstractmethod
    def next(self, state: _Round) -> _Round:
        """One more solve of what was judged to take part, judged."""

    @abstractmethod
    def with_leverages(self, state: _Round) -> _Round:
        """The state with what its problem says there, judged by the leverages; without it where that asks for another
        round.
        """

    def mended(self, state: _Round, undecided: frozenset[SightKey]) -> tuple[_Round, int, frozenset[SightKey]]:
        """The state with poses changed that a solve cannot get out of, how many, and which sights are undecided."""
        return state, 0, undecided

    def refined(self, state: _Round) -> _Round:
        """The state after the first solve, nearer to what it settles at."""
        return state

    def to_rest(self, state: _Round, most_rounds: int = MOST_ROUNDS, *, is_near: bool = False) -> _Round:
        """Round after round, until nothing changes."""
        undecided: frozenset[SightKey] = frozenset(state.problem.sights.keys)
        before: _Round | None = None
        while state.rounds < most_rounds:
            at_rest = before is not None and state.judged_like(before, self.no_change)
            if not at_rest and before is not None:
                undecided = frozenset(state.problem.sights.keys)  # another lens had decided about mirrored poses
            if at_rest or before is None:
                state, changed, undecided = self.mended(state, undecided)
                if before is None and not is_near:
                    state = self.refined(state)
                if at_rest and not changed:
                    state = self.with_leverages(state)
                    if state.reduced is not None:
                        break
            before, state = state, self.next(state)
        return state


# Of a camera: with them it is known well enough to place all others; fewer cost another round, more cost time.
# Nothing changes from half to double.
_ENOUGH_PLACEMENTS = 20
_MOST_REFINED = 3
# Share of the residuals' scale: a rough solve that leaves less is followed by another one at the new scale. A line that
# is painted aside is told from noise only at a scale near the noise's own.
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
    """The minimum over the inliers, at the noise that they show.

    A start is off by more than the noise, so the first solve rejects nothing that the start can show: a redescending
    loss at the residuals' median keeps gross errors from deciding.

    Args:
        problem: of all the observations; its weighting is not looked at.
        usual: noise scales of points and curves that were seen before, where there are any.
        most_rounds: solves, the rough one counted; 2 end near the minimum.
        is_near: whether the start is near the minimum but for private placements: then there is no rough solve.

    Raises:
        CalibrationError: see `solve`.
    """
    rounds = _RowRounds(problem, usual, progress)
    state = rounds.posed(estimate) if is_near else rounds.first(estimate)
    return rounds.to_rest(state, most_rounds, is_near=is_near)


def judge_at(problem: Problem, estimate: Estimate) -> RobustSolution:
    """Noise and outliers by the leverages at an estimate, where nothing is solved."""
    rounds = _RowRounds(problem, None, None)
    return rounds.by_leverages(rounds.at(estimate))


class _RowRounds(Rounds[RobustSolution]):
    """The rounds over rows that are at hand."""

    def __init__(self, problem: Problem, usual: tuple[float, float] | None, progress: SolveProgress | None) -> None:
        self._problem, self._usual, self._progress = problem, usual, progress
        self._redundancy: Redundancy | None = None
        self._moving = 0.0
        self._scales = (1.0, 1.0)  # of points and of curves that the last rough solve was weighted by
        self._last: tuple[Inliers, Sights] | None = None
        self.no_change = AT_REST if usual is None else AT_REST_AGAIN
        # Relative change of the cost at which the first solve ends, and every further one.
        self._rough_end, self._end = 1e-3, 1e-14
        options = problem.options
        lenses = {name: options.of_camera(name).blank_lens for name in problem.layout.free}
        if options.is_rough and not any(problem.knows_lens(name, lens) for name, lens in lenses.items()):
            # From farther off the next solve, whose lens is as smooth as the data say, begins with steps in vain. With
            # sigmas of a tenth a hundredth of a variance may be left, and no number is off by 0.1 of its sd.
            # Measured are a hundredth of that and 0.01.
            self._rough_end, self._end = 1e-4, 1e-2 / max(problem.equations, 1)

    def first(self, estimate: Estimate) -> RobustSolution:
        """The rough solve from a start."""
        there = residuals(self._problem.sights, estimate, self._problem.feet)
        return self._rough(estimate, there, visible_from(self._problem.observations, there), 1)

    def at(self, estimate: Estimate) -> RobustSolution:
        """An estimate as it is, judged."""
        there = residuals(self._problem.sights, estimate, self._problem.feet)
        solution = Solution(estimate, np.nan, False, "", ())
        return self._with(self._judge(solution, there), solution, there, 0)

    def posed(self, estimate: Estimate) -> RobustSolution:
        """A start near the minimum, its private placements at their best."""
        there = residuals(self._problem.sights, estimate, self._problem.feet)
        visible = visible_from(self._problem.observations, there)
        weighting = Weighting(visible.point_scale, visible.curve_scale, "cauchy", loss_scale=1.0)
        problem = replace(self._problem.used(visible.points, visible.curves), weighting=weighting, feet=there.feet)
        estimate = with_placements_at_best(problem, estimate)
        return self._judged(Solution(estimate, np.nan, False, "", ()), there, 0)

    def refined(self, state: RobustSolution) -> RobustSolution:
        """Further rough solves, each at the scale of the residuals that the one before left, while that falls."""
        for _ in range(_MOST_REFINED):
            visible = visible_from(self._problem.observations, state.residuals)
            if not _much_below(visible.scales, self._scales):
                break
            state = self._rough(state.estimate, state.residuals, visible, state.rounds + 1)
        # Of one kind of observations without priors the leverages add up to the count.
        stated = any(not prior.is_usual for prior in self._problem.priors_at(state.estimate))
        if self._problem.smoothness:  # which tells as much, of fewer sights
            return state
        mixed = stated or all(kind.equations for kind in self._problem.sights.by_kind)
        return self.by_leverages(state) if mixed and len(state.problem.sights) else state

    def _rough(self, estimate: Estimate, there: Residuals, visible: Inliers, rounds: int) -> RobustSolution:
        """A solve of few placements, which the others follow, that gross errors do not decide."""
        self._scales = visible.scales
        # A line painted aside is an outlier to a redescending loss, but not to its tolerance.
        loss = "huber" if len(estimate.structure.values) else "cauchy"
        weighting = Weighting(visible.point_scale, visible.curve_scale, loss, loss_scale=1.0)
        problem = replace(self._problem.rough(weighting), feet=there.feet).used(visible.points, visible.curves)
        if not len(problem.sights):
            raise DegenerateError(
                "the observations fix no pose that could show them: add points or lines of the targets"
            )
        few = problem.of_sights(_evenly(problem))
        if problem.options.is_rough and len(few.sights) < len(problem.sights):
            of_few = _RowRounds(few, self._usual, self._progress)
            end = of_few.to_rest(of_few.first(estimate), most_rounds=2)
            self._scales = of_few._scales  # at which they were solved, not those of the start
            self._problem = replace(self._problem, smoothness=end.problem.smoothness)
            solution = end.solution
        else:
            solution = self._of_few(few, estimate, len(few.sights) < len(problem.sights))
        if len(few.sights) < len(problem.sights):
            solution = replace(solution, estimate=with_placements_at_best(problem, solution.estimate))
        return self._judged(solution, there, rounds)

    def _of_few(self, few: Problem, estimate: Estimate, others_follow: bool) -> Solution:
        """A rough solve; where others follow, which takes time, again at the scale that it left while that falls."""
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
        """One more solve, from where the last one ended, of what was judged to be inliers; with the same rows where
        others are as good.
        """
        solution = solve(state.problem, state.estimate, self._progress, precision=self._end)
        return self._judged(solution, state.residuals, state.rounds + 1, state.inliers)

    def mended(
        self, state: RobustSolution, undecided: frozenset[SightKey]
    ) -> tuple[RobustSolution, int, frozenset[SightKey]]:
        """The state with lost boards posed again and mirrored poses turned over, how many there were of both, and which
        sights' poses compete still.
        """
        weighting = state.problem.weighting
        everything = self._problem.weighted(replace(weighting, loss="cauchy"))
        estimate, lost = with_lost_boards_posed(everything, state.inliers, state.estimate)
        estimate, turned, undecided = without_mirrored_poses(state.problem, estimate, undecided)
        if lost + turned:
            state = self._judged(replace(state.solution, estimate=estimate), state.residuals, state.rounds)
        return state, lost + turned, undecided

    def with_leverages(self, state: RobustSolution) -> RobustSolution:
        """The state with what its problem says there, where the noise is judged no other by the leverages, and nothing
        moves by how smooth lenses are; else judged by them, for another round.
        """
        # Variances by which a lens that is as smooth as the data say stands off: no number is off by 0.23 sd.
        still = 0.05
        anew, reduced = self._anew(state)
        if self._moving > still or not anew.same_as(state.inliers, self.no_change):
            return self._with(anew, state.solution, state.residuals, state.rounds)
        problem = replace(state.problem, smoothness=self._problem.smoothness)
        inliers = replace(state.inliers, degrees_of_freedom=anew.degrees_of_freedom)
        return replace(state, problem=problem, inliers=inliers, reduced=reduced)

    def by_leverages(self, state: RobustSolution) -> RobustSolution:
        """The state judged by the leverages there."""
        return self._with(self._anew(state)[0], state.solution, state.residuals, state.rounds)

    def _anew(self, state: RobustSolution) -> tuple[Inliers, ReducedInformation]:
        """Noise and inliers by the leverages there, and what they were taken from."""
        reduced = information(state.problem, state.estimate)
        if any(camera.lens.roughness for camera in state.estimate.cameras.values()):
            from ceres_cal.effects.smoothness import with_smoothness

            self._problem, reduced, self._moving = with_smoothness(self._problem, state.estimate, reduced)
        sights = state.problem.sights
        points, curves = reduced.leverages
        taken = points + self._problem.taken_up, curves
        self._redundancy = by_leverage((2 * len(sights.point_rows), len(sights.curve_rows)), taken)
        inliers, rows = self._judge(state.solution, state.residuals), state.inliers.rows
        estimate, there = state.estimate, state.residuals
        fitted = InlierFit(self._problem, estimate, there, rows, reduced)
        return by_deleted_residuals(inliers, fitted), reduced

    def _judged(
        self, solution: Solution, before: Residuals, rounds: int, inliers: Inliers | None = None
    ) -> RobustSolution:
        """Where a solve, of these inliers, ended, and the problem that the inliers there make."""
        there = residuals(self._problem.sights, solution.estimate, before.feet)
        anew = self._judge(solution, there)
        if inliers is not None and anew.same_as(inliers, self.no_change):
            anew = anew.with_rows(inliers.rows)
        return self._with(anew, solution, there, rounds)

    def _judge(self, solution: Solution, there: Residuals) -> Inliers:
        problem = self._problem
        redundancy = self._redundancy or by_count(
            problem.sights.equations, problem.unknowns(solution.estimate) + problem.taken_up
        )
        return judge(problem.observations, there, redundancy, problem.options, self._usual)

    def _with(self, inliers: Inliers, solution: Solution, there: Residuals, rounds: int) -> RobustSolution:
        """The state with the problem that the inliers make; rows are not moved where the last ones were the same."""
        last = self._last
        if last is None or not np.array_equal(inliers.rows, last[0].rows):
            self._last = last = inliers, self._problem.sights.used(inliers.points, inliers.curves)
        weighting = inliers.weighting(self._problem.options)
        problem = replace(self._problem, sights=last[1], weighting=weighting, feet=there.feet)
        return RobustSolution(problem, solution, inliers, there, rounds)


def _much_below(scales: tuple[float, float], before: tuple[float, float]) -> bool:
    """Whether the scale of points or that of curves fell to a small share of what it was."""
    return any(now < _MUCH_LESS * then for now, then in zip(scales, before, strict=True))


def _evenly(problem: Problem) -> Indices:
    """Numbers of some sights that tell a camera well enough for a start: of private placements no more than enough."""
    # Of a lens that says nothing of where it was not seen; they are solved to the end, and tell how smooth it is.
    enough_without_formula = 100
    # Of very many: a camera of 20 has so many others' rows on the wrong side of the bound that another solve follows.
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
