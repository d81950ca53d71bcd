"""The information of observations and priors on every number at an estimate: J^T W J, nothing is moved (design, 6).

Every sight gives its compressed normal equations once. Placements that one station sees are eliminated; the rest is
summed over the shared numbers, in the coordinates of `problem.information`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import reduce
from operator import add

import numpy as np

from ceres_cal import kernels
from ceres_cal.base import Array, Frozen, Indices, SolutionError, cached_property, known_inverses, parts_of, run_parts
from ceres_cal.observations.sights import STRUCTURE, Owner, SightKey, Sights
from ceres_cal.problem.costs import NORMAL_NS, kernel_loss
from ceres_cal.problem.information import Information, Key, columns_by_owner, pose_keys, sigma_limits
from ceres_cal.problem.parameters import Estimate, intrinsics_scales
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.quantities import free_keys, from_placement, from_station
from ceres_cal.problem.residuals import camera_optics, curve_columns, point_columns, starting_feet


class PrivatePlacements(Frozen):
    """Private placements of one station: their own information, and how they follow the shared numbers.

    Attributes:
        station: its name. names: (S). own: (S, 6, 6) information on each with everything shared held. inverses: (S, 6,
            6) of that, over known directions.
        gains: (S, 6, K); a step d of the shared numbers `keys` (K) moves each placement by -gains d.
    """

    station: str
    names: tuple[str, ...]
    own: Array
    inverses: Array
    gains: Array
    keys: tuple[Key, ...]

    @property
    def ranks(self) -> Array:
        """(S,) number of directions of each placement that its own observations determine."""
        return np.asarray(np.einsum("sij,sji->s", self.own, self.inverses))


class ReducedInformation(Frozen):
    """J^T W J of everything shared, with private placements eliminated.

    Attributes:
        points, curves: information of the observations of either kind. priors: prior information.
        stated: the part of the priors that was stated or comes from an earlier calibration. built: the part that says
            how far targets may be off their drawings, a scatter that equations have in common.
        eliminated: the private placements, by station.
        pull: (K,) half the derivative of the squares of all priors, except those on targets, at the estimate.
        point_leverage, curve_leverage: the equations of either kind that private placements absorb by themselves.
    """

    points: Information
    curves: Information
    priors: Information
    stated: Information
    built: Information
    pull: Array
    eliminated: tuple[PrivatePlacements, ...]
    point_leverage: float
    curve_leverage: float

    @cached_property
    def shared(self) -> Information:
        """All information together."""
        return self.points + self.curves + self.priors

    @property
    def leverages(self) -> tuple[float, float]:
        """Equations of points and of curves that the free numbers absorb: the traces of the hat matrix."""
        covariance = self.shared.inverse
        return (
            self.point_leverage + float(np.sum(covariance * self.points.matrix)),
            self.curve_leverage + float(np.sum(covariance * self.curves.matrix)),
        )


def information(problem: Problem, estimate: Estimate) -> ReducedInformation:
    """The information of observations and priors on the free intrinsics, stations, placements and structure.

    Each observation counts with its robust weight rho'. Eliminated placements must be at their best, as they are after
    a solve.

    Raises:
        SolutionError: an observation cannot be projected at this estimate.
    """
    return _InformationSums(problem, estimate).result()


def normals_of(sight: Sights, problem: Problem, estimate: Estimate) -> dict[int, Array]:
    """Normal equations (K, K) of a single sight by kind, of points (0) and of curves (1), if there are any. K is [free
    intrinsics in the units of the files | structure | left perturbation of the pose: turn, shift].

    Raises:
        SolutionError: an observation cannot be projected.
    """
    kinds = enumerate(sight.by_kind)
    return {kind: normals_with_residuals(own, problem, estimate)[0, :-1, :-1] for kind, own in kinds if own.equations}


def normals_with_residuals(sights: Sights, problem: Problem, estimate: Estimate) -> Array:
    """Normal equations (S, K + 1, K + 1) of one camera's sights, each by itself, as in `normals_of`; the last row is
    that of the residuals.

    Raises:
        SolutionError: an observation cannot be projected.
    """
    return _kernel_normals(sights, problem, estimate)(0, len(sights))


def owned_columns(keys: Sequence[Key]) -> dict[Owner, Indices]:
    """The columns of the keys of each owner, and an entry for the structure in any case."""
    columns = {STRUCTURE: list[int](), **columns_by_owner(keys)}
    return {owner: np.array(at, dtype=np.int64) for owner, at in columns.items()}


def steps_of(key: SightKey, pose: Array, estimate: Estimate, columns: Mapping[Owner, Indices]) -> tuple[Array, Indices]:
    """Derivatives (K, P) of a sight's numbers (see `normals_of`) by P shared numbers, and the columns of these.

    Args:
        pose: (3, 4) cam_from_frame. columns: see `owned_columns`.
    """
    world, nothing = estimate.stations[key.station].cam_from_world, np.empty(0, dtype=np.int64)
    at = [columns.get(("camera", key.camera), nothing), columns[STRUCTURE]]
    lead = len(at[0]) + len(at[1])
    steps = [np.eye(lead + 6)[:, :lead]]
    if (station := ("station", key.station)) in columns:
        at.append(columns[station])
        steps.append(np.vstack([np.zeros((lead, 6)), from_station(pose[None], world)[0]]))
    if (placement := ("placement", str(key.placement))) in columns and key.placement is not None:
        at.append(columns[placement])
        steps.append(np.vstack([np.zeros((lead, 6)), from_placement(pose[None], world)[0]]))
    return np.hstack(steps), np.concatenate(at)


class _InformationSums:
    """The sums of one pass over the sights."""

    def __init__(self, problem: Problem, estimate: Estimate) -> None:
        self._problem, self._estimate = problem, estimate
        self._keys = free_keys(estimate, problem.layout, problem.private)
        self._columns = owned_columns(self._keys)
        size = len(self._keys)
        self._matrices, self._leverages = np.zeros((2, size, size)), np.zeros(2)  # of points, of curves

    def result(self) -> ReducedInformation:
        """The information of the whole problem."""
        sights, private = self._problem.sights, self._problem.private
        alone = sights.numbers(placements=private)
        eliminated = []
        for name in dict.fromkeys(sights.keys[number].station for number in alone):
            own = sights.take(sights.numbers(station=name, placements=private))
            eliminated.append(self._eliminate(own))
        for number in np.delete(np.arange(len(sights)), alone):
            sight = sights[int(number)]
            self._add(sight.key, normals_of(sight, self._problem, self._estimate))
        if self._problem.elsewhere is not None:
            for (key, kind), normal in self._problem.elsewhere.normals(self._problem, self._estimate).items():
                self._add(key, {kind: normal})
        points, curves = (Information(self._keys, 0.5 * (matrix + matrix.T)) for matrix in self._matrices)
        priors, pull = self._problem.priors_at(self._estimate), np.zeros(len(self._keys))
        known = Information.nothing(self._keys).beside_all(prior.information for prior in priors)
        for prior in [one for one in priors if not one.is_of_target]:
            pull[known.columns(prior.keys)] += prior.information.matrix @ prior.offsets(self._estimate)
        given = [prior for prior in self._problem.stated_at(self._estimate) if not prior.is_usual]
        stated, built = (
            Information.nothing().beside_all(one.information for one in given if one.is_of_target == of)
            for of in (False, True)
        )
        every = points, curves, known, stated, built, pull, tuple(eliminated)
        return ReducedInformation(*every, *self._leverages.tolist())

    def _owned(self, kind: str, name: str) -> Indices:
        return self._columns.get((kind, name), np.empty(0, dtype=np.int64))

    def _normals(self, sights: Sights) -> Iterator[tuple[Array, dict[int, Array]]]:
        """cam_from_frame (n, 3, 4) of a camera's sights, and normal equations (n, K, K) by kind, see `normals_of`; in
        batches.
        """
        kernel_of = {
            kind: _kernel_normals(own, self._problem, self._estimate)
            for kind, own in enumerate(sights.by_kind)
            if own.equations
        }
        poses = self._estimate.pose_stack(sights.keys)
        size = len(self._problem.layout.free[sights.keys[0].camera]) + len(self._estimate.structure.values) + 6
        most_numbers = 250_000  # entries of the normal equations in a batch: they fit into the processor's cache
        batch = max(1, most_numbers // size**2)
        for first in range(0, len(sights), batch):
            last = min(first + batch, len(sights))
            yield poses[first:last], {kind: one(first, last)[:, :-1, :-1] for kind, one in kernel_of.items()}

    def _eliminate(self, sights: Sights) -> PrivatePlacements:
        """Eliminate the private placements of one station; what their sights say of the rest is added to the sums."""
        key = sights.keys[0]
        world = self._estimate.stations[key.station].cam_from_world
        lead = np.concatenate([self._owned("camera", key.camera), self._columns[STRUCTURE]])
        station = self._owned("station", key.station)
        stacks, reduced = [], np.zeros((2, len(lead), len(lead)))
        for poses, normals in self._normals(sights):
            chain = from_placement(poses, world)
            back = np.swapaxes(chain, 1, 2)  # the chain is orthogonal
            whole = reduce(add, normals.values())
            own = back @ whole[:, -6:, -6:] @ chain
            inverse = known_inverses(own, _limits(own))
            covariance = chain @ inverse @ back
            follows = covariance @ whole[:, -6:, :-6]
            self._add_reduced(reduced, normals, covariance, follows)
            gain = back @ follows
            if len(station):  # the placement compensates every motion of its station
                gain = np.concatenate([gain, back @ from_station(poses, world)], axis=2)
            stacks.append((own, inverse, gain))
        for whole, own in zip(self._matrices, reduced, strict=True):
            if own.any():
                whole[lead[:, None], lead] += own
        own, inverse, gain = (np.concatenate(parts) for parts in zip(*stacks, strict=True))
        names = tuple(str(key.placement) for key in sights.keys)
        return PrivatePlacements(
            key.station, names, own, inverse, gain, tuple(self._keys[i] for i in np.concatenate([lead, station]))
        )

    def _add_reduced(self, sums: Array, normals: dict[int, Array], covariance: Array, follows: Array) -> None:
        """Add V^T N V of each kind, where V is how a sight's numbers follow the shared ones, to the sums (2, K, K).

        Args:
            covariance: (S, 6, 6) of each pose with everything shared held. follows: (S, 6, K) minus V's rows of the
                pose.
        """
        rows, size = 6 * len(follows), follows.shape[2]
        flat = follows.reshape(rows, size)
        for kind, normal in normals.items():
            coupling = normal[:, -6:, :-6]
            sums[kind] += np.sum(normal[:, :-6, :-6], axis=0)
            sums[kind] -= coupling.reshape(rows, size).T @ flat
            if len(normals) > 1:  # placements are at their best for all kinds together, not for each kind
                left = coupling - normal[:, -6:, -6:] @ follows
                sums[kind] -= flat.T @ left.reshape(rows, size)
            self._leverages[kind] += float(np.sum(normal[:, -6:, -6:] * covariance))

    def _add(self, key: SightKey, normals: Mapping[int, Array]) -> None:
        """Add the normal equations of a sight from which nothing is eliminated to the sums."""
        steps, everywhere = steps_of(key, self._estimate.pose_stack([key])[0], self._estimate, self._columns)
        own = len(steps) - 6  # these numbers are shared themselves; the steps of the pose follow
        chain = steps[own:, own:]
        for kind, normal in normals.items():
            along = np.hstack([normal[:, :own], normal[:, own:] @ chain])
            whole = np.vstack([along[:own], chain.T @ along[own:]])
            self._matrices[kind][np.ix_(everywhere, everywhere)] += whole


def _limits(own: Array) -> Array:
    """(S, 6) sigmas beyond which a placement's number is unknown. Sums over all rows of rings, for the turn about their
    centre, are only rounding of the other turns.
    """
    rounding = 1e-13  # share of a sum over the rows of a sight
    turns, shifts = np.max(np.diagonal(own, axis1=1, axis2=2).reshape(-1, 2, 3), axis=2).T
    largest = np.repeat(np.column_stack([turns, shifts]), 3, axis=1)
    return np.asarray(np.minimum(sigma_limits(pose_keys("placement", "")), (rounding * largest + 1e-300) ** -0.5))


def _kernel_normals(sights: Sights, problem: Problem, estimate: Estimate) -> Callable[[int, int], Array]:
    """A function of a range of one camera's sights that returns their normal equations (n, K + 1, K + 1) by the
    kernels, with the residuals' row last. It raises SolutionError where an observation cannot be projected.
    """
    camera = estimate.cameras[sights.keys[0].camera]
    free, structure, weighting = problem.layout.free[sights.keys[0].camera], estimate.structure, problem.weighting
    offsets = len(structure.offsets)
    units = np.ones(len(free) + offsets + 7)
    units[: len(free)] = intrinsics_scales(camera)[free]
    size, chain = len(units), structure.chain(len(free), 7)
    rows = (len(sights.points) + len(sights.curve_pixels)) / len(sights)
    arguments = (
        camera_optics(camera),
        kernels.Unknowns(free, offsets),
        point_columns(sights, structure, weighting.point_scale),
        curve_columns(sights, structure, starting_feet(sights, estimate, problem.feet), weighting.curve_scale),
        kernel_loss(weighting),
        estimate.pose_stack(sights.keys),
        units,
    )

    def between(first: int, last: int) -> Array:
        normals = np.empty((last - first, size, size))

        def part(begin: int, end: int) -> bool:
            return kernels.sight_normals(first + begin, first + end, *arguments, normals[begin:end])

        if not all(run_parts(part, parts_of(last - first, int(rows * (last - first)), NORMAL_NS))):
            raise SolutionError(
                "the solved camera cannot project an observation, so no uncertainty can be given: choose another lens "
                "(kannala-brandt or spline for wide ones), do not hold its numbers, or leave out the observations "
                "nearest to the image's corners"
            )
        return normals if chain is None else chain.T @ normals @ chain

    return between
