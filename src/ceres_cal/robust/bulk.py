"""Solve for very many observations of the world: a subset decides what there is, and all observations take part.

The subset goes through all steps of a calibration: the choice of the lens, outliers as a whole, targets as built. From
its end, which is off by about a standard deviation of the subset, all observations are judged and solved for together,
in shares that answer with sums (`shares`): in this process, or on workers.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from uuid import uuid4

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, distinct, replace
from ceres_cal.effects.aside import Explanation
from ceres_cal.observations import Observations, SightKey, shown_rows, some_views
from ceres_cal.problem import Estimate, Layout, Problem, Solution, SolveProgress, Weighting, solve
from ceres_cal.problem.engines import InProcess, OnWorkers, SharedObservations, of_world
from ceres_cal.problem.reduced import ReducedInformation, information
from ceres_cal.problem.residuals import Residuals, relative_lengths, residuals
from ceres_cal.problem.shares import Histogram, ResidualSummary, RowSelection, Share, ShareRequest, cut
from ceres_cal.robust.noise import SAME, Inliers, NoiseScales, Redundancy, by_count, by_leverage, noise_of
from ceres_cal.robust.robust import RobustSolution, Rounds

# Approximate number of observations in the subset, and least number of views of the world in it.
_PART, _FEWEST_VIEWS = 300_000, 200
_STANDING_OUT = 12  # further views of the largest residuals, and as many of the most outliers


class Subset(Frozen):
    """A subset of the observations: all that are not of the world, and evenly chosen views of the world.

    Attributes:
        rows: of its points and of its curve observations, among all observations. gone: (n + m,) rows that explanations
            leave out as a whole.
    """

    observations: Observations
    rows: tuple[Indices, Indices]
    gone: Mask | None = None


class BulkSolution(Frozen):
    """The solution for all observations.

    Attributes:
        end: the end, with inliers and residuals of the subset. used: which of all observations take part.
        explanations: with the rows among all observations.
    """

    observations: Observations
    end: RobustSolution
    used: RowSelection
    explanations: tuple[Explanation, ...]


class Bulk:
    """Very many observations, and the engine that computes sums over them."""

    def __init__(self, observations: Observations, client: Any = None) -> None:
        self.observations: Observations = observations
        self._client = client
        self._engines: list[InProcess | OnWorkers] = []
        self._left_out = None
        if observations.copies.are_there:
            points, curves = observations.copies.originals
            self._left_out = ~points, ~curves
        self._engine = self._engine_without(self._left_out)
        views = observations.views
        self._world = np.array([view.placement is None for view in views])
        self.keys: tuple[SightKey, ...] = tuple(
            {SightKey(v.camera, v.station, None): None for v in views if v.placement is None}
        )

    def _engine_without(self, left_out: tuple[Mask, Mask] | None) -> InProcess | OnWorkers:
        shares = list(cut(self.observations, left_out))
        engine = InProcess(shares) if self._client is None else OnWorkers(self._client, shares)
        self._engines.append(engine)
        return engine

    def close(self) -> None:
        """Release all shares, wherever they are."""
        for engine in self._engines:
            engine.close()

    # ---- the subset that decides ------------------------------------------------------------------------------------

    def part(self, besides: Indices | None = None) -> Subset:
        """The subset: views of the world, evenly, and the views `besides`; and everything that is not of the world."""
        counts = np.diff(self.observations.ends[0]) + np.diff(self.observations.ends[1])
        chosen = ~self._world
        chosen[some_views(np.where(self._world, counts, 0), _PART, _FEWEST_VIEWS)] = True
        if besides is not None:
            chosen[besides] = True
        step = max(1, int(counts[chosen & self._world].sum()) // (2 * _PART))
        rows = [
            np.concatenate(
                [np.arange(ends[v], ends[v + 1], step if self._world[v] else 1) for v in np.flatnonzero(chosen)]
            )
            for ends in self.observations.ends
        ]
        return Subset(self.observations.part(*rows), (rows[0], rows[1]))

    def standing_out(self, end: RobustSolution) -> Indices:
        """Views of the largest residuals at a solution of a subset, and views of the most outliers."""
        looked = self.look(self._engine, end.estimate, end.problem.weighting, _bounds(end))[1]
        spare = np.maximum(looked.equations, 1.0)
        above = (looked.squares / spare - 1.0) * np.sqrt(spare) * (looked.equations > 0)
        worst = [looked.view[np.argsort(-by, kind="stable")[:_STANDING_OUT]] for by in (above, looked.beyond)]
        return distinct(np.concatenate(worst))

    # ---- all observations -------------------------------------------------------------------------------------------

    def settled(
        self,
        part: Subset,
        problem: Problem,
        end: RobustSolution,
        explanations: Sequence[Explanation],
        progress: SolveProgress | None,
    ) -> BulkSolution:
        """Judge all observations and solve for them, starting from the end of a subset.

        Args:
            problem: of the whole subset.
        """
        every = tuple(replace(one, rows=self._rows_of(one, part)) for one in explanations)
        taken = [(mine.rows, one.rows) for mine, one in zip(explanations, every, strict=True) if one.is_taken]
        gone, engine = np.zeros(part.observations.rows, dtype=bool), self._engine
        if taken:
            gone = np.any([mine for mine, _ in taken], axis=0)
            engine = self._engine_without(self._also(np.any([rows for _, rows in taken], axis=0)))
        rounds = _SumRounds(self, engine, replace(part, gone=gone), problem, end, progress)
        return BulkSolution(self.observations, rounds.end(), rounds.used(), every)

    def _rows_of(self, explanation: Explanation, part: Subset) -> Mask:
        """(N + M,) mask of all observations of what an explanation leaves out, of which the subset has some."""
        few, split = part.observations, len(part.observations.points)
        masks = []
        for is_curve, (own, column) in enumerate(
            ((few.points, self.observations.points), (few.curves, self.observations.curves))
        ):
            rows = np.flatnonzero(explanation.rows[split:] if is_curve else explanation.rows[:split])
            features, views = distinct(own.feature[rows]), np.zeros(len(self._world), dtype=bool)
            views[own.view[rows]] = True
            if np.count_nonzero(views & self._world) > 1:  # a feature in all frames
                shown = {(few.views[v].station, few.views[v].target) for v in np.flatnonzero(views)}
                views = np.array([(view.station, view.target) in shown for view in few.views]) & self._world
            masks.append(views[column.view] & np.isin(column.feature, features))
        return np.concatenate(masks)

    def _also(self, rows: Mask) -> tuple[Mask, Mask]:
        """Masks of the points and curve observations that do not count: copies, and these rows (N + M,)."""
        points, curves = np.split(rows, [len(self.observations.points)])
        return (points, curves) if self._left_out is None else (points | self._left_out[0], curves | self._left_out[1])

    def look(
        self, engine: InProcess | OnWorkers, estimate: Estimate, weighting: Weighting, bounds: tuple[float, float],
        along: tuple[tuple[str, Estimate], ...] = (),
    ) -> tuple[str, ResidualSummary]:  # fmt: skip
        """A new name for an estimate, and the summary of the residuals at it. along: estimates of earlier searches for
        feet.
        """
        here = uuid4().hex, of_world(estimate)
        blank = Layout({}, frozenset(), frozenset())
        return here[0], engine.ask(Share.looked, ShareRequest(here[1], blank, weighting, here, bounds, (*along, here)))


class _BulkResiduals(Frozen):
    """Residuals at an estimate: the name under which shares keep theirs, their summary, the residuals of the subset,
    their lengths in stated sigmas, and the rows of the subset that are not of the world.
    """

    name: str
    estimate: Estimate
    looked: ResidualSummary
    here: Residuals
    lengths: tuple[Array, Array]
    placed: tuple[Mask, Mask]

    def noise(self, redundancy: Redundancy, problem: Problem) -> NoiseScales:
        """The noise scales that the residuals show."""
        return noise_of(*self._histograms, redundancy, problem.options)

    def inside(self, noise: NoiseScales) -> tuple[int, int]:
        """Numbers of points and of curve observations that are inliers."""
        points, curves = self._histograms
        return points.within(noise.bounds[0])[0], curves.within(noise.bounds[1])[0]

    @property
    def _histograms(self) -> tuple[Histogram, Histogram]:
        own = [Histogram.of(lengths[mask]) for lengths, mask in zip(self.lengths, self.placed, strict=True)]
        return self.looked.points + own[0], self.looked.curves + own[1]


class _SumRound(RobustSolution, kw_only=True):
    """The end of one round over all observations. Its inliers and residuals are those of the subset.

    Attributes:
        problem: as it was last solved. seen: the residuals at its end. noise: the noise that they show.
    """

    seen: _BulkResiduals
    noise: NoiseScales

    def judged_like(self, before: _SumRound, no_change: float) -> bool:
        """Whether no scale changed, and the numbers of inliers are about the same."""
        scales = zip(self.noise[:2], before.noise[:2], strict=True)
        rows = zip(self.seen.inside(self.noise), before.seen.inside(before.noise), strict=True)
        return all(abs(now - then) <= no_change * then for now, then in scales) and all(
            abs(now - then) <= SAME * then**0.5 for now, then in rows
        )


class _SumRounds(Rounds[_SumRound]):
    """The rounds over sums of shares, which may be on workers."""

    def __init__(
        self, bulk: Bulk, engine: InProcess | OnWorkers, part: Subset, problem: Problem, end: RobustSolution,
        progress: SolveProgress | None,
    ) -> None:  # fmt: skip
        self._bulk, self._engine, self._part, self._few = bulk, engine, part, part.observations
        self._problem, self._progress = problem, progress
        placed = np.flatnonzero([key.placement is not None for key in problem.sights.keys])
        self._core = problem.sights.take(placed)
        points, curves = np.split(shown_rows(self._core), [len(self._few.points)])
        self._placed, self._before = (points, curves), end
        self._along: tuple[tuple[str, Estimate], ...] = ()
        self._unknowns = problem.unknowns(end.estimate)

    def _look(self, estimate: Estimate, bounds: tuple[float, float], weighting: Weighting) -> _BulkResiduals:
        name, looked = self._bulk.look(self._engine, estimate, weighting, bounds, self._along)
        self._along = (*self._along, (name, of_world(estimate)))
        here = residuals(self._problem.sights, estimate)
        points, curves = relative_lengths(self._few, here)
        if self._part.gone is not None:
            gone = np.split(self._part.gone, [len(points)])
            points, curves = np.where(gone[0], np.inf, points), np.where(gone[1], np.inf, curves)
        return _BulkResiduals(name, estimate, looked, here, (points, curves), self._placed)

    def _judged(self, seen: _BulkResiduals, noise: NoiseScales) -> Problem:
        """The problem of the inliers, judged at the last estimate."""
        options, (points, curves) = self._problem.options, noise.bounds
        inside = seen.lengths[0] <= points, seen.lengths[1] <= curves
        equations = 2 * seen.looked.points.within(points)[0] + seen.looked.curves.within(curves)[0]
        judged_at = seen.name, of_world(seen.estimate)
        judged = SharedObservations(self._engine, self._bulk.keys, equations, judged_at, noise.bounds, self._along)
        weighting = Weighting(noise.points, noise.curves, options.loss, options.loss_scale)
        return replace(
            self._problem,
            sights=self._core.used(*inside),
            weighting=weighting,
            feet=seen.here.feet,
            smoothness=self._before.problem.smoothness,
            elsewhere=judged,
        )

    def next(self, state: _SumRound) -> _SumRound:
        """Solve once more for the inliers, and judge the result."""
        # Relative change of the cost at which a solve for all ends: the order of sums changes the end by its root.
        to_the_last = 1e-17
        problem = self._judged(state.seen, state.noise)
        solution = solve(problem, state.seen.estimate, self._progress, precision=to_the_last)
        seen = self._look(solution.estimate, state.noise.bounds, problem.weighting)
        return self._round(problem, solution, seen, by_count(problem.equations, self._unknowns), state.rounds + 1)

    def _round(
        self, problem: Problem, solution: Solution, seen: _BulkResiduals, redundancy: Redundancy, rounds: int,
        reduced: ReducedInformation | None = None,
    ) -> _SumRound:  # fmt: skip
        """The state where a solve ended, judged."""
        noise = seen.noise(redundancy, self._problem)
        inliers = Inliers.by_noise(*seen.lengths, noise)
        return _SumRound(problem, solution, inliers, seen.here, rounds, reduced, seen=seen, noise=noise)

    def with_leverages(self, state: _SumRound) -> _SumRound:
        """The state judged by the leverages, with the information of all observations."""
        elsewhere = state.problem.elsewhere
        assert isinstance(elsewhere, SharedObservations)
        here = replace(elsewhere, feet_along=self._along)  # else shares would search for earlier feet again
        reduced = information(replace(state.problem, elsewhere=here), state.estimate)
        points, curves = state.seen.inside(state.noise)
        redundancy = by_leverage((2 * points, curves), reduced.leverages)
        return self._round(state.problem, state.solution, state.seen, redundancy, state.rounds, reduced)

    def end(self) -> RobustSolution:
        """Run the rounds. Returns their end, with the information of all observations."""
        most_rounds = 8
        before = self._before
        seen = self._look(before.estimate, _bounds(before), before.problem.weighting)
        redundancy = by_count(sum(seen.looked.equations), self._unknowns)
        state = self.to_rest(self._round(self._problem, before.solution, seen, redundancy, 0), most_rounds)
        state = state if state.reduced is not None else self.with_leverages(state)
        self._seen, self._noise, inliers = state.seen, state.noise, state.inliers
        sights = self._problem.used(inliers.points, inliers.curves).sights
        problem = replace(state.problem, sights=sights, feet=state.residuals.feet, elsewhere=None)
        rounds = before.rounds + state.rounds
        return RobustSolution(problem, state.solution, inliers, state.residuals, rounds, state.reduced)

    def used(self) -> RowSelection:
        """The observations that take part at the end, of the world and of everything else."""
        judged = self._judged(self._seen, self._noise)
        assert isinstance(judged.elsewhere, SharedObservations)
        used = self._engine.ask(Share.used, judged.elsewhere.asked(judged, self._seen.estimate)) + self._used_here()
        (p, c), (far_p, far_c) = used.rows, used.sigmas
        first, then = np.argsort(p), np.argsort(c)
        return RowSelection(used.sums, (p[first], c[then]), (far_p[first], far_c[then]))

    def _used_here(self) -> RowSelection:
        """The rows of the subset that are not of the world: which take part, and how far off the others are."""
        sums, rows, sigmas = [], [], []
        columns = self._few.points, self._few.curves
        each = zip(
            columns,
            self._seen.lengths,
            self._placed,
            self._noise.bounds,
            self._seen.here.lengths,
            self._part.rows,
            strict=True,
        )
        for column, lengths, placed, bound, px, row in each:
            inside = placed & (lengths <= bound)
            sums.append((np.count_nonzero(inside), np.sum(px[inside] ** 2), np.sum(column.sigma_px[inside] ** 2)))
            rows.append(row[placed & ~inside])
            sigmas.append(lengths[placed & ~inside])
        return RowSelection(np.array(sums, dtype=float), (rows[0], rows[1]), (sigmas[0], sigmas[1]))


def _bounds(end: RobustSolution) -> tuple[float, float]:
    """Approximate lengths in stated sigmas beyond which observations are outliers."""
    sigmas = end.problem.options.reject_sigma
    return sigmas * end.inliers.point_scale, sigmas * end.inliers.curve_scale
