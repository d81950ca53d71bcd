"""Possible poses of a camera with a known lens: closed form, the old pose and its turns, then a coarse grid.

Every candidate is refined by the kernels' own search, first with a wide loss, then at the noise of the old calibration;
the least robust cost wins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Pose, distinct, median, replace
from ceres_cal.observations.sights import SightKey, Sights
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import Estimate, GaussianPrior, Weighting, over, placement_costs, pose_keys
from ceres_cal.problem.residuals import Residuals, residuals
from ceres_cal.scene.camera import Camera
from ceres_cal.start import fit_lines, plane_sight, pose_from_homography

# Scales of the loss, in standard deviations, while a candidate is far off: 20 px and 4 px at 0.3 px of noise. Nothing
# changes from half to double.
_WIDE = (60.0, 12.0)
# Turns about each axis of the camera; neighbouring basins of convergence overlap.
_GRID = list(product(np.deg2rad((-24.0, 0.0, 24.0)), repeat=3))
# m and rad: candidates closer than this converge to one minimum. Nothing changes from half to double.
_ALIKE = (0.02, 0.01)
# Nats by which log-likelihoods of competing poses may differ: a factor of 20 000. Nothing changes from half to double.
_NATS_ALIKE = 10.0
# Factors on the calibration's noise that new observations may have; the likeliest is used. With 1 alone a pose passes
# through some of what is clicked after a calibration by boards, and the others seem to be strays (19 of 120 cameras
# that stand still were moved, now 6; of 120 that were moved 105 were found, now 102). Halved it is 7, doubled 5.
NOISES = (1.0, 2.0, 4.0, 8.0)
# A pose fits where this share of the observations lies within this many standard deviations, at a noise of at most this
# factor on the calibration's: up to 40 % may be wrong. Nothing changes, but with a factor of 2 another iris fits no
# pose, and is not named.
_FITS_SHARE, _FITS_SIGMA, _FITS_SCALE = 0.6, 5.0, 4.0


class PoseCandidate(Frozen):
    """A pose that a station may have.

    Attributes:
        misfit: negative log-likelihood of its observations, each of which may be a stray; in nats.
        scale: median residual, relative to the old calibration's noise. share: of the observations that are within five
            times that noise (or their own, up to four times as large).
    """

    pose: Pose
    misfit: float
    scale: float
    share: float

    @property
    def fits(self) -> bool:
        """Whether most observations are explained, with a plausible noise."""
        return self.share >= _FITS_SHARE and self.scale <= _FITS_SCALE


class PoseSearch(Frozen):
    """One station's observations of the world, through a lens that counts as known.

    Attributes:
        sight: the station's only sight. scales: expected noise scales of points and curves.
    """

    sight: Sights
    estimate: Estimate
    scales: tuple[float, float]

    @property
    def camera(self) -> Camera:
        """The station's camera, without a particular pose."""
        return self.estimate.cameras[self.sight.key.camera]

    def allows(self, pose: Pose) -> bool:
        """Return whether a pose is possible: above the floor, and not in the clouds; a placement may be anywhere."""
        farthest_m = 1e3
        x, y, height = pose.position
        near = float(np.hypot(x, y)) < farthest_m and abs(float(height)) < farthest_m
        return near and (self.sight.key.placement is not None or height > 0.0)

    @property
    def drawn(self) -> Sights:
        """The sight with points as drawn: on a plane, also where a board was built bent."""
        every = np.concatenate([target.point_array for target in self.sight.observations.targets.values()])
        return replace(self.sight, points=every[self.sight.point_index])

    def with_camera(self, camera: Camera) -> PoseSearch:
        """Return the search with another lens."""
        cameras = {**self.estimate.cameras, self.sight.key.camera: camera}
        return replace(self, estimate=replace(self.estimate, cameras=cameras))

    def residuals(self, pose: Pose) -> Residuals:
        """Return the residuals of the sight's observations with this pose of the camera in the sight's frame."""
        key = self.sight.key
        station = replace(self.estimate.stations[key.station], cam_from_world=pose)
        stations = {**self.estimate.stations, key.station: station}
        placements = {} if key.placement is None else {key.placement: Pose.identity()}
        there = replace(self.estimate, stations=stations, placements=placements)
        return residuals(self.sight, there)


