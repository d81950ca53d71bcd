"""Cameras of ssl-vision and vision-processor: one focal length, one coefficient, a quaternion, millimetres.

p = Q x_field + t; u = p_xy / p_z; |u| = rd (1 + d rd^2); pixel = f u rd / |u| + centre: this package's `radial` with
power 3 alone, d = a3 phi^2. For any other lens the best fit on the field is used, with the camera's position held:
otherwise f and height would trade off.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Annotated, Any

import numpy as np

from ceres_cal.base import HEIGHTS_M, Array, InputError, Pose, finite, quaternion, rotation_exp, rotation_of, short
from ceres_cal.base.least_squares import least_squares
from ceres_cal.formats.format import Export, ExportLoss, ExportRequest
from ceres_cal.formats.loss import Box, camera_loss, field_pixels, nearest_foreign
from ceres_cal.formats.opencv import parse_size
from ceres_cal.scene import LARGEST, Camera, Radial, opencv_models

_QUATERNION, _SHIFT = ("q0", "q1", "q2", "q3"), ("tx", "ty", "tz")
NAMES = ("focal_length", "principal_point_x", "principal_point_y", "distortion", *_QUATERNION, *_SHIFT)
_POSITION = tuple(f"derived_camera_world_{name}" for name in _SHIFT)


CameraIds = Annotated[
    str, "ids of the stations' cameras, with commas between; default: the number that each name ends in, else 0, 1, ..."
]


def camera_ids(stations: Sequence[str], given: str) -> tuple[int, ...]:
    """Return the id of each station's camera.

    Raises:
        InputError: not as many different whole numbers as there are stations.
    """
    ends = [name[len(name.rstrip("0123456789")) :] for name in stations]
    texts = [text.strip() for text in given.split(",")] if given else ends
    if not given and (not all(texts) or len(set(texts)) != len(texts)):
        texts = [str(number) for number in range(len(stations))]
    if len(texts) != len(stations) or len(set(texts)) != len(texts) or not all(text.isdigit() for text in texts):
        each = f"{', '.join(stations)} a whole number from 0 on, no two alike"
        raise InputError(f"camera_id {given!r}: give {each}")
    return tuple(map(int, texts))


def to_entries(request: ExportRequest, camera_id: str, box_m: Box | None) -> tuple[dict[int, dict[str, Any]], Export]:
    """Return id -> SSL_GeometryCameraCalibration as plain data, and their export, whose content is still empty."""
    entries, losses, warnings = {}, [], []
    ids = camera_ids(request.stations, camera_id)
    for name, number in zip(request.stations, ids, strict=True):
        camera = request.calibration.station(name)
        entry = to_entry(_nearest(camera, box_m), number)
        written = to_camera(entry)
        entries[number] = entry
        losses.append(camera_loss(name, camera, written.project, box_m))
        warnings += [
            f"station {name!r}: {text}" for text in (*_less_lost(camera, losses[-1], box_m), *reader_traps(entry))
        ]
    facts = {"camera_ids": dict(zip(request.stations, ids, strict=True))}
    return entries, Export(b"", tuple(losses), f"camera {', '.join(map(str, ids))}", facts, tuple(warnings))


def _less_lost(camera: Camera, loss: ExportLoss, box_m: Box | None) -> list[str]:
    """Suggest what represents a camera better, if one coefficient, or one focal length, causes a large error."""
    much_mm = 10.0  # largest error anywhere on the field: the width of a line
    worst = max((worst for _, worst in loss.field_mm.values()), default=0.0)
    if not worst > much_mm:
        return []
    other = nearest_foreign(camera, loss.station, opencv_models(camera), box_m)[1]
    left = max(worst for _, worst in other.field_mm.values())
    cause, remedy = "one coefficient cannot describe this lens", "or more cameras, each seeing less of the field"
    if _has_one_coefficient(camera):
        cause = f"one focal length cannot describe fy / fx = {camera.aspect:.4f}"
        remedy = "or calibrate with --fix aspect=1 if its pixels are square"
    return [
        f"{cause} (error up to {short(worst, 3)} mm): for less, use --to opencv ({short(left)} mm at most) or --to "
        f"table in your own software, {remedy}"
    ]


def _has_one_coefficient(camera: Camera) -> bool:
    return camera.lens.kind == "radial" and camera.lens.powers == (3,)


def as_before(entry: Mapping[str, Any], before: Mapping[str, Any] | None) -> dict[str, Any]:
    """Return an entry with the numbers of an earlier one if both are the same camera to the digits of float32."""
    if before is None or any(name not in before for name in NAMES):
        return dict(entry)
    old, new = (np.array([float(e[name]) for name in NAMES]) for e in (before, entry))
    new[4:8] *= np.sign(old[4:8] @ new[4:8])  # q and -q are one rotation
    if np.any(np.abs(old - new) > 2e-6 * np.maximum(1.0, np.abs(old))):
        return dict(entry)
    return {**entry, **{name: value for name, value in before.items() if name in entry}}


def reader_traps(entry: Mapping[str, Any]) -> list[str]:
    """Return what readers of an entry may get wrong."""
    if float(entry["distortion"]) < 0.0:
        return [
            "its distortion is negative: ssl-vision uses it to locate, but not to draw or to compute its RMSE "
            "(its issue 148); vision-processor supports both signs"
        ]
    return []


def _nearest(camera: Camera, box_m: Box | None) -> Camera:
    """Return the camera with one focal length and one coefficient that locates most similarly on the field, from the
    same place.
    """
    if _has_one_coefficient(camera) and (camera.aspect, camera.skew) == (1.0, 0.0):
        return camera
    if box_m is None:
        raise InputError("no field to fit ssl-vision's camera over: calibrate with the field, or use a radial lens "
                         "with power 3 alone")  # fmt: skip
    pixels = field_pixels(camera, box_m)
    if not len(pixels):
        raise InputError("the camera sees nothing of the field")
    true = [camera.locate(pixels, height_m) for height_m in HEIGHTS_M]
    unit = 0.5 * float(np.hypot(*camera.image_size))

    def made(v: Array) -> Camera:
        turned = Pose.looking(camera.position, rotation_exp(v[4:]) @ camera.cam_from_world.rotation)
        return Camera(camera.image_size, v[0], (v[1], v[2]), Radial((v[3],), (3,)), 1.0, turned)

    def residuals(v: Array) -> Array:
        if v[0] <= 0.0:
            return np.full(2 * len(pixels) * len(true), np.inf)
        there = made(v)
        off = [there.locate(pixels, height_m) - place for height_m, place in zip(HEIGHTS_M, true, strict=True)]
        return np.where(np.isfinite(flat := 1e3 * np.concatenate(off).ravel()), flat, 1e6)

    start = np.array([camera.phi, *camera.principal_point, 0.0, 0.0, 0.0, 0.0])
    sizes = np.array([camera.phi, unit, unit, unit**-2, 1.0, 1.0, 1.0])
    return made(least_squares(residuals, start, sizes))


def to_entry(camera: Camera, number: int) -> dict[str, Any]:
    """Return SSL_GeometryCameraCalibration of a camera with a radial lens of power 3, in float32."""
    numbers = [camera.phi, *camera.principal_point, camera.lens.values[0] * camera.phi**2]
    numbers += quaternion(camera.cam_from_world.rotation).tolist()
    numbers += [*(1e3 * camera.cam_from_world.translation), *(1e3 * camera.position)]
    named = zip((*NAMES, *_POSITION), numbers, strict=True)
    single = {name: float(str(np.float32(value))) for name, value in named}  # no more digits than float32 has
    width, height = camera.image_size
    return {"camera_id": number, **single, "pixel_image_width": width, "pixel_image_height": height}


def to_cameras(entries: Iterable[Mapping[str, Any]], image_size: str) -> tuple[dict[str, Camera], list[str]]:
    """Return the cameras of SSL_GeometryCameraCalibrations by name, and warnings for their readers."""
    cameras, warnings = {}, []
    for entry in entries:
        name = f"camera{entry['camera_id']}"
        cameras[name] = to_camera(entry, image_size)
        cameras[name].require_monotone(name)
        warnings += [f"camera {name!r}: {text}" for text in reader_traps(entry)]
    return cameras, warnings


def to_camera(entry: Mapping[str, Any], image_size: str = "") -> Camera:
    """Return the camera of an SSL_GeometryCameraCalibration; `image_size` is WIDTHxHEIGHT for one that has none.

    Raises:
        InputError: a number that is missing, or that makes no camera.
    """
    here = f"camera {entry.get('camera_id', '?')}"
    f, cx, cy, d, *rest = (
        finite(entry.get(name), InputError(f"{here}: {name} is not a number, but {entry.get(name)!r}"), LARGEST)
        for name in NAMES
    )
    turn, shift = np.array(rest[:4]), np.array(rest[4:])
    norm = float(np.linalg.norm(turn))
    if not (f > 1.0 / LARGEST and abs(norm - 1.0) < 0.05):
        raise InputError(f"{here}: focal_length {f:g}, or the length {norm:g} of its quaternion, is impossible")
    sizes = [entry.get("pixel_image_width"), entry.get("pixel_image_height")]
    width, height = (int(float(size)) for size in sizes) if all(sizes) else parse_size(image_size)  # type: ignore[arg-type]
    pose = Pose(rotation_of(turn), 1e-3 * shift)
    return Camera((width, height), f, (cx, cy), Radial((d / f**2,), (3,)), 1.0, pose)
