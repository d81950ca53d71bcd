"""Sights as planes: the radial profile of a camera, and each sight's homography, from any mix of points and lines.

The steps of design section 7, 1 and 2, on top of `closed_forms`: which sights can tell what, reweighting and LO-RANSAC
against wrong labels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.camera import Camera
from ceres_cal.closed_forms import (
    PlaneData,
    Profile,
    facing,
    homography_from_points,
    inverse_homography_from_moments,
    line_moments,
    profile_from_moments,
    radial_alignment,
    require_spread,
    ring_profile,
)
from ceres_cal.errors import DegenerateError
from ceres_cal.sights import Sights
from ceres_cal.transforms import Array

_MOST = 1500  # observations of one kind in a sight beyond which a start learns nothing more


@dataclass(frozen=True, eq=False)
class PlaneSight:
    """A sight's observations on its plane z = height: points and straight segments, offsets in px."""

    sight: Sights
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


def on_plane(sight: Sights, camera: Camera) -> PlaneSight:
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
    return PlaneSight(
        sight,
        height,
        sight.points[on, :2],
        camera.offsets(sight.pixels[on]),
        np.column_stack([normal, -np.sum(normal * c, axis=1)]),
        camera.offsets(sight.curve_pixels[straight]),
    )


def profile_and_homographies(
    planes: Sequence[PlaneSight], sights: Sights, camera: Camera, unit: float
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


def _flatten(planes: Sequence[PlaneSight]) -> PlaneData:
    return PlaneData(
        np.repeat(np.arange(len(planes)), [len(plane.points) for plane in planes]),
        np.vstack([plane.points for plane in planes]),
        np.vstack([plane.offsets for plane in planes]),
    )


def _as_lines(plane: PlaneSight, scale: float) -> tuple[Array, Array]:
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


def _scale_of(plane: PlaneSight) -> float:
    reach = max(
        float(np.max(np.abs(plane.points), initial=0.0)), float(np.max(np.abs(plane.lines[:, 2]), initial=0.0)), 1e-9
    )
    return 1.0 / reach


def _solve_plane(plane: PlaneSight, profile: Profile, rounds: int) -> tuple[Array, float, float]:
    """(G, typical distance in the scaled plane, distinctness): point-on-line DLT, reweighted against wrong labels."""
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


def _homography_of(plane: PlaneSight, profile: Profile) -> Array:
    """H of one sight: plane (x, y, 1) m to (p in px, w)."""
    inverse, _, distinct = _solve_plane(plane, profile, rounds=6)
    if distinct < 1e-6:
        raise DegenerateError(
            f"{plane.sight.key}: its {len(plane.points)} points and {len(np.unique(plane.lines, axis=0))} lines "
            "cannot fix the plane's pose (all on one line, or parallel): add points or lines in other directions"
        )
    homography = np.diag([profile.unit_px, profile.unit_px, 1.0]) @ np.linalg.inv(inverse)
    lifted = profile.lift(np.vstack([plane.offsets, plane.line_offsets]))
    sent = lifted @ np.linalg.inv(homography).T
    return facing(homography, sent[:, :2] / sent[:, 2:], lifted)


def _profile_from_lines(planes: Sequence[PlaneSight], unit: float) -> Profile:
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


def _from_rings(sight: Sights, camera: Camera, unit: float) -> tuple[Profile, Array]:
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


def _without_wrong_labels(plane: PlaneSight, profile: Profile, homography: Array) -> Array:
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
