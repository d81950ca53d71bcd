"""Decide whether a solution may be used: it must explain the observations, and its lens and geometry must be possible.

Impossible geometry is a camera under the floor that it sees from above, or observed places behind a camera.

A flat scene fits as well when its picture is mirrored: the columns h1 and h2 of R are mirrored, r3 = h1 x h2 is
reversed, and the camera stands as far under the floor as it stood above. Exchanged axes and y upwards are also mirrored
pictures, turned about the principal point. Residuals say nothing about any of these.

Also detected are points of a target that are listed in another order than drawn, or that belong to another kind of
grid.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from ceres_cal.base import Array, CalibrationError, Mask, SolutionError, attempt, distinct, first_of, median
from ceres_cal.effects import AsBuilt
from ceres_cal.observations import SightKey, Sights, column_of, shown_rows
from ceres_cal.problem import Estimate, Problem, Residuals, floor_of
from ceres_cal.problem.residuals import residuals as residuals_at
from ceres_cal.problem.residuals import write_equations
from ceres_cal.robust.noise import Inliers
from ceres_cal.robust.other_minima import LOST
from ceres_cal.robust.robust import RobustSolution
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import Target

# Ratio of the principal point's distances from the image centre and from that of the image with its sides exchanged. If
# one is below this share of the other, the principal point decides between them; in the tests' scenes its distance from
# its own centre is a tenth of that between the two.
_NEARER = 0.5
_BELOW = 0.5  # share of the camera's height over the floor: noise lowers a board only by centimetres

NO_FIT = 0.015
"""Share of the image's diagonal: 24 px of 1600. If half of a camera's observations are farther off, the result is no
calibration; a lens that is too simple leaves at most a few pixels. Halving or doubling changes nothing.
"""


def require_fits(end: RobustSolution, problem: Problem) -> None:
    """Raise SolutionError where the solve failed, or where the solution misses too many observations."""
    if end.solution.failed:
        raise SolutionError("the solve found no camera from its start: check labels and target dimensions")
    points, curves = end.residuals.lengths
    for name, camera in end.estimate.cameras.items():
        own = problem.sights.of_camera(name)
        limit_px = NO_FIT * float(np.hypot(*camera.image_size))
        met = np.count_nonzero(points[own.point_rows] <= limit_px)  # NaN is not
        met += np.count_nonzero(curves[own.curve_rows] <= limit_px)
        if 2 * met < len(own.point_rows) + len(own.curve_rows):
            count, checks = own.equations, "check labels, target dimensions and the lens"
            few = count < 4 * (len(camera.lens.values) + 10)  # equations for a camera and its pose: too few to decide
            what = f"show it more of the targets (only {count} numbers are measured), or {checks}" if few else checks
            missed = f"the best solution misses half of its observations by more than {limit_px:.0f} px"
            raise SolutionError(f"camera {name!r}: {missed}: {what}", name)


def require_possible(sights: Sights, estimate: Estimate, residuals: Residuals) -> None:
    """Raise SolutionError where the position of a station is impossible.

    This is decided only for stations that see a floor of the world: boards are seen from either side, a wall stands
    upright, and a ceiling is above the origin. Scenes seen from below must be given in coordinates whose z axis points
    to the camera.

    Args:
        sights: those of all the observations, with the targets as they were solved for.
    """
    for station, sight in sights.of_world.items():
        camera = estimate.camera_at(station)
        floor_m = floor_of(_places_of_world(sight))
        if floor_m is not None and camera.position[2] <= min(floor_m, 0.0):
            raise SolutionError(
                f"station {station!r}: the camera stands {floor_m - camera.position[2]:.2f} m under the floor that it "
                f"sees: {_cause(camera)}, or left and right, or top and bottom, are exchanged in the labels: correct "
                "the observations"
            )
        _require_ahead(station, sight, residuals, estimate)
        if floor_m is not None:
            _require_above(floor_m - _BELOW * (camera.position[2] - floor_m), sight, estimate)


def _open_pose(sight: Sights, estimate: Estimate) -> str:
    """The cause of an impossible position where a sight of the world leaves a pose open through any lens, as two lines
    do that cross; "" where it does not.
    """
    # quiet: where nothing at all is shown, the labels are the likelier cause
    equations = attempt(lambda: write_equations(sight, estimate, residuals_at(sight, estimate)))
    if isinstance(equations, CalibrationError):
        return ""
    pose = equations.pose
    if np.linalg.matrix_rank(pose / np.maximum(np.linalg.norm(pose, axis=0), 1e-300), 1e-6) == pose.shape[1]:
        return ""
    return "what it shows of the world does not determine its pose: add points, lines in other places or arcs"


def _require_above(least_m: float, sight: Sights, estimate: Estimate) -> None:
    """Raise SolutionError where most placements of a target lie so deep under the floor that its size must be wrong."""
    observations, station = sight.observations, sight.keys[0].station
    for name, target in observations.targets.items():
        placed = dict.fromkeys(v.placement for v in observations.shown_views if v.target == name and v.placement)
        tops = [float(np.max(estimate.placements[one].transform(target.places)[:, 2])) for one in placed]
        if target.movable and 2 * np.count_nonzero(np.array(tops) < least_m) > len(tops):
            if open_pose := _open_pose(sight, estimate):
                raise SolutionError(f"station {station!r}: {open_pose}")
            raise SolutionError(
                f"target {name!r} lies up to {-min(tops):.0f} m under the floor: its dimensions are too large, or not "
                "in metres"
            )


def _require_ahead(station: str, sight: Sights, residuals: Residuals, estimate: Estimate) -> None:
    """Raise SolutionError where most of what the station observed lies behind it, or beyond its lens."""
    points, curves = residuals.lengths
    lengths = np.concatenate([points[sight.point_rows], curves[sight.curve_rows]])
    behind = np.count_nonzero(~np.isfinite(lengths))
    if 2 * behind > len(lengths):
        raise SolutionError(
            f"station {station!r}: {behind} of its {len(lengths)} observations of fixed targets lie behind the "
            f"camera or beyond its lens: {_open_pose(sight, estimate) or 'check labels and target dimensions'}"
        )


def _places_of_world(sight: Sights) -> Array:
    """(P, 3) m, places on immovable targets that a sight shows: its points, the starts and ends of its lines, and the
    centre and a quarter point of its arcs.
    """
    observations = sight.observations
    world = np.array([not observations.targets[view.target].movable for view in observations.views])
    points = sight.points[world[observations.points.view[sight.point_rows]]]
    tracks = sight.tracks[distinct(sight.track_index[world[observations.curves.view[sight.curve_rows]]])]
    return np.concatenate([points, *(tracks[:, 0] + along for along in (0.0, tracks[:, 1], tracks[:, 2]))])


def _cause(camera: Camera) -> str:
    """The likely kind of mirrored picture; the principal point of an image that is not square tells swapped axes."""
    width, height = camera.image_size
    sizes = np.array([[width, height], [height, width]])
    off, other = np.linalg.norm(camera.principal_point - (sizes - 1.0) / 2.0, axis=1)
    if other < _NEARER * off:
        return "x and y are swapped (its principal point shows this)"
    swapped = "x and y are swapped" + (", image_size too" if off < _NEARER * other else "")
    return f"the image is mirrored, or {swapped}, or y points upwards"


# Share of the image's diagonal (240 px of 1600): lenses are mounted within some hundredths, unless a picture was
# cropped.
_OFF_CENTRE = 0.15
# Share of an image's side beyond which observations usually reach.
_UNFILLED = 0.9
# Share of the image's diagonal: three standard deviations of usual principal points (`priors.USUAL_CENTRE`).
_UNUSUAL = 0.045


def all_shown(camera: Camera, sights: Sights) -> bool:
    """Whether the lens folds nowhere within the observed part of the image. `sights`: the camera's, `about` it."""
    places = (sights.pixels, sights.curve_pixels)
    return all(bool(np.all(camera.lens.shows(pixels, camera.phi))) for pixels in places)


