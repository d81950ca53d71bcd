"""From nothing to a start for the solve, in closed form (design, section 7; the paper's sections 2 and 3).

For each camera: the radial profile, one homography per sight, phi, lens coefficients, poses; then the poses are chained
into stations and placements. Nothing here is the answer: the bundle is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.camera import Camera
from ceres_cal.closed_forms import (
    PlaneData,
    Profile,
    facing,
    homography_from_points,
    inverse_homography_from_moments,
    line_moments,
    orthogonality_error,
    polar_pose,
    profile_from_moments,
    radial_alignment,
    require_spread,
    ring_profile,
)
from ceres_cal.errors import DegenerateError
from ceres_cal.lens import Brown, KannalaBrandt, Lens, Radial
from ceres_cal.observations import Observations, Prior
from ceres_cal.parameters import Estimate, Options, Station, anchored_stations
from ceres_cal.sights import Sight
from ceres_cal.transforms import Array, Pose

_MOST = 1500  # observations of one kind in a sight beyond which a start learns nothing more
_PHI_RANGE = np.geomspace(0.15, 15.0, 120)  # in half image diagonals
_PHI_GUESS = 1.4


@dataclass(frozen=True, eq=False)
class _PlaneSight:
    """A sight's observations on its plane z = height: points and straight segments, offsets in px."""

    sight: Sight
    height_m: float
    points: Array
    offsets: Array
    lines: Array
    line_offsets: Array

    @property
    def equations(self) -> int:
        return 2 * len(self.points) + len(self.lines)

    @property
    def size_px(self) -> float:
        """Spread of the observations over the image; 0 where there are none on the plane."""
        every = np.vstack([self.offsets, self.line_offsets])
        if not len(every):
            return 0.0
        return float(np.sqrt(np.mean(np.sum((every - every.mean(axis=0)) ** 2, axis=1))))


@dataclass(frozen=True)
class Start:
    """A start for the solve, and where phi of each camera came from: "fixed", "views", "prior" or "guess"."""

    estimate: Estimate
    phi_from: Mapping[str, str]


def initialise(observations: Observations, sights: Sequence[Sight], options: Options) -> Start:
    """A start for everything the observations show.

    Raises:
        DegenerateError: naming the sight whose pose the observations cannot tell.
    """
    cameras: dict[str, Camera] = {}
    phi_from: dict[str, str] = {}
    poses: dict[int, Pose] = {}
    priors = (*observations.priors, *options.priors)
    for name, image_size in observations.cameras.items():
        own = [number for number, sight in enumerate(sights) if sight.camera == name]
        start = _start_camera(name, image_size, [sights[i] for i in own], options, priors)
        cameras[name], phi_from[name] = start.camera, start.phi_from
        poses |= {own[i]: pose for i, pose in start.poses.items()}
    stations, placements = _chain_poses(observations, sights, poses)
    return Start(Estimate(cameras, stations, placements), phi_from)


# ---- one camera -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _CameraStart:
    camera: Camera
    phi_from: str
    poses: Mapping[int, Pose]


def _start_camera(
    name: str, image_size: tuple[int, int], sights: Sequence[Sight], options: Options, priors: Sequence[Prior]
) -> _CameraStart:
    blank = _blank_camera(name, image_size, options, priors)
    unit = 0.5 * float(np.hypot(*image_size))
    planes = [_on_plane(sight, blank) for sight in sights]
    profile, homographies = _profile_and_homographies(planes, sights, blank, unit)
    own_priors = [p for p in priors if p.name == (name if p.owner == "camera" else sights[0].station)]
    phi, phi_from = _choose_phi(planes, homographies, unit, options, own_priors)
    reach = max(float(np.max(np.linalg.norm(_all_offsets(s, blank), axis=1))) for s in sights)
    camera = replace(blank, phi=phi, lens=_fit_lens(blank.lens, profile, phi, reach, options.fixed))
    flat = np.diag([1.0 / phi, 1.0 / phi, 1.0])
    poses = {}
    for i, homography in homographies.items():
        pose = polar_pose(flat @ homography)
        shift = planes[i].height_m * pose.rotation[:, 2]
        poses[i] = Pose(pose.rotation, pose.translation - shift)
    return _CameraStart(camera, phi_from, poses)


