"""Straightened images: what a camera without distortion would have seen from the same place.

The straight image's camera is a pinhole with square pixels and the same viewing direction. It can show less than half a
sphere, and what is far off the axis is stretched more and more; therefore the angle of view is limited.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct

from ceres_cal.base import Array, InputError, Mask, Pose, grid_places
from ceres_cal.report.pictures.warp import Warp, make_warp, require_size
from ceres_cal.scene.camera import Camera, in_image
from ceres_cal.scene.lens import Brown

WIDEST_DEG = 150.0
MOST_STRETCH = 4.0
_GRID, _ROUNDS, _SHRINK = 9, 24, 0.6
_ASPECTS = np.linspace(-1.2, 1.2, _GRID)  # logarithms of width over height


class Straightening(Struct, frozen=True, eq=False):
    """The straightening of photographs of one camera.

    Attributes:
        camera: camera of the straight image, a pinhole at the photograph's pose; its projection and location apply to
            the straight image.
        warp: makes the images.
        share: share of the photograph's pixels that the straight image shows.
        limit_deg: angle off the axis beyond which nothing is shown, because of `angle_deg`, or because the lens has no
            answer there or stretches pixels too much; None where the photograph ends before.
    """

    camera: Camera
    warp: Warp
    share: float
    limit_deg: float | None

    @property
    def view_deg(self) -> tuple[float, float]:
        """Angles of view across and down, between the image's edges."""
        edges = np.array([[-0.5, -0.5], np.array(self.camera.image_size) - 0.5])
        low, high = np.degrees(np.arctan((edges - self.camera.principal_point) / self.camera.phi))
        return float(high[0] - low[0]), float(high[1] - low[1])


def straighten(
    camera: Camera,
    *,
    whole: bool = False,
    size: tuple[int, int] | None = None,
    phi: float | None = None,
    angle_deg: float | None = None,
) -> Straightening:
    """Return how to straighten a camera's photographs.

    Args:
        camera: any lens, with the pose for the straight image's camera.
        whole: show everything that the photograph shows, with black around it; else the largest upright rectangle in
            which every pixel shows something (as OpenCV's alpha 1 and 0, but pixels remain square).
        size: (width, height) px of the straight image; the photograph's by default.
        phi: instead of a size: the focal length, px; the camera's own keeps the scale in the middle.
        angle_deg: angle of view; what is farther off the axis than half of it is left out. A straight image always ends
            before 180 degrees. None: 150 degrees and, for a rectangle, as far as pixels are stretched at most 4 times
            as much as in the middle. Near the angle where a lens folds, all pixels are stretched more than that.

    Raises:
        InputError: an image without pixels or too large, or nothing within the angle.
    """
    least_deg, most_deg = 1.0, 175.0
    if angle_deg is not None and not least_deg <= angle_deg <= most_deg:
        raise InputError(f"the angle of view must be {least_deg:g} to {most_deg:g} degrees, not {angle_deg:g}")
    if phi is not None and not (np.isfinite(phi) and phi > 0.0):
        raise InputError(f"phi must be above 0 px, not {phi:g}")
    wanted = camera.image_size if size is None else size
    require_size(wanted, "ask for another size")
    stretch = np.inf if whole or angle_deg is not None else MOST_STRETCH
    region = _region(camera, _last_angle(camera, np.radians(0.5 * (angle_deg or WIDEST_DEG)), stretch))
    aspect = wanted[0] / wanted[1] if phi is None else None
    box = _box(region) if whole else _largest_rectangle(region, aspect)
    new_phi, new_size = _scaled(box, wanted, phi, whole=whole)
    require_size(new_size, "ask for another phi, a size or another angle of view")
    centre = 0.5 * (np.array(new_size) - 1.0) - new_phi * 0.5 * (box[0] + box[1])
    straight = Camera(new_size, new_phi, (centre[0], centre[1]), Brown(), 1.0, camera.cam_from_world)
    optics = camera.at(Pose.identity())

    def places(pixels: Array) -> Array:
        across = (pixels - centre) / new_phi
        there = optics.project(np.column_stack([across, np.ones(len(across))]))
        there[np.hypot(across[:, 0], across[:, 1]) > region.slope] = np.nan
        return there

    warp = make_warp(new_size, camera.image_size, places)
    return Straightening(straight, warp, _share_shown(camera, straight, region.slope), region.limit_deg)


def _scaled(box: Array, wanted: tuple[int, int], phi: float | None, *, whole: bool) -> tuple[float, tuple[int, int]]:
    """Focal length and (width, height) of an image of a box (2, 2) at depth 1: its low and high corner."""
    across, down = box[1] - box[0]
    if phi is None:
        return float(min(wanted[0] / across, wanted[1] / down)), wanted
    extent = np.array([across, down]) * phi
    count = np.ceil(extent - 1e-6) if whole else np.floor(extent + 1e-6)
    return float(phi), (int(count[0]), int(count[1]))


def _share_shown(camera: Camera, straight: Camera, slope: float) -> float:
    """Share of the photograph's pixels, evenly sampled, whose centres fall into the straight image."""
    counted = 100_000  # approximate number of pixels that are sampled
    width, height = camera.image_size
    step = max(1, int(np.sqrt(width * height / counted)))
    pixels = grid_places(np.arange(0.0, width, step), np.arange(0.0, height, step))
    there = _at_depth_1(camera, pixels, slope)
    return float(np.mean(in_image(there * straight.phi + straight.principal_point, straight.image_size)))


# ---- what a photograph shows of the plane at depth 1 ----------------------------------------------------------------


