"""The one nonlinear least-squares problem: its blocks, the solve and what comes out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyceres

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.errors import DegenerateError, InputError, SolutionError
from ceres_cal.base.threads import at_most, available
from ceres_cal.base.transforms import Pose, Poses
from ceres_cal.model.parameters import (
    Estimate,
    Layout,
    Options,
    Station,
    intrinsic_names,
    intrinsics_scales,
    intrinsics_vector,
    with_intrinsics,
)
from ceres_cal.observations import Prior
from ceres_cal.observations.sights import SightKey, Sights
from ceres_cal.solve.costs import (
    ROWS_WORTH_A_THREAD,
    EliminatedCost,
    LinearPriorCost,
    PositionPriorCost,
    Run,
    SightCost,
    Weighting,
)
from ceres_cal.solve.joint import joint_block

_AT_REST = 10  # iterations
_NOTHING_LEFT = "Nothing left to gain."
_SUCCESS = (pyceres.TerminationType.CONVERGENCE, pyceres.TerminationType.USER_SUCCESS)
_POSED = 1e-2  # relative change of a placement's cost that a start may leave
_DENSE_LIMIT = 600  # numbers that stay after the Schur complement; above it a sparse factorisation is faster


@dataclass(frozen=True)
class Progress:
    """One iteration of a solve, as the progress callback gets it."""

    iteration: int
    cost: float
    step_norm: float


@dataclass(frozen=True)
class Solution:
    """The end of one solve.

    Attributes:
        cost: half the sum of all rho, at the end. history: the same at every iteration.
        converged: False when the iterations ran out or the solver failed; termination: Ceres' own words why it stopped.
        failed: the estimate must not be used.
    """

    estimate: Estimate
    cost: float
    converged: bool
    termination: str
    history: tuple[float, ...]
    failed: bool = False


@dataclass(eq=False)
class _Blocks:
    """The arrays that Ceres moves, by name; the caller's estimate is never touched."""

    cameras: dict[str, Array]
    stations: dict[str, Array]
    placements: dict[str, Array]
    structure: Array

    @classmethod
    def pack(cls, estimate: Estimate, layout: Layout, eliminated: frozenset[str | None]) -> _Blocks:
        kept = layout.placements - eliminated
        return cls(
            {name: intrinsics_vector(camera)[layout.free[name]] for name, camera in estimate.cameras.items()},
            {n: estimate.stations[n].cam_from_world.log() for n in estimate.stations if n in layout.stations},
            {n: estimate.placements[n].log() for n in estimate.placements if n in kept},
            estimate.structure.values.copy(),
        )

    def of(self, key: SightKey, slots: Iterable[int]) -> list[Array]:
        """The arrays of a sight's camera (slot 0), station (1), placement (2) and structure (3)."""
        every = (
            lambda: self.cameras[key.camera],
            lambda: self.stations[key.station],
            lambda: self.placements[str(key.placement)],
            lambda: self.structure,
        )
        return [every[slot]() for slot in slots]

    def unpack(self, estimate: Estimate, layout: Layout) -> Estimate:
        cameras = {}
        for name, camera in estimate.cameras.items():
            vector = intrinsics_vector(camera)
            vector[layout.free[name]] = self.cameras[name]
            cameras[name] = with_intrinsics(camera, vector) if len(layout.free[name]) else camera
        stations = {
            name: Station(old.camera, Pose.exp(self.stations[name])) if name in layout.stations else old
            for name, old in estimate.stations.items()
        }
        moved = Poses.of({name: Pose.exp(vector) for name, vector in self.placements.items()})
        placements = Poses.of(estimate.placements).updated(list(moved), moved.stack)
        return Estimate(cameras, stations, placements, estimate.structure.with_values(self.structure))


@dataclass(eq=False)
class _Assembly:
    """Every cost of a problem with the arrays it depends on; costs that depend on nothing free have no array."""

    blocks: _Blocks
    costs: list[tuple[Any, list[Array]]]
    eliminated: list[tuple[EliminatedCost, list[Array]]]
    threads: int = 1
    """Blocks that are worth a thread each."""


def _assemble(
    run: Run,
    sights: Sights,
    estimate: Estimate,
    layout: Layout,
    weighting: Weighting,
    places: Array | None = None,
) -> _Assembly:
    private = private_placements(sights, layout)
    blocks = _Blocks.pack(estimate, layout, private)
    assembly = _Assembly(blocks, [], [])
    for camera in estimate.cameras:
        own = sights.numbers(camera, placements=private)
        if len(own):
            cost = EliminatedCost(run, sights.take(own), estimate, layout.free[camera], weighting, places)
            assembly.eliminated.append((cost, blocks.of(sights.keys[own[0]], cost.slots)))
    assembly.costs += assembly.eliminated
    for number, key in enumerate(sights.keys):
        if key.placement not in private:
            parts = list(_parts(sights[number]))
            assembly.threads = max(assembly.threads, len(parts))
            for part in parts:
                sight_cost = SightCost(run, part, estimate, layout, weighting, places)
                assembly.costs.append((sight_cost, blocks.of(key, sight_cost.slots)))
    assembly.costs += [(cost, [array]) for cost, array in _prior_blocks(layout, estimate, blocks)]
    joint = joint_block(run, estimate, layout, blocks)
    return assembly if joint is None else replace(assembly, costs=[*assembly.costs, joint])


