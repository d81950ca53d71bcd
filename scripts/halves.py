"""Whether random halves of the views agree as stated, on real photographs: python scripts/halves.py [--help]

Each half is calibrated separately. The difference of the two is divided by the standard deviation that both together
state: for the intrinsics (Mahalanobis length over the square root of their number) and for the projections of rays over
the part of the image that the views fill (root mean square over a grid). For projections the best-fitting rotation is
removed, since the orientation of a camera frame is not determined. For "in plane" the pose of a plane that faces the
camera is removed instead, as for a board or a floor. All are 1 where the statement is honest. "By defaults" each half
also chooses its lens. Each set has a control: the same views as the calibration of the whole set predicts them, with
independent normal noise of the estimated size. Exits with 1 when a figure is missed by more than two standard errors;
the folder of real sets is $CERES_CAL_REAL, or shared/real beside the repository.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from photos.real_data import ov_plane, real_folder
from runner import Row, root_and_error, script

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import CalibrationError
from ceres_cal.base.transforms import Pose, skew
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import detect_boards
from ceres_cal.observations import Observations, Points
from ceres_cal.observations.columns import taken
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem.information import Key
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.quantities import camera_moved, natural_sizes, values_of
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Lens
from ceres_cal.scene.targets import checkerboard

LEAST, MOST = 0.85, 1.25
_CONTROL = 0.9, 1.1
_GRID = 12  # places along the longer side of the image
_STEP = 1e-5  # of each number's natural size
_LEAST_AHEAD = 0.17  # cosine of the largest angle from the axis at which a plane is evaluated


# ---- the sets -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RealSet:
    """One camera's views of a board, and the options of their calibration."""

    observations: Callable[[], Observations]
    options: Options


def _photographed(pattern: str, columns: int, rows: int, square_m: float) -> Observations:
    return detect_boards(sorted(real_folder().glob(pattern)), checkerboard(columns, rows, square_m)).observations


_ORDINARY = Options(lens="radial")
_WIDE = Options(lens="kannala-brandt", free_aspect=True)
SETS: dict[str, RealSet] = {
    "opencv left": RealSet(partial(_photographed, "opencv_left_right/left*.jpg", 9, 6, 0.025), _ORDINARY),
    "opencv right": RealSet(partial(_photographed, "opencv_left_right/right*.jpg", 9, 6, 0.025), _ORDINARY),
    "sony": RealSet(partial(_photographed, "boofcv_sony_chess/*.jpg", 4, 6, 0.03), _ORDINARY),
    "gopro": RealSet(partial(_photographed, "udacity_gopro_wide/GOPR*.jpg", 8, 6, 1.0), _WIDE),
    "ov plane": RealSet(partial(ov_plane, "train"), _WIDE),
}
_DEFAULTS = ", by defaults"
SETS |= {f"{name}{_DEFAULTS}": replace(one, options=Options()) for name, one in SETS.items()}


def control(calibration: Calibration, observations: Observations, seed: int) -> Observations:
    """The same views of the same points as the calibration predicts them, with independent normal noise."""
    points, pixels = observations.points, np.empty_like(observations.points.pixels)
    for number, view in enumerate(observations.views):
        own = points.view == number
        camera = calibration.estimate.camera_at(view.station, view.placement)
        pixels[own] = camera.project(observations.targets[view.target].point_array[points.feature[own]])
    noise = np.random.default_rng(seed).standard_normal(pixels.shape)
    seen = pixels + calibration.fit.point_scale * points.sigma_px[:, None] * noise
    return _of_rows(replace(points, pixels=np.nan_to_num(seen)), np.isfinite(pixels[:, 0]), observations)


# ---- halves ---------------------------------------------------------------------------------------------------------


