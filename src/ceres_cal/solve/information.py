"""What observations and priors say of every number, where an estimate stands: J^T W J, nothing moved (design, 6).

Every sight gives its compressed normal equations once; placements that one station sees are eliminated, the rest is
added up over what is shared, in the coordinates of `quantities`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ceres_cal import kernels
from ceres_cal.base.errors import SolutionError
from ceres_cal.base.spread import known_inverses
from ceres_cal.base.threads import parts_of, run_parts
from ceres_cal.base.transforms import Array
from ceres_cal.model.parameters import Estimate, Layout, intrinsics_scales
from ceres_cal.model.quantities import (
    Key,
    from_placement,
    from_station,
    places_of,
    pose_keys,
    shared_keys,
    sigma_limits,
)
from ceres_cal.model.residuals import camera_optics, curve_columns, point_columns, starting_places
from ceres_cal.observations.sights import SightKey, Sights
from ceres_cal.solve.bundle import own_structure, private_placements
from ceres_cal.solve.costs import NORMAL_NS, Weighting, kernel_loss

Places = NDArray[np.int64]
_BATCH = 2_000_000  # numbers of normal equations worked on at once


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Private placements of one station: their own information, and how they follow the shared numbers.

    Attributes:
        names: (S). own: (S, 6, 6) information about each with everything shared held; inverses: (S, 6, 6) of that,
            over what it tells.
        gains: (S, 6, K); a step d of the shared numbers at `places` (K,) takes each placement along by -gains d.
    """

    names: tuple[str, ...]
    own: Array
    inverses: Array
    gains: Array
    places: Places


@dataclass(frozen=True, eq=False)
class Information:
    """J^T W J of everything shared, private placements eliminated; priors are in it.

    Attributes:
        keys: (P) of the shared numbers. matrix: (P, P). eliminated: the private placements, by station.
    """

    keys: tuple[Key, ...]
    matrix: Array
    eliminated: tuple[Eliminated, ...]


def information(
    sights: Sights, estimate: Estimate, layout: Layout, weighting: Weighting, places: Array | None = None
) -> Information:
    """What the observations and priors say of the free intrinsics, stations, placements and structure.

    Each observation counts with its robust weight rho'. For a placement to be eliminated rightly it must be at its
    best, as it is after a solve.

    Args:
        places: feet of the curve observations, see `residuals`.

    Raises:
        SolutionError: an observation cannot be projected from there.
    """
    private = private_placements(sights, layout)
    keys = shared_keys(estimate, layout, private)
    matrix, owned = np.zeros((len(keys), len(keys))), _owned(keys)
    alone = [number for number, key in enumerate(sights.keys) if key.placement in private]
    eliminated = []
    for name in dict.fromkeys(sights.keys[number].station for number in alone):
        own = sights.take(np.array([number for number in alone if sights.keys[number].station == name]))
        parts = list(_normals(own, estimate, layout, weighting, places))
        eliminated.append(_eliminate(own, parts, estimate, owned, matrix))
    for number in np.delete(np.arange(len(sights)), alone):
        sight = sights[int(number)]
        for pose, normal in _normals(sight, estimate, layout, weighting, places):
            _add(sight.key, pose[0], normal[0], estimate, owned, matrix)
    _add_priors(keys, estimate, layout, matrix)
    return Information(keys, 0.5 * (matrix + matrix.T), tuple(eliminated))


Owned = Callable[[str, str], Places]


def _owned(keys: Sequence[Key]) -> Owned:
    """Where the keys of an owner are, by kind and name; all structure numbers are the structure's."""
    places = {owner: np.array(at, dtype=np.int64) for owner, at in places_of(keys).items()}
    structure = np.array([i for i, key in enumerate(keys) if key.kind == "structure"], dtype=np.int64)
    nothing = np.empty(0, dtype=np.int64)
    return lambda kind, name: structure if kind == "structure" else places.get((kind, name), nothing)