class _ShownRegion(Struct, frozen=True, eq=False):
    """The part of the plane at depth 1 that a photograph shows, without holes.

    Attributes:
        slope: distance from the axis beyond which nothing is shown. limit_deg: the same as an angle; None where the
            photograph ends before.
        outline: (Q, 2) places along its border, in no order.
    """

    camera: Camera
    slope: float
    limit_deg: float | None
    outline: Array

    def holds(self, places: Array) -> Mask:
        """(N,) whether the photograph shows these places (N, 2)."""
        pixels = self.camera.at(Pose.identity()).project(np.column_stack([places, np.ones(len(places))]))
        near = np.hypot(places[:, 0], places[:, 1]) <= self.slope
        return np.asarray(near & in_image(pixels, self.camera.image_size))


def _at_depth_1(camera: Camera, pixels: Array, slope: float) -> Array:
    """(N, 2) where the rays of pixels (N, 2) meet the plane at depth 1; NaN beyond the slope."""
    rays = camera.rays(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        there = rays[:, :2] / np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)
        there[np.hypot(there[:, 0], there[:, 1]) > slope] = np.nan
    return np.asarray(there)


def _region(camera: Camera, angle: float) -> _ShownRegion:
    rim_steps = 20_000
    slope = float(np.tan(angle))
    border = _at_depth_1(camera, _border(camera.image_size), slope)
    turn = np.linspace(0.0, 2.0 * np.pi, rim_steps, endpoint=False)
    rim = slope * (1.0 - 1e-9) * np.column_stack([np.cos(turn), np.sin(turn)])
    pixels = camera.at(Pose.identity()).project(np.column_stack([rim, np.ones(len(rim))]))
    rim = rim[in_image(pixels, camera.image_size)]
    outline = np.concatenate([border[np.isfinite(border[:, 0])], rim])
    if not len(outline):
        raise InputError(
            f"no pixel of the camera looks to within {np.degrees(angle):.1f} degrees of its axis: "
            "its principal point lies far outside of the image"
        )
    return _ShownRegion(camera, slope, float(np.degrees(angle)) if len(rim) else None, outline)


def _last_angle(camera: Camera, most_rad: float, most_stretch: float) -> float:
    """Largest angle off the axis, up to `most_rad`, at which the lens has an answer and stretches by at most
    `most_stretch`.

    Measured along the image's x axis: lenses are rotationally symmetric except for Brown's decentring.
    """
    endless = 1e12  # an effectively unlimited stretch
    angle_step = 1e-6
    halvings = 60

    def answers(angle: float) -> bool:
        angles = np.array([angle - angle_step, angle])
        rays = np.column_stack([np.sin(angles), np.zeros(2), np.cos(angles)])
        measured = float(np.diff(camera.lens.distort(rays, camera.phi)[:, 0])[0])  # NaN where there is no answer
        return camera.phi * float(np.diff(np.tan(angles))[0]) <= min(most_stretch, endless) * measured

    low, high = 0.0, most_rad
    if answers(high):
        return high
    for _ in range(halvings):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if answers(middle) else (low, middle)
    return low


def _border(size: tuple[int, int]) -> Array:
    """Pixels (N, 2) along the border of an image, half a pixel outside of its outermost centres."""
    border_step_px = 0.25
    x, y = (np.linspace(-0.5, side - 0.5, int(side / border_step_px) + 1) for side in size)
    sides = [np.column_stack([x, np.full(len(x), end)]) for end in y[[0, -1]]]
    sides += [np.column_stack([np.full(len(y), end), y]) for end in x[[0, -1]]]
    return np.concatenate(sides)


def _box(region: _ShownRegion) -> Array:
    """(2, 2) low and high corner of the region's bounding box."""
    return np.array([region.outline.min(axis=0), region.outline.max(axis=0)])


def _largest_rectangle(region: _ShownRegion, aspect: float | None) -> Array:
    """(2, 2) low and high corner of the largest upright rectangle inside; `aspect` is width over height.

    A rectangle around a centre grows until it meets the outline: its half height is the smallest of max(|dx| / aspect,
    |dy|) over the outline. Centre and aspect are searched on a grid that shrinks around the best.
    """
    roughly = 2000  # number of places of the outline used in the search
    rough = region.outline[:: max(1, len(region.outline) // roughly)]
    low, high = _box(region)
    best = np.append(0.5 * (low + high), 0.0)
    reach = np.append(0.5 * (high - low), 0.0 if aspect is not None else _ASPECTS[-1])
    fixed = 1.0 if aspect is None else aspect
    for _ in range(_ROUNDS):
        steps = [np.linspace(-1.0, 1.0, _GRID) * r if r > 0.0 else np.zeros(1) for r in reach]
        tried = best + np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
        tried = tried[region.holds(tried[:, :2])]
        if len(tried):
            aspects = fixed * np.exp(tried[:, 2])
            areas = aspects * _half_height(rough, tried[:, :2], aspects) ** 2
            best = tried[np.argmax(areas)]
        reach = _SHRINK * reach
    aspects = np.array([fixed * np.exp(best[2])])
    half = _half_height(region.outline, best[None, :2], aspects)[0] * np.array([aspects[0], 1.0])
    return np.array([best[:2] - half, best[:2] + half])


def _half_height(outline: Array, centres: Array, aspects: Array) -> Array:
    """(N,) half heights of the rectangles around centres (N, 2) that touch the outline."""
    return np.array(
        [
            np.min(np.maximum(np.abs(outline[:, 0] - x) / aspect, np.abs(outline[:, 1] - y)))
            for (x, y), aspect in zip(centres, aspects, strict=True)
        ]
    )