def pose_candidates(search: PoseSearch, old: Sequence[Pose], patience: int = 2) -> list[PoseCandidate]:
    """Return possible poses, best first, without repetitions.

    Args:
        old: earlier poses of the camera. patience: 0 tries only the old poses, their turns and the closed form;
            otherwise the grid around them is tried as well, where none of those fits.
    """
    turns = [(0.0, 0.0, angle) for angle in (np.pi, np.pi / 2, -np.pi / 2)]
    closed = closed_form(search)
    seeds = [*old, *(pose.turned(turn) for pose in old for turn in turns)]
    unmoved = _refined(search, old, ())  # a wide loss leads away from a true pose where many labels are wrong
    candidates = _distinct([*unmoved, *_refined(search, [*seeds, *([closed] if closed is not None else [])])])
    if patience and not (candidates and candidates[0].fits):
        around = [pose.turned(turn) for pose in seeds for turn in _GRID]
        candidates = _distinct([*candidates, *_refined(search, around)])
    return candidates


def found_poses(
    sights: Sights, estimate: Estimate, scales: tuple[float, float], old: Mapping[str, Pose], patience: int = 2
) -> tuple[Indices, Array]:
    """Return the numbers (K,) of the sights with a pose, through known lenses, and the likeliest pose (K, 3, 4) of
    each.

    Args:
        scales: see `PoseSearch`. old: earlier poses of stations. patience: see `pose_candidates`.
    """
    found = {}
    for number, key in enumerate(sights.keys):
        before = [old[key.station]] if key.placement is None and key.station in old else []
        if candidates := pose_candidates(PoseSearch(sights[number], estimate, scales), before, patience):
            found[number] = candidates[0].pose.matrix
    return np.array(list(found), dtype=np.int64), np.array(list(found.values())).reshape(-1, 3, 4)


def alike(candidates: Sequence[PoseCandidate]) -> list[PoseCandidate]:
    """Return those that explain the observations about as well as the best one."""
    return [one for one in candidates if one.misfit <= candidates[0].misfit + _NATS_ALIKE]


def least_moved(candidates: Sequence[PoseCandidate], old: Sequence[Pose]) -> PoseCandidate:
    """Return the candidate with the smallest movement."""
    return min(candidates, key=lambda one: min((sum(movement(one.pose, before)) for before in old), default=0.0))


def equations(sight: Sights) -> int:
    """Return how many equations a sight gives for a pose: two for each point and straight line, three for each arc, but
    no more than its observations.
    """
    tracks, counts = np.unique(sight.track_index, return_counts=True)
    most = np.where(sight.is_arc[tracks], 3, 2)
    return 2 * len(distinct(sight.points, axis=0)) + int(np.sum(np.minimum(counts, most)))


def closed_form(search: PoseSearch) -> Pose | None:
    """Return the pose by a homography between the lens's rays and the plane of the drawing, from points and straight
    lines; None where they are too few (each gives two equations) or do not determine it.
    """
    rounds = 4  # of the closed form's reweighting
    plane = plane_sight(search.drawn, height_m=0.0)
    rays = search.camera.rays(plane.pixels)
    known = np.isfinite(rays[:, 0])
    if plane.equations < 8 or np.count_nonzero(known) < 8:
        return None
    homography, _ = fit_lines(plane.lines[known], rays[known], rounds)
    return None if homography is None else pose_from_homography(homography)


def _refined(search: PoseSearch, poses: Sequence[Pose], wides: Sequence[float] = _WIDE) -> list[PoseCandidate]:
    """Return each candidate at its minimum, best first, without poses from which something cannot be seen.

    Args:
        wides: scales of the loss, in standard deviations, before the last one at the expected noise.
    """
    stack = np.array([pose.matrix for pose in poses])
    for wide in wides:
        stack = _searched(search, stack, Weighting(*search.scales, "huber", wide), 1e-3)
    stack = _searched(search, stack, Weighting(*search.scales, "cauchy", 2.0), 1e-8)
    refined = [Pose(matrix[:, :3], matrix[:, 3]) for matrix in stack]
    return _distinct([candidate_at(search, pose) for pose in refined if search.allows(pose)])


