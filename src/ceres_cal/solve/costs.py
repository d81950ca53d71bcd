"""The cost functions of the observations that Ceres calls: compressed sights, eliminated placements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import pyceres
from numpy.typing import NDArray

from ceres_cal import kernels
from ceres_cal.base.arrays import Array
from ceres_cal.base.threads import parts_of, run_parts
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.residuals import lens_arguments, starting_feet
from ceres_cal.model.structure import Structure
from ceres_cal.observations.sights import SightKey, Sights
from ceres_cal.solve.problem import Problem, Weighting

ROWS_WORTH_A_THREAD = 20_000
NORMAL_NS = 60.0
"""That an observation's share of the normal equations takes."""
_NOTHING = np.empty(0)
_LEFT_TO_THE_COMPLEMENT = 1e-2  # of a sight's cost, by the step its pose would take


@dataclass(eq=False)
class Run:
    """What the callbacks of one solve share: the first exception in any of them (Ctrl-C too) ends the solve."""

    failure: BaseException | None = None
    history: list[float] = field(default_factory=list)


class SightCost(pyceres.CostFunction):
    """The compressed block of one sight (design, section 6).

    Attributes:
        slots: which of its camera (0), station (1), placement (2) and structure (3) the solver hands over; the others
            are held.
    """

    def __init__(self, run: Run, sight: Sights, problem: Problem, estimate: Estimate) -> None:
        super().__init__()
        self._run, self._sight, self._structure = run, sight, estimate.structure
        key, layout, weighting = sight.key, problem.layout, problem.weighting
        code, vector, powers, unit = lens_arguments(estimate.cameras[key.camera])
        free = layout.free[key.camera]
        self._static = (
            code, vector, free, powers, unit, *kernel_columns(sight, estimate.structure, weighting),
            starting_feet(sight, estimate, problem.feet),
            estimate.structure.track_slots, kernels.LOSS_CODES[weighting.loss], weighting.loss_scale,
        )  # fmt: skip
        self._poses = [estimate.stations[key.station].cam_from_world.log(), np.zeros(6)]
        if key.placement is not None:
            self._poses[1] = estimate.placements[key.placement].log()
        count = len(estimate.structure.values)
        sizes = (len(free), 6, 6, count)
        is_free = (len(free) > 0, key.station in layout.stations, key.placement in layout.placements, count > 0)
        self.slots = [slot for slot in range(4) if is_free[slot]]
        self._known: tuple[Array, Array, list[Array]] | None = None
        self.set_num_residuals(len(free) + count + 7)
        self.set_parameter_block_sizes([sizes[slot] for slot in self.slots])

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        try:
            at = np.concatenate(parameters)
            # Ceres asks for the cost of a step first, then for the Jacobian in the same place: once is enough.
            if self._known is None or not np.array_equal(self._known[0], at):
                self._known = self._evaluated(at, parameters)
        except BaseException as error:  # an exception must not travel through C++: the solve ends, then it is raised
            self._run.failure = self._run.failure or error
            return False
        if self._known is None:
            return False
        residuals[:] = self._known[1]
        for jacobian, known in zip(jacobians or (), self._known[2], strict=False):
            jacobian[:] = known
        return True

    def _evaluated(self, at: Array, parameters: Sequence[Array]) -> tuple[Array, Array, list[Array]] | None:
        """(place, residuals, flat Jacobians), or None where an observation cannot be projected from there."""
        arguments, outputs = [_NOTHING, *self._poses, _NOTHING], [_NOTHING] * 4
        rows = self.num_residuals()
        for place, slot in enumerate(self.slots):
            arguments[slot], outputs[slot] = parameters[place], np.empty(rows * len(parameters[place]))
        residuals = np.empty(rows)
        built = self._structure.with_values(arguments[3])
        answered = kernels.evaluate_block(
            *self._static, built.points(self._sight), built.tracks(self._sight), len(built.values), *arguments[:3],
            residuals, *outputs,
        )  # fmt: skip
        return (at, residuals, [outputs[slot] for slot in self.slots]) if answered else None


def kernel_columns(sights: Sights, structure: Structure, weighting: Weighting) -> tuple[NDArray[Any], ...]:
    """The observations as the kernels take them, but for points and tracks, which the structure moves."""
    moves = len(structure.values) > 0
    feature = sights.feature if moves else sights.feature[:0]
    return (
        sights.pixels,
        1.0 / (weighting.point_scale * sights.sigma_px),
        structure.point_slots[feature],
        structure.bends[feature],
        sights.is_arc,
        sights.track,
        sights.curve_pixels,
        1.0 / (weighting.curve_scale * sights.curve_sigma_px),
    )


class _Sweep(NamedTuple):
    """Placements at their best for given shared numbers.

    Attributes:
        poses: (S, 3, 4) cam_from_target. gains: (S, 6, shared) how they follow the shared numbers. costs: (S,).
        reduced: lower triangle of the normal equations that are left, the residual's row last.
    """

    poses: Array
    gains: Array
    costs: Array
    reduced: Array


@dataclass(frozen=True, eq=False)
class _Evaluation:
    """An EliminatedCost in one place: its numbers `at`, what Ceres is told, poses and gains (see `_Sweep`)."""

    at: Array
    residuals: Array
    jacobian: Array
    poses: Array
    gains: Array


