"""The camera that fits a photograph's lines, as far as they are known: from an initial estimate, in one robust solve,
or with the kind of lens that fits them best.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import Array, Frozen, Indices32, attempt, field, or_none, replace
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate_near
from ceres_cal.detect.courses import Course, course_at
from ceres_cal.observations import NO_POINTS, Curves, Observations, Points, Prior, View, gather_sights
from ceres_cal.problem import Problem, Weighting, make_structure, redrawn, solve, stated_prior
from ceres_cal.problem.parameters import Estimate, Layout, Options, Station, intrinsic_names
from ceres_cal.problem.quantities import is_lens
from ceres_cal.problem.residuals import residuals
from ceres_cal.scene import Camera, Target
from ceres_cal.scene.lens import LENSES

CAMERA, STATION, TARGET = "camera", "station", "field"
NOTHING: tuple[Indices32, Array, Array] = (np.empty(0, np.int32), np.empty((0, 2)), np.empty(0))
"""Curves, pixels and sigmas of zero places."""
_QUICK = Options(max_iterations=30, threads=1)
ROBUST = Weighting(loss="cauchy", loss_scale=2.0)


class PointHints(Frozen):
    """Features of a target that a user marked in a photograph: points by their index (P,) in the target, pixels (P, 2),
    sigma_px (P,), and places (N, 2) px on curves (N,), with sigmas (N,) px.
    """

    target: Target
    feature: Indices32
    pixels: Array
    sigma_px: Array
    curve: Indices32 = field(default_factory=lambda: NOTHING[0])
    places: Array = field(default_factory=lambda: NOTHING[1])
    place_sigma_px: Array = field(default_factory=lambda: NOTHING[2])

    @classmethod
    def of(
        cls,
        target: Target,
        points: Mapping[str, tuple[float, float, float]],
        places: Sequence[tuple[str, float, float, float]] = (),
    ) -> PointHints:
        """Make hints from points by name and places with their curve, each with x, y and sigma in px; names unknown to
        the target are omitted.
        """
        points = {name: place for name, place in points.items() if name in target.point_index}
        places = [place for place in places if place[0] in target.curve_index]
        at = np.array(list(points.values()), dtype=float).reshape(-1, 3)
        on = np.array([place[1:] for place in places], dtype=float).reshape(-1, 3)
        index = np.array([target.point_index[name] for name in points], dtype=np.int32)
        curve = np.array([target.curve_index[place[0]] for place in places], dtype=np.int32)
        return cls(target, index, at[:, :2], at[:, 2], curve, on[:, :2], on[:, 2])

    @property
    def names(self) -> list[str]:
        """(P,) names of the points."""
        return [self.target.point_names[number] for number in self.feature]

    def observed(self, image_size: tuple[int, int]) -> Observations:
        """Return the hints as observations."""
        return observations_of(self.target, image_size, *NOTHING, self)

    @property
    def equations(self) -> int:
        """Number of equations: two for a point, one for a place on a curve."""
        return 2 * len(self.feature) + len(self.curve)


class FreeIntrinsics(Frozen):
    """Free numbers of the camera besides its pose, and of the target, in a fit to a photograph.

    Attributes:
        names: free intrinsics, in the order in which they are freed.
        priors: priors on them, and on dimensions of the target, which are thereby free.
        hints: what a user showed, which holds the camera while lines are far off.
        keep: whether the starts are known to be near, so that nothing far off is searched.
    """

    names: tuple[str, ...] = ()
    priors: tuple[Prior, ...] = ()
    hints: PointHints | None = None
    keep: bool = False


def observations_of(
    target: Target,
    image_size: tuple[int, int],
    curve: Indices32,
    pixels: Array,
    sigma_px: Array,
    hints: PointHints | None = None,
) -> Observations:
    """Return one view of a field in the world: pixels (N, 2) on curves (N,), and what a user showed besides."""
    points = NO_POINTS
    if hints is not None:
        points = Points(np.zeros(len(hints.feature), np.int32), hints.feature, hints.pixels, hints.sigma_px)
        curve, pixels = np.concatenate([curve, hints.curve]), np.concatenate([pixels, hints.places])
        sigma_px = np.concatenate([sigma_px, hints.place_sigma_px])
    count = len(curve)
    return Observations(
        {TARGET: target},
        {CAMERA: image_size},
        (View("frame", CAMERA, STATION, TARGET),),
        points,
        Curves(np.zeros(count, np.int32), curve, pixels, sigma_px, np.zeros(count, np.int8)),
    )


def problem_of(
    camera: Camera,
    observations: Observations,
    free: tuple[str, ...],
    priors: tuple[Prior, ...],
    weighting: Weighting = ROBUST,
) -> tuple[Problem, Estimate]:
    """Return the problem that `refit_camera` solves, and its initial estimate."""
    names, solved = intrinsic_names(camera.lens), tuple(prior.dimension for prior in priors if prior.dimension)
    freed = np.array(sorted(names.index(name) for name in free), dtype=np.int64)
    estimate = Estimate(
        {CAMERA: camera.at(camera.cam_from_world)},
        {STATION: Station(CAMERA, camera.cam_from_world)},
        {},
        make_structure(observations.targets, {}, solved),
    )
    layout = Layout({CAMERA: freed}, frozenset({STATION}), frozenset())
    known = tuple(stated_prior(prior, camera.lens) for prior in priors)
    return Problem(gather_sights(observations), layout, known, weighting, _QUICK), estimate


@or_none  # reads: "its lines were not found ..." where no start leads to a camera
def refit_camera(
    camera: Camera,
    observations: Observations,
    free: tuple[str, ...] = (),
    priors: tuple[Prior, ...] = (),
    weighting: Weighting = ROBUST,
) -> tuple[Camera, Target] | None:
    """Fit a posed camera, and the target, to one view's observations, from a camera nearby; None where it cannot be
    determined.

    Args:
        free: names of the intrinsics that are free, too.
        priors: on them, and on dimensions that are estimated.
        weighting: noise and loss; by default far outliers have no influence.
    """
    problem, estimate = problem_of(camera, observations, free, priors, weighting)
    solution = solve(problem, estimate, precision=1e-6)
    refitted = solution.estimate.camera_at(STATION)
    finite = np.all(np.isfinite(refitted.position))
    usable = not solution.failed and not refitted.folds and finite and refitted.position[2] > 0.0
    found = solution.estimate.structure.dimensions
    lengths = {name.partition("/")[2]: length for name, length in found.items()}
    if not usable or not all(length > 0.0 for length in lengths.values()):
        return None
    return refitted, redrawn(observations.targets[TARGET], lengths)


def best_fit(
    camera: Camera, observations: Observations, lengths: tuple[Prior, ...] = (), *, is_stretched: bool = False
) -> Calibration | None:
    """Return the calibration of one view with the kind of lens that fits it best, from a camera nearby.

    Pixels are square if this camera's are, or if they fit the view almost as well and it is not stretched.
    """
    # Largest ratio of the noise with square pixels to that with free ones: 1.00 to 1.07 where a court was drawn a
    # millimetre off, 1.18 where a photograph of worn lines was stretched by 4 %, 7 where a clear one was by 7 %.
    nearly = 1.12
    fits = [] if is_stretched else _fits(squared_pixels(camera), observations, lengths)
    if camera.aspect != 1.0:
        fits += [(nearly * off, found, own) for off, found, own in _fits(camera, observations, lengths)]
    # A lens that folds in the picture counts as noisier, up to twice: a polynomial may do so beyond the last line, and
    # bends what is predicted there. For a fisheye the other lenses leave a hundred times as much noise.
    order = sorted(fits, key=lambda fit: fit[0] * (1.0 + fit[1].station().folded_edge))
    asked = (  # a phi that no lens has is in an open valley of the cost, where another place fits as well
        # quiet: the next one is taken
        one if is_lens(one.station()) else attempt(partial(calibrate_near, one.station(), observations, own))
        for _, one, own in order
    )
    return next((one for one in asked if isinstance(one, Calibration)), None)


def _fits(
    near: Camera, observations: Observations, lengths: tuple[Prior, ...]
) -> list[tuple[float, Calibration, Options]]:
    """For each kind of lens, return the residual noise of the view, the calibration, and its options."""
    stretched, fits = near.aspect != 1.0, list[tuple[float, Calibration, Options]]()
    own_first = sorted(LENSES.items(), key=lambda one: one[0] != near.lens.kind)  # the others start from its result
    for kind, lens in own_first:
        if lens.set_at_start:
            continue  # a few lines do not determine a lens without a formula
        powers = (lens.trial_powers or ((),))[-1]
        own = Options(lens=kind, powers=powers, priors=lengths, as_built="as drawn", free_aspect=stretched)
        # quiet: where none fits these lines, they are judged as found
        found = attempt(partial(calibrate_near, near, observations, own, knows=False))
        if isinstance(found, Calibration):
            fits.append((found.fit.curve_scale * len(observations.curves) / found.fit.curves, found, own))
            near = min(fits, key=lambda fit: fit[0])[1].station()
    return fits


def squared_pixels(camera: Camera) -> Camera:
    """Return the camera with square pixels of the same area."""
    return replace(camera, phi=camera.phi * camera.aspect**0.5, aspect=1.0)


def misfit(camera: Camera, observations: Observations) -> float:
    """Mean cost of the curve observations of one view, under the loss of `refit_camera`."""
    problem, estimate = problem_of(camera, observations, (), ())
    left = residuals(problem.sights, estimate).curves / problem.weighting.loss_scale
    return float(np.mean(np.log1p(np.nan_to_num(left, nan=np.inf) ** 2)))


def moved_px(camera: Camera, refitted: Camera, pixels: Array) -> float:
    """Largest displacement, px, from one camera to the other of the floor that is seen at these pixels."""
    floor = camera.locate(pixels)
    moved = refitted.project(np.column_stack([floor, np.zeros(len(floor))])) - pixels
    return float(np.nanmax(np.linalg.norm(moved, axis=1), initial=0.0))


def redrawn_px(camera: Camera, course: Course, target: Target) -> float:
    """Largest distance, px, from the places of a course to the curves of another drawing of the target."""
    there = course_at(target, camera, course.curve, course.s).pixels
    return float(np.nanmax(np.abs(np.sum((there - course.pixels) * course.normals, axis=1)), initial=0.0))