def shows_all(end: RobustSolution) -> bool:
    """Whether no lens folds inside the observed part of the image."""
    sights, cameras = end.problem.sights, end.estimate.cameras.items()
    return all(all_shown(camera, sights.of_camera(name).about(camera)) for name, camera in cameras)


def require_usable(end: RobustSolution, *, is_refit: bool = False) -> tuple[str, ...]:
    """Warnings about the cameras of a solution. Raises SolutionError where it must not be used.

    Args:
        is_refit: whether the lens was chosen earlier.
    """
    instead = "choose fewer or other coefficients, or observe nearer to the corners"
    if is_refit:
        instead = "keep the lens as it was (--what pose-only), or calibrate again with fewer coefficients"
    warnings = []
    _require_shown(end)
    for name, camera in end.estimate.cameras.items():
        width, height = camera.image_size
        off_px = float(np.hypot(*(camera.principal_point - 0.5 * (np.array(camera.image_size) - 1.0))))
        own = end.problem.sights.of_camera(name)
        seen = own.pixels, own.curve_pixels
        reach = np.array([max(float(np.max(one[:, k], initial=0.0)) for one in seen) for k in (0, 1)])
        if off_px > _OFF_CENTRE * np.hypot(width, height) or _suits_another(camera, reach, off_px):
            warnings.append(
                f"camera {name!r}: its principal point lies {off_px:.0f} px from the middle of its image of {width} x "
                f"{height} px, of which observations reach {reach[0]:.0f} x {reach[1]:.0f}: "
                "check that image_size is the size of the pictures, that pixels count from their top-left corner, and "
                "that x comes before y"
            )
        if not camera.folds:
            continue
        fold, corner = camera.lens.monotone_radius(camera.phi), camera.corner_radius
        where = f"camera {name!r}: the solved {camera.lens.kind} lens folds {fold:.0f} px from the principal point"
        observed = end.problem.sights.of_camera(name).about(camera)
        if not camera.lens.may_fold or not all_shown(camera, observed):
            raise SolutionError(
                f"{where}, inside the image (corner at {corner:.0f} px): {instead}",
                name,
            )
        warnings.append(
            f"{where}: pixels from there to the corner ({corner:.0f} px) cannot be undistorted; "
            f"observations reach {observed.reach_px:.0f} px"
        )
    return tuple(warnings)