def halves(observations: Observations, seed: int) -> tuple[Observations, Observations]:
    """The views split at random into two halves whose sizes differ by at most one."""
    count = len(observations.views)
    first = np.isin(np.arange(count), np.random.default_rng(seed).permutation(count)[: count // 2])
    return _of_views(observations, first), _of_views(observations, ~first)


def _of_views(observations: Observations, chosen: Mask) -> Observations:
    return _of_rows(observations.points, chosen[observations.points.view], observations)


def _of_rows(points: Points, rows: Mask, observations: Observations) -> Observations:
    """The observations with only these rows of the given points."""
    return replace(observations, points=taken(points, rows))


@dataclass(frozen=True)
class Agreement:
    """Difference of two calibrations of one camera over what they state: 1 on average where both are honest.

    Attributes:
        intrinsics, projections, in_plane: see the module's docstring; mean squares, not their roots.
    """

    intrinsics: float
    projections: float
    in_plane: float


def agreement(first: Calibration, second: Calibration, pixels: Array) -> Agreement:
    """Agreement of two calibrations with one camera each; projections at pixels (N, 2). For lenses of two kinds the
    intrinsics have different meanings: NaN. Coefficients of one kind with other knots or other free terms are left out.
    """
    posteriors = [one.uncertainty.posterior for one in (first, second)]
    keys = [key for key in posteriors[0].keys if key.kind == "camera" and key in posteriors[1].keys]
    lenses = [one.estimate.cameras[keys[0].owner].lens for one in (first, second)]
    free = [tuple(key for key in one.keys if key.kind == "camera") for one in posteriors]
    if len(set(map(_meaning, lenses))) > 1 or free[0] != free[1]:
        keys = [key for key in keys if key.quantity not in lenses[0].names]
    sizes = natural_sizes(first.estimate, keys)
    step = (values_of(first.estimate, keys) - values_of(second.estimate, keys)) / sizes
    spread = sum(_covariance(posterior, keys) for posterior in posteriors) / sizes[:, None] / sizes
    alike = lenses[0].kind == lenses[1].kind
    mahalanobis = float(step @ np.linalg.solve(spread, step)) / len(keys) if alike else np.nan
    cameras = [one.estimate.cameras[keys[0].owner].at(Pose.identity()) for one in (first, second)]
    rays = cameras[0].rays(pixels)
    shown = np.isfinite(rays[:, 0]) & np.isfinite(cameras[1].project(rays)[:, 0])
    pixels, rays = pixels[shown], rays[shown]
    off = (cameras[1].project(rays) - pixels).ravel()

    def over_stated(shown: Mask, basis: Array) -> float:
        left = off.reshape(-1, 2)[shown].ravel()
        left = left - basis @ (basis.T @ left)
        both = zip((first, second), cameras, strict=True)
        stated = np.sum([stated_squares(*each, rays[shown], basis) for each in both], axis=0)
        return float(np.mean(pairs(left**2) / pairs(stated)))

    ahead = rays[:, 2] > _LEAST_AHEAD * np.linalg.norm(rays, axis=1)
    turned, posed = turn_basis(cameras[0], rays), pose_basis(cameras[0], rays[ahead])
    return Agreement(mahalanobis, over_stated(np.ones_like(ahead), turned), over_stated(ahead, posed))


def _meaning(lens: Lens) -> tuple[object, ...]:
    """What determines the meaning of a lens's numbers."""
    return lens.kind, lens.names, *(lens.coefficients.get(name) for name in lens.set_at_start)


def stated_squares(calibration: Calibration, camera: Camera, rays: Array, turned: Array) -> Array:
    """(2 N,) stated variance, px^2, of the projections of rays (N, 3), after the rotations of a basis (2 N, 3) are
    projected out.
    """
    posterior = calibration.uncertainty.posterior
    own = [key for key in posterior.keys if key.kind == "camera"]
    steps = _STEP * natural_sizes(calibration.estimate, own)
    slopes = _projection_slopes(camera, rays, [key.quantity for key in own], steps)
    slopes -= turned @ (turned.T @ slopes)
    return np.asarray(np.einsum("ni,ij,nj->n", slopes, _covariance(posterior, own), slopes))


def _covariance(posterior: Posterior, keys: Sequence[Key]) -> Array:
    at = [posterior.keys.index(key) for key in keys]
    return np.asarray(posterior.covariance[np.ix_(at, at)])


def pairs(values: Array) -> Array:
    """(N,) sums over x and y of values (2 N,)."""
    return np.asarray(values.reshape(-1, 2).sum(axis=1))


def seen_grid(observations: Observations) -> Array:
    """(N, 2) a grid of pixels in the convex hull of the observed points of all views."""
    ((width, height),) = observations.cameras.values()
    step = max(width, height) / _GRID
    x, y = (np.arange(0.5 * step, size, step) for size in (width, height))
    hull = cv2.convexHull(observations.points.pixels.astype(np.float32))
    every = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return every[[cv2.pointPolygonTest(hull, (float(a), float(b)), False) > 0.0 for a, b in every]]


def _projection_slopes(camera: Camera, rays: Array, quantities: Sequence[str], steps: Array) -> Array:
    """(2 N, K) derivatives of the projections of rays (N, 3), px per unit of each intrinsic."""
    columns = []
    for number, size in enumerate(steps):
        step = np.array([size])
        ahead, behind = (camera_moved(camera, [quantities[number]], s).project(rays) for s in (step, -step))
        columns.append((ahead - behind).ravel() / (2.0 * size))
    return np.column_stack(columns)


def turn_basis(camera: Camera, rays: Array) -> Array:
    """(2 N, 3) orthonormal basis of the displacements of projected rays (N, 3) under rotations of the camera."""
    ahead, behind = (
        [camera.project(rays + sign * _STEP * rays @ skew(axis)) for axis in np.eye(3)] for sign in (1, -1)
    )
    return np.asarray(np.linalg.qr(np.column_stack([(a - b).ravel() for a, b in zip(ahead, behind, strict=True)]))[0])


def pose_basis(camera: Camera, rays: Array) -> Array:
    """(2 N, 6) the same for motions of a plane that faces the camera, on which the rays (N, 3) end."""
    places, columns = rays / rays[:, 2:], []
    for axis in np.eye(3):
        for step in (np.broadcast_to(axis, places.shape), places @ skew(axis)):
            ahead, behind = (camera.project(places + sign * _STEP * step) for sign in (1.0, -1.0))
            columns.append((ahead - behind).ravel())
    return np.asarray(np.linalg.qr(np.column_stack(columns))[0])


# ---- the command ----------------------------------------------------------------------------------------------------


def rows(name: str, chosen: RealSet, splits: int) -> Iterator[Row]:
    """The figures of one set and of its control."""
    observations = chosen.observations()
    whole = calibrate(observations, chosen.options)
    pixels = seen_grid(observations)
    real = [halves(observations, seed) for seed in range(splits)]
    yield from _rows(name, real, chosen.options, pixels, (LEAST, MOST))
    simulated = [halves(control(whole, observations, seed), seed) for seed in range(splits)]
    yield from _rows(f"{name}, control", simulated, chosen.options, pixels, _CONTROL)


def _rows(
    name: str,
    pairs: Sequence[tuple[Observations, Observations]],
    options: Options,
    pixels: Array,
    limits: tuple[float, float],
) -> Iterator[Row]:
    found, failed = [], 0
    for pair in pairs:
        try:
            one, other = (calibrate(half, options) for half in pair)
            found.append(agreement(one, other, pixels))
        except CalibrationError:
            failed += 1
    views = " and ".join(str(len(half.shown_views)) for half in pairs[0])
    note = f"{len(found)} splits into {views} views" + (f", {failed} without a calibration" if failed else "")
    for what in ("intrinsics", "projections", "in_plane"):
        squares = [value for one in found if np.isfinite(value := getattr(one, what))]
        if squares:
            words = what.replace("_", " ")
            yield Row(name, f"{words}: difference over stated, rms", *root_and_error(squares), *limits, note)


_cases = {name: partial(rows, name, chosen) for name, chosen in SETS.items()}
main = script(_cases, __doc__, (20, "random splits of each set"), 2)

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
