"""Cost functions of the observations and of priors.

Ceres calls them. They keep the last value, and an exception ends the solve instead of passing through C++.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import add
from typing import Any, NamedTuple

import numpy as np
import pyceres

from ceres_cal import kernels
from ceres_cal.base import Array, Frozen, Pose, left_jacobian, parts_of, replace, rotation_log, run_parts, skew
from ceres_cal.observations.sights import STRUCTURE, Owner, SightKey, Sights
from ceres_cal.problem.information import STATION_QUANTITIES, columns_by_owner
from ceres_cal.problem.parameters import Chart, Estimate, Layout, intrinsic_names, intrinsics_scales
from ceres_cal.problem.priors import USUAL_BENDS, GaussianPrior
from ceres_cal.problem.problem import Problem, Weighting
from ceres_cal.problem.residuals import camera_optics, curve_columns, point_columns, starting_feet
from ceres_cal.problem.structure import Structure


@dataclass(eq=False)
class Run:
    """The state that the callbacks of one solve share: the first exception in any of them, also Ctrl-C, ends the solve.

    It is a context manager in which each callback works. An exception is raised again when Ceres has returned.
    """

    failure: BaseException | None = None
    history: list[float] = field(default_factory=list)

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        self.failure = self.failure or error
        return error is not None


class CostValue(NamedTuple):
    """A value of a cost: the parameters `at`, the residuals (N,) and the flat Jacobian (N, size) by each block."""

    at: Array
    residuals: Array
    jacobians: Sequence[Array]


Evaluated = Callable[[Array, Sequence[Array]], CostValue]
"""A function of all parameters, given as one vector and by blocks, that returns a cost value."""

CostFunction: Any = pyceres.CostFunction  # pyceres has no types


class CachedCost(CostFunction):
    """A cost function that keeps its last value.

    `evaluated`, given all parameters as one vector and by blocks, returns the value, or None where an observation
    cannot be projected. It is no abstract method, because pyceres' metaclass does not permit any.

    Attributes:
        owners: the owners of the blocks that the solver passes; all other numbers are held.
        charts: for owners whose numbers Ceres moves in other coordinates.
    """

    evaluated: Callable[[Array, Sequence[Array]], CostValue | None]
    owners: list[Owner]
    charts: Mapping[Owner, Chart]

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.charts = {}
        self._run = run
        self._known: CostValue | None = None

    def _take(self, sizes: Mapping[Owner, int], residuals: int) -> None:
        """Set the sizes of the parameter blocks, by owner, and the number of residuals."""
        self.owners = list(sizes)
        self.set_num_residuals(residuals)
        self.set_parameter_block_sizes(list(sizes.values()))

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        with self._run:
            charts = [self.charts.get(owner) for owner in self.owners]
            blocks = [chart.numbers(one) if chart else one for chart, one in zip(charts, parameters, strict=True)]
            at = np.concatenate(blocks) if len(blocks) > 1 else blocks[0].copy()
            # Ceres asks for the cost of a step first, then for the Jacobian at the same point: one evaluation is
            # enough.
            if self._known is None or self._known.at.tobytes() != at.tobytes():
                self._known = self.evaluated(at, blocks)
            if self._known is None:
                return False
            residuals[:] = self._known.residuals
            for chart, block, jacobian, there in zip(
                charts, blocks, jacobians or (), self._known.jacobians, strict=False
            ):
                jacobian[:] = chart.chained(there.reshape(len(residuals), -1), block).reshape(-1) if chart else there
            if jacobians is not None:
                self._accept()
            return True
        return False

    def _accept(self) -> None:
        """Accept the last point: Ceres asks for Jacobians only where it has accepted a step."""


ROWS_WORTH_A_THREAD = 20_000
NORMAL_NS = 60.0
"""Time (ns) that the normal equations take for each observation."""
# Share of a sight's cost that its pose may still gain: the Schur complement includes such a step exactly, to second
# order. Halving or doubling moves the answer by less than 1 % of its error.
_LEFT_TO_THE_COMPLEMENT = 1e-2


class _SightsCost(CachedCost):
    """The cost of sights of one camera."""

    def __init__(self, run: Run, sights: Sights, problem: Problem, estimate: Estimate) -> None:
        super().__init__(run)
        self.camera: str = sights.keys[0].camera
        self._sights, self._structure, weighting = sights, estimate.structure, problem.weighting
        feet = starting_feet(sights, estimate, problem.feet)
        self._optics = camera_optics(estimate.cameras[self.camera])
        self._unknowns = kernels.Unknowns(problem.layout.free[self.camera], len(self._structure.offsets))
        self._points = point_columns(sights, self._structure, weighting.point_scale)
        self._curves = curve_columns(sights, self._structure, feet, weighting.curve_scale)
        self._loss = kernel_loss(weighting)

    def _as_built(self, structure: Structure) -> tuple[kernels.PointColumns, kernels.CurveColumns]:
        """The columns with points and tracks where the structure has them."""
        if not len(structure.values):
            return self._points, self._curves
        points, tracks = structure.points(self._sights), structure.tracks(self._sights)
        return self._points._replace(places=points), self._curves._replace(tracks=tracks)


class SightCost(_SightsCost):
    """The compressed block of one sight (design, section 6)."""

    def __init__(self, run: Run, sight: Sights, problem: Problem, estimate: Estimate) -> None:
        super().__init__(run, sight, problem, estimate)
        key, layout, free, count = sight.key, problem.layout, self._unknowns.free, len(self._structure.values)
        self._poses = [estimate.stations[key.station].cam_from_world.log(), np.zeros(6)]
        if key.placement is not None:
            self._poses[1] = estimate.placements[key.placement].log()
        sizes = len(free), 6 * (key.station in layout.stations), 6 * (key.placement in layout.placements), count
        self._slots = [slot for slot in range(len(sizes)) if sizes[slot]]
        taken = {key.owners[slot]: sizes[slot] for slot in self._slots}
        self._take(taken, len(free) + self._unknowns.structure + 7)

    def block(self, parameters: Sequence[Array]) -> Array | None:
        """(N, K + 1) the Jacobians side by side, then the residuals; None where an observation cannot be projected."""
        known = self.evaluated(kernels.NOTHING, parameters)
        if known is None:
            return None
        return np.column_stack([*(each.reshape(self.num_residuals(), -1) for each in known.jacobians), known.residuals])

    def evaluated(self, at: Array, parameters: Sequence[Array]) -> CostValue | None:
        structure = 3  # slot
        numbers, jacobians = [kernels.NOTHING, *self._poses, kernels.NOTHING], [kernels.NOTHING] * 4
        rows, mixing = self.num_residuals(), self._structure.mixing
        for place, slot in enumerate(self._slots):
            size = self._unknowns.structure if slot == structure else len(parameters[place])
            numbers[slot], jacobians[slot] = parameters[place], np.empty(rows * size)
        residuals = np.empty(rows)
        points, curves = self._as_built(self._structure.with_values(numbers[structure]))
        answered = kernels.evaluate_block(
            self._optics, self._unknowns, points, curves, self._loss, kernels.Blocks(*numbers), residuals,
            kernels.Blocks(*jacobians),
        )  # fmt: skip
        if mixing is not None:
            jacobians[structure] = (jacobians[structure].reshape(rows, -1) @ mixing).reshape(-1)
        return CostValue(at, residuals, [jacobians[slot] for slot in self._slots]) if answered else None


def kernel_loss(weighting: Weighting) -> kernels.Loss:
    """The loss in the form that the kernels take."""
    return kernels.Loss(kernels.LOSS_CODES[weighting.loss], weighting.loss_scale)


def robust_weights(weighting: Weighting, squared: Array) -> Array:
    """(N,) the weight rho' of each squared residual in the solve."""
    weights = np.empty(len(squared))
    kernels.loss_weights(kernel_loss(weighting), squared, weights)
    return weights


