"""Initial estimates from points that a user pointed out: their rough pixels, and the cameras that they are consistent
with.

Also the camera for points and lines that a user drags on a page, from the first one on and fast enough to follow it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base import Array, InputError, answer_or_reason, body_of, convert, naming, read_json, replace
from ceres_cal.base.transforms import Pose, rotation_exp
from ceres_cal.detect.photographs.refit import CAMERA, ROBUST, FreeIntrinsics, PointHints, refit_camera
from ceres_cal.observations import Prior
from ceres_cal.problem import Weighting, intrinsic_names
from ceres_cal.scene import Camera, Radial, Target, curve_points, require_features
from ceres_cal.start.closed_forms import RADII, LensProfile
from ceres_cal.start.initialise import USUAL_PHI, USUAL_PHI_FACTOR
from ceres_cal.start.search import searched
from ceres_cal.start.sightlines import CameraPrior, Sightlines

FORMAT, VERSION = "ceres-cal/corners", 1
# Standard deviation of a click on a corner, px, twice that of a careful one. Nothing changes from half to double.
SIGMA_PX = 15.0
FEWEST = 4
STRETCH = 0.03
"""Standard deviation of fy / fx of a picture that was stretched in one direction."""
_WRONG = 6.0  # standard deviations of a click, beyond which it shows another place
_FREED = ("a3", "phi", "aspect", "a2", "cx", "cy", "a4", "a5")


class Clicks(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pixels of named points of a target, and of places somewhere on named curves, accurate to some 15 px; they may lie
    outside the image.
    """

    points: Mapping[str, tuple[float, float]]
    curves: tuple[tuple[str, float, float], ...] = ()

    def __post_init__(self) -> None:
        if len(self.points) < FEWEST:
            raise InputError(f"{FEWEST} points are needed to start from, not {len(self.points)}: show more corners")
        if not np.all(np.isfinite([*self.points.values(), *(place[1:] for place in self.curves)])):
            raise InputError("a point to start from has a number that is not finite")

    def require_names(self, target: Target) -> None:
        """Raise InputError where a target has no such point or curve."""
        require_features(target, self.points, (name for name, *_ in self.curves))


def load_clicks(path: str | Path) -> Clicks:
    """Load a file `{"format": "ceres-cal/corners", "version": 1, "points": {"TopLeftCorner": [x, y], ...}}`, which may
    also contain places on curves, `"curves": [["HalfwayLine", x, y], ...]`.

    Raises:
        InputError: one line that names the file.
    """
    return clicks_from_json(read_json(path, FORMAT, VERSION), str(path))


def clicks_from_json(data: Mapping[str, Any], where: str) -> Clicks:
    """Return the clicks that a file describes; an InputError names `where`."""
    with naming(where):
        return convert(body_of(data, where, FORMAT, VERSION), Clicks, where)


def starts_from_clicks(
    clicks: Clicks, target: Target, image_size: tuple[int, int], lengths: tuple[Prior, ...] = ()
) -> tuple[list[Camera], FreeIntrinsics]:
    """Return posed cameras with several lenses that are consistent with the clicks, and what the photograph may change.

    Args:
        lengths: priors on dimensions of the target that are free, too.

    Raises:
        InputError: a point that the target does not have, points on one line, or no camera that sees them there.
    """
    # Radial stretch of the image's corner by the lens; the last one is a fisheye's.
    stretches = (1.0, 1.06, 1.14, 1.25, 1.4, 1.7, 2.3, 4.0)
    clicks.require_names(target)
    points = {name: (*pixel, SIGMA_PX) for name, pixel in clicks.points.items()}
    hints = PointHints.of(target, points, [(*place, SIGMA_PX) for place in clicks.curves])
    pixels, plane = hints.pixels, target.point_array[hints.feature]
    if np.linalg.svd(plane - plane.mean(axis=0), compute_uv=False)[1] < 1e-6:
        raise InputError(f"all {len(plane)} points to start from lie on one line: show more corners")
    every = [_with_stretch(stretch, pixels, plane, image_size) for stretch in stretches]
    fitting = [camera for camera, off_px in every if off_px.max() < _WRONG * SIGMA_PX]
    if not fitting:
        raise InputError(_odd_one(list(clicks.points), min((off for _, off in every), key=np.median)))
    phi = float(np.median([camera.phi for camera in fitting]))
    if clicks.curves:
        shown = hints.observed(image_size)
        refitted = (refit_camera(camera, shown) for camera in fitting)
        fitting = [one[0] if one is not None else camera for one, camera in zip(refitted, fitting, strict=True)]
    return fitting, unknown_optics(replace(fitting[0], phi=phi), hints, lengths)