def _require_shown(end: RobustSolution) -> None:
    """Raise SolutionError where the solution does not show observations that took part: their residuals do not exist.
    A later minimum may lie on the far side of the horizon, where a line is still followed from one step to the next.
    """
    lengths = np.concatenate(end.residuals.lengths)
    lost = np.count_nonzero(end.inliers.rows & ~np.isfinite(lengths))
    if lost:
        raise SolutionError(
            f"the best solution cannot show {lost} of the {np.count_nonzero(end.inliers.rows)} observations that it is "
            "based on: check labels and target dimensions"
        )


def _suits_another(camera: Camera, reach: Array, off_px: float) -> bool:
    """Whether the principal point suits another image size than the stated one: the extent of the observations, or
    width and height exchanged, as where pixels are given as (row, column).
    """
    size = np.array(camera.image_size, dtype=float)
    others = [size[::-1]]
    if np.any(reach < _UNFILLED * size):
        others.append(reach)
    other_px = min(float(np.hypot(*(camera.principal_point - 0.5 * (other - 1.0)))) for other in others)
    return bool(off_px > _UNUSUAL * np.hypot(*size) and other_px < _NEARER * off_px)


class LostSight(NamedTuple):
    """A sight with most observations rejected, so that its pose is not known; or a still camera's, in some frames.

    Attributes:
        words: for the user. is_alone: whether it is that of a placement that no other sight shows, so that nothing else
            depends on it.
    """

    key: SightKey
    words: str
    is_alone: bool


