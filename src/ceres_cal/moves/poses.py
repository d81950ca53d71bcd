"""Where a camera with a known lens may stand: closed form, the old pose and its turns, then a coarse grid.

Every candidate is brought to its best by the kernels' own search, first under a wide loss, then at the noise that the
old calibration saw; the least robust cost wins.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.model.parameters import Estimate
from ceres_cal.model.residuals import Residuals, residuals
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import SightKey, Sights
from ceres_cal.scene.camera import Camera
from ceres_cal.solve import Weighting, placement_costs
from ceres_cal.start.closed_forms import fit_lines, pose_from_homography
from ceres_cal.start.planes import plane_sight

# Standard deviations: scale of the loss while a candidate is far off, 20 px and 4 px at 0.3 px of noise. Nothing
# changes from half to double.
_WIDE = (60.0, 12.0)
_FARTHEST_M = 1e3
_GRID_DEG = (-24.0, 0.0, 24.0)  # of turns about each axis of the camera; neighbours' basins overlap
# Share of observations that may be anywhere in the image: as many as are wrong in the simulated days of
# scripts/moves.py. Nothing changes from half to double.
_STRAY = 0.05
# m and rad: candidates nearer than this end in one minimum. Nothing changes from half to double.
_ALIKE = (0.02, 0.01)
# A pose fits where that share of the observations lies within so many standard deviations, at a noise of at most so
# many times that of the calibration: up to 40 % may be wrong. Nothing changes but at a noise of twice: another iris
# then fits no pose, and is not named.
_FITS_SHARE, _FITS_SIGMA, _FITS_SCALE = 0.6, 5.0, 4.0
_ROUNDS = 4  # of the closed form's reweighting


@dataclass(frozen=True, eq=False)
class Place:
    """A pose that a station may have.

    Attributes:
        misfit: negative log likelihood of its observations, each of which may be a stray; in nats.
        scale: median residual, in units of the old calibration's noise. share: of the observations that are within
            five times that noise (or their own, up to four times as large).
    """

    pose: Pose
    misfit: float
    scale: float
    share: float

    @property
    def fits(self) -> bool:
        """Whether most observations are explained, with a noise that is not absurd."""
        return self.share >= _FITS_SHARE and self.scale <= _FITS_SCALE


@dataclass(frozen=True, eq=False)
class PoseSearch:
    """What one station sees of the world, through a lens that is taken as known.

    Attributes:
        sight: its one sight. scales: noise scales of points and curves to be expected.
    """

    observations: Observations
    sight: Sights
    estimate: Estimate
    scales: tuple[float, float]

    @property
    def camera(self) -> Camera:
        """The station's camera, at no particular pose."""
        return self.estimate.cameras[self.sight.key.camera]

    def allows(self, pose: Pose) -> bool:
        """Whether a camera may stand there: over the floor, not in the clouds; a placement may be anywhere near."""
        x, y, height = pose.position
        near = float(np.hypot(x, y)) < _FARTHEST_M and abs(float(height)) < _FARTHEST_M
        return near and (self.sight.key.placement is not None or height > 0.0)

    def with_camera(self, camera: Camera) -> PoseSearch:
        """The same through another lens."""
        cameras = {**self.estimate.cameras, self.sight.key.camera: camera}
        return replace(self, estimate=replace(self.estimate, cameras=cameras))

    def residuals(self, pose: Pose) -> Residuals:
        """Residuals of the sight's observations where the camera has this pose in the sight's frame."""
        key = self.sight.key
        station = replace(self.estimate.stations[key.station], cam_from_world=pose)
        stations = {**self.estimate.stations, key.station: station}
        placements = {} if key.placement is None else {key.placement: Pose.identity()}
        there = replace(self.estimate, stations=stations, placements=placements)
        return residuals(self.observations, self.sight, there)


def places(search: PoseSearch, old: Sequence[Pose], patience: int = 2) -> list[Place]:
    """Poses that come into question, best first, each once.

    Args:
        old: where the camera stood before. patience: 0 tries the old poses, their turns and the closed form alone; 1
            the grid around them as well, where none of those fits.
    """
    seeds = [*old, *(turn for pose in old for turn in _turned(pose))]
    closed = closed_form(search)
    found = _settled(search, [*seeds, *([closed] if closed is not None else [])])
    if patience and not (found and found[0].fits):
        around = [turn for pose in seeds for turn in _grid(pose)]
        found = _distinct([*found, *_settled(search, around)])
    return found


def _turned(pose: Pose) -> list[Pose]:
    """The camera turned by a half and by quarters about its own axis, where it stands."""
    return [
        Pose.looking(pose.position, rotation_exp((0, 0, a)) @ pose.rotation) for a in (np.pi, np.pi / 2, -np.pi / 2)
    ]


def _grid(pose: Pose) -> list[Pose]:
    angles = np.deg2rad(_GRID_DEG)
    return [Pose.looking(pose.position, rotation_exp(turn) @ pose.rotation) for turn in product(angles, repeat=3)]


def equations(sight: Sights) -> int:
    """What a sight can say of a pose's six numbers and more: two for each point and straight line, three for each arc,
    but no more than its observations.
    """
    tracks, counts = np.unique(sight.track_index, return_counts=True)
    most = np.where(sight.is_arc[tracks], 3, 2)
    return 2 * len(np.unique(sight.points, axis=0)) + int(np.sum(np.minimum(counts, most)))