def unknown_optics(camera: Camera, hints: PointHints | None, lengths: tuple[Prior, ...] = ()) -> FreeIntrinsics:
    """Return what a photograph may change of a camera of which only a rough phi and points are known, and of the
    target's lengths.

    Args:
        camera: if its principal point is far from the picture's middle, it is taken as about right.
    """
    off = 0.04  # standard deviation of the principal point, as a share of the width
    size, centre = np.array(camera.image_size), 0.5 * (np.array(camera.image_size) - 1.0)
    if np.any(np.abs(camera.principal_point - centre) > 3.0 * off * size):
        centre, off = np.array(camera.principal_point), 2.0 * off
    priors = (
        Prior("camera", CAMERA, "phi", (camera.phi,), (0.3 * camera.phi,)),
        Prior("camera", CAMERA, "principal_point", tuple(centre), (off * size[0],) * 2),
        Prior("camera", CAMERA, "aspect", (1.0,), (STRETCH,)),
    )
    return FreeIntrinsics(_FREED, (*priors, *lengths), hints)


def _with_stretch(stretch: float, pixels: Array, plane: Array, image_size: tuple[int, int]) -> tuple[Camera, Array]:
    """Return the camera with this radial stretch that fits the clicks best, and each click's residual (N,) px."""
    middle, half = 0.5 * (np.array(image_size) - 1.0), 0.5 * float(np.hypot(*image_size))
    offsets, bend = pixels - middle, 1.0 / stretch - 1.0
    usual = float(np.log(USUAL_PHI * half)), float(np.log(USUAL_PHI_FACTOR))
    known = CameraPrior(np.zeros(3), np.full(3, np.inf), usual, 0.0, least_px=0.5 * SIGMA_PX)
    lines = Sightlines.of_points(known, offsets, plane, half, bend)
    best = searched(lines, lines).poses
    rotation, phi = best.rotations[0].T, float(np.exp(best.log_phi[0]))
    radii = RADII * min(half, 1.1 * float(np.max(np.linalg.norm(offsets, axis=1))))
    profile = LensProfile(radii, np.arctan2(radii, phi * (1.0 + bend * (radii / half) ** 2)))
    lens = profile.nearest(Radial((0.0,) * 4, (2, 3, 4, 5)), phi, ())
    pose = Pose(rotation, -rotation @ best.positions[0])
    camera = Camera(image_size, phi, (float(middle[0]), float(middle[1])), lens, 1.0, pose)
    off = np.linalg.norm(lines.equations(best)[0][0].reshape(2, -1), axis=0)
    return camera, np.where(lines.seen(best)[0][: len(plane)], off, np.inf)


def _odd_one(names: list[str], off_px: Array) -> str:
    """Return what is wrong with clicks: the one that contradicts the others, or all of them."""
    wrong = [name for name, off in zip(names, off_px, strict=True) if off > _WRONG * SIGMA_PX]
    if len(names) - len(wrong) < FEWEST:
        return (
            "no camera above the target sees the points to start from at these pixels: check names, and that neither "
            "the points nor the picture are mirrored"
        )
    return (
        f"point {wrong[0]!r} to start from lies {off_px.max():.0f} px from where the others predict it: check its name"
    )


# ---- dragged by hand ------------------------------------------------------------------------------------------------

_AS_SHOWN = Weighting(loss="trivial")
# Least number of equations for each set of free intrinsics; with fewer the lens is not changed.
_FREED_BY = ((8, ("phi",)), (12, ("phi", "a3")), (24, ("phi", "a3", "cx", "cy")), (36, ("phi", "a3", "a2", "cx", "cy")))
_AGAINST = 4.0  # standard deviations of a click by which it contradicts the others


