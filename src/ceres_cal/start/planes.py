"""The radial profile of a camera, and the homography of each sight, from any mix of points and lines on planes.

These are steps 1 and 2 of design section 7, based on `closed_forms`: which sights determine what, with reweighting and
LO-RANSAC against wrong labels.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, distinct, evenly, kept_signals, median, or_none, rms
from ceres_cal.observations import Sights, bounds_of, joined, ranges
from ceres_cal.start.closed_forms import (
    PlaneData,
    RadialProfile,
    fit_lines,
    homographies_of_sights,
    homography_from_points,
    misfits_of_lines,
    point_lines,
    profile_from_lines,
    radial_alignment,
    ring_profile,
)

# Median error above which a fit may be wrong, however even: corners are detected to a tenth of it. Halving or doubling
# changes nothing.
_ROUGH_PX = 1.0
# Length of a wrong residual in medians: no clean residual is that long, nine standard deviations. Halving or doubling
# moves the answer by less than 1 % of its error.
_SUSPICIOUS = 8.0
# Typical distance from a fit in a plane scaled to unit size, above which it does not hold; good fits are 20 times
# better. Halving or doubling changes nothing.
_NO_FIT = 0.01


class PlaneSight(Frozen):
    """A sight's observations on its plane z = height_m: points, and lines with the pixel observed on each.

    Attributes:
        points: (N, 2) m. lines: (2 N + L, 3) two through each point, x = const first, then those of segments.
        pixels: (2 N + L, 2), in the coordinates of the sight.
    """

    height_m: float
    points: Array
    lines: Array
    pixels: Array

    @property
    def segments(self) -> int:
        """Number of straight lines with observations."""
        return len(distinct(self.lines[2 * len(self.points) :], axis=0))

    @property
    def equations(self) -> int:
        """Number of equations for a homography's eight numbers: two for each point, two for each line."""
        return 2 * len(distinct(self.points, axis=0)) + 2 * self.segments

    @property
    def size_px(self) -> float:
        """Spread of the observations over the image; 0 where there are none on the plane."""
        offsets = self.pixels[len(self.points) :]
        return rms(np.linalg.norm(offsets - offsets.mean(axis=0), axis=1)) if len(offsets) else 0.0


