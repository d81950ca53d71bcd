"""The one nonlinear least-squares solve: its blocks, its settings and its result."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from typing import Any

import numpy as np
import pyceres

from ceres_cal.base import Array, DegenerateError, Frozen, InputError, SolutionError, at_most, available, plural
from ceres_cal.base.transforms import Pose, Poses
from ceres_cal.observations.sights import STRUCTURE, Owner, Sights
from ceres_cal.problem.costs import ROWS_WORTH_A_THREAD, CachedCost, EliminatedCost, PriorCost, Run, SightCost
from ceres_cal.problem.parameters import Estimate, Layout, Station, charts_of, intrinsics_vector, with_intrinsics
from ceres_cal.problem.problem import Problem, Weighting

_NOTHING_LEFT = "The cost cannot decrease any further."
_SUCCESS = (pyceres.TerminationType.CONVERGENCE, pyceres.TerminationType.USER_SUCCESS)
# Relative change of a placement's cost that an initial estimate may leave. Halving or doubling changes nothing.
_POSED = 1e-2


class Progress(Frozen, eq=True):
    """One iteration of a solve, as passed to the progress callback."""

    iteration: int
    cost: float
    step_norm: float


SolveProgress = Callable[[Progress], None]
"""A function that is called at every iteration of every solve."""


class Solution(Frozen, eq=True):
    """The result of one solve.

    Attributes:
        cost: half the sum of all rho at the end; infinite where the solve failed. history: the cost at every iteration.
        converged: False if the iterations ran out or the solver failed. termination: Ceres' message why it stopped.
        failed: whether the solve failed; the estimate is then the initial one.
    """

    estimate: Estimate
    cost: float
    converged: bool
    termination: str
    history: tuple[float, ...]
    failed: bool = False


# ---- the problem --------------------------------------------------------------------------------------------------


def packed(estimate: Estimate, layout: Layout, eliminated: frozenset[str | None]) -> dict[Owner, Array]:
    """The arrays that Ceres moves, as copies: the caller's estimate is never changed."""
    cameras = {name: intrinsics_vector(camera)[layout.free[name]] for name, camera in estimate.cameras.items()}
    stations = {n: station.cam_from_world.log() for n, station in estimate.stations.items() if n in layout.stations}
    kept = layout.placements - eliminated
    placements = {name: estimate.placements[name].log() for name in estimate.placements if name in kept}
    by_kind = {"camera": cameras, "station": stations, "placement": placements}
    blocks = {(kind, name): array for kind, arrays in by_kind.items() for name, array in arrays.items()}
    return {**blocks, STRUCTURE: estimate.structure.values.copy()}


def _unpacked(blocks: Mapping[Owner, Array], estimate: Estimate, layout: Layout) -> Estimate:
    cameras = {}
    for name, camera in estimate.cameras.items():
        vector = intrinsics_vector(camera)
        vector[layout.free[name]] = blocks["camera", name]
        cameras[name] = with_intrinsics(camera, vector) if len(layout.free[name]) else camera
    stations = {
        name: Station(old.camera, Pose.exp(blocks["station", name])) if name in layout.stations else old
        for name, old in estimate.stations.items()
    }
    moved = Poses.of({name: Pose.exp(vector) for (kind, name), vector in blocks.items() if kind == "placement"})
    placements = Poses.of(estimate.placements).updated(list(moved), moved.stack)
    return Estimate(cameras, stations, placements, estimate.structure.with_values(blocks[STRUCTURE]))


def _costs_of(run: Run, problem: Problem, estimate: Estimate) -> tuple[list[CachedCost], int]:
    """All cost functions of a problem, and the number of threads that they are worth."""
    private, sights, layout = problem.private, problem.sights, problem.layout
    eliminated, threads, stated = list[EliminatedCost](), 1, problem.stated_at(estimate)
    for camera in estimate.cameras:
        own = sights.numbers(camera, placements=private)
        if len(own):
            of_camera = [PriorCost(run, prior, estimate, layout) for prior in stated if prior.is_of(camera)]
            stated = [prior for prior in stated if not prior.is_of(camera)]
            known = [one.evaluated for one in of_camera]
            eliminated.append(EliminatedCost(run, sights.take(own), problem, estimate, known))
    costs: list[CachedCost] = [*eliminated]
    for number, key in enumerate(sights.keys):
        if key.placement not in private:
            parts = list(_parts(sights[number]))
            threads = max(threads, len(parts))
            costs += [SightCost(run, part, problem, estimate) for part in parts]
    if problem.elsewhere is not None:
        costs.append(problem.elsewhere.cost(run, problem, estimate))
    posed = {cost.camera for cost in eliminated}
    smooth = (problem.smooth_at(estimate, name) for name in estimate.cameras if name not in posed)
    costs += [PriorCost(run, prior, estimate, layout) for prior in (*stated, *chain.from_iterable(smooth))]
    return costs, threads