def _blank_camera(name: str, image_size: tuple[int, int], options: Options, priors: Sequence[Prior]) -> Camera:
    """Fixed numbers and principal point put in; phi still to come."""
    centre = [(image_size[0] - 1) / 2.0, (image_size[1] - 1) / 2.0]
    aspect = options.fixed.get("aspect", 1.0)
    for prior in priors:
        if prior.owner == "camera" and prior.name == name:
            if prior.quantity == "principal_point":
                centre = list(prior.value)
            elif prior.quantity in ("cx", "cy"):
                centre[prior.quantity == "cy"] = prior.value[0]
            elif prior.quantity == "aspect":
                aspect = prior.value[0]
    cx, cy = options.fixed.get("cx", centre[0]), options.fixed.get("cy", centre[1])
    return Camera(image_size, 1.0, (cx, cy), options.blank_lens, aspect)


def _all_offsets(sight: Sight, camera: Camera) -> Array:
    return camera.offsets(np.vstack([sight.pixels, sight.curve_pixels]))


def _on_plane(sight: Sight, camera: Camera) -> _PlaneSight:
    """The observations on the plane that holds most of them, thinned where there are very many."""
    segments = ~sight.is_arc[sight.track]
    tracks = sight.tracks[sight.track]
    level = np.abs(tracks[:, 1, 2]) < 1e-12
    heights, votes = np.unique(np.concatenate([sight.points[:, 2], tracks[level, 0, 2]]).round(9), return_counts=True)
    height = float(heights[np.argmax(votes)]) if len(heights) else 0.0
    on = np.flatnonzero(np.abs(sight.points[:, 2] - height) < 1e-9)
    on = on[:: max(1, len(on) // _MOST)]
    straight = np.flatnonzero(segments & level & (np.abs(tracks[:, 0, 2] - height) < 1e-9))
    straight = straight[:: max(1, len(straight) // _MOST)]
    c, a = tracks[straight, 0, :2], tracks[straight, 1, :2]
    normal = np.column_stack([-a[:, 1], a[:, 0]]) / np.linalg.norm(a, axis=1, keepdims=True)
    return _PlaneSight(
        sight,
        height,
        sight.points[on, :2],
        camera.offsets(sight.pixels[on]),
        np.column_stack([normal, -np.sum(normal * c, axis=1)]),
        camera.offsets(sight.curve_pixels[straight]),
    )


def _profile_and_homographies(
    planes: Sequence[_PlaneSight], sights: Sequence[Sight], camera: Camera, unit: float
) -> tuple[Profile, dict[int, Array]]:
    """The camera's radial profile and the homography of each sight that can tell one."""
    pure = [i for i, plane in enumerate(planes) if len(plane.points) >= 6 and not len(plane.lines)]
    pure = [i for i in pure if _is_spread(planes[i].points)]
    mixed = [i for i, plane in enumerate(planes) if i not in pure and plane.equations >= 8]
    ringed = [
        i for i in range(len(planes)) if i not in pure and i not in mixed and sights[i].is_arc[sights[i].track].any()
    ]
    homographies: dict[int, Array] = {}
    profile: Profile | None = None
    if sum(len(planes[i].points) - 3 for i in pure) >= 10:
        profile, found = radial_alignment(_flatten([planes[i] for i in pure]), len(pure), unit, terms=2)
        homographies |= dict(zip(pure, found, strict=True))
    for i in ringed:
        ring, homography = _from_rings(sights[i], camera, unit)
        profile = profile or ring
        homographies[i] = homography
    if profile is None:
        profile = _profile_from_lines([planes[i] for i in mixed], unit)
    for i in [*mixed, *(i for i in pure if i not in homographies)]:
        homographies[i] = _homography_of(planes[i], profile)
    for i in pure:
        homographies[i] = _without_wrong_labels(planes[i], profile, homographies[i])
    return profile, homographies


def _is_spread(points: Array) -> bool:
    try:
        require_spread(points)
    except DegenerateError:
        return False
    return True


def _flatten(planes: Sequence[_PlaneSight]) -> PlaneData:
    return PlaneData(
        np.repeat(np.arange(len(planes)), [len(plane.points) for plane in planes]),
        np.vstack([plane.points for plane in planes]),
        np.vstack([plane.offsets for plane in planes]),
    )


def _as_lines(plane: _PlaneSight, scale: float) -> tuple[Array, Array]:
    """Every observation as pixels on lines of the plane scaled to unit size; a point is the crossing of two."""
    x, y = scale * plane.points.T
    one, zero = np.ones(len(x)), np.zeros(len(x))
    lines = np.vstack(
        [
            np.column_stack([one, zero, -x]),
            np.column_stack([zero, one, -y]),
            plane.lines * (1.0, 1.0, scale),
        ]
    )
    return lines, np.vstack([plane.offsets, plane.offsets, plane.line_offsets])


def _scale_of(plane: _PlaneSight) -> float:
    reach = max(
        float(np.max(np.abs(plane.points), initial=0.0)), float(np.max(np.abs(plane.lines[:, 2]), initial=0.0)), 1e-9
    )
    return 1.0 / reach


def _solve_plane(plane: _PlaneSight, profile: Profile, rounds: int) -> tuple[Array, float, float]:
    """(G, typical distance in the scaled plane, distinctness): the point-on-line DLT, reweighted against wrong labels."""
    scale = _scale_of(plane)
    lines, offsets = _as_lines(plane, scale)
    lifted = profile.lift(offsets) / (profile.unit_px, profile.unit_px, 1.0)
    weights = np.ones(len(lines))
    inverse, typical, distinct = np.eye(3), np.inf, 0.0
    for _ in range(rounds):
        moments = line_moments(lines, offsets, weights, profile.unit_px, len(profile.coefficients))
        inverse, _, distinct = inverse_homography_from_moments(moments / len(lines), profile.coefficients)
        sent = lifted @ inverse.T
        distance = np.abs(np.sum(lines * sent, axis=1)) / np.maximum(np.abs(sent[:, 2]), 1e-9)
        typical = float(np.median(distance))
        bound = max(3.0 * typical, 1e-9)
        weights = 1.0 / (np.maximum(sent[:, 2] ** 2, 1e-9) * (1.0 + (distance / bound) ** 2))
        weights /= weights.mean()
    return np.diag([1.0, 1.0, scale]) @ inverse, typical, distinct


def _homography_of(plane: _PlaneSight, profile: Profile) -> Array:
    """H of one sight: plane (x, y, 1) m to (p in px, w)."""
    inverse, _, distinct = _solve_plane(plane, profile, rounds=6)
    if distinct < 1e-6:
        raise DegenerateError(
            f"{plane.sight.frame_name}: its {len(plane.points)} points and {len(np.unique(plane.lines, axis=0))} lines "
            "cannot fix the plane's pose (all on one line, or parallel): add points or lines in other directions"
        )
    homography = np.diag([profile.unit_px, profile.unit_px, 1.0]) @ np.linalg.inv(inverse)
    lifted = profile.lift(np.vstack([plane.offsets, plane.line_offsets]))
    sent = lifted @ np.linalg.inv(homography).T
    return facing(homography, sent[:, :2] / sent[:, 2:], lifted)


def _profile_from_lines(planes: Sequence[_PlaneSight], unit: float) -> Profile:
    """The profile under which lines are straight and points in place: rank-one closed form, then a shrinking grid."""
    candidates = [(0.0, 0.0)]
    for plane in planes:
        lines, offsets = _as_lines(plane, _scale_of(plane))
        candidates.append(profile_from_moments(line_moments(lines, offsets, np.ones(len(lines)), unit, 2), 2))  # type: ignore[arg-type]
    candidates += [(c1, c2) for c1 in np.linspace(-1.0, 0.4, 8) for c2 in np.linspace(-0.6, 0.6, 5)]

    def misfit(c: tuple[float, ...]) -> float:
        if np.min(1.0 + c[0] * _RADII**2 + c[1] * _RADII**4) < -0.5:
            return np.inf
        return sum(_solve_plane(plane, Profile(c, unit), rounds=2)[1] for plane in planes)

    best = min(candidates, key=misfit) if planes else candidates[0]
    for width in (0.1, 0.03, 0.01, 0.003) if planes else ():
        around = [(best[0] + i * width, best[1] + j * width) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        best = min(around, key=misfit)
    return Profile(best, unit)


_RADII = np.linspace(0.0, 1.0, 21)


def _from_rings(sight: Sight, camera: Camera, unit: float) -> tuple[Profile, Array]:
    """Profile and homography of concentric rings seen about frontally (paper, section 2)."""
    offsets = camera.offsets(sight.curve_pixels)
    radii = np.linalg.norm(sight.tracks[sight.track, 1], axis=1)
    centre = offsets.mean(axis=0)
    for _ in range(10):  # each ring's own mean radius, so that stretches that are not seen do not pull the centre
        away = offsets - centre
        radius = np.linalg.norm(away, axis=1)
        rings, ring = np.unique(radii, return_inverse=True)
        mean = np.bincount(ring, radius) / np.bincount(ring)
        direction = away / np.maximum(radius, 1e-9)[:, None]
        centre = centre + np.linalg.lstsq(direction, radius - mean[ring], rcond=None)[0]
    profile, kappa = ring_profile(np.linalg.norm(offsets - centre, axis=1), radii, unit)
    if len(rings) < 3:
        profile = Profile((0.0, 0.0), unit)
    return profile, np.array([[kappa, 0.0, centre[0]], [0.0, kappa, centre[1]], [0.0, 0.0, 1.0]])


def _without_wrong_labels(plane: _PlaneSight, profile: Profile, homography: Array) -> Array:
    """The homography again by LO-RANSAC (pycolmap) where single points lie far off while most fit."""
    lifted = profile.lift(plane.offsets)
    sent = np.column_stack([plane.points, np.ones(len(plane.points))]) @ homography.T
    image, ideal = lifted[:, :2] / lifted[:, 2:], sent[:, :2] / sent[:, 2:]
    error = np.linalg.norm(image - ideal, axis=1)
    if len(error) < 8 or np.max(error) < max(10.0 * float(np.median(error)), 4.0):
        return homography
    import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error = max(4.0 * float(np.median(error)), 2.0)
    options.random_seed = 0
    found = pycolmap.estimate_homography_matrix(plane.points, image, options)
    if found is None:
        return homography
    inliers = np.asarray(found["inlier_mask"], dtype=bool)
    if inliers.sum() < 6 or not _is_spread(plane.points[inliers]):
        return homography
    return homography_from_points(plane.points[inliers], lifted[inliers])


# ---- phi and lens ---------------------------------------------------------------------------------------------------


def _choose_phi(
    planes: Sequence[_PlaneSight],
    homographies: Mapping[int, Array],
    unit: float,
    options: Options,
    priors: Sequence[Prior],
) -> tuple[float, str]:
    """phi from r1 . r2 = 0 and |r1| = |r2| over all sights, with what is known beforehand, by a one-dimensional search.

    Where no view is tilted enough to tell and nothing is known, a usual field of view is guessed; the bundle then says
    how little is known.
    """
    if "phi" in options.fixed:
        return options.fixed["phi"], "fixed"
    sizes = np.array([planes[i].size_px for i in homographies])
    stack = np.array(list(homographies.values())).reshape(-1, 3, 3)
    known = [p for p in priors if p.quantity in ("phi", "height_m", "position_m")]

    def cost(phi: Array) -> Array:
        error = orthogonality_error(stack, phi) * sizes
        total = np.sum(np.log1p((error / 0.5) ** 2), axis=1)
        return np.asarray(total + sum(_prior_cost(prior, phi, planes, homographies) for prior in known))

    grid = unit * _PHI_RANGE
    values = cost(grid)
    acceptable = grid[values <= values.min() + 1.0]
    flat = acceptable[-1] > 1.6 * acceptable[0]
    middle = (
        min(acceptable, key=lambda phi: abs(np.log(phi / (_PHI_GUESS * unit)))) if flat else grid[np.argmin(values)]
    )
    for _ in range(0 if flat else 6):
        near = middle * np.geomspace(1.0 / 1.04, 1.04, 13)
        middle = near[np.argmin(cost(near))]
    source = "guess" if flat else ("prior" if known else "views")
    return float(middle), source


def _prior_cost(prior: Prior, phi: Array, planes: Sequence[_PlaneSight], homographies: Mapping[int, Array]) -> Array:
    if prior.quantity == "phi":
        return np.asarray(((phi - prior.value[0]) / prior.sigma[0]) ** 2)
    heights = [
        [polar_pose(np.diag([1.0 / f, 1.0 / f, 1.0]) @ h).position[2] + planes[i].height_m for f in phi]
        for i, h in homographies.items()
        if planes[i].sight.placement is None and planes[i].sight.station == prior.name
    ]
    if not heights:
        return np.zeros(len(phi))
    spread = max(prior.sigma[-1], 0.01 * abs(prior.value[-1]))  # a start's height is no better than that
    return np.asarray(((np.mean(heights, axis=0) - prior.value[-1]) / spread) ** 2)


def _fit_lens(blank: Lens, profile: Profile, phi: float, reach_px: float, fixed: Mapping[str, float]) -> Lens:
    """The lens nearest to the profile over the observed radii: every model is linear in its coefficients there."""
    r = np.linspace(0.02, 1.0, 50) * reach_px
    w = profile.lift(np.column_stack([r, np.zeros_like(r)]))[:, 2]
    columns, right = _lens_equations(blank, r, w, phi)
    free = [i for i, name in enumerate(blank.names) if name in columns and name not in fixed]
    ahead = np.isfinite(right)
    right = right - sum(
        np.nan_to_num(columns[n]) * blank.coefficients[n] for n in blank.names if n in columns and n in fixed
    )
    for count in range(len(free), 0, -1):
        basis = np.column_stack([columns[blank.names[i]] for i in free[:count]])[ahead]
        values = np.array(blank.values)
        values[free[:count]] = np.linalg.lstsq(basis, right[ahead], rcond=1e-8)[0]
        lens = blank.with_values(values)
        if lens.monotone_radius(phi) > 1.05 * reach_px:
            return lens
    return blank


def _lens_equations(lens: Lens, r: Array, w: Array, phi: float) -> tuple[dict[str, Array], Array]:
    """Columns by coefficient name and right side of the model at measured radii r whose rays are (r, phi w)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ideal = np.where(w > 0.02, r / w, np.nan)
    if isinstance(lens, Radial):
        return {name: r**power for name, power in zip(lens.names, lens.powers, strict=True)}, ideal - r
    if isinstance(lens, Brown):
        u = ideal / phi
        return {name: u**power for name, power in (("k1", 3), ("k2", 5), ("k3", 7))}, r / phi - u
    assert isinstance(lens, KannalaBrandt)
    angle = np.arctan2(r, phi * w)
    return {name: angle**power for name, power in zip(lens.names, lens.radius_powers, strict=True)}, r / phi - angle


# ---- stations and placements ----------------------------------------------------------------------------------------


def _chain_poses(
    observations: Observations, sights: Sequence[Sight], poses: Mapping[int, Pose]
) -> tuple[dict[str, Station], dict[str, Pose]]:
    """Stations and placements from the sights' poses: best-seen sights first, each one extending what is known."""
    stations = {name: Pose.identity() for name in anchored_stations(observations)}
    placements: dict[str, Pose] = {}
    waiting = sorted(poses, key=lambda i: -len(sights[i].point_rows) - len(sights[i].curve_rows))
    progress = True
    while progress:
        progress = False
        for i in list(waiting):
            sight, pose = sights[i], poses[i]
            station_known = sight.station in stations
            if sight.placement is None or sight.placement in placements:
                if not station_known:
                    world = Pose.identity() if sight.placement is None else placements[sight.placement]
                    stations[sight.station] = pose @ world.inverse
            elif station_known:
                placements[sight.placement] = stations[sight.station].inverse @ pose
            else:
                continue
            waiting.remove(i)
            progress = True
    _require_all(observations, sights, stations, placements)
    cameras = observations.stations
    return {name: Station(cameras[name], stations[name]) for name in cameras if name in stations}, placements


def _require_all(
    observations: Observations, sights: Sequence[Sight], stations: Iterable[str], placements: Iterable[str]
) -> None:
    for sight in sights:
        if sight.station in stations and (sight.placement is None or sight.placement in placements):
            continue
        frames = ", ".join(repr(observations.views[i].frame) for i in sight.views[:3])
        raise DegenerateError(
            f"frame {frames} ({sight.frame_name}): {len(sight.point_rows)} points and {len(sight.curve_rows)} curve "
            "observations cannot fix its pose: give at least four points, not on one line, or remove the view"
        )