class _Evaluation(Frozen):
    """The value of an EliminatedCost: its numbers `at`, what Ceres receives, poses and gains (see `kernels.Sweep`), and
    the length of the step to it, in standard deviations.
    """

    at: Array
    residuals: Array
    jacobian: Array
    poses: Array
    gains: Array
    step: float = 0.0


class EliminatedCost(_SightsCost):
    """All sights of one camera whose placements no other station sees, over its free intrinsics and the structure, with
    the priors on these intrinsics: as separate blocks, these would take Ceres as long as all sights.
    """

    def __init__(
        self, run: Run, sights: Sights, problem: Problem, estimate: Estimate, stated: Sequence[Evaluated] = ()
    ) -> None:
        super().__init__(run, sights, problem, estimate)
        free, count = self._unknowns.free, len(self._structure.values)
        self._size = len(free) + count
        start = np.concatenate([self._optics.intrinsics[free], self._structure.values])
        # From the numbers to the offsets, which the kernels work with; None where these are the same.
        self._chain, lead = self._structure.chain(len(free), 1), len(free) + self._unknowns.structure
        poses, gains = estimate.pose_stack(sights.keys), np.zeros((len(sights), 6, lead))
        # Every step starts from the poses of the last accepted one: a rejected step may have moved them to another
        # minimum.
        self._accepted = _Evaluation(start, kernels.NOTHING, np.zeros((1, self._size)), poses, gains)
        self._last = self._accepted
        self._smooth, self._stated = _smoothness(problem, estimate, self.camera, self._size), stated
        self._parts = parts_of(len(sights), len(sights.points) + len(sights.curve_pixels), NORMAL_NS)
        sizes = {("camera", self.camera): len(free), STRUCTURE: count}
        self._take({owner: size for owner, size in sizes.items() if size}, self._size + 1)
        self._blocks = [slice(first, last) for first, last in ((0, len(free)), (len(free), self._size)) if last > first]

    def evaluated(self, at: Array, parameters: Sequence[Array]) -> CostValue | None:
        along = self._accepted.jacobian @ (at - self._accepted.at)
        step = float(np.linalg.norm(along))
        last = self._followed(at, along, step) or self._eliminated(at, _LEFT_TO_THE_COMPLEMENT, step)
        if last is None:
            return None
        self._last = last
        return CostValue(at, last.residuals, [last.jacobian[:, own].reshape(-1) for own in self._blocks])

    def _accept(self) -> None:
        self._accepted = self._last

    def _followed(self, at: Array, along: Array, step: float) -> _Evaluation | None:
        """The value after a step so short that the equations of the last accepted point predict it. None if more than
        rounding may be missing, assuming that steps shrink as fast as they did; if the step is not all that these
        equations ask for; or if the last value was predicted already.
        """
        nothing, before = 1e-6, self._accepted  # standard deviations that count as rounding
        if step * step >= nothing * (before.step - step):
            return None
        residuals = before.residuals + along
        if np.linalg.norm(residuals[:-1]) > nothing:
            return None
        return replace(before, at=at, residuals=residuals, poses=self._swept(at, np.inf).poses, step=0.0)

    def _eliminated(self, at: Array, tolerance: float, step: float = 0.0) -> _Evaluation | None:
        """The value with placements eliminated; None where an observation cannot be projected."""
        upper = np.empty((self._size + 1, self._size + 1))
        for newton in (True, False):
            swept = self._swept(at, tolerance, newton)
            cost = float(np.sum(swept.costs)) + self._add_known(at, swept.reduced)
            if not np.isfinite(cost):
                return None
            kernels.cholesky(swept.reduced, upper)
            residuals = upper[:, -1].copy()
            missing = cost - float(residuals[:-1] @ residuals[:-1])
            if missing > -kernels.ROUNDING * cost:  # otherwise Newton's step promises more than the cost
                break
        residuals[-1] = np.sqrt(max(missing, 0.0))
        upper[-1] = 0.0
        return _Evaluation(at, residuals, upper[:, :-1], swept.poses, swept.gains, step)

    def _add_known(self, at: Array, reduced: Array) -> float:
        """Add the normal equations of priors on the camera and of its lens's roughness; return their cost."""
        cost, numbers = 0.0, at[: len(self._unknowns.free)]
        if self._smooth is not None:
            slope = self._smooth @ at
            reduced[:-1, :-1] += self._smooth
            reduced[-1, :-1] += slope
            cost = float(at @ slope)
        for known in (evaluated(numbers, [numbers]) for evaluated in self._stated):
            jacobian = known.jacobians[0].reshape(-1, len(numbers))
            reduced[: len(numbers), : len(numbers)] += jacobian.T @ jacobian
            reduced[-1, : len(numbers)] += known.residuals @ jacobian
            cost += float(known.residuals @ known.residuals)
        return cost

    def _swept(self, at: Array, tolerance: float, newton: bool = True) -> kernels.Sweep:
        """Solve for every placement at the given numbers, starting from the last accepted poses."""
        free = self._unknowns.free
        intrinsics = self._optics.intrinsics.copy()
        intrinsics[free] = at[: len(free)]
        optics = self._optics._replace(intrinsics=intrinsics)
        points, curves = self._as_built(self._structure.with_values(at[len(free) :]))
        change, size, chain = at - self._accepted.at, self._accepted.gains.shape[2] + 1, self._chain
        change = change if chain is None else chain[:-1, :-1] @ change
        poses, gains, costs = self._accepted.poses.copy(), self._accepted.gains.copy(), np.empty(len(self._sights))

        def part(first: int, last: int) -> Array:
            sweep = kernels.Sweep(poses, gains, costs, np.zeros((size, size)))
            kernels.eliminate_placements(
                first, last, optics, self._unknowns, points, curves, self._loss, newton, tolerance, change, sweep
            )
            return sweep.reduced

        reduced = reduce(add, run_parts(part, self._parts))
        return kernels.Sweep(poses, gains, costs, reduced if chain is None else chain.T @ reduced @ chain)

    def posed(self, tolerance: float, poses: Array | None = None) -> tuple[Array, Array]:
        """Costs (S,) and poses (S, 3, 4) after solving for each placement, with everything else held, starting from the
        present poses or from `poses`; the cost is infinite where a start cannot be projected.
        """
        poses = self._accepted.poses if poses is None else poses
        self._accepted = replace(self._accepted, poses=poses, gains=np.zeros_like(self._accepted.gains))
        swept = self._swept(self._accepted.at, tolerance)
        self._accepted = replace(self._accepted, poses=swept.poses, gains=swept.gains)
        return swept.costs, swept.poses

    def converged(self, parameters: Sequence[Array]) -> tuple[tuple[SightKey, ...], Array]:
        """The sights' keys and their cam_from_target, (S, 3, 4), at their best for these numbers."""
        at = np.concatenate([kernels.NOTHING, *parameters])
        # At the accepted point they have converged as well; elsewhere, or if Ceres had nothing to move, they are found.
        if not len(self._accepted.residuals) or not np.array_equal(self._accepted.at, at):
            self._accepted = self._eliminated(at, 1e-14) or self._accepted
        return self._sights.keys, self._accepted.poses


