"""The one nonlinear least-squares problem, in Ceres: blocks, losses, priors, solve (design, sections 5 and 6).

The only module that imports pyceres. Each sight is one compressed block over its camera's free intrinsics, its station
and its placement; each prior is one small block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
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
from ceres_cal.sights import Sight, nearest_places
from ceres_cal.transforms import Array, Pose, left_jacobian, rotation_exp, skew

_DENSE_LIMIT = 600  # numbers that stay after the Schur complement; above it a sparse factorisation is faster


@dataclass(frozen=True)
class Weighting:
    """How residuals become costs: the noise scale of points and of curves (times the stated sigmas), and the loss."""

    point_scale: float = 1.0
    curve_scale: float = 1.0
    loss: str = "huber"
    loss_scale: float = 3.0


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
    def pack(cls, estimate: Estimate, layout: Layout) -> _Blocks:
        return cls(
            {name: intrinsics_vector(camera)[layout.free[name]].copy() for name, camera in estimate.cameras.items()},
            {name: station.cam_from_world.log() for name, station in estimate.stations.items()},
            {name: pose.log() for name, pose in estimate.placements.items()},
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
            name: Pose.exp(self.placements[name]) if name in layout.placements else old
            for name, old in estimate.placements.items()
        }
        return Estimate(cameras, stations, placements)


@dataclass(eq=False)
class _Run:
    """What the callbacks of one solve share: the first exception in any of them (Ctrl-C too) ends the solve."""

    failure: BaseException | None = None
    history: list[float] = field(default_factory=list)


_NOTHING = np.empty(0)


class _SightCost(pyceres.CostFunction):
    """The compressed block of one sight."""

    def __init__(self, run: _Run, sight: Sight, estimate: Estimate, layout: Layout, weighting: Weighting) -> None:
        super().__init__()
        self._run = run
        camera = estimate.cameras[sight.camera]
        code, vector, powers, unit = lens_arguments(camera)
        free = layout.free[sight.camera]
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
            nearest_places(sight, estimate.camera_at(sight.station, sight.placement)),
            kernels.LOSS_CODES[weighting.loss],
            weighting.loss_scale,
        )
        self._poses = [estimate.stations[sight.station].cam_from_world.log(), np.zeros(6)]
        if sight.placement is not None:
            self._poses[1] = estimate.placements[sight.placement].log()
        # Which of the three arguments the solver hands over; the others are held.
        self._slots = [
            slot
            for slot, is_free in enumerate(
                (len(free) > 0, sight.station in layout.stations, sight.placement in layout.placements)
            )
            if is_free
        ]
        self.set_num_residuals(len(free) + 7)
        self.set_parameter_block_sizes([(len(free), 6, 6)[slot] for slot in self._slots])

    def blocks(self, sight: Sight, blocks: _Blocks) -> list[Array]:
        """The arrays of the slots that are free, in their order."""
        placement = blocks.placements[sight.placement] if sight.placement is not None else _NOTHING
        every = (blocks.cameras[sight.camera], blocks.stations[sight.station], placement)
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
    sights: Sequence[Sight],
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
    blocks = _Blocks.pack(estimate, layout)
    problem = pyceres.Problem()
    costs = [_SightCost(run, sight, estimate, layout, weighting) for sight in sights]
    for cost, sight in zip(costs, sights, strict=True):
        if arrays := cost.blocks(sight, blocks):
            problem.add_residual_block(cost, None, arrays)
    prior_costs = list(_prior_blocks(layout, estimate, blocks))
    for prior_cost, array in prior_costs:
        problem.add_residual_block(prior_cost, None, [array])
    summary = pyceres.SolverSummary()
    pyceres.solve(_solver_options(layout, sights, options, _Watcher(run, progress)), problem, summary)
    if run.failure is not None:
        raise run.failure
    return Solution(
        blocks.unpack(estimate, layout),
        float(summary.final_cost),
        summary.termination_type == pyceres.TerminationType.CONVERGENCE,
        str(summary.message),
        tuple(run.history),
    )


def _require_enough(sights: Sequence[Sight], layout: Layout) -> None:
    equations = sum(2 * len(s.point_rows) + len(s.curve_rows) for s in sights)
    equations += sum(len(prior.value) for prior in layout.priors)
    if equations < layout.size:
        raise DegenerateError(
            f"{equations} measured numbers (two a point, one a curve observation or prior) cannot determine "
            f"{layout.size} unknowns: add observations, or fix some of the unknowns"
        )


def _solver_options(layout: Layout, sights: Sequence[Sight], options: Options, watcher: _Watcher) -> Any:
    solver = pyceres.SolverOptions()
    kept = sum(len(free) for free in layout.free.values())
    kept += 6 * len(layout.stations) if layout.placements else 0
    few = kept < _DENSE_LIMIT
    solver.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR if few else pyceres.LinearSolverType.SPARSE_SCHUR
    solver.max_num_iterations = options.max_iterations
    solver.function_tolerance = 1e-12
    solver.parameter_tolerance = 1e-12
    solver.gradient_tolerance = 1e-14
    solver.num_threads = options.threads or 1
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