def plane_sight(sight: Sights, height_m: float | None = None) -> PlaneSight:
    """The observations on a plane, by default the one with most of them; thinned out if there are very many."""
    most = 1500  # observations of one kind in a sight: more do not improve the initial estimate
    starts, along = sight.tracks[:, 0], sight.tracks[:, 1]
    level = np.abs(along[:, 2]) < 1e-12
    height = _usual_height(sight, level) if height_m is None else height_m
    on = np.flatnonzero(np.abs(sight.points[:, 2] - height) < 1e-9)
    on = on[:: max(1, len(on) // most)]
    usable = level & ~sight.is_arc & (np.abs(starts[:, 2] - height) < 1e-9)
    straight = np.flatnonzero(usable[sight.track_index])
    straight = straight[:: max(1, len(straight) // most)]
    c, a = starts[sight.track_index[straight], :2], along[sight.track_index[straight], :2]
    normal = np.column_stack([-a[:, 1], a[:, 0]]) / np.linalg.norm(a, axis=1, keepdims=True)
    points = sight.points[on, :2]
    return PlaneSight(
        height,
        points,
        np.vstack([point_lines(points), np.column_stack([normal, -np.sum(normal * c, axis=1)])]),
        np.vstack([sight.pixels[on], sight.pixels[on], sight.curve_pixels[straight]]),
    )


def _usual_height(sight: Sights, level: Mask) -> float:
    """The z at which most of the places and level curves lie, each counted once; 0 where there are none."""
    places = distinct(sight.points.round(9), axis=0)[:, 2]
    tracks = distinct(sight.track_index[level[sight.track_index]])
    heights, votes = np.unique(np.append(places, sight.tracks[tracks, 0, 2].round(9)), return_counts=True)
    return float(heights[np.argmax(votes)]) if len(heights) else 0.0


class Homographies(Frozen):
    """The homographies that a camera's sights determine.

    Attributes:
        sights: (K,) numbers of the sights. matrices: (K, 3, 3), plane (x, y, 1) m to (p px, w), see `closed_forms`.
        heights_m: (K,) z of each plane. sizes_px: (K,) spread of its observations over the image.
    """

    sights: Indices
    matrices: Array
    heights_m: Array
    sizes_px: Array


_NONE = Homographies(np.empty(0, np.int64), np.empty((0, 3, 3)), np.empty(0), np.empty(0))


def profile_and_homographies(
    sights: Sights, unit: float, known: RadialProfile | None = None
) -> tuple[RadialProfile, Homographies]:
    """A camera's radial profile, if it is not known, and the homographies of those of its sights that determine one;
    the sights must be about its principal point.
    """
    pure, board = _flat_sights_of_points(sights)
    rest = np.delete(np.arange(len(sights)), pure)
    planes = {int(i): plane_sight(sights[int(i)]) for i in rest}
    matrices: dict[int, Array] = {}
    profile = known
    if len(pure):
        data = _plane_data(board, _spread_rows(board.point_bounds))
        profile = profile or _profile_of_boards(board, data, unit)
    for i, plane in planes.items():
        if plane.equations == 0 and len(sights[i].on_arc) and sights[i].on_arc.all():
            ring, matrices[i] = _from_rings(sights[i], unit)
            if sights[i].key.placement is None:  # a floor's z axis points to the camera
                matrices[i][:, 1] *= -1.0
            profile = profile or ring
    mixed = [i for i, plane in planes.items() if plane.equations >= 8]
    lined = [(planes[i].lines, planes[i].pixels) for i in mixed]
    # Boards in a corner of the image may say nothing about the rest of it.
    if known is None and (
        profile is None or any(fit_lines(seen, profile.lift(p), rounds=2)[1] > _NO_FIT for seen, p in lined)
    ):
        profile = _profile_from_lines(lined, unit)
    profile = profile or RadialProfile((0.0, 0.0), unit)
    fitted = {i: fit_lines(planes[i].lines, profile.lift(planes[i].pixels), rounds=6)[0] for i in mixed}
    matrices |= {i: matrix for i, matrix in fitted.items() if matrix is not None}
    parts = [_NONE]
    for i, matrix in matrices.items():
        height, size = np.array([planes[i].height_m]), np.array([planes[i].size_px])
        parts.append(Homographies(np.array([i]), matrix[None], height, size))
    if len(pure):
        parts.append(_of_boards(pure, board, data, profile))
    return profile, joined(parts)


def _scatter(values: Array, bounds: Indices) -> Array:
    """(k, k, groups) mean of (v - mean)(v - mean)^T over values[bounds[g]:bounds[g + 1]] (N, k); no group is empty."""
    first, counts = bounds[:-1], np.diff(bounds)
    columns = np.ascontiguousarray(values.T)  # column by column: ten times as fast as row by row
    off = [column - np.repeat(np.add.reduceat(column, first) / counts, counts) for column in columns]
    return np.array([[np.add.reduceat(one * other, first) / counts for other in off] for one in off])


def _of_boards(numbers: Indices, board: Sights, data: PlaneData, profile: RadialProfile) -> Homographies:
    """The homographies of sights of points, without those that map the plane to a point or a line."""
    matrices = _homographies_of_boards(board, data, profile)
    sizes = np.sqrt(np.trace(_scatter(data.offsets, data.bounds)))
    heights = board.points[board.point_bounds[:-1], 2]
    b = matrices[:, :, :2]
    m = np.swapaxes(b, 1, 2) @ b
    posed = np.linalg.det(m) > 1e-20 * np.trace(m, axis1=1, axis2=2) ** 2
    return Homographies(numbers[posed], matrices[posed], heights[posed], sizes[posed])


def _flat_sights_of_points(sights: Sights) -> tuple[Indices, Sights]:
    """Sights that show at least six points of one plane, not on one line, and no curve: their numbers, and
    themselves.
    """
    few = (np.diff(sights.point_bounds) >= 6) & (np.diff(sights.curve_bounds) == 0)
    candidates = np.flatnonzero(few)
    board = sights.take(candidates)
    scatter = _scatter(board.points, board.point_bounds)
    xx, xy, yy = scatter[0, 0], scatter[0, 1], scatter[1, 1]
    flat = np.flatnonzero((scatter[2, 2] < 1e-18) & (xx * yy - xy**2 > 1e-12 * (xx + yy) ** 2))
    return candidates[flat], board.take(flat)


def _profile_of_boards(board: Sights, data: PlaneData, unit: float) -> RadialProfile:
    """The profile by radial alignment from some points of some sights; from all points of these, in more rounds, if not
    all fit.

    A profile needs no more sights: all other homographies follow from it.
    """
    enough_boards = 24  # sights that suffice for a profile
    numbers = evenly(len(board), enough_boards)
    rows, sizes = ranges(data.bounds, numbers), np.diff(board.point_bounds)[numbers]
    few = PlaneData(
        bounds_of(np.diff(data.bounds)[numbers]), data.plane.take(rows, axis=0), data.offsets.take(rows, axis=0)
    )
    terms = int(np.clip((sizes.sum() - 3 * len(numbers)) // 8, 1, 3))
    profile, error_px, relative_error = radial_alignment(few, unit, terms, rounds=2)
    wrong = (relative_error > _SUSPICIOUS) & (error_px > 1.0)
    if np.mean(wrong) < 0.02 and median(error_px) < _ROUGH_PX:
        return profile
    some = board.take(numbers)
    return radial_alignment(_plane_data(some, np.arange(len(some.points))), unit, terms, rounds=8)[0]


def _spread_rows(bounds: Indices) -> Indices:
    """Rows of about `enough_points` points of each sight.

    Steps of the golden ratio spread them evenly and never along one row of a board.
    """
    golden = 0.6180339887498949
    enough_points = 40.0  # points of a board that suffice
    sizes = np.diff(bounds)
    order = (np.arange(sizes.max()) * golden) % 1.0
    place = np.arange(bounds[-1]) - np.repeat(bounds[:-1], sizes)
    return np.flatnonzero(order[place] < np.repeat(enough_points / sizes, sizes))


def _plane_data(board: Sights, rows: Indices) -> PlaneData:
    return PlaneData(
        np.searchsorted(rows, board.point_bounds),
        np.ascontiguousarray(board.points.take(rows, axis=0)[:, :2]),
        board.pixels.take(rows, axis=0),
    )


def _profile_from_lines(planes: Sequence[tuple[Array, Array]], unit: float) -> RadialProfile:
    """The profile under which lines are straight and points in place: by a closed form of rank one, then a shrinking
    grid.

    Args:
        planes: lines (N, 3) of each plane, and the offsets (N, 2) px observed on them.
    """
    if not planes:
        return RadialProfile((0.0, 0.0), unit)

    def best_of(candidates: Sequence[tuple[float, ...]]) -> tuple[float, ...]:
        profiles = [RadialProfile(c, unit) for c in candidates if _is_lens(c)]
        misfit = sum(
            misfits_of_lines(lines, np.array([profile.lift(offsets) for profile in profiles]), rounds=2)
            for lines, offsets in planes
        )
        return profiles[int(np.argmin(misfit))].coefficients

    known = [profile_from_lines(lines, offsets, unit, 2) for lines, offsets in planes]
    grid = [(c1, c2) for c1 in np.linspace(-1.0, 0.4, 8) for c2 in np.linspace(-0.6, 0.6, 5)]
    best = best_of([(0.0, 0.0), *known, *grid])
    for width in (0.1, 0.03, 0.01, 0.003):
        best = best_of([(best[0] + i * width, best[1] + j * width) for i in (-1, 0, 1) for j in (-1, 0, 1)])
    return RadialProfile(best, unit)


def _is_lens(c: tuple[float, ...]) -> bool:
    """Whether a profile hardly looks backwards anywhere."""
    return bool(np.min(1.0 + c[0] * _RADII**2 + c[1] * _RADII**4) >= -0.5)


_RADII = np.linspace(0.0, 1.0, 21)


def ring_radii(sight: Sights) -> tuple[Array, Array, Array]:
    """For rings that a sight about its camera shows: their own centre (2,) px, which need not be the principal point
    (paper, section 2); and for each observation (M,) its distance from there, px, and the radius of its ring, m.
    """
    on_ring = sight.on_arc
    offsets = sight.curve_pixels[on_ring]
    radii = np.linalg.norm(sight.tracks[sight.track_index[on_ring], 1], axis=1)
    _, ring = np.unique(radii, return_inverse=True)
    centre = offsets.mean(axis=0)
    for _ in range(10):  # the mean radius is that of each ring, so that unobserved parts do not shift the centre
        away = offsets - centre
        radius = np.linalg.norm(away, axis=1)
        mean = np.bincount(ring, radius) / np.bincount(ring)
        direction = away / np.maximum(radius, 1e-9)[:, None]
        centre = centre + np.linalg.lstsq(direction, radius - mean[ring], rcond=None)[0]
    return centre, np.linalg.norm(offsets - centre, axis=1), radii


def _from_rings(sight: Sights, unit: float) -> tuple[RadialProfile, Array]:
    (cx, cy), measured_px, ring_m = ring_radii(sight)
    if len(distinct(ring_m)) < 3:  # these determine only a magnification, and nothing of the lens
        profile, kappa = RadialProfile((0.0, 0.0), unit), float(np.mean(measured_px / ring_m))
    else:
        profile, kappa = ring_profile(measured_px, ring_m, unit)
    return profile, np.array([[kappa, 0.0, cx], [0.0, kappa, cy], [0.0, 0.0, 1.0]])


def _homographies_of_boards(board: Sights, data: PlaneData, profile: RadialProfile) -> Array:
    """The homographies, by LO-RANSAC (pycolmap) for sights in which some points are far off while most fit."""
    homographies, error_px = homographies_of_sights(data, profile)
    limit = max(_SUSPICIOUS * median(error_px), 2.0)
    far = np.add.reduceat(error_px > limit, data.bounds[:-1], dtype=np.int64)
    sizes = np.diff(data.bounds)
    for number in np.flatnonzero((far > 0.1 * sizes) & (sizes >= 8)):
        sight = board[int(number)]
        homography = consensus_homography(sight.points[:, :2], profile.lift(sight.pixels), limit)
        if homography is not None:
            homographies[number] = homography
    return homographies


@or_none  # quiet: these points make no homography; the caller keeps the one of all
def consensus_homography(plane: Array, lifted: Array, limit_px: float) -> Array | None:
    """The homography on which most points agree within `limit_px`, by LO-RANSAC (pycolmap), or None.

    Args:
        plane: (N, 2) m. lifted: (N, 3) homogeneous undistorted offsets, px.
    """
    with kept_signals():
        import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error = limit_px
    options.random_seed = 0
    consensus = pycolmap.estimate_homography_matrix(plane, lifted[:, :2] / lifted[:, 2:], options)
    if consensus is None:
        return None
    inliers = np.asarray(consensus["inlier_mask"], dtype=bool)
    return homography_from_points(plane[inliers], lifted[inliers])