class _Watcher(pyceres.IterationCallback):
    """Passes progress on; ends the solve when nothing is left to gain, a callback has failed or Ctrl-C was pressed."""

    def __init__(self, run: Run, progress: Callable[[Progress], None] | None, precision: float) -> None:
        super().__init__()
        self._run, self._progress, self._precision = run, progress, precision
        self._accepted: list[float] = []

    def __call__(self, summary: Any) -> Any:
        try:
            self._run.history.append(float(summary.cost))
            if summary.step_is_successful:
                self._accepted.append(float(summary.cost))
            if self._progress is not None:
                self._progress(Progress(int(summary.iteration), float(summary.cost), float(summary.step_norm)))
        except BaseException as error:
            self._run.failure = self._run.failure or error
        if self._run.failure is not None:
            return pyceres.CallbackReturnType.SOLVER_ABORT
        if summary.step_is_successful and _left_to_gain(self._accepted) <= self._precision:
            return pyceres.CallbackReturnType.SOLVER_TERMINATE_SUCCESSFULLY
        return pyceres.CallbackReturnType.SOLVER_CONTINUE


def _left_to_gain(costs: Sequence[float]) -> float:
    """The share of the cost that all further steps bring if the gains go on shrinking as the last two did.

    Ceres waits for a gain of nothing, which near the end of Newton's way is an iteration in vain.
    """
    if len(costs) < 3:
        return np.inf
    before, last = costs[-3] - costs[-2], costs[-2] - costs[-1]
    return last * last / ((before - last) * costs[-1]) if before > last > 0.0 else np.inf


@contextmanager
def _quiet() -> Iterator[None]:
    """Ceres keeps to its summary: what it would print besides says no more."""
    before = pyceres.logging.minloglevel
    pyceres.logging.minloglevel = int(pyceres.logging.FATAL)
    try:
        yield
    finally:
        pyceres.logging.minloglevel = before