def closed_form(search: PoseSearch) -> Pose | None:
    """The pose by a homography between the lens's rays and the floor, from points and straight lines; None where they
    are too few (a point gives two equations, a line two) or cannot fix it.
    """
    plane = plane_sight(search.sight, height_m=0.0)
    rays = search.camera.rays(plane.pixels)
    known = np.isfinite(rays[:, 0])
    if plane.equations < 8 or np.count_nonzero(known) < 8:
        return None
    homography, _ = fit_lines(plane.lines[known], rays[known], _ROUNDS)
    return None if homography is None else pose_from_homography(homography)


def _settled(search: PoseSearch, poses: Sequence[Pose]) -> list[Place]:
    """Each candidate at its best, best first; those from which something cannot be seen are left out."""
    stack = np.array([pose.matrix for pose in poses])
    for wide in _WIDE:
        stack = _searched(search, stack, Weighting(*search.scales, "huber", wide), 1e-3)
    stack = _searched(search, stack, Weighting(*search.scales, "cauchy", 2.0), 1e-8)
    found = [Pose(matrix[:, :3], matrix[:, 3]) for matrix in stack]
    return _distinct([place_of(search, pose) for pose in found if search.allows(pose)])


def _searched(search: PoseSearch, stack: Array, weighting: Weighting, tolerance: float) -> Array:
    """Poses (K, 3, 4) after the search, without those from which something cannot be seen."""
    if not len(stack):
        return stack
    key, count = search.sight.key, len(stack)
    many = search.sight.take(np.zeros(count, dtype=np.int64))
    keys = tuple(SightKey(key.camera, key.station, str(number)) for number in range(count))
    world = search.estimate.stations[key.station].cam_from_world
    placements = {k.placement: world for k in keys if k.placement is not None}
    estimate = replace(search.estimate, placements=placements).with_placements(keys, stack)
    costs, found = placement_costs(replace(many, keys=keys), estimate, weighting, stack, tolerance)
    return found[np.isfinite(costs)]


def place_of(search: PoseSearch, pose: Pose) -> Place:
    """How well a pose explains the sight."""
    sight, found = search.sight, search.residuals(pose)
    points = np.linalg.norm(found.points[sight.point_rows], axis=1) / (sight.sigma_px * search.scales[0])
    curves = np.abs(found.curves[sight.curve_rows]) / (sight.curve_sigma_px * search.scales[1])
    lengths = np.nan_to_num(np.concatenate([points / 1.1774, curves / 0.6745]), nan=np.inf)
    scale = float(np.median(lengths))
    sigmas = np.nan_to_num(np.concatenate([points, curves]), nan=np.inf)
    share = float(np.mean(sigmas <= _FITS_SIGMA * np.clip(scale, 1.0, _FITS_SCALE)))
    return Place(pose, misfit(search.sight, search.camera, found, search.scales), scale, share)


def misfit(sights: Sights, camera: Camera, found: Residuals, scales: tuple[float, float]) -> float:
    """Negative log likelihood of a camera's residuals at these noise scales, each observation a stray with a small
    probability; in nats.
    """
    width, height = camera.image_size
    p, c = sights.sigma_px * scales[0], sights.curve_sigma_px * scales[1]
    points = np.linalg.norm(found.points[sights.point_rows], axis=1) / p
    curves = np.abs(found.curves[sights.curve_rows]) / c
    total = 0.0
    for lengths, inside, stray in (
        (points, 1.0 / (2.0 * np.pi * p**2), 1.0 / (width * height)),
        (curves, 1.0 / (np.sqrt(2.0 * np.pi) * c), 1.0 / np.hypot(width, height)),
    ):
        likely = (1.0 - _STRAY) * inside * np.exp(-0.5 * np.minimum(np.nan_to_num(lengths, nan=1e3), 1e3) ** 2)
        total -= float(np.sum(np.log(likely + _STRAY * stray)))
    return total


def _distinct(found: Sequence[Place]) -> list[Place]:
    """The places, best first, without repetitions."""
    kept: list[Place] = []
    for place in sorted(found, key=lambda p: p.misfit):
        if not any(_alike(place.pose, other.pose) for other in kept):
            kept.append(place)
    return kept


def _alike(a: Pose, b: Pose) -> bool:
    shift_m, turn = movement(a, b)
    return shift_m < _ALIKE[0] and turn < _ALIKE[1]


def movement(a: Pose, b: Pose) -> tuple[float, float]:
    """Distance (m) between the positions of two cameras, and the angle (rad) between them."""
    cosine = 0.5 * (float(np.trace(a.rotation @ b.rotation.T)) - 1.0)
    sine = float(np.linalg.norm(a.rotation - b.rotation)) / np.sqrt(8.0)  # |a - b| = 2 sqrt 2 sin(angle / 2)
    angle = 2.0 * np.arcsin(min(sine, 1.0)) if cosine > -0.9 else np.arccos(np.clip(cosine, -1.0, 1.0))
    return float(np.linalg.norm(a.position - b.position)), float(angle)
