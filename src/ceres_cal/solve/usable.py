"""May a solution be used? Whether it explains the observations, its lens folds, and nothing was lost on the way."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import SolutionError
from ceres_cal.observations.sights import Sights
from ceres_cal.scene.camera import Camera
from ceres_cal.solve.explanation import Explanation
from ceres_cal.solve.noise import Inliers
from ceres_cal.solve.problem import Problem
from ceres_cal.solve.robust import RobustSolution

# Of the image's diagonal, 24 px of 1600: half of a camera's observations farther off is no calibration, while a lens
# that is too simple stays below a few pixels. Nothing changes from half to double.
_NO_FIT = 0.015
# Of the image's diagonal, 240 px of 1600: lenses are mounted within some hundredths, unless a picture was cropped.
_OFF_CENTRE = 0.15
# Share of a side that observations of an image usually reach beyond.
_UNFILLED = 0.9
# Of the image's diagonal: three standard deviations of usual principal points (`priors.USUAL_CENTRE`).
_UNUSUAL = 0.045
_NEARER = 0.5  # of the distance from the stated middle, to the other: as it is of swapped axes (`possible`)


def require_fits(end: RobustSolution, problem: Problem) -> None:
    """Raise SolutionError where the solve failed, or its end explains too little."""
    if end.solution.failed:
        raise SolutionError(f"the solve failed ({end.solution.termination}): check labels and target dimensions")
    points, curves = end.residuals.lengths
    for name, camera in end.solution.estimate.cameras.items():
        own = problem.sights.of_camera(name)
        limit_px = _NO_FIT * float(np.hypot(*camera.image_size))
        met = np.count_nonzero(points[own.point_rows] <= limit_px)  # NaN is not
        met += np.count_nonzero(curves[own.curve_rows] <= limit_px)
        if 2 * met < len(own.point_rows) + len(own.curve_rows):
            raise SolutionError(
                f"camera {name!r}: the best solution misses half of its observations by more than {limit_px:.0f} px: "
                "check labels, target dimensions and which lens it is"
            )


def all_shown(camera: Camera, sights: Sights) -> bool:
    """Whether the lens folds nowhere inside of what was observed: the camera's sights `about` it."""
    places = (sights.pixels, sights.curve_pixels)
    return all(bool(np.all(camera.lens.shows(pixels, camera.phi))) for pixels in places)


def require_usable(end: RobustSolution, problem: Problem, explanations: Sequence[Explanation]) -> tuple[str, ...]:
    """Warnings about the solution; SolutionError where it must not be used."""
    warnings = []
    for name, camera in end.solution.estimate.cameras.items():
        width, height = camera.image_size
        off_px = float(np.hypot(*(camera.principal_point - 0.5 * (np.array(camera.image_size) - 1.0))))
        own = end.problem.sights.of_camera(name)
        reach = np.concatenate([own.pixels, own.curve_pixels]).max(axis=0, initial=0.0)
        if off_px > _OFF_CENTRE * np.hypot(width, height) or _is_of_smaller(camera, reach, off_px):
            warnings.append(
                f"camera {name!r}: its principal point lies {off_px:.0f} px from the middle of its image of {width} x "
                f"{height} px, of which observations reach {reach[0]:.0f} x {reach[1]:.0f}: "
                "is image_size that of the pictures, and are pixels counted from their top-left corner?"
            )
        if not camera.folds:
            continue
        fold, corner = camera.lens.monotone_radius(camera.phi), camera.corner_radius
        where = f"camera {name!r}: the solved {camera.lens.kind} lens folds {fold:.0f} px from the principal point"
        observed = end.problem.sights.of_camera(name).about(camera)
        if not camera.lens.may_fold or not all_shown(camera, observed):
            raise SolutionError(
                f"{where}, inside the image (corner at {corner:.0f} px): "
                "choose fewer or other coefficients, or observe nearer to the corners"
            )
        warnings.append(
            f"{where}: from there to the corner ({corner:.0f} px) pixels have no answer; "
            f"observations reach {observed.reach_px:.0f} px"
        )
    return (*warnings, *_lost(end.inliers, problem, explanations))


def _is_of_smaller(camera: Camera, reach: Array, off_px: float) -> bool:
    """Whether the principal point suits an image that ends where the observations do, not the stated one."""
    size = np.array(camera.image_size, dtype=float)
    other_px = float(np.hypot(*(camera.principal_point - 0.5 * reach)))
    return bool(
        np.any(reach < _UNFILLED * size) and off_px > _UNUSUAL * np.hypot(*size) and other_px < _NEARER * off_px
    )


def _lost(inliers: Inliers, problem: Problem, explanations: Sequence[Explanation]) -> Iterator[str]:
    """Sights most of whose observations were taken out one by one: they were not understood, whatever the rest says."""
    used = np.concatenate([inliers.points, inliers.curves])
    for one in explanations:
        used |= one.rows & one.is_taken
    shares = problem.sights.used_share(used[: len(inliers.points)], used[len(inliers.points) :])
    for number in np.flatnonzero(shares < 0.5):
        out = f"{100.0 * (1.0 - shares[number]):.0f} % of its observations were taken out"
        yield f"{problem.sights.keys[number]}: {out}: check its labels, do not use its pose"
