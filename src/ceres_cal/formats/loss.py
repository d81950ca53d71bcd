"""By how much what a file says of a camera differs from the calibration."""

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
    """height_m -> root mean square and largest error of located pixels, mm.

    Args:
        camera: that knows better. locate: pixels (N, 2) and a height -> places (N, 2) m, NaN where it knows none.
        pixels: (N, 2); those count that look into the box around the x and y of `box_m`. Infinite where none does.
    """
    edge_m = 1e-6  # places at the box's own edge are in it, whatever the last bit of their way there and back says
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
    """x and y of a grid over what does not move; None where everything does."""
    return posterior.field_grid(targets) if scene.still(targets) else None


def field_pixels(camera: scene.Camera, box_m: Box) -> Array:
    """(N, 2) pixels in which the camera shows places evenly over the field and a little above it."""
    places = grid_places(*box_m)
    every = [camera.project(np.column_stack([places, np.full(len(places), h)])) for h in HEIGHTS_M]
    pixels = np.concatenate(every)
    return np.asarray(pixels[in_image(pixels, camera.image_size)])


def camera_loss(station: str, camera: scene.Camera, project: Callable[[Array], Array], box_m: Box | None) -> ExportLoss:
    """What a file gets wrong about a camera.

    Args:
        project: as the file has it, points (N, 3) m -> pixels (N, 2). box_m: of the field, None where there is none.

    Raises:
        InputError: parts of the field have no place in what the file says.
    """
    rounds = 8  # of bringing a place to where another camera shows it in the same pixel
    grid = (122, 91)  # pixels: finer than that of the fit
    pixels = image_grid(camera.image_size, grid)
    rays = camera.rays(pixels)
    known = np.isfinite(rays[:, 0])
    depth_m = max(abs(camera.position[2]), 1.0)
    points = camera.position + depth_m * (rays[known] @ camera.cam_from_world.rotation)
    image_px = rms_and_largest(np.linalg.norm(project(points) - pixels[known], axis=1))
    if box_m is None:
        return ExportLoss(station, {}, image_px)

    def locate(seen: Array, height_m: float) -> Array:
        """Where the file's camera has these pixels: from where ours has them, by what it misses there."""
        there = place = camera.locate(seen, height_m)
        for _ in range(rounds):
            shown = project(np.column_stack([place, np.full(len(place), height_m)]))
            place = place + there - camera.locate(shown, height_m)
        return place

    field_mm = field_error_mm(camera, locate, field_pixels(camera, box_m), box_m, HEIGHTS_M)
    if not np.all(np.isfinite(list(field_mm.values()))):
        raise InputError(
            f"station {station!r}: the camera sees so wide that nothing in this format shows all of the field as it "
            "does: take another format, such as table, or name a lens that this one holds"
        )
    return ExportLoss(station, field_mm, image_px)


def as_foreign(
    request: ExportRequest, models: Callable[[scene.Camera], Sequence[str]]
) -> tuple[list[ForeignCamera], tuple[ExportLoss, ...]]:
    """The cameras of all stations that are asked for, as `nearest_foreign`, and what is lost of each."""
    box_m, cameras = field_box(request.calibration.targets), map(request.calibration.station, request.stations)
    every = [
        nearest_foreign(camera, name, models(camera), box_m)
        for name, camera in zip(request.stations, cameras, strict=True)
    ]
    return [foreign for foreign, _ in every], tuple(loss for _, loss in every)


def nearest_foreign(
    camera: scene.Camera, station: str, models: Sequence[str], box_m: Box | None
) -> tuple[ForeignCamera, ExportLoss]:
    """A station's camera in the first of these models that holds it, else the best fit among them; what is lost."""
    foreign = ForeignCamera.of(camera, *models)
    if foreign.error_px == (0.0, 0.0):
        return foreign, ExportLoss(station, {} if box_m is None else dict.fromkeys(HEIGHTS_M, (0.0, 0.0)), (0.0, 0.0))
    pose = camera.cam_from_world
    return foreign, camera_loss(station, camera, lambda points: foreign.project_rays(pose.transform(points)), box_m)


def loss_words(loss: ExportLoss) -> list[str]:
    """What is lost, a line each, for files that have room for it: on the field first, where it counts."""
    lines = [
        f"{loss.station}: {short(rms, 3)} mm rms, {short(worst, 3)} mm at most, {at_height(height_m)}"
        for height_m, (rms, worst) in loss.field_mm.items()
    ]
    if loss.image_px is not None:
        rms, worst = loss.image_px
        shown = f"{short(rms, 3)} px rms, {short(worst, 3)} px at most"
        off = shown if np.isfinite(rms) else "some of it is not shown at all"
        lines.append(f"{loss.station}: {off}, over the image")
    return lines