def _smoothness(problem: Problem, estimate: Estimate, name: str, size: int) -> Array | None:
    """(size, size) prior information on a lens's roughness, over its camera's block; None if there is none."""
    camera, whole = estimate.cameras[name], None
    place = {number: at for at, number in enumerate(problem.layout.free[name].tolist())}
    for prior in problem.smooth_at(estimate, name):
        numbers = [intrinsic_names(camera.lens).index(key.quantity) for key in prior.keys]
        at, scales = [place[number] for number in numbers], 1.0 / intrinsics_scales(camera)[numbers]
        whole = np.zeros((size, size)) if whole is None else whole
        whole[np.ix_(at, at)] += scales[:, None] * prior.information.matrix * scales
    return whole


# ---- a prior's block: root (x - mean) over every camera, station and structure number that it is about -------------

_Coordinates = Callable[[Array], tuple[Array, Array]]
"""A function of a solver's block: (n,) a prior's numbers, in the units of its keys, and (n, size) their derivatives."""


def _linear(slots: Sequence[int], scales: Array, size: int) -> _Coordinates:
    """Coordinates that are numbers of the block itself, times scales."""
    slopes, places = np.zeros((len(slots), size)), np.array(slots, dtype=np.int64)
    slopes[np.arange(len(slots)), places] = scales
    return lambda block: (block[places] * scales, slopes)