def _normals(
    sights: Sights, estimate: Estimate, layout: Layout, weighting: Weighting, places: Array | None
) -> Iterator[tuple[Array, Array]]:
    """cam_from_frame (n, 3, 4) and normal equations (n, K, K) of a camera's sights, in batches; K is [free intrinsics
    in the units of the files | structure | left perturbation of the pose: turn, shift].
    """
    camera = estimate.cameras[sights.keys[0].camera]
    free, structure = layout.free[sights.keys[0].camera], estimate.structure
    optics, unknowns = camera_optics(camera), kernels.Unknowns(free, len(structure.values))
    points = point_columns(sights, structure, weighting.point_scale)
    curves = curve_columns(sights, structure, starting_places(sights, estimate, places), weighting.curve_scale)
    loss, poses = kernel_loss(weighting), estimate.pose_stack(sights.keys)
    size = len(free) + len(structure.values) + 6
    units = np.ones(size)
    units[: len(free)] = intrinsics_scales(camera)[free]

    def told(first: int, last: int) -> Array:
        normals = np.empty((last - first, size, size))
        if not kernels.sight_normals(first, last, optics, unknowns, points, curves, loss, poses, units, normals):
            raise SolutionError("an observation cannot be projected where the solve ended: no uncertainty can be given")
        return normals

    batch = max(1, _BATCH // size**2)
    for first in range(0, len(sights), batch):
        last = min(first + batch, len(sights))
        parts = [first + place for place in parts_of(last - first, len(points.pixels) + len(curves.pixels), NORMAL_NS)]
        yield poses[first:last], np.concatenate(run_parts(told, parts))


def _eliminate(
    sights: Sights, parts: Sequence[tuple[Array, Array]], estimate: Estimate, owned: Owned, matrix: Array
) -> Eliminated:
    """The private placements of one station; what is left of their sights is added to the matrix."""
    key = sights.keys[0]
    world = estimate.stations[key.station].cam_from_world
    lead = np.concatenate([owned("camera", key.camera), owned("structure", "")])
    station = owned("station", key.station)
    eliminated, limits = [], sigma_limits(pose_keys("placement", ""))
    for poses, normals in parts:
        chain = from_placement(poses, world)
        own = np.swapaxes(chain, 1, 2) @ normals[:, -6:, -6:] @ chain
        coupling = np.swapaxes(chain, 1, 2) @ normals[:, -6:, :-6]
        inverse = known_inverses(own, limits)
        gain = inverse @ coupling
        taken = coupling.reshape(-1, len(lead)).T @ gain.reshape(-1, len(lead))  # summed over the sights
        matrix[np.ix_(lead, lead)] += np.sum(normals[:, :-6, :-6], axis=0) - taken
        if len(station):  # the placement makes up for whatever its station does: the chain is orthogonal
            moved = np.swapaxes(chain, 1, 2) @ from_station(poses, world)
            gain = np.concatenate([gain, moved], axis=2)
        eliminated.append((own, inverse, gain))
    own, inverse, gain = (np.concatenate(stacks) for stacks in zip(*eliminated, strict=True))
    names = tuple(str(key.placement) for key in sights.keys)
    return Eliminated(names, own, inverse, gain, np.concatenate([lead, station]))


def _add(key: SightKey, pose: Array, normal: Array, estimate: Estimate, owned: Owned, matrix: Array) -> None:
    """What a sight that nothing is eliminated from says, added to the matrix."""
    world, lead = estimate.stations[key.station].cam_from_world, len(normal) - 6
    at = [owned("camera", key.camera), owned("structure", "")]
    chain = [np.eye(len(normal))[:, :lead]]
    if len(station := owned("station", key.station)):
        at.append(station)
        chain.append(np.vstack([np.zeros((lead, 6)), from_station(pose[None], world)[0]]))
    if key.placement is not None and len(placement := owned("placement", key.placement)):
        at.append(placement)
        chain.append(np.vstack([np.zeros((lead, 6)), from_placement(pose[None], world)[0]]))
    steps, everywhere = np.hstack(chain), np.concatenate(at)
    matrix[np.ix_(everywhere, everywhere)] += steps.T @ normal @ steps


def _add_priors(keys: Sequence[Key], estimate: Estimate, layout: Layout, matrix: Array) -> None:
    """1 / sigma^2 of every prior on a number that is free: each is on one number of the keys."""
    places = {key[:3]: place for place, key in enumerate(keys)}
    several = {"principal_point": ("cx", "cy"), "height_m": ("height",), "position_m": ("x", "y", "height")}
    for prior in layout.priors:
        quantities = several.get(prior.quantity, (prior.quantity,))
        for quantity, sigma in zip(quantities, prior.sigma, strict=True):
            place = places.get((prior.owner, prior.name, quantity))
            if place is not None:  # a number that is held needs no prior
                matrix[place, place] += sigma**-2.0
    structure, fresh = _owned(keys)("structure", ""), own_structure(layout, estimate)
    matrix[structure[fresh], structure[fresh]] += estimate.structure.sigma_m[fresh] ** -2.0
    if layout.joint is not None:  # what it says of numbers that are held now, it says with them held
        own = [i for i, key in enumerate(layout.joint.keys) if key in keys]
        at = [keys.index(Key(*layout.joint.keys[i])) for i in own]
        if own:
            matrix[np.ix_(at, at)] += layout.joint.information[np.ix_(own, own)]