def _searched(search: PoseSearch, stack: Array, weighting: Weighting, tolerance: float) -> Array:
    """Return poses (K, 3, 4) after the search, without those from which something cannot be seen."""
    if not len(stack):
        return stack
    key, count = search.sight.key, len(stack)
    many = search.sight.take(np.zeros(count, dtype=np.int64))
    keys = tuple(SightKey(key.camera, key.station, str(number)) for number in range(count))
    world = search.estimate.stations[key.station].cam_from_world
    placements = {k.placement: world for k in keys if k.placement is not None}
    estimate = replace(search.estimate, placements=placements).with_placements(keys, stack)
    costs, refined = placement_costs(replace(many, keys=keys), estimate, weighting, stack, tolerance)
    return refined[np.isfinite(costs)]


def candidate_at(search: PoseSearch, pose: Pose) -> PoseCandidate:
    """Return how well a pose explains the sight."""
    there = search.residuals(pose)
    points, curves = there.in_sigmas(search.sight, search.scales)
    lengths = np.nan_to_num(np.concatenate([points / 1.1774, curves / 0.6745]), nan=np.inf)
    scale = median(lengths)
    sigmas = np.nan_to_num(np.concatenate([points, curves]), nan=np.inf)
    share = float(np.mean(sigmas <= _FITS_SIGMA * np.clip(scale, 1.0, _FITS_SCALE)))
    return PoseCandidate(pose, there.misfit(search.sight, search.camera, search.scales), scale, share)


def _distinct(candidates: Sequence[PoseCandidate]) -> list[PoseCandidate]:
    """Return the candidates, best first, without repetitions."""
    kept: list[PoseCandidate] = []
    for candidate in sorted(candidates, key=lambda c: c.misfit):
        moves = [movement(candidate.pose, other.pose) for other in kept]
        if not any(shift_m < _ALIKE[0] and turn < _ALIKE[1] for shift_m, turn in moves):
            kept.append(candidate)
    return kept


def movement(a: Pose, b: Pose) -> tuple[float, float]:
    """Return the distance (m) between the positions of two cameras, and the angle (rad) between their orientations."""
    cosine = 0.5 * (float(np.trace(a.rotation @ b.rotation.T)) - 1.0)
    sine = float(np.linalg.norm(a.rotation - b.rotation)) / np.sqrt(8.0)  # |a - b| = 2 sqrt 2 sin(angle / 2)
    angle = 2.0 * np.arcsin(min(sine, 1.0)) if cosine > -0.9 else np.arccos(np.clip(cosine, -1.0, 1.0))
    return float(np.linalg.norm(a.position - b.position)), float(angle)


def moved_from(known: GaussianPrior, before: Posterior, station: str, now: Estimate) -> tuple[float, float]:
    """Return how far (m) and by what angle (rad) a station has moved from its prior, given everything else as it is
    seen now: a height that changes with phi is no movement. The distance is NaN where phi is only known to be in a
    valley that was followed.
    """
    keys = pose_keys("station", station)
    own = known.given(keys, now)
    shift_m, turn = np.split(over(own.offsets(now), own.keys, keys), 2)
    known_m = np.nan if now.stations[station].camera in before.followed else float(np.linalg.norm(shift_m))
    return known_m, float(np.linalg.norm(turn))


def moved_words(shift_m: float, turned_deg: float, about: str = "") -> str:
    """Return in words how far a station moved."""
    if np.isnan(shift_m):
        return f"turned by {about}{turned_deg:.3f} deg (the distance is unknown, because phi is)"
    return f"moved by {about}{1e3 * shift_m:.1f} mm and {turned_deg:.3f} deg"
