"""Following a field's lines in a photograph: search along normals, refit the camera, search nearer, until at rest."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Array32
from ceres_cal.base.errors import CalibrationError
from ceres_cal.calibrating import calibrate
from ceres_cal.detect.courses import clear_px, predict
from ceres_cal.detect.lines import SPACING_PX, Lines, measure, search, window_px
from ceres_cal.detect.registration import nearness, shifted
from ceres_cal.model.parameters import Options
from ceres_cal.observations import Prior
from ceres_cal.photographs.refit import Shown, observations_of, refit_camera
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import LENSES
from ceres_cal.scene.targets import Target

FAR_PX = 130.0  # how far off the start may be
# Of the places in view where paint must be found: robots and wear hide a third. Nothing changes from 0.33 to 0.67.
LEAST_SHARE = 0.5
# Share from which on no other start is tried. At half of its odds nothing changes.
_SURE_SHARE = 0.7
# Found of a curve, at least; places on curves without that, at most.
_ABSENT, _MOST_ABSENT = 0.2, 0.08
_ROUGH_SPACING_PX = 12.0
_NEAR_REACHES_PX = (12.0, 6.0, 4.0)
_FAR_REACHES_PX = (45.0, 45.0, 30.0, 30.0, 20.0, 12.0, 8.0, 5.0)
_LAST_REACH_PX = 5.0
_CANDIDATES = 5
_FEWEST = 12
_ROUNDS = 6
_AT_REST_PX = 0.02


@dataclass(frozen=True, eq=False)
class Freedom:
    """What of the camera a photograph may change besides the pose.

    Attributes:
        names: of the free intrinsics, in the order in which they are freed. priors: that hold them.
        shown: points that somebody showed, which hold the camera while lines are far off.
    """

    names: tuple[str, ...] = ()
    priors: tuple[Prior, ...] = ()
    shown: Shown | None = None


@dataclass(frozen=True, eq=False)
class Followed:
    """A field's lines as they were followed.

    Attributes:
        camera: the posed camera that predicts them. lines: what was measured there.
        moved_px: how far the last refit moved the prediction; at rest below 0.02.
    """

    camera: Camera
    lines: Lines
    moved_px: float

    @property
    def share(self) -> float:
        """Of the places in view, the share where paint was found."""
        return self.lines.share

    @property
    def absent(self) -> tuple[int, ...]:
        """The curves in view of which next to nothing was found."""
        curve, found = self.lines.course.curve, self.lines.found
        numbers, places = np.unique(curve, return_counts=True)
        seen = np.array([np.count_nonzero(found[curve == number]) for number in numbers])
        return tuple(int(number) for number in numbers[seen < _ABSENT * places])

    @property
    def holds(self) -> bool:
        """Whether this is the field: paint at half of the places in view, and no line missing that weighs."""
        missing = np.isin(self.lines.course.curve, self.absent)
        return self.share >= LEAST_SHARE and float(np.mean(missing)) <= _MOST_ABSENT


def follow(
    grey: Array32, target: Target, starts: Sequence[Camera], curves: Collection[str], freedom: Freedom | None = None
) -> Followed:
    """Follow a target's painted curves in a photograph, from the best of several starts.

    A start that is near is taken at once; else shifts, turns and scales of it are tried, by 130 px and 7.5 degrees.

    Args:
        starts: posed cameras, any of which may be right. curves: names of those that are painted.

    Returns:
        The best that was reached; whether it is the field, `Followed.holds` tells.
    """
    freedom = freedom or Freedom()
    tried: list[Followed] = []
    if freedom.shown is None:
        tried = [_close_in(grey, target, camera, curves, freedom, _NEAR_REACHES_PX) for camera in starts[:1]]
        if tried[0].holds and tried[0].share >= _SURE_SHARE:
            return tried[0]
    for camera in _candidates(grey, target, starts, curves, freedom):
        tried.append(_close_in(grey, target, camera, curves, freedom, _FAR_REACHES_PX))
        if tried[-1].holds and tried[-1].share >= _SURE_SHARE:
            break
    tried = tried or [_close_in(grey, target, starts[0], curves, freedom, ())]  # as it is: nothing to search
    best = max(tried, key=lambda one: (one.holds, one.share))
    return _with_its_lens(grey, target, best, curves) if best.holds and freedom.names else best


# ---- near enough to search ------------------------------------------------------------------------------------------


def _candidates(
    grey: Array32, target: Target, starts: Sequence[Camera], curves: Collection[str], freedom: Freedom
) -> list[Camera]:
    """Cameras that put the lines near something thin and bright, the best first."""
    courses = [predict(target, camera, curves, _ROUGH_SPACING_PX) for camera in starts]
    known = [number for number, course in enumerate(courses) if len(course) >= _FEWEST]
    if not known:
        return []
    width = float(np.median(courses[known[0]].width_px))
    near = nearness(grey, max(width, 2.0))
    known.sort(key=lambda number: -near.score(courses[number].pixels))
    found = []
    if freedom.shown is None:
        camera, wide = starts[known[0]], predict(target, starts[known[0]], curves, _ROUGH_SPACING_PX, -FAR_PX)
        for places in shifted(wide, near, camera.image_size, FAR_PX, _CANDIDATES):
            moved = observations_of(target, camera.image_size, wide.curve, places, np.full(len(wide), 5.0))
            found.append(refit_camera(camera, moved) or camera)
        return found
    return [starts[number] for number in known[:_CANDIDATES]]


# ---- closing in -----------------------------------------------------------------------------------------------------


def _close_in(
    grey: Array32,
    target: Target,
    camera: Camera,
    curves: Collection[str],
    freedom: Freedom,
    reaches_px: Sequence[float],
) -> Followed:
    for number, reach in enumerate(reaches_px):
        free = freedom.names[: max(0, 2 * number - 1)]
        camera = _searched(grey, target, camera, curves, freedom, free, reach) or camera
    lines, moved = _measured(grey, target, camera, curves), np.inf
    for _ in range(_ROUNDS):
        found = lines.found
        if np.count_nonzero(found) < _FEWEST:
            break
        seen = observations_of(
            target, camera.image_size, lines.course.curve[found], lines.pixels[found], lines.sigma_px[found]
        )
        refitted = refit_camera(camera, seen, freedom.names, freedom.priors)
        if refitted is None:
            break
        moved = _moved_px(camera, refitted, lines.course.pixels)
        camera, lines = refitted, _measured(grey, target, refitted, curves)
        if moved < _AT_REST_PX:
            break
    return Followed(camera, lines, moved)


def _with_its_lens(grey: Array32, target: Target, followed: Followed, curves: Collection[str]) -> Followed:
    """What is found when the lines are predicted with the kind of lens that suits them best.

    A polynomial that is a pixel off bends what crossings are extrapolated along.
    """
    lines, fits = followed.lines, []
    found = lines.found
    seen = observations_of(
        target, followed.camera.image_size, lines.course.curve[found], lines.pixels[found], lines.sigma_px[found]
    )
    for kind, lens in LENSES.items():
        try:
            calibration = calibrate(seen, Options(lens=kind, powers=(lens.trial_powers or ((),))[-1]))
        except CalibrationError:
            continue
        fits.append((calibration.fit.curve_scale * len(lines.found) / calibration.fit.curves, calibration))
    if not fits:
        return followed
    camera = min(fits, key=lambda fit: fit[0])[1].station()
    lines = _measured(grey, target, camera, curves)
    refined = Followed(camera, lines, _moved_px(followed.camera, camera, lines.course.pixels))
    return refined if refined.holds and refined.share > followed.share - 0.02 else followed


def _moved_px(camera: Camera, refitted: Camera, pixels: Array) -> float:
    """How far the floor that is seen at these pixels moves from one camera to the other, px at most."""
    floor = camera.locate(pixels)
    moved = refitted.project(np.column_stack([floor, np.zeros(len(floor))])) - pixels
    return float(np.nanmax(np.linalg.norm(moved, axis=1), initial=0.0))


def _searched(
    grey: Array32,
    target: Target,
    camera: Camera,
    curves: Collection[str],
    freedom: Freedom,
    free: tuple[str, ...],
    reach_px: float,
) -> Camera | None:
    course = predict(target, camera, curves, _ROUGH_SPACING_PX, 2.0)
    if len(course) < _FEWEST:
        return None
    offset, bright = search(grey, course, reach_px, 0.6 * reach_px)
    clear = bright > 0.4 * float(np.quantile(bright, 0.8))
    if np.count_nonzero(clear) < _FEWEST:
        return None
    course, offset = course.take(clear), offset[clear]
    places = course.pixels + offset[:, None] * course.normals
    sigma = np.full(len(course), max(0.1 * reach_px, 0.5))
    shown = freedom.shown if reach_px > 10.0 else None
    seen = observations_of(target, camera.image_size, course.curve, places, sigma, shown)
    return refit_camera(camera, seen, free, freedom.priors)


def _measured(grey: Array32, target: Target, camera: Camera, curves: Collection[str]) -> Lines:
    course = predict(target, camera, curves, SPACING_PX, SPACING_PX)
    clear = clear_px(target, camera, course, curves) > window_px(course)
    return measure(grey, course.take(clear), _LAST_REACH_PX)