def lost_sights(inliers: Inliers, problem: Problem, groups: Sequence[Mask]) -> Iterator[LostSight]:
    """Yield the sights with most observations rejected one by one, and those of still cameras of which some frames are.

    Args:
        groups: masks (N + M,) of the observations that were left out as one group each, which explains them.
    """
    used = inliers.rows
    for rows in groups:
        used |= rows
    sights = problem.sights
    shares = sights.used_share(used[: len(inliers.points)], used[len(inliers.points) :])
    yield from _lost_frames(sights, shares, (inliers.rows, *groups))
    lost = [(sights.keys[number], shares[number]) for number in np.flatnonzero(shares < LOST)]
    otherwise: Mapping[tuple[str, str], str] = {}
    if any(key.placement not in (None, *sights.seen_once) for key, _ in lost):  # shared by a rig
        from ceres_cal.start.same_moments import shown_otherwise

        otherwise = shown_otherwise(problem.observations)
    for key, share in lost:
        usual = "check its labels, do not use its pose"
        if key.placement not in (None, *sights.seen_once):
            usual = "check its labels, and that all cameras took it at the same moment"
        checks = otherwise.get((key.station, str(key.placement)), usual)
        words = f"{key}: {100.0 * (1.0 - share):.0f} % of its observations were taken out: {checks}"
        yield LostSight(key, words, key.placement in sights.seen_once)


def _lost_frames(sights: Sights, shares: Array, explained: Sequence[Mask]) -> Iterator[LostSight]:
    """Yield sights that are not lost, but of which some frames are: nothing explains most of what these show.

    Args:
        explained: masks (N + M,) of the observations that are used, and of each group that was left out.
    """
    few = 8  # observations of a frame: of fewer, most may be outliers by chance
    there, view, views = shown_rows(sights), column_of(sights.observations, "view"), sights.observations.views
    every, *parts = (np.bincount(view[rows & there], minlength=len(views)) for rows in (there, *explained))
    is_lost = (every >= few) & (np.max(parts, axis=0) < LOST * every)
    for key, own, share in zip(sights.keys, sights.views, shares, strict=True):
        frames = [repr(views[number].frame) for number in own if is_lost[number]]
        if frames and share >= LOST and key.placement is None:
            words = (
                f"{key}: most observations of {len(frames)} of its {len(own)} frames ({first_of(frames)}) were taken "
                "out: check that it took these pictures, that it did not move, and the labels"
            )
            yield LostSight(key, words, is_alone=False)


# ---- targets whose points are not those of the drawing ---------------------------------------------------------------

# Share of the distance between neighbouring points, for the root mean square of offsets along one axis. Where the
# points of a grid are listed in another order, or belong to another kind of grid, it is 0.17 to 0.5; boards are built
# to a hundredth.
_NOT_BUILT = 0.1


def is_another(one: AsBuilt, target: Target) -> bool:
    """Whether the points lie so far from their nominal positions that they cannot be those of the drawing."""
    most_probes = 500  # points whose nearest neighbours are determined
    if one.kind != "points":
        return False
    places = target.point_array
    away = np.linalg.norm(places[:: -(-len(places) // most_probes), None] - places, axis=2)
    return one.rms_m > _NOT_BUILT * median(np.partition(away, 1, axis=1)[:, 1])


def misnamed(every: Sequence[AsBuilt], targets: Mapping[str, Target]) -> Iterator[str]:
    """A warning for each target whose points cannot be those of its drawing."""
    for one in every:
        if is_another(one, targets[one.target]):
            yield (
                f"target {one.target!r}: {one.words}, by more than a tenth of the distance between neighbours. Targets "
                "are built more accurately: check the order of its points, and its kind, columns, rows and dimensions"
            )
