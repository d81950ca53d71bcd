"""The one nonlinear least-squares problem, in Ceres: blocks, losses, priors, solve (design, sections 5 and 6).

The only module that imports pyceres. Placements that a single station sees are eliminated inside one block per camera,
over its free intrinsics alone; every other sight is one compressed block over its camera's free intrinsics, its station
and its placement; each prior is one small block. What Ceres minimises is the same function either way.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyceres
from numpy.typing import NDArray

from ceres_cal import kernels
from ceres_cal.errors import DegenerateError
from ceres_cal.observations import Prior
from ceres_cal.parameters import (
    Estimate,
    Layout,
    Options,
    Station,
    intrinsic_names,
    intrinsics_scales,
    intrinsics_vector,
    with_intrinsics,
)
from ceres_cal.residuals import lens_arguments
from ceres_cal.sights import SightKey, Sights, nearest_places
from ceres_cal.transforms import Array, Pose, left_jacobian, rotation_exp, skew

_DENSE_LIMIT = 600  # numbers that stay after the Schur complement; above it a sparse factorisation is faster


@dataclass(frozen=True)
class Weighting:
    """How residuals become costs, and how far down the cost is followed.

    Attributes:
        point_scale, curve_scale: noise scales, factors on the stated sigmas.
        loss, loss_scale: robust loss of each observation, its scale in standard deviations.
        precision: relative change of the cost at which the solve ends.
    """

    point_scale: float = 1.0
    curve_scale: float = 1.0
    loss: str = "huber"
    loss_scale: float = 3.0
    precision: float = 1e-12


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
    """

    estimate: Estimate
    cost: float
    converged: bool
    termination: str
    history: tuple[float, ...]


@dataclass(eq=False)
class _Blocks:
    """The arrays that Ceres moves, by name; the caller's estimate is never touched."""

    cameras: dict[str, Array]
    stations: dict[str, Array]
    placements: dict[str, Array]

    @classmethod
    def pack(cls, estimate: Estimate, layout: Layout, eliminated: Container[str | None]) -> _Blocks:
        return cls(
            {name: intrinsics_vector(camera)[layout.free[name]] for name, camera in estimate.cameras.items()},
            {name: station.cam_from_world.log() for name, station in estimate.stations.items()},
            {name: pose.log() for name, pose in estimate.placements.items() if name not in eliminated},
        )

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
        placements = {
            name: Pose.exp(self.placements[name]) if name in layout.placements and name in self.placements else old
            for name, old in estimate.placements.items()
        }
        return Estimate(cameras, stations, placements)


@dataclass(eq=False)
class _Run:
    """What the callbacks of one solve share: the first exception in any of them (Ctrl-C too) ends the solve."""

    failure: BaseException | None = None
    history: list[float] = field(default_factory=list)


_NOTHING = np.empty(0)
_ROWS_WORTH_A_THREAD = 20_000


class _SightCost(pyceres.CostFunction):
    """The compressed block of one sight (design, section 6)."""

    def __init__(self, run: _Run, sight: Sights, estimate: Estimate, layout: Layout, weighting: Weighting) -> None:
        super().__init__()
        self._run = run
        key = sight.key
        camera = estimate.cameras[key.camera]
        code, vector, powers, unit = lens_arguments(camera)
        free = layout.free[key.camera]
        self._static = (
            code,
            vector,
            free,
            powers,
            unit,
            sight.points,
            sight.pixels,
            1.0 / (weighting.point_scale * sight.sigma_px),
            sight.tracks,
            sight.is_arc,
            sight.track,
            sight.curve_pixels,
            1.0 / (weighting.curve_scale * sight.curve_sigma_px),
            nearest_places(sight, estimate.camera_at(key.station, key.placement)),
            kernels.LOSS_CODES[weighting.loss],
            weighting.loss_scale,
        )
        self._poses = [estimate.stations[key.station].cam_from_world.log(), np.zeros(6)]
        if key.placement is not None:
            self._poses[1] = estimate.placements[key.placement].log()
        # Which of the three arguments the solver hands over; the others are held.
        self._slots = [
            slot
            for slot, is_free in enumerate(
                (len(free) > 0, key.station in layout.stations, key.placement in layout.placements)
            )
            if is_free
        ]
        self.set_num_residuals(len(free) + 7)
        self.set_parameter_block_sizes([(len(free), 6, 6)[slot] for slot in self._slots])

    def arrays(self, key: SightKey, blocks: _Blocks) -> list[Array]:
        """The arrays of the slots that are free, in their order."""
        placement = blocks.placements[key.placement] if key.placement is not None else _NOTHING
        every = (blocks.cameras[key.camera], blocks.stations[key.station], placement)
        return [every[slot] for slot in self._slots]

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        arguments = [_NOTHING, self._poses[0], self._poses[1]]
        outputs = [_NOTHING, _NOTHING, _NOTHING]
        for place, slot in enumerate(self._slots):
            arguments[slot] = parameters[place]
            if jacobians is not None:
                outputs[slot] = jacobians[place]
        try:
            return bool(kernels.evaluate_block(*self._static, *arguments, jacobians is not None, residuals, *outputs))
        except BaseException as error:  # an exception must not travel through C++: the solve ends, then it is raised
            self._run.failure = self._run.failure or error
            return False