class _Watcher(pyceres.IterationCallback):
    """Pass progress on; end the solve if nothing is left to gain, if a callback has failed, or on Ctrl-C."""

    def __init__(self, run: Run, progress: SolveProgress | None, precision: float) -> None:
        super().__init__()
        self._run, self._progress, self._precision = run, progress, precision
        self._accepted: list[float] = []

    def __call__(self, summary: Any) -> Any:
        with self._run:
            self._run.history.append(float(summary.cost))
            if summary.step_is_successful:
                self._accepted.append(float(summary.cost))
            if self._progress is not None:
                self._progress(Progress(int(summary.iteration), float(summary.cost), float(summary.step_norm)))
        if self._run.failure is not None:
            return pyceres.CallbackReturnType.SOLVER_ABORT
        if summary.step_is_successful and _left_to_gain(self._accepted) <= self._precision:
            return pyceres.CallbackReturnType.SOLVER_TERMINATE_SUCCESSFULLY
        return pyceres.CallbackReturnType.SOLVER_CONTINUE


def _left_to_gain(costs: Sequence[float]) -> float:
    """The share of the cost that all further steps will gain if gains go on shrinking as the last two did.

    Ceres itself stops only when a step gains nothing, which near the end of Newton's method wastes an iteration.
    """
    if len(costs) < 3:
        return np.inf
    before, last = costs[-3] - costs[-2], costs[-2] - costs[-1]
    if costs[-1] <= 0.0:  # an exact fit
        return 0.0
    return last * last / (before - last) / costs[-1] if before > last > 0.0 else np.inf


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence Ceres: what it prints says no more than its summary."""
    before = pyceres.logging.minloglevel
    pyceres.logging.minloglevel = int(pyceres.logging.FATAL)
    try:
        yield
    finally:
        pyceres.logging.minloglevel = before


def _parts(sight: Sights) -> list[Sights]:
    """The parts of a sight, one for each thread; a sight of few observations is one part."""
    count = max(1, min(available(), (len(sight.points) + len(sight.curve_pixels)) // ROWS_WORTH_A_THREAD))
    return [sight.part(number, count) for number in range(count)] if count > 1 else [sight]


def solve(
    problem: Problem,
    estimate: Estimate,
    progress: SolveProgress | None = None,
    *,
    precision: float = 1e-14,
    is_near: bool = True,
    posed: float = 0.0,
) -> Solution:
    """Minimise the robust cost over everything free, starting from `estimate`.

    Args:
        progress: called at every iteration. precision: relative change of the cost at which the solve ends.
        is_near: whether the estimate is near the minimum. There plain Gauss-Newton is right if the loss is convex;
            without it, convergence along phi and height is slow.
        posed: relative change of its cost to which each private placement is solved for before the first step; 0 leaves
            it unchanged.

    Raises:
        DegenerateError: fewer observations than free numbers.
        SolutionError: the least cost lies where phi or the aspect is negative.
    """
    _require_enough(problem, estimate)
    run, layout = Run(), problem.layout
    with at_most(problem.options.threads):
        costs, threads = _costs_of(run, problem, estimate)
    ceres, blocks, charts = pyceres.Problem(), packed(estimate, layout, problem.private), charts_of(estimate, layout)
    for cost in costs:
        cost.charts = charts
        if posed and isinstance(cost, EliminatedCost):
            cost.posed(posed)
        if cost.owners:  # otherwise it depends on nothing that is free
            ceres.add_residual_block(cost, None, [blocks[owner] for owner in cost.owners])
    for owner, chart in charts.items():
        blocks[owner][:] = chart.moved(blocks[owner])
    settings = _solver_options(problem, blocks, precision)
    # Kernels end sooner than a thread gets Python's lock; only parts of very large sights are worth a thread each.
    settings.num_threads = threads
    settings.callbacks = [_Watcher(run, progress, precision)]
    if is_near and problem.weighting.is_convex:
        settings.initial_trust_region_radius = 1e8
    summary = pyceres.SolverSummary()
    with _quiet():
        pyceres.solve(settings, ceres, summary)
    if run.failure is not None:
        raise run.failure
    for owner, chart in charts.items():
        blocks[owner][:] = chart.numbers(blocks[owner])
    try:
        solved = _unpacked(blocks, estimate, layout)
    except InputError:  # phi or aspect below 0
        raise SolutionError(
            "the least cost is at a negative phi or fy / fx, which no camera has: check labels and target dimensions"
        ) from None
    for cost in costs:
        if isinstance(cost, EliminatedCost):
            solved = solved.with_placements(*cost.converged([blocks[owner] for owner in cost.owners]))
    usable = bool(summary.IsSolutionUsable())
    return Solution(
        solved,
        float(summary.final_cost) if usable else np.inf,
        summary.termination_type in _SUCCESS or _rests(run.history),
        _NOTHING_LEFT if summary.termination_type == pyceres.TerminationType.USER_SUCCESS else str(summary.message),
        tuple(run.history),
        not usable,
    )


def placement_costs(
    sights: Sights, estimate: Estimate, weighting: Weighting, poses: Array, tolerance: float = 1e-6
) -> tuple[Array, Array]:
    """Costs (S,) and cam_from_target (S, 3, 4) of one camera's sights after solving for each placement alone.

    Args:
        poses: (S, 3, 4) initial cam_from_target of each; the cost is infinite if an observation cannot be projected
            from there. tolerance: relative, of each cost.
    """
    held = Layout({sights.keys[0].camera: np.empty(0, dtype=np.int64)}, frozenset(), frozenset())
    problem = Problem(sights, held, weighting=weighting)
    return EliminatedCost(Run(), sights, problem, estimate).posed(tolerance, poses)


def with_placements_at_best(problem: Problem, estimate: Estimate, tolerance: float = _POSED) -> Estimate:
    """The estimate with every private placement solved for, everything else held; `tolerance`: relative, of its
    cost.
    """
    for camera in estimate.cameras:
        own = problem.sights.take(problem.sights.numbers(camera, placements=problem.private))
        if len(own):
            poses = estimate.pose_stack(own.keys)
            _, best = placement_costs(own, estimate, problem.weighting, poses, tolerance)
            estimate = estimate.with_placements(own.keys, best)
    return estimate


def _rests(history: Sequence[float]) -> bool:
    """Whether the last iterations changed the cost only by rounding: a redescending loss may go on like that."""
    at_rest = 10  # number of these iterations
    last = history[-at_rest:]
    return len(last) == at_rest and max(last) - min(last) <= 1e-11 * max(last)


def _require_enough(problem: Problem, estimate: Estimate) -> None:
    unknowns = problem.layout.size + len(estimate.structure.values)
    if problem.equations >= unknowns:
        return
    known = unknowns - problem.unknowns(estimate)
    if problem.equations + known < unknowns:
        observed = 2 * len(problem.observations.points) + len(problem.observations.curves)
        others = (
            f"; no camera explains the others of the {observed} that were observed: check the names of features, and "
            "that pixels are x, y from the top left"
        )
        missing = unknowns - problem.equations - known
        more = f"{plural((missing + 1) // 2, 'point')} or {plural(missing, 'curve observation')}"
        raise DegenerateError(
            f"{problem.equations + known} measured numbers (two a point, one a curve observation or prior) "
            f"cannot determine {unknowns} unknowns: add observations, at least {more}, or fix some of the unknowns"
            f"{others if problem.equations < observed else ''}"
        )


def _solver_options(problem: Problem, blocks: Mapping[Owner, Array], precision: float) -> Any:
    dense_limit = 600  # numbers left after the Schur complement, above which a sparse factorisation is faster
    dense_blocks = 2000  # numbers up to which full blocks are solved densely: two of 850 take .1 s, not half a minute
    most_invalid = 20  # consecutive invalid steps: the trust region shrinks ever faster, and no pose lies beyond
    solver = pyceres.SolverOptions()
    kept = sum(len(free) for free in problem.layout.free.values()) + len(blocks[STRUCTURE])
    left = kept + 6 * len(problem.layout.stations)
    few = left < dense_limit
    solver.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR if few else pyceres.LinearSolverType.SPARSE_SCHUR
    has_placements = any(kind == "placement" for kind, _ in blocks)
    if not has_placements and left < dense_blocks:  # nothing is left to be eliminated, and blocks are full
        solver.linear_solver_type = pyceres.LinearSolverType.DENSE_NORMAL_CHOLESKY
    solver.max_num_iterations = problem.options.max_iterations
    solver.max_num_consecutive_invalid_steps = most_invalid
    solver.function_tolerance = precision
    solver.parameter_tolerance = 1e-12
    solver.gradient_tolerance = 1e-14
    solver.logging_type = pyceres.LoggingType.SILENT
    return solver