class EliminatedCost(pyceres.CostFunction):
    """All sights of one camera whose placements no other station sees, over its free intrinsics and the structure."""

    def __init__(self, run: Run, sights: Sights, problem: Problem, estimate: Estimate) -> None:
        super().__init__()
        self.camera, weighting = sights.keys[0].camera, problem.weighting
        self._run, self._sights, self._structure = run, sights, estimate.structure
        self._optics = lens_arguments(estimate.cameras[self.camera])
        self._free = problem.layout.free[self.camera]
        pixels, weights, slots, bends, is_arc, track, curve_pixels, curve_weights = kernel_columns(
            sights, estimate.structure, weighting
        )
        self._observations = (
            sights.point_bounds, pixels, weights, slots, bends, is_arc, sights.curve_bounds, track, curve_pixels,
            curve_weights, starting_feet(sights, estimate, problem.feet), estimate.structure.track_slots,
        )  # fmt: skip
        self._loss = (kernels.LOSS_CODES[weighting.loss], weighting.loss_scale)
        sizes = (len(self._free), len(estimate.structure.values))
        self._size = sum(sizes)
        start = np.concatenate([self._optics[1][self._free], estimate.structure.values])
        poses, gains = estimate.pose_stack(sights.keys), np.zeros((len(sights), 6, self._size))
        # Every step starts from the poses of the last accepted one: a rejected step may have led them astray.
        self._accepted = _Evaluation(start, _NOTHING, _NOTHING, poses, gains)
        self._known: _Evaluation | None = None
        self._parts = parts_of(len(sights), len(sights.points) + len(sights.curve_pixels), NORMAL_NS)
        self.slots = [slot for slot, size in zip((0, 3), sizes, strict=True) if size]
        self.set_num_residuals(self._size + 1)
        self.set_parameter_block_sizes([size for size in sizes if size])

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        try:
            at = np.concatenate(parameters)
            # Ceres asks for the cost of a step first, then for the Jacobian in the same place: once is enough.
            if self._known is None or not np.array_equal(self._known.at, at):
                self._known = self._evaluated(at, _LEFT_TO_THE_COMPLEMENT)
        except BaseException as error:  # an exception must not travel through C++: the solve ends, then it is raised
            self._run.failure = self._run.failure or error
            return False
        if self._known is None:
            return False
        residuals[:] = self._known.residuals
        first = 0
        for jacobian in jacobians or ():
            size = len(jacobian) // (self._size + 1)
            jacobian[:] = self._known.jacobian[:, first : first + size].reshape(-1)
            first += size
        if jacobians is not None:  # asked for where a step was accepted, and nowhere else
            self._accepted = self._known
        return True

    def _evaluated(self, at: Array, tolerance: float) -> _Evaluation | None:
        """The cost in a place, or None where an observation cannot be projected from there."""
        upper = np.empty((self._size + 1, self._size + 1))
        for newton in (True, False):
            swept = self._swept(at, tolerance, newton)
            cost = float(np.sum(swept.costs))
            if not np.isfinite(cost):
                return None
            kernels.cholesky(swept.reduced, upper)
            residuals = upper[:, -1].copy()
            missing = cost - float(residuals[:-1] @ residuals[:-1])
            if missing > -kernels.ROUNDING * cost:  # else Newton's step promises more than there is
                break
        residuals[-1] = np.sqrt(max(missing, 0.0))
        upper[-1] = 0.0
        return _Evaluation(at, residuals, upper[:, :-1], swept.poses, swept.gains)

    def _swept(self, at: Array, tolerance: float, newton: bool = True) -> _Sweep:
        """Every placement brought to its best in a place, from the last accepted one."""
        count = len(self._free)
        code, intrinsics, powers, unit = self._optics
        intrinsics = intrinsics.copy()
        intrinsics[self._free] = at[:count]
        built = self._structure.with_values(at[count:])
        points, tracks = built.points(self._sights), built.tracks(self._sights)
        poses, gains, costs = self._accepted.poses.copy(), self._accepted.gains.copy(), np.empty(len(self._sights))

        def part(first: int, last: int) -> Array:
            reduced = np.zeros((self._size + 1, self._size + 1))
            kernels.eliminate_placements(
                first, last, code, intrinsics, self._free, powers, unit, *self._observations, *self._loss, newton,
                points, tracks, self._size - count, tolerance, at - self._accepted.at, poses, gains, costs, reduced,
            )  # fmt: skip
            return reduced

        return _Sweep(poses, gains, costs, np.sum(run_parts(part, self._parts), axis=0))

    def from_poses(self, poses: Array, tolerance: float) -> tuple[Array, Array]:
        """Costs (S,) and poses (S, 3, 4) that the search for each placement ends with when it starts from `poses`,
        everything else held; an infinite cost where a start cannot be seen.
        """
        self._accepted = replace(self._accepted, poses=poses, gains=np.zeros_like(self._accepted.gains))
        swept = self._swept(self._accepted.at, tolerance)
        return swept.costs, swept.poses

    def converged(self, parameters: Sequence[Array]) -> tuple[tuple[SightKey, ...], Array]:
        """The sights' keys and their cam_from_target, (S, 3, 4), at their best for these numbers."""
        at = np.concatenate([_NOTHING, *parameters])
        # At rest they have come to rest as well; elsewhere, or where Ceres had nothing to move, they are sought.
        if not len(self._accepted.residuals) or not np.array_equal(self._accepted.at, at):
            self._accepted = self._evaluated(at, 1e-14) or self._accepted
        return self._sights.keys, self._accepted.poses