def _parts(sight: Sights) -> list[Sights]:
    """A sight of very many observations as one for each thread."""
    count = max(1, min(available(), (len(sight.points) + len(sight.curve_pixels)) // ROWS_WORTH_A_THREAD))
    return [sight.part(number, count) for number in range(count)] if count > 1 else [sight]


def solve(
    sights: Sights,
    estimate: Estimate,
    layout: Layout,
    weighting: Weighting,
    options: Options,
    progress: Callable[[Progress], None] | None = None,
    places: Array | None = None,
) -> Solution:
    """Minimise the robust cost over everything free, from `estimate`.

    Args:
        progress: called at every iteration. places: feet of the curve observations, see `residuals`.

    Raises:
        DegenerateError: fewer observations than free numbers.
        SolutionError: the least cost lies where phi or the aspect is negative.
    """
    _require_enough(sights, layout)
    run = Run()
    with at_most(options.threads):
        assembly = _assemble(run, sights, estimate, layout, weighting, places)
    watcher = _Watcher(run, progress, weighting.precision)
    problem = pyceres.Problem()
    for cost, arrays in assembly.costs:
        if arrays:
            problem.add_residual_block(cost, None, arrays)
    summary = pyceres.SolverSummary()
    with _quiet():
        pyceres.solve(
            _solver_options(layout, assembly.blocks, options, weighting, assembly.threads, watcher),
            problem,
            summary,
        )
    if run.failure is not None:
        raise run.failure
    try:
        solved = assembly.blocks.unpack(estimate, layout)
    except InputError as error:  # phi or aspect below 0
        raise SolutionError(f"the solve ended at no camera ({error}): check labels and target dimensions") from None
    for eliminated, arrays in assembly.eliminated:
        solved = solved.with_placements(*eliminated.settled(arrays))
    return Solution(
        solved,
        float(summary.final_cost),
        summary.termination_type in _SUCCESS or _rests(run.history),
        _NOTHING_LEFT if summary.termination_type == pyceres.TerminationType.USER_SUCCESS else str(summary.message),
        tuple(run.history),
        not summary.IsSolutionUsable(),
    )


def placement_costs(
    sights: Sights,
    estimate: Estimate,
    weighting: Weighting,
    poses: Array,
    tolerance: float = 1e-6,
) -> tuple[Array, Array]:
    """Costs (S,) and cam_from_target (S, 3, 4) of one camera's sights after each placement alone was solved for.

    Args:
        poses: (S, 3, 4) where the search for each cam_from_target starts; a start from where an observation cannot be
            projected costs infinity. tolerance: relative, of each cost.
    """
    held = np.empty(0, dtype=np.int64)
    return EliminatedCost(Run(), sights, estimate, held, weighting).from_poses(poses, tolerance)


def settle_placements(sights: Sights, estimate: Estimate, layout: Layout, weighting: Weighting) -> Estimate:
    """The estimate with every private placement where it fits best, everything else held."""
    private = private_placements(sights, layout)
    for camera in estimate.cameras:
        own = sights.take(sights.numbers(camera, placements=private))
        if len(own):
            poses = estimate.pose_stack(own.keys)
            _, found = placement_costs(own, estimate, weighting, poses, _POSED)
            estimate = estimate.with_placements(own.keys, found)
    return estimate


def _rests(history: Sequence[float]) -> bool:
    """Whether the last iterations changed the cost by rounding alone: a redescending loss can go on like that."""
    last = history[-_AT_REST:]
    return len(last) == _AT_REST and max(last) - min(last) <= 1e-11 * max(last)


def private_placements(sights: Sights, layout: Layout) -> frozenset[str | None]:
    """Free placements that a single sight shows."""
    return layout.placements & sights.seen_once


def _require_enough(sights: Sights, layout: Layout) -> None:
    equations = sights.equations + sum(
        len(prior.value) for prior in layout.priors
    )  # each structure number has a prior of its own
    if equations < layout.unknowns:
        raise DegenerateError(
            f"{equations} measured numbers (two a point, one a curve observation or prior) cannot determine "
            f"{layout.unknowns} unknowns: add observations, or fix some of the unknowns"
        )


def _solver_options(
    layout: Layout,
    blocks: _Blocks,
    options: Options,
    weighting: Weighting,
    threads: int,
    watcher: _Watcher,
) -> Any:
    solver = pyceres.SolverOptions()
    kept = sum(len(free) for free in layout.free.values())
    kept += 6 * len(layout.stations) if blocks.placements else 0
    few = kept < _DENSE_LIMIT
    solver.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR if few else pyceres.LinearSolverType.SPARSE_SCHUR
    solver.max_num_iterations = options.max_iterations
    solver.function_tolerance = weighting.precision
    # Near the end of a convex problem plain Gauss-Newton is right, and phi against height creeps without it.
    if not weighting.rough and weighting.loss in ("trivial", "huber", "soft_l1"):
        solver.initial_trust_region_radius = 1e8
    solver.parameter_tolerance = 1e-12
    solver.gradient_tolerance = 1e-14
    # Short kernels are over before Python's lock is had; only parts of very large sights are worth a thread each.
    solver.num_threads = threads
    solver.logging_type = pyceres.LoggingType.SILENT
    solver.callbacks = [watcher]
    return solver


def _prior_blocks(layout: Layout, estimate: Estimate, blocks: _Blocks) -> Iterable[tuple[Any, Array]]:
    """The cost and the array of each prior on something free."""
    for prior in layout.priors:
        if prior.owner == "station":
            if prior.name in layout.stations:
                axes = np.array([2] if prior.quantity == "height_m" else [0, 1, 2])
                cost = PositionPriorCost(axes, np.asarray(prior.value), np.asarray(prior.sigma))
                yield cost, blocks.stations[prior.name]
            continue
        places, mean, sigma = prior_on_intrinsics(prior, estimate, layout.free)
        if len(places):
            array = blocks.cameras[prior.name]
            yield LinearPriorCost(places, mean, sigma, len(array)), array
    sigma_m, fresh = estimate.structure.sigma_m, own_structure(layout, estimate)
    if len(fresh):
        yield LinearPriorCost(fresh, np.zeros(len(fresh)), sigma_m[fresh], len(sigma_m)), blocks.structure


def own_structure(layout: Layout, estimate: Estimate) -> Indices:
    """Places of the structure numbers under their tolerance, not under the joint prior, which holds theirs."""
    known = frozenset() if layout.joint is None else layout.joint.structure_names
    return np.array([i for i, name in enumerate(estimate.structure.names) if name not in known], dtype=np.int64)


def prior_on_intrinsics(prior: Prior, estimate: Estimate, free: Mapping[str, Indices]) -> tuple[Indices, Array, Array]:
    """Places in the camera's block, mean and sigma in the solver's units; a number that is held needs no prior."""
    camera = estimate.cameras[prior.name]
    names = intrinsic_names(camera.lens)
    quantities = ("cx", "cy") if prior.quantity == "principal_point" else (prior.quantity,)
    wanted = np.array([names.index(quantity) for quantity in quantities])
    scales = intrinsics_scales(camera)[wanted]
    held = np.isin(wanted, free[prior.name])
    places = np.searchsorted(free[prior.name], wanted[held])
    return places, (np.asarray(prior.value) * scales)[held], (np.asarray(prior.sigma) * scales)[held]