def guess(target: Target, image_size: tuple[int, int], side: str = "") -> Camera:
    """Return a camera straight above the middle of a target, which fills most of the picture.

    Args:
        side: side of the picture towards which the field's left end lies.
    """
    filled = 0.8  # share of the picture that a field fills of which nothing is known yet
    low, high = target.box
    size, (width, height) = high - low, image_size
    turns = {"left": 0, "top": 1, "right": 2, "bottom": 3}
    default = 0 if (size[0] >= size[1]) == (width >= height) else 1
    turn = 0.5 * np.pi * turns.get(side.rpartition("-")[2], default)
    across = size if round(turn / (0.5 * np.pi)) % 2 == 0 else size[::-1]
    phi = USUAL_PHI * 0.5 * float(np.hypot(*image_size))
    above = phi * float(np.max(across / (filled * np.array(image_size))))
    rotation = np.diag([1.0, -1.0, -1.0]) @ rotation_exp([0.0, 0.0, -turn])
    position = np.array([*(0.5 * (low + high)), above])
    middle = 0.5 * (width - 1.0), 0.5 * (height - 1.0)
    return Camera(image_size, phi, middle, Radial((0.0,) * 4, (2, 3, 4, 5)), 1.0, Pose.looking(position, rotation))


def solved(shown: PointHints, before: Camera, base: Camera, *, quickly: bool = False) -> Camera:
    """Fit the camera to all clicks, each weighted by the accuracy of a hand; other points move along with them.

    Args:
        before: start of the fit.
        base: the camera before anything was shown.
        quickly: another start is tried only where this one does not converge.
    """
    if not shown.equations:
        return base
    best: Camera | None = None
    base = _turned(shown, base)
    for start in (before, base) if shown.equations >= _FREED_BY[0][0] else (base, before):
        there = _fitted(shown, start, base, _AS_SHOWN)
        if there is not None and (best is None or _cost(shown, there) < _cost(shown, best)):
            best = there
        if best is not None and (quickly or _cost(shown, best) < _AGAINST**2):
            break
    return best or before


def _fitted(shown: PointHints, start: Camera, base: Camera, weighting: Weighting) -> Camera | None:
    """Fit the camera to what was shown, with as many free intrinsics as that can determine."""
    wanted: tuple[str, ...] = next((names for least, names in reversed(_FREED_BY) if shown.equations >= least), ())
    free = tuple(name for name in wanted if name in intrinsic_names(base.lens))
    observed = _hints(shown, base).observed(base.image_size)
    fitted = refit_camera(start, observed, free, unknown_optics(base, None).priors, weighting)
    return None if fitted is None else fitted[0]


def settled(shown: PointHints, before: Camera, base: Camera) -> tuple[Camera, dict[str, float], str]:
    """Return the camera after dragging has ended, the clicks that contradict the others (see `judged`), and what is
    wrong with all of them together.
    """
    far = 10.0  # standard deviations of a click, beyond which no camera nearby fits it
    camera, wrong = solved(shown, before, base), ""
    off_px, sigma_px = off(shown, camera)
    if len(shown.feature) >= FEWEST and np.any(off_px > far * sigma_px):
        other, wrong = answer_or_reason(lambda: anew(shown, base.image_size))
        camera = other or camera
    return *judged(shown, camera, base), wrong


def judged(shown: PointHints, camera: Camera, base: Camera) -> tuple[Camera, dict[str, float]]:
    """Return the camera without the clicks that contradict the others, and how far off those are, px, by name, or by
    "#2" for a place on a curve.
    """
    enough = 10  # least number of equations with which a contradiction can be seen
    off_px, sigma_px = off(shown, camera)
    # The other clicks absorb a share of an error, hence half of the limit.
    if shown.equations < enough or np.all(off_px <= 0.5 * _AGAINST * sigma_px):
        return camera, {}
    robust = _fitted(shown, camera, _turned(shown, base), ROBUST) or camera
    off_px, sigma_px = off(shown, robust)
    names = (*shown.names, *(f"#{number}" for number in range(len(shown.curve))))
    rows = zip(names, off_px.tolist(), (off_px > _AGAINST * sigma_px).tolist(), strict=True)
    return robust, {name: distance for name, distance, against in rows if against}


def anew(shown: PointHints, image_size: tuple[int, int]) -> Camera:
    """Return the camera that the named points determine without an initial estimate, as in `detect_field`.

    Raises:
        InputError: fewer than four points, or none can be right, and why.
    """
    points = dict(zip(shown.names, map(tuple, shown.pixels.tolist()), strict=True))
    names = (shown.target.curve_names[number] for number in shown.curve)
    curves = tuple((name, x, y) for name, (x, y) in zip(names, shown.places.tolist(), strict=True))
    cameras, _ = starts_from_clicks(Clicks(points, curves), shown.target, image_size)
    return min(cameras, key=lambda camera: _cost(shown, camera))


