"""A start from points that somebody showed: their pixels, roughly, and which cameras they may belong to."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import DegenerateError, InputError, naming
from ceres_cal.base.files import check_header, convert, read_json
from ceres_cal.detect.photographs.refit import CAMERA, FreeIntrinsics, PointHints
from ceres_cal.observations import Prior
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Target
from ceres_cal.start.closed_forms import homography_from_points, orthogonality_error, pose_from_homography
from ceres_cal.start.initialise import USUAL_PHI, USUAL_PHI_FACTOR

FORMAT, VERSION = "ceres-cal/corners", 1
# How far off a click on a corner is, twice as far as a careful one. Nothing changes from half to double.
SIGMA_PX = 15.0
FEWEST = 4
_STRETCHES = (1.0, 1.06, 1.14, 1.25, 1.4)  # of the image's corner by the lens
_PHI = np.geomspace(0.5, 3.0, 40)  # in half image diagonals
_FREED = ("a3", "phi", "a2", "cx", "cy", "a4", "a5")
# A standard deviation of fy / fx where a picture was stretched one way.
_STRETCH = 0.03
# How square clicks are good to make the axes. Nothing changes from half to double.
_SQUARE = 0.02


@dataclass(frozen=True)
class Clicks:
    """Pixels of named points of a target, good to some 15 px; they may lie outside the image."""

    points: Mapping[str, tuple[float, float]]

    def __post_init__(self) -> None:
        if len(self.points) < FEWEST:
            raise InputError(f"{FEWEST} points are needed to start from, not {len(self.points)}: show more corners")
        if not np.all(np.isfinite(list(self.points.values()))):
            raise InputError("a point to start from has a number that is not finite")


class _ClicksFile(msgspec.Struct, forbid_unknown_fields=True):
    format: str
    version: int
    points: dict[str, tuple[float, float]]


def load_clicks(path: str | Path) -> Clicks:
    """A file `{"format": "ceres-cal/corners", "version": 1, "points": {"TopLeftCorner": [x, y], ...}}`.

    Raises:
        InputError: one line that names the file.
    """
    return clicks_from_json(read_json(path, FORMAT, VERSION), str(path))


def clicks_from_json(data: Mapping[str, Any], where: str) -> Clicks:
    """The clicks that a file describes; InputError that names `where`."""
    file = convert(check_header(data, where, FORMAT, VERSION), _ClicksFile, where)
    with naming(where):
        return Clicks(file.points)


def starts_from_clicks(
    clicks: Clicks, target: Target, image_size: tuple[int, int], lengths: tuple[Prior, ...] = ()
) -> tuple[list[Camera], FreeIntrinsics]:
    """Posed cameras of several lenses that the clicks may belong to, and what is free to be told by the photograph.

    Args:
        lengths: what is known of dimensions of the target that are free, too.

    Raises:
        InputError: a point that the target does not have, or points of which three lie on a line.
    """
    for name in clicks.points:
        if name not in target.point_index:
            raise InputError(f"point {name!r} is not one of the target's: `ceres-cal targets` lists the names")
    index = np.array([target.point_index[name] for name in clicks.points], dtype=np.int32)
    pixels, plane = np.array(list(clicks.points.values()), dtype=float), target.point_array[index]
    middle = 0.5 * (np.array(image_size) - 1.0)
    half = 0.5 * float(np.hypot(*image_size))
    cameras = []
    for stretch in _STRETCHES:
        lens = Radial((0.0, (stretch - 1.0) / half**2, 0.0, 0.0), (2, 3, 4, 5))
        lifted = (pixels - middle) * (1.0 + lens.values[1] * np.sum((pixels - middle) ** 2, axis=1))[:, None]
        try:
            homography = homography_from_points(plane[:, :2], lifted)
        except DegenerateError as error:
            raise InputError(f"the points to start from tell no pose: {error}") from None
        phi = _phi(homography, half)
        pose = pose_from_homography(homography, phi)
        if pose.position[2] < 0.0:
            raise InputError("the points to start from go round the wrong way, as if seen from below: check names")
        cameras.append(Camera(image_size, phi, (float(middle[0]), float(middle[1])), lens, 1.0, pose))
    phi = float(np.median([camera.phi for camera in cameras]))
    hints = PointHints(index, pixels, np.full(len(index), SIGMA_PX))
    return cameras, unknown_optics(image_size, phi, hints, lengths)


def unknown_optics(
    image_size: tuple[int, int], phi: float, hints: PointHints | None, lengths: tuple[Prior, ...] = ()
) -> FreeIntrinsics:
    """What a photograph may tell of a camera of which nothing is known but, roughly, its phi and where points are; and
    of lengths of the target.
    """
    middle = 0.5 * (np.array(image_size) - 1.0)
    priors = (
        Prior("camera", CAMERA, "phi", (phi,), (0.5 * phi,)),
        Prior("camera", CAMERA, "principal_point", tuple(middle), (0.04 * image_size[0],) * 2),
        Prior("camera", CAMERA, "aspect", (1.0,), (_STRETCH,)),
    )
    return FreeIntrinsics(_FREED, (*priors, *lengths), hints)


def _phi(homography: Array, half_px: float) -> float:
    """The focal length that makes the field's axes square, held near what lenses have where the view is too frontal."""
    error = orthogonality_error(homography[None], _PHI * half_px)[:, 0]
    cost = (error / _SQUARE) ** 2 + (np.log(_PHI / USUAL_PHI) / np.log(USUAL_PHI_FACTOR)) ** 2
    return float(_PHI[np.argmin(cost)] * half_px)