class _EliminatedCost(pyceres.CostFunction):
    """All sights of one camera whose placements no other station sees, over the camera's free intrinsics alone."""

    def __init__(
        self, run: _Run, sights: Sights, estimate: Estimate, layout: Layout, weighting: Weighting, threads: int
    ) -> None:
        super().__init__()
        self._run = run
        self.camera = sights.keys[0].camera
        self._optics = lens_arguments(estimate.cameras[self.camera])
        self._free = layout.free[self.camera]
        self._sights = sights
        places = [nearest_places(s, estimate.camera_at(s.key.station, s.key.placement)) for s in _with_curves(sights)]
        self._observations = (
            sights.point_bounds,
            sights.points,
            sights.pixels,
            1.0 / (weighting.point_scale * sights.sigma_px),
            sights.tracks,
            sights.is_arc,
            sights.curve_bounds,
            sights.track,
            sights.curve_pixels,
            1.0 / (weighting.curve_scale * sights.curve_sigma_px),
            np.concatenate([_NOTHING, *places]),
        )
        self._loss = (kernels.LOSS_CODES[weighting.loss], weighting.loss_scale)
        self._precision = weighting.precision
        self._poses = estimate.pose_stack(sights.keys)
        self._gains = np.zeros((len(sights), 6, len(self._free)))
        self._at = self._optics[1][self._free]
        self._known: tuple[Array, Array, Array] | None = None
        work = len(sights.points) + len(sights.curve_pixels)
        parts = max(1, min(threads, work // _ROWS_WORTH_A_THREAD))
        self._parts = np.linspace(0, len(sights), parts + 1).astype(int).tolist()
        self.set_num_residuals(len(self._free) + 1)
        self.set_parameter_block_sizes([len(self._free)])

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        try:
            # Ceres asks for the cost of a step first, then for the Jacobian in the same place: once is enough.
            if self._known is None or not np.array_equal(self._known[0], parameters[0]):
                self._known = self._evaluated(parameters[0].copy(), max(1e-4, 10.0 * self._precision))
        except BaseException as error:  # an exception must not travel through C++: the solve ends, then it is raised
            self._run.failure = self._run.failure or error
            return False
        if self._known is None:
            return False
        residuals[:] = self._known[1]
        if jacobians is not None:
            jacobians[0][:] = self._known[2]
        return True

    def _evaluated(self, at: Array, tolerance: float) -> tuple[Array, Array, Array] | None:
        """(place, residuals, flat Jacobian), or None where an observation cannot be projected from there."""
        count = len(self._free)
        before = self._poses.copy()
        code, intrinsics, powers, unit = self._optics
        intrinsics = intrinsics.copy()
        intrinsics[self._free] = at

        def part(first: int, last: int) -> tuple[float, Array]:
            reduced = np.zeros((count + 1, count + 1))
            cost = kernels.eliminate_placements(
                first, last, code, intrinsics, self._free, powers, unit, *self._observations, *self._loss, tolerance,
                at - self._at, self._poses, self._gains, reduced,
            )  # fmt: skip
            return cost, reduced

        if len(self._parts) == 2:
            results = [part(*self._parts)]
        else:
            with ThreadPoolExecutor(len(self._parts) - 1) as pool:
                results = list(pool.map(part, self._parts[:-1], self._parts[1:]))
        cost = sum(result[0] for result in results)
        if not np.isfinite(cost):
            self._poses[:] = before
            self._gains[:] = 0.0
            self._at = at
            return None
        self._at = at
        upper = np.empty((count + 1, count + 1))
        kernels.cholesky(sum(result[1] for result in results), upper)
        residuals = upper[:, count].copy()
        residuals[count] = np.sqrt(max(cost - float(residuals[:count] @ residuals[:count]), 0.0))
        upper[count] = 0.0
        return at, residuals, upper[:, :count].reshape(-1)

    def settled(self, at: Array) -> tuple[tuple[SightKey, ...], Array]:
        """The sights' keys and their cam_from_target, (S, 3, 4), at their best for these intrinsics."""
        self._evaluated(at.copy(), self._precision)
        return self._sights.keys, self._poses


def _with_curves(sights: Sights) -> list[Sights]:
    return [sights[int(number)] for number in np.flatnonzero(np.diff(sights.curve_bounds))]


class _LinearPriorCost(pyceres.CostFunction):
    """(value - mean) / sigma of some free intrinsics of one camera."""

    def __init__(self, places: NDArray[np.int64], mean: Array, sigma: Array, size: int) -> None:
        super().__init__()
        self._places, self._mean, self._sigma = places, mean, sigma
        self.set_num_residuals(len(places))
        self.set_parameter_block_sizes([size])

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        residuals[:] = (parameters[0][self._places] - self._mean) / self._sigma
        if jacobians is not None:
            jacobian = jacobians[0].reshape(len(residuals), -1)
            jacobian[:] = 0.0
            jacobian[np.arange(len(residuals)), self._places] = 1.0 / self._sigma
        return True


class _PositionPriorCost(pyceres.CostFunction):
    """(position - mean) / sigma of a station, on some axes: position = -R^T t."""

    def __init__(self, axes: NDArray[np.int64], mean: Array, sigma: Array) -> None:
        super().__init__()
        self._axes, self._mean, self._sigma = axes, mean, sigma
        self.set_num_residuals(len(axes))
        self.set_parameter_block_sizes([6])

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        vector = parameters[0]
        inverse = rotation_exp(vector[:3]).T
        residuals[:] = ((-inverse @ vector[3:])[self._axes] - self._mean) / self._sigma
        if jacobians is not None:
            turned = -inverse @ skew(vector[3:]) @ left_jacobian(vector[:3])
            jacobians[0].reshape(-1, 6)[:] = np.hstack([turned, -inverse])[self._axes] / self._sigma[:, None]
        return True


class _Watcher(pyceres.IterationCallback):
    """Passes progress on, and ends the solve when a callback has failed or Ctrl-C was pressed."""

    def __init__(self, run: _Run, progress: Callable[[Progress], None] | None) -> None:
        super().__init__()
        self._run, self._progress = run, progress

    def __call__(self, summary: Any) -> Any:
        try:
            self._run.history.append(float(summary.cost))
            if self._progress is not None:
                self._progress(Progress(int(summary.iteration), float(summary.cost), float(summary.step_norm)))
        except BaseException as error:
            self._run.failure = self._run.failure or error
        stop = self._run.failure is not None
        return pyceres.CallbackReturnType.SOLVER_ABORT if stop else pyceres.CallbackReturnType.SOLVER_CONTINUE


def solve(
    sights: Sights,
    estimate: Estimate,
    layout: Layout,
    weighting: Weighting,
    options: Options,
    progress: Callable[[Progress], None] | None = None,
) -> Solution:
    """Minimise the robust cost over everything free, from `estimate`.

    Raises:
        DegenerateError: fewer observations than free numbers.
    """
    _require_enough(sights, layout)
    run = _Run()
    threads = options.threads or min(os.cpu_count() or 1, 8)
    private = _private_placements(sights, layout)
    blocks = _Blocks.pack(estimate, layout, private)
    problem = pyceres.Problem()
    eliminated: list[_EliminatedCost] = []
    others: list[_SightCost] = []
    for camera in estimate.cameras:
        own = np.array([i for i, key in enumerate(sights.keys) if key.camera == camera and key.placement in private])
        if len(own):
            eliminated.append(_EliminatedCost(run, sights.take(own), estimate, layout, weighting, threads))
            if len(blocks.cameras[camera]):
                problem.add_residual_block(eliminated[-1], None, [blocks.cameras[camera]])
    for number, key in enumerate(sights.keys):
        if key.placement not in private:
            others.append(_SightCost(run, sights[number], estimate, layout, weighting))
            if arrays := others[-1].arrays(key, blocks):
                problem.add_residual_block(others[-1], None, arrays)
    prior_costs = list(_prior_blocks(layout, estimate, blocks))
    for prior_cost, array in prior_costs:
        problem.add_residual_block(prior_cost, None, [array])
    summary = pyceres.SolverSummary()
    pyceres.solve(_solver_options(layout, blocks, options, weighting, _Watcher(run, progress)), problem, summary)
    if run.failure is not None:
        raise run.failure
    solved = blocks.unpack(estimate, layout)
    placements = dict(solved.placements)
    for cost in eliminated:
        placements |= _placed(solved, *cost.settled(blocks.cameras[cost.camera]))
    return Solution(
        Estimate(solved.cameras, solved.stations, placements),
        float(summary.final_cost),
        summary.termination_type == pyceres.TerminationType.CONVERGENCE,
        str(summary.message),
        tuple(run.history),
    )


def _private_placements(sights: Sights, layout: Layout) -> frozenset[str | None]:
    """Free placements that a single sight shows."""
    seen = Counter(key.placement for key in sights.keys)
    return frozenset(name for name, times in seen.items() if times == 1 and name in layout.placements)


def _placed(estimate: Estimate, keys: Sequence[SightKey], cam_from_target: Array) -> dict[str, Pose]:
    """world_from_target of each key's placement."""
    stations = {name: station.cam_from_world.inverse for name, station in estimate.stations.items()}
    first = np.array([stations[key.station].rotation for key in keys])
    offset = np.array([stations[key.station].translation for key in keys])
    rotations = first @ cam_from_target[:, :, :3]
    translations = np.einsum("sij,sj->si", first, cam_from_target[:, :, 3]) + offset
    return {str(key.placement): Pose(r, t) for key, r, t in zip(keys, rotations, translations, strict=True)}


def _require_enough(sights: Sights, layout: Layout) -> None:
    equations = 2 * len(sights.point_rows) + len(sights.curve_rows)
    equations += sum(len(prior.value) for prior in layout.priors)
    if equations < layout.size:
        raise DegenerateError(
            f"{equations} measured numbers (two a point, one a curve observation or prior) cannot determine "
            f"{layout.size} unknowns: add observations, or fix some of the unknowns"
        )


def _solver_options(layout: Layout, blocks: _Blocks, options: Options, weighting: Weighting, watcher: _Watcher) -> Any:
    solver = pyceres.SolverOptions()
    kept = sum(len(free) for free in layout.free.values())
    kept += 6 * len(layout.stations) if blocks.placements else 0
    few = kept < _DENSE_LIMIT
    solver.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR if few else pyceres.LinearSolverType.SPARSE_SCHUR
    solver.max_num_iterations = options.max_iterations
    solver.function_tolerance = weighting.precision
    solver.parameter_tolerance = 1e-12
    solver.gradient_tolerance = 1e-14
    solver.num_threads = 1  # the kernels are shorter than the wait for Python's lock
    solver.logging_type = pyceres.LoggingType.SILENT
    solver.callbacks = [watcher]
    return solver


def _prior_blocks(layout: Layout, estimate: Estimate, blocks: _Blocks) -> Iterable[tuple[Any, Array]]:
    """The cost and the array of each prior on something free."""
    for prior in layout.priors:
        if prior.owner == "station":
            if prior.name in layout.stations:
                axes = np.array([2] if prior.quantity == "height_m" else [0, 1, 2])
                cost = _PositionPriorCost(axes, np.asarray(prior.value), np.asarray(prior.sigma))
                yield cost, blocks.stations[prior.name]
            continue
        places, mean, sigma = _prior_on_intrinsics(prior, estimate, layout.free)
        if len(places):
            array = blocks.cameras[prior.name]
            yield _LinearPriorCost(places, mean, sigma, len(array)), array


def _prior_on_intrinsics(
    prior: Prior, estimate: Estimate, free: Mapping[str, NDArray[np.int64]]
) -> tuple[NDArray[np.int64], Array, Array]:
    """Places in the camera's block, mean and sigma in the solver's units; a number that is held needs no prior."""
    camera = estimate.cameras[prior.name]
    names = intrinsic_names(camera.lens)
    quantities = ("cx", "cy") if prior.quantity == "principal_point" else (prior.quantity,)
    wanted = np.array([names.index(quantity) for quantity in quantities])
    scales = intrinsics_scales(camera)[wanted]
    held = np.isin(wanted, free[prior.name])
    places = np.searchsorted(free[prior.name], wanted[held])
    return places, (np.asarray(prior.value) * scales)[held], (np.asarray(prior.sigma) * scales)[held]