def _of_station(rows: Sequence[int], rotation: Array) -> _Coordinates:
    """Coordinates of a station, whose block is a rotation vector and a translation: its position, and its turn, from
    the prior's rotation, about its own axes.
    """

    def coordinates(block: Array) -> tuple[Array, Array]:
        pose = Pose.exp(block)
        turn = rotation_log(pose.rotation @ rotation.T)
        inverse, left = pose.rotation.T, left_jacobian(block[:3])
        slopes = np.zeros((6, 6))
        slopes[:3] = np.hstack([-inverse @ skew(block[3:]) @ left, -inverse])
        slopes[3:, :3] = np.linalg.solve(left_jacobian(turn), left)
        return np.concatenate([pose.position, turn])[rows], slopes[rows]

    return coordinates


class PriorCost(CachedCost):
    """The cost of a prior on free numbers only: root (x - mean), in standard deviations."""

    def __init__(self, run: Run, prior: GaussianPrior, estimate: Estimate, layout: Layout) -> None:
        super().__init__(run)
        self._prior, self._root = prior, prior.information.root
        parts = list(_parts(prior, estimate, layout))
        whole = list(range(len(prior.keys)))  # a slice of it takes no copy
        self._coordinates = [(slice(None) if columns == whole else columns, there) for _, _, columns, there in parts]
        self._take({owner: size for owner, size, _, _ in parts}, len(self._root))

    def evaluated(self, at: Array, parameters: Sequence[Array]) -> CostValue:
        off, root, slopes = -self._prior.mean, self._root, []
        for (columns, coordinates), block in zip(self._coordinates, parameters, strict=True):
            values, by_block = coordinates(block)
            off[columns] += values
            slopes.append((columns, by_block))
        if self._prior.logs:
            off, slope = self._prior.bent(off)
            root = root * slope
        residuals = self._root @ off
        if self._prior.gives_way:
            residuals, slope = _bent(residuals)
            root = slope[:, None] * root
        return CostValue(at, residuals, [(root[:, columns] @ by_block).reshape(-1) for columns, by_block in slopes])


