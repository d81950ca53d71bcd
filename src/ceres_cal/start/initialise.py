"""Find the initial estimate of the solve, in closed form (design, section 7; the paper's sections 2 and 3).

For each camera it finds the radial profile, one homography per sight, phi, lens coefficients and poses. Then the poses
are chained into stations and placements. None of this is the answer: the bundle gives it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Pose, field, median, numerical, replace
from ceres_cal.base.errors import CalibrationError, InputError, attempt
from ceres_cal.observations import Prior, SightKey, Sights
from ceres_cal.problem import ANY_PHI, PHI_RANGE, Estimate, Options, Station, unit_px
from ceres_cal.scene.camera import Camera
from ceres_cal.start.closed_forms import (
    RADII,
    LensProfile,
    RadialProfile,
    edge_over,
    orthogonality_error,
    poses_from_homographies,
)
from ceres_cal.start.planes import Homographies, profile_and_homographies
from ceres_cal.start.world import CameraPlace, CameraPlaces, beforehand, chained_poses, left_of, placed

USUAL_PHI, USUAL_PHI_FACTOR = 1.1, 1.4
"""Usual phi in half image diagonals, 85 degrees across the diagonal, and a factor either way, 66 to 104 degrees: a
standard deviation of log phi. It is used where the image does not determine phi, so it is that of usual cameras over a
field or before a board.
"""
_GRID = np.geomspace(*PHI_RANGE, 120)
_NEAR = np.geomspace(1.0 / 1.04, 1.04, 13)  # one grid step to either side


class Start(Frozen, eq=True):
    """An initial estimate, and the origin of each camera's phi: "fixed", "views", "prior" or "guess".

    Attributes:
        is_near: whether it is near the minimum except for private placements, so that gross errors do not dominate.
        others: other initial estimates, which explain a station's view as well from elsewhere.
        keys, poses: sights, and cam_from_frame (K, 3, 4) of each by itself, without regard to other cameras.
    """

    estimate: Estimate
    phi_from: Mapping[str, str]
    is_near: bool = False
    others: tuple[Estimate, ...] = ()
    keys: tuple[SightKey, ...] = ()
    poses: Array = field(default_factory=lambda: np.empty((0, 3, 4)))


@numerical("the initial estimate")
def initialise(sights: Sights, options: Options, *, may_search: bool = True) -> Start:
    """Find an initial estimate of everything that the observations show.

    A camera that sees only a field, and whose principal point is not stated, may show a part of a sensor. Where the
    estimate from the picture's middle leaves large residuals, those from its quarters are tried, too, but only by
    homographies: one holds about the right quarter, and about a wrong one a search only costs time. Boards determine
    the principal point by themselves. Where a stated principal point leaves large residuals, the middle is tried.

    Args:
        may_search: whether the pose is searched for where no closed form suits the observations, which takes time.

    Raises:
        DegenerateError: it names the sight whose pose the observations do not determine.
    """
    least_sigmas, better = 5.0, 0.75  # residuals that are large; ratio that is better (wrong quarters: 1.3 to 20)
    share = 0.22  # distance of the quarters from the middle, as a share of the picture's size
    observations = sights.observations
    start, places = _initialised(sights, options, may_search=may_search)
    for name, size in observations.cameras.items():
        every = sights.numbers(camera=name)
        own = np.array([number for number in every.tolist() if number in places], dtype=np.int64)
        point = {"principal_point", "cx", "cy"}
        is_stated = any(one.name == name and one.quantity in point for one in (*observations.priors, *options.priors))
        if point & {*options.fixed} or not len(own) or (len(own) < len(every) and not is_stated):
            continue
        least, given = better * _left(sights, own, start, places), options
        shares = (0.5,) if is_stated else (0.5 - share, 0.5 + share)
        for x, y in product(shares, repeat=2) if least > better * least_sigmas else ():
            there = Prior("camera", name, "principal_point", (x * size[0], y * size[1]), (1.0, 1.0))
            moved = replace(given, priors=(*given.priors, there))
            other = attempt(partial(_initialised, sights, moved, may_search=False))  # quiet: it is one of five
            if isinstance(other, tuple) and (left := _left(sights, own, *other)) < least:
                (start, _), least, options = other, left, moved
    return start


def _left(sights: Sights, own: Indices, start: Start, places: Mapping[int, CameraPlace]) -> float:
    """The median of what an initial estimate leaves of all rows of a camera's own sights, in stated sigmas, by the
    profile that it found. The paper's lens, which is used until one is chosen, may be off by more than a wrong quarter
    is.
    """
    one = sights.take(own)
    seen = one.about(start.estimate.cameras[one.cameras[0]])
    return median(np.concatenate([left_of(seen[i], places[number]) for i, number in enumerate(own.tolist())]))


def _initialised(
    sights: Sights, options: Options, *, may_search: bool = True
) -> tuple[Start, Mapping[int, CameraPlace]]:
    """An initial estimate, and the place from which each sight of the world is seen there."""
    posed = posed_sights(sights, options, may_search=may_search)
    stations, placements = chained_poses(sights, posed.numbers, posed.poses, open_numbers=posed.open)
    structure = options.structure_of(sights.observations.targets)
    estimate = Estimate(posed.cameras, stations, placements, structure)
    others = tuple(
        replace(
            estimate,
            cameras={**posed.cameras, key.camera: camera},
            stations={**stations, key.station: Station(key.camera, Pose(pose[:, :3], pose[:, 3]))},
        )
        for key, pose, camera in posed.others
    )
    start = Start(estimate, posed.phi_from, others=others, keys=posed.keys(sights), poses=posed.poses)
    return start, posed.places


class PosedSights(Frozen):
    """Cameras, and the sights whose poses were found.

    Attributes:
        cameras, phi_from: by name. numbers: (K,) of sights. poses: (K, 3, 4) cam_from_frame.
        places: number of a sight of the world -> the place of its camera.
        others: sights of the world that look the same from elsewhere, with pose (3, 4) and camera there.
        open: number of a sight -> names of the numbers that it leaves undetermined.
    """

    cameras: dict[str, Camera]
    phi_from: dict[str, str]
    numbers: Indices
    poses: Array
    places: dict[int, CameraPlace]
    others: tuple[tuple[SightKey, Array, Camera], ...]
    open: dict[int, tuple[str, ...]]

    def keys(self, sights: Sights) -> tuple[SightKey, ...]:
        """(K) keys of the sights whose poses were found."""
        return tuple(sights.keys[number] for number in self.numbers.tolist())

    def by_key(self, sights: Sights) -> dict[SightKey, Pose]:
        """cam_from_frame of each of these sights."""
        each = zip(self.keys(sights), self.poses, strict=True)
        return {key: Pose(pose[:, :3], pose[:, 3]) for key, pose in each}


def posed_sights(sights: Sights, options: Options, *, may_search: bool = True) -> PosedSights:
    """Find the poses of sights, for each camera by itself.

    Raises:
        InputError, SolutionError: see `placed`.
    """
    priors = (*sights.observations.priors, *options.priors)
    parts: list[PosedSights] = []
    for name, image_size in sights.observations.cameras.items():
        given = options.of_camera(name)
        blank = _blank_camera(name, image_size, given, priors)
        own = sights.numbers(camera=name)
        seen = sights.take(own).about(blank)
        # Statements may be wrong: they are used only where the views do not determine phi or the camera's place.
        posed_by = partial(_start_camera, name, blank, seen, given, may_search=may_search)
        one = attempt(partial(posed_by, ()))  # quiet: it is tried with what is stated, or ends with that
        own_priors = [p for p in priors if _concerns(p, name, seen)]
        if isinstance(one, InputError):  # a mirrored picture, whatever is stated
            raise one
        if own_priors and (isinstance(one, CalibrationError) or one.phi_from[name] == "guess"):
            one = posed_by(own_priors)
        if isinstance(one, CalibrationError):
            raise one
        places, there = ({int(own[n]): value for n, value in part.items()} for part in (one.places, one.open))
        parts.append(replace(one, numbers=own[one.numbers], places=places, open=there))
    return PosedSights(
        {name: camera for part in parts for name, camera in part.cameras.items()},
        {name: source for part in parts for name, source in part.phi_from.items()},
        np.concatenate([part.numbers for part in parts]),
        np.concatenate([part.poses for part in parts]),
        {number: place for part in parts for number, place in part.places.items()},
        tuple(other for part in parts for other in part.others),
        {number: names for part in parts for number, names in part.open.items()},
    )


# ---- one camera -----------------------------------------------------------------------------------------------------


def _start_camera(
    name: str, blank: Camera, sights: Sights, options: Options, priors: Sequence[Prior], *, may_search: bool
) -> PosedSights:
    """Pose the sights of one camera, given about its principal point, with the priors that concern it."""
    unit = unit_px(blank)
    given = _held_profile(blank, sights, options)
    profile, homographies = profile_and_homographies(sights, unit, given)
    phi, phi_from = _choose_phi(sights, homographies, unit, options, priors)
    poses = dict(zip(homographies.sights.tolist(), _poses_at(homographies, phi), strict=True))
    sizes = np.diff(sights.point_bounds) + np.diff(sights.curve_bounds)
    of_world = sorted((n for n, key in enumerate(sights.keys) if key.placement is None), key=lambda n: -sizes[n])
    # Boards determine phi and lens better than a sight of the world that no homography explains.
    told = phi_from == "fixed" or (phi_from != "guess" and len(homographies.sights) > 1)
    found: dict[int, CameraPlaces] = {}
    for number in of_world:
        known = beforehand(priors, sights.keys[number].station, _known_phi(phi, told, unit, priors))
        may_bend = given is None and not told
        guess = poses.get(number), float(np.log(phi))
        one = placed(sights[number], profile, known, *guess, may_bend=may_bend, may_search=may_search)
        found[number], best = one, one.places[0]
        if not told:
            phi, profile = best.phi, best.profile
            known_phi = any(p.quantity in ("phi", "height_m", "position_m") for p in priors)
            phi_from = "guess" if not one.tells_phi else "prior" if known_phi else "views"
            poses = dict(zip(homographies.sights.tolist(), _poses_at(homographies, phi), strict=True))
            told = one.tells_phi
    poses |= {n: one.places[0].pose for n, one in found.items() if n in poses or not one.open}
    others = tuple(
        (sights.keys[n], place.pose, _with_lens(blank, sights, place.profile, place.phi, options))
        for n, one in found.items()
        for place in one.places[1:]
        if n in poses
    )
    camera = _with_lens(blank, sights, profile, phi, options)
    numbers, stack = np.array(list(poses), dtype=np.int64), np.array(list(poses.values())).reshape(-1, 3, 4)
    lost = {n: one.open for n, one in found.items() if n not in poses}
    places = {n: one.places[0] for n, one in found.items()}
    return PosedSights({name: camera}, {name: phi_from}, numbers, stack, places, others, lost)


def _known_phi(phi: float, told: bool, unit: float, priors: Sequence[Prior]) -> tuple[float, float]:
    """Mean and standard deviation of log phi with which the search for a sight begins."""
    least_sd = 1e-3  # relative, of phi: an initial estimate is no more accurate
    if told:
        return float(np.log(phi)), 0.0
    for prior in priors:
        if prior.quantity == "phi":
            return float(np.log(prior.value[0])), max(prior.sigma[0] / prior.value[0], least_sd)
    return float(np.log(ANY_PHI[0] * unit)), ANY_PHI[1]


def _with_lens(blank: Camera, sights: Sights, profile: RadialProfile, phi: float, options: Options) -> Camera:
    """The camera with the lens that is nearest to a profile."""
    r = RADII * sights.reach_px
    w = profile.lift(np.column_stack([r, np.zeros_like(r)]))[:, 2]
    seen = LensProfile(r, np.arctan2(r, phi * w))
    beyond = edge_over(blank, sights.reach_px)
    spanning = blank.lens.spanning(float(seen.angles[-1]), phi, beyond, blank.image_size)
    return replace(blank, phi=phi, lens=seen.nearest(spanning, phi, options.held))


def _held_profile(blank: Camera, sights: Sights, options: Options) -> RadialProfile | None:
    """The profile of a lens with all coefficients held; None if one is free, or depends on a phi that is not held."""
    if not set(blank.lens.names) <= set(options.held) or blank.lens.set_at_start:
        return None
    if any(blank.lens.values) and "phi" not in options.fixed and blank.lens.kind != "radial":
        return None
    phi, unit = options.fixed.get("phi", unit_px(blank)), unit_px(blank)
    seen = LensProfile.of(replace(blank, phi=phi), sights.reach_px)
    squared = (seen.radii_px / unit) ** 2
    w = seen.radii_px / (phi * np.tan(seen.angles))
    powers = np.column_stack([squared, squared**2, squared**3])
    return RadialProfile(tuple(np.linalg.lstsq(powers, w - 1.0, rcond=1e-12)[0].tolist()), unit)


def _concerns(prior: Prior, camera: str, sights: Sights) -> bool:
    if prior.owner == "camera":
        return prior.name == camera
    return prior.owner == "station" and any(key.station == prior.name for key in sights.keys)


def _poses_at(homographies: Homographies, phi: float) -> Array:
    """cam_from_frame (K, 3, 4) of the homographies for one phi."""
    matrices = poses_from_homographies(homographies.matrices, phi)
    matrices[:, :, 3] -= homographies.heights_m[:, None] * matrices[:, :, 2]
    return matrices


def _blank_camera(name: str, image_size: tuple[int, int], options: Options, priors: Sequence[Prior]) -> Camera:
    """The camera with fixed numbers and principal point, and without phi."""
    known = {"cx": (image_size[0] - 1) / 2.0, "cy": (image_size[1] - 1) / 2.0, "aspect": 1.0, "skew": 0.0}
    for prior in priors:
        if prior.owner == "camera" and prior.name == name:
            quantities = ("cx", "cy") if prior.quantity == "principal_point" else (prior.quantity,)
            known |= zip(quantities, prior.value, strict=True)
    known |= options.fixed
    centre = known["cx"], known["cy"]
    blank = Camera(image_size, 1.0, centre, options.blank_lens, known["aspect"], skew=known["skew"])
    if set(blank.lens.names) <= set(options.held) and not blank.lens.may_fold:
        blank.require_monotone(name)
    return blank


# ---- phi and lens ---------------------------------------------------------------------------------------------------


def _choose_phi(
    sights: Sights, homographies: Homographies, unit: float, options: Options, priors: Sequence[Prior]
) -> tuple[float, str]:
    """phi from r1 . r2 = 0 and |r1| = |r2| over all sights, with the priors, by a one-dimensional search.

    Where no view is tilted enough and there is no prior, a usual field of view is guessed; the bundle then says how
    little is known.
    """
    enough_views = 50  # views that suffice for phi
    if "phi" in options.fixed:
        return options.fixed["phi"], "fixed"
    known = [p for p in priors if p.quantity in ("phi", "height_m", "position_m")]

    some = slice(None, None, max(1, len(homographies.matrices) // enough_views))

    def cost(phi: Array) -> Array:
        error = orthogonality_error(homographies.matrices[some], phi) * homographies.sizes_px[some]
        total = np.sum(np.log1p((error / 0.5) ** 2), axis=1)
        return np.asarray(total + sum(_prior_cost(prior, phi, sights, homographies) for prior in known))

    grid = unit * _GRID
    values = cost(grid)
    acceptable = grid[values <= values.min() + 1.0]
    flat = acceptable[-1] > 1.6 * acceptable[0]
    middle = min(acceptable, key=lambda phi: abs(np.log(phi / (USUAL_PHI * unit)))) if flat else grid[np.argmin(values)]
    for _ in range(0 if flat else 6):
        step = int(np.argmin(cost(middle * _NEAR)))
        middle *= _NEAR[step]
        if 0 < step < len(_NEAR) - 1:
            break
    source = "guess" if flat else ("prior" if known else "views")
    return float(middle), source


def _prior_cost(prior: Prior, phi: Array, sights: Sights, homographies: Homographies) -> Array:
    if prior.quantity == "phi":
        return np.asarray(((phi - prior.value[0]) / prior.sigma[0]) ** 2)
    keys = [sights.keys[i] for i in homographies.sights]
    own = np.array([key.placement is None and key.station == prior.name for key in keys])
    if not own.any():
        return np.zeros(len(phi))
    heights = []
    for value in phi:
        poses = _poses_at(homographies, value)[own]
        heights.append(float(np.mean(-np.sum(poses[:, :, 2] * poses[:, :, 3], axis=1))))
    spread = max(prior.sigma[-1], 0.01 * abs(prior.value[-1]))  # the height of an initial estimate is no more accurate
    return np.asarray(((np.array(heights) - prior.value[-1]) / spread) ** 2)
