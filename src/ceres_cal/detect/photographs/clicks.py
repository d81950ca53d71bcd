"""A start from points that somebody showed: their pixels, roughly, and which cameras they may belong to."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError, naming
from ceres_cal.base.files import body_of, convert, read_json
from ceres_cal.base.frozen import replace
from ceres_cal.base.transforms import Pose
from ceres_cal.detect.photographs.refit import CAMERA, FreeIntrinsics, PointHints, refit_camera
from ceres_cal.observations import Prior
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Target
from ceres_cal.start.initialise import USUAL_PHI, USUAL_PHI_FACTOR
from ceres_cal.start.search import searched
from ceres_cal.start.sightlines import Beforehand, Sightlines

FORMAT, VERSION = "ceres-cal/corners", 1
# How far off a click on a corner is, twice as far as a careful one. Nothing changes from half to double.
SIGMA_PX = 15.0
FEWEST = 4
STRETCH = 0.03
"""A standard deviation of fy / fx where a picture was stretched one way."""
_WRONG = 6.0  # standard deviations of a click: as far off, and it is another place's
_FREED = ("a3", "phi", "aspect", "a2", "cx", "cy", "a4", "a5")


class Clicks(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pixels of named points of a target, and of places somewhere on named curves, good to some 15 px; they may lie
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
        for name in self.points:
            if name not in target.point_index:
                raise InputError(f"point {name!r} is not one of the target's: `ceres-cal targets` lists the names")
        for name, *_ in self.curves:
            if name not in target.curve_index:
                raise InputError(f"curve {name!r} is not one of the target's: `ceres-cal targets` lists the names")


def load_clicks(path: str | Path) -> Clicks:
    """A file `{"format": "ceres-cal/corners", "version": 1, "points": {"TopLeftCorner": [x, y], ...}}`, which may have
    places of curves besides, `"curves": [["HalfwayLine", x, y], ...]`.

    Raises:
        InputError: one line that names the file.
    """
    return clicks_from_json(read_json(path, FORMAT, VERSION), str(path))


def clicks_from_json(data: Mapping[str, Any], where: str) -> Clicks:
    """The clicks that a file describes; InputError that names `where`."""
    with naming(where):
        return convert(body_of(data, where, FORMAT, VERSION), Clicks, where)


def starts_from_clicks(
    clicks: Clicks, target: Target, image_size: tuple[int, int], lengths: tuple[Prior, ...] = ()
) -> tuple[list[Camera], FreeIntrinsics]:
    """Posed cameras of several lenses that the clicks may belong to, and what is free to be told by the photograph.

    Args:
        lengths: what is known of dimensions of the target that are free, too.

    Raises:
        InputError: a point that the target does not have, points on one line, or no camera that sees them there.
    """
    stretches = (1.0, 1.06, 1.14, 1.25, 1.4)  # of the image's corner by the lens
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
    """What a photograph may tell of a camera of which nothing is known but, roughly, its phi and where points are; and
    of lengths of the target.

    Args:
        camera: far from the middle of whose picture its principal point is about right.
    """
    off = 0.04  # a standard deviation of the principal point, of the width
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
    """The camera with so wide a lens that suits the clicks best, and how far off each click is, (N,) px."""
    middle, half = 0.5 * (np.array(image_size) - 1.0), 0.5 * float(np.hypot(*image_size))
    lens = Radial((0.0, (stretch - 1.0) / half**2, 0.0, 0.0), (2, 3, 4, 5))
    lifted = (pixels - middle) * (1.0 + lens.values[1] * np.sum((pixels - middle) ** 2, axis=1))[:, None]
    usual = float(np.log(USUAL_PHI * half)), float(np.log(USUAL_PHI_FACTOR))
    known = Beforehand(np.zeros(3), np.full(3, np.inf), usual, 0.0, least_px=0.5 * SIGMA_PX)
    lines = Sightlines.of_points(known, lifted, plane, half)
    best = searched(lines, lines).poses
    rotation, phi = best.rotations[0].T, float(np.exp(best.log_phi[0]))
    pose = Pose(rotation, -rotation @ best.positions[0])
    camera = Camera(image_size, phi, (float(middle[0]), float(middle[1])), lens, 1.0, pose)
    off = np.linalg.norm(lines.equations(best)[0][0].reshape(2, -1), axis=0)
    return camera, np.where(lines.seen(best)[0][: len(plane)], off, np.inf)


def _odd_one(names: list[str], off_px: Array) -> str:
    """What is wrong with clicks: the one that the others contradict, or all."""
    wrong = [name for name, off in zip(names, off_px, strict=True) if off > _WRONG * SIGMA_PX]
    if len(names) - len(wrong) < FEWEST:
        return (
            "the points to start from are those of no camera above the target: check names, and that none go round the "
            "wrong way, as if seen from below"
        )
    return f"point {wrong[0]!r} to start from lies {off_px.max():.0f} px from where the others have it: check its name"