def _bent(residuals: Array) -> tuple[Array, Array]:
    """(R,) residuals whose squares are Cauchy's loss of the given ones, each separately, and their derivatives."""
    least = 1e-12  # ratio to the bend of the loss, below which Cauchy's loss is the square itself
    squares = np.maximum((residuals / USUAL_BENDS) ** 2, least**2)
    lengths = np.sqrt(np.log1p(squares))
    return USUAL_BENDS * np.copysign(lengths, residuals), np.sqrt(squares) / (lengths * (1.0 + squares))


def _parts(
    prior: GaussianPrior, estimate: Estimate, layout: Layout
) -> Iterator[tuple[Owner, int, list[int], _Coordinates]]:
    """The blocks on which a prior depends: owner, size, columns of the prior, and coordinates."""
    for (kind, owner), columns in columns_by_owner(prior.keys).items():
        quantities = [prior.keys[column].quantity for column in columns]
        if kind == "camera":
            camera, free = estimate.cameras[owner], layout.free[owner].tolist()
            numbers = [intrinsic_names(camera.lens).index(quantity) for quantity in quantities]
            slots, scales = [free.index(number) for number in numbers], 1.0 / intrinsics_scales(camera)[numbers]
            yield (kind, owner), len(free), columns, _linear(slots, scales, len(free))
        elif kind == "station":
            rows = [STATION_QUANTITIES.index(quantity) for quantity in quantities]
            # Without turns among its numbers any rotation will do.
            rotation = prior.rotations.get(owner, estimate.stations[owner].cam_from_world.rotation)
            yield (kind, owner), 6, columns, _of_station(rows, rotation)
        elif kind == "structure":
            slots = estimate.structure.places(prior.keys[column] for column in columns)
            size = len(estimate.structure.names)
            yield STRUCTURE, size, columns, _linear(slots, np.ones(len(slots)), size)
