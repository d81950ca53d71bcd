"""Errors of a file's camera compared with the calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ceres_cal import posterior, scene
from ceres_cal.base import HEIGHTS_M, Array, InputError, at_height, grid_places, rms_and_largest, short
from ceres_cal.formats.format import ExportLoss, ExportRequest
from ceres_cal.scene import ForeignCamera, image_grid, in_image

Box = tuple[Array, Array]


def field_error_mm(
    camera: scene.Camera, locate: Callable[[Array, float], Array], pixels: Array, box_m: Box, heights_m: Sequence[float]
) -> dict[float, tuple[float, float]]:
    """Return height_m -> root mean square and largest error of located pixels, mm; infinite where no pixel counts.

    Args:
        camera: the exact camera. locate: pixels (N, 2) and a height -> places (N, 2) m, NaN where unknown.
        pixels: (N, 2); those count that see a place in the box around the x and y of `box_m`.
    """
    edge_m = 1e-6  # tolerance, so that rounding does not exclude places on the edge of the box
    errors = {}
    low, high = (np.array([end(axis) for axis in box_m]) for end in (np.min, np.max))
    for height_m in heights_m:
        true = camera.locate(pixels, height_m)
        with np.errstate(invalid="ignore"):
            on_field = np.all((true >= low - edge_m) & (true <= high + edge_m), axis=1)
        off = 1e3 * np.linalg.norm(locate(pixels[on_field], height_m) - true[on_field], axis=1)
        errors[height_m] = rms_and_largest(off)
    return errors


def field_box(targets: Mapping[str, scene.Target]) -> Box | None:
    """x and y of a grid over targets that do not move; None if all move."""
    return posterior.field_grid(targets) if scene.still(targets) else None


def field_pixels(camera: scene.Camera, box_m: Box) -> Array:
    """(N, 2) pixels in which the camera shows evenly spaced places on the field and a little above it."""
    places = grid_places(*box_m)
    every = [camera.project(np.column_stack([places, np.full(len(places), h)])) for h in HEIGHTS_M]
    pixels = np.concatenate(every)
    return np.asarray(pixels[in_image(pixels, camera.image_size)])


def camera_loss(station: str, camera: scene.Camera, project: Callable[[Array], Array], box_m: Box | None) -> ExportLoss:
    """Return the errors of a file's camera.

    Args:
        project: the file's projection, points (N, 3) m -> pixels (N, 2). box_m: of the field, None where there is none.

    Raises:
        InputError: the file's camera cannot see parts of the field.
    """
    rounds = 8  # iterations that find the place that the other camera shows in the same pixel
    grid = (122, 91)  # number of pixels, finer than the grid of the fit
    pixels = image_grid(camera.image_size, grid)
    rays = camera.rays(pixels)
    known = np.isfinite(rays[:, 0])
    depth_m = max(abs(camera.position[2]), 1.0)
    points = camera.position + depth_m * (rays[known] @ camera.cam_from_world.rotation)
    image_px = rms_and_largest(np.linalg.norm(project(points) - pixels[known], axis=1))
    if box_m is None:
        return ExportLoss(station, {}, image_px)

    def locate(seen: Array, height_m: float) -> Array:
        """Locate pixels with the file's camera, iterating from this camera's places by the remaining differences."""
        there = place = camera.locate(seen, height_m)
        for _ in range(rounds):
            shown = project(np.column_stack([place, np.full(len(place), height_m)]))
            place = place + there - camera.locate(shown, height_m)
        return place

    field_mm = field_error_mm(camera, locate, field_pixels(camera, box_m), box_m, HEIGHTS_M)
    if not np.all(np.isfinite(list(field_mm.values()))):
        raise InputError(
            f"station {station!r}: the field of view is too wide for this format, which cannot show all of the field: "
            "use another format, such as table, or calibrate with a lens that this one supports"
        )
    return ExportLoss(station, field_mm, image_px)


def as_foreign(
    request: ExportRequest, models: Callable[[scene.Camera], Sequence[str]]
) -> tuple[list[ForeignCamera], tuple[ExportLoss, ...]]:
    """Return the cameras of all requested stations, as `nearest_foreign` makes them, and their errors."""
    box_m, cameras = field_box(request.calibration.targets), map(request.calibration.station, request.stations)
    every = [
        nearest_foreign(camera, name, models(camera), box_m)
        for name, camera in zip(request.stations, cameras, strict=True)
    ]
    return [foreign for foreign, _ in every], tuple(loss for _, loss in every)


def nearest_foreign(
    camera: scene.Camera, station: str, models: Sequence[str], box_m: Box | None
) -> tuple[ForeignCamera, ExportLoss]:
    """Return a station's camera in the first of these models that represents it exactly, else the best fit, and the
    error.
    """
    foreign = ForeignCamera.of(camera, *models)
    if foreign.error_px == (0.0, 0.0):
        return foreign, ExportLoss(station, {} if box_m is None else dict.fromkeys(HEIGHTS_M, (0.0, 0.0)), (0.0, 0.0))
    pose = camera.cam_from_world
    return foreign, camera_loss(station, camera, lambda points: foreign.project_rays(pose.transform(points)), box_m)


def loss_words(loss: ExportLoss) -> list[str]:
    """Words on the errors, one line each, for files that allow comments: on the field first, where they matter."""
    lines = [
        f"{loss.station}: {short(rms, 3)} mm rms, {short(worst, 3)} mm at most, {at_height(height_m)}"
        for height_m, (rms, worst) in loss.field_mm.items()
    ]
    if loss.image_px is not None:
        rms, worst = loss.image_px
        shown = f"{short(rms, 3)} px rms, {short(worst, 3)} px at most"
        off = shown if np.isfinite(rms) else "part of the image cannot be shown"
        lines.append(f"{loss.station}: {off}, over the image")
    return lines