def off(shown: PointHints, camera: Camera) -> tuple[Array, Array]:
    """(N,) distance of each click from its point or curve, px, and (N,) standard deviation of a click, px."""
    ends = np.concatenate([shown.pixels, shown.places]) - feet(shown, camera)
    return np.nan_to_num(np.linalg.norm(ends, axis=1), nan=1e6), np.concatenate([shown.sigma_px, shown.place_sigma_px])


def feet(shown: PointHints, camera: Camera) -> Array:
    """(N, 2) px where the model places what each click shows."""
    points = camera.project(shown.target.point_array[shown.feature]) if len(shown.feature) else np.empty((0, 2))
    lines = curves_in_image(shown.target, camera)
    nearest = []
    for curve, place in zip(shown.curve, shown.places, strict=True):
        line = lines[shown.target.curve_names[curve]]
        apart = np.nan_to_num(np.linalg.norm(line - place, axis=1), nan=np.inf)
        nearest.append(_foot(line, int(np.argmin(apart)), place))
    return np.concatenate([points, np.array(nearest).reshape(-1, 2)])


def _foot(line: Array, number: int, place: Array) -> Array:
    """Return the nearest place on the two pieces of a polyline that meet at one of its corners."""
    best = line[number]
    for other in (number - 1, number + 1):
        if 0 <= other < len(line) and np.all(np.isfinite(line[other])):
            along = line[other] - line[number]
            share = np.clip((place - line[number]) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
            foot = line[number] + share * along
            if np.linalg.norm(foot - place) < np.linalg.norm(best - place):
                best = foot
    return np.asarray(best)


def curves_in_image(target: Target, camera: Camera, steps: int = 60) -> Mapping[str, Array]:
    """Return each curve's middle (S, 2) px; NaN where the camera does not show it."""
    return {name: camera.project(curve_points(curve, 0, steps)) for name, curve in target.curves.items()}


def _cost(shown: PointHints, camera: Camera) -> float:
    """Return the largest squared residual of the clicks, in standard deviations."""
    off_px, sigma_px = off(shown, camera)
    return float(np.max((off_px / sigma_px) ** 2, initial=0.0))


def _hints(shown: PointHints, base: Camera) -> PointHints:
    """Add the other points of the target, held loosely at their present pixels, to what was shown."""
    held_px = 300.0  # standard deviation with which the other points are held
    rest = np.setdiff1d(np.arange(len(shown.target.points), dtype=np.int32), shown.feature)
    there = base.project(shown.target.point_array[rest])
    rest, there = rest[np.isfinite(there[:, 0])], there[np.isfinite(there[:, 0])]
    return replace(
        shown,
        feature=np.concatenate([shown.feature, rest]),
        pixels=np.concatenate([shown.pixels, there]),
        sigma_px=np.concatenate([shown.sigma_px, np.full(len(rest), held_px)]),
    )


def _turned(shown: PointHints, base: Camera) -> Camera:
    """Return the base camera shifted, and with two or more points also turned about its axis and raised, so that points
    come near the clicks.
    """
    if not len(shown.feature):
        return base
    axis = np.array(base.principal_point)
    seen, wanted = base.project(shown.target.point_array[shown.feature]) - axis, shown.pixels - axis
    if not np.all(np.isfinite(seen)):
        return base
    a, b = seen @ (1.0, 1.0j), wanted @ (1.0, 1.0j)
    away = a - a.mean()
    factor = np.vdot(away, b - b.mean()) / max(float(np.vdot(away, away).real), 1e-12) if len(a) > 1 else 1.0
    if not abs(factor) > 1e-3:
        return base
    about = rotation_exp([0.0, 0.0, float(np.angle(factor))])
    pose = base.cam_from_world
    translation = about @ pose.translation
    translation[2] /= abs(factor)
    shift = b.mean() - factor * a.mean()
    translation[:2] += np.array([shift.real, shift.imag]) * translation[2] / base.phi
    return replace(base, cam_from_world=Pose(about @ pose.rotation, translation))
