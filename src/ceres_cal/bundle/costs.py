"""The cost functions that Ceres calls: compressed sights, eliminated placements, priors (design, sections 5 and 6)."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
import pyceres
from numpy.typing import NDArray

from ceres_cal import kernels
from ceres_cal.parameters import Estimate, Layout
from ceres_cal.residuals import lens_arguments
from ceres_cal.sights import SightKey, Sights, nearest_places
from ceres_cal.transforms import Array, left_jacobian, rotation_exp, skew

_ROWS_WORTH_A_THREAD = 20_000
_NOTHING = np.empty(0)


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


@dataclass(eq=False)
class Run:
    """What the callbacks of one solve share: the first exception in any of them (Ctrl-C too) ends the solve."""

    failure: BaseException | None = None
    history: list[float] = field(default_factory=list)


class SightCost(pyceres.CostFunction):
    """The compressed block of one sight (design, section 6)."""

    def __init__(self, run: Run, sight: Sights, estimate: Estimate, layout: Layout, weighting: Weighting) -> None:
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
        self.slots = [
            slot
            for slot, is_free in enumerate(
                (len(free) > 0, key.station in layout.stations, key.placement in layout.placements)
            )
            if is_free
        ]
        self.set_num_residuals(len(free) + 7)
        self.set_parameter_block_sizes([(len(free), 6, 6)[slot] for slot in self.slots])

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        arguments = [_NOTHING, self._poses[0], self._poses[1]]
        outputs = [_NOTHING, _NOTHING, _NOTHING]
        for place, slot in enumerate(self.slots):
            arguments[slot] = parameters[place]
            if jacobians is not None:
                outputs[slot] = jacobians[place]
        try:
            return bool(kernels.evaluate_block(*self._static, *arguments, jacobians is not None, residuals, *outputs))
        except BaseException as error:  # an exception must not travel through C++: the solve ends, then it is raised
            self._run.failure = self._run.failure or error
            return False


class EliminatedCost(pyceres.CostFunction):
    """All sights of one camera whose placements no other station sees, over the camera's free intrinsics alone."""

    def __init__(
        self, run: Run, sights: Sights, estimate: Estimate, layout: Layout, weighting: Weighting, threads: int
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


class LinearPriorCost(pyceres.CostFunction):
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


class PositionPriorCost(pyceres.CostFunction):
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
