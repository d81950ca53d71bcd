"""Photographs of a scene: targets, robots and other things, light, lens blur and sensor, with their truth."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from ceres_cal.base.arrays import Array, Array32, Image8, Mask
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.curves import along_curve, curve_points
from ceres_cal.scene.targets import Target
from ceres_cal.simulate.scene import Scene
from rendering import render
from rendering.ground import Ground, ground_of
from rendering.photography import Photography, photography_of
from rendering.things import Ball, Box, Robot, Shadow, Thing, outline, patches, shadow_outline

Stretches = Mapping[str, tuple[tuple[float, float], ...]]
"""Curve -> (from, to) m along it."""

_TRACE_PX = 0.25  # step along curves in the search for hidden parts
_PENUMBRA_PX = 12.0
_LIGHT_STEP = 8  # light changes slowly, so it is drawn at an eighth of the size
_WEAR_PATCH_PX, _BLOTCH_PX = 2.0, 30.0
_TRIES = 200
_LARGEST_BOX = (0.9, 0.5, 1.4, np.pi, 0.7, 0.7, 0.7)  # half sides and height, m, turn and colour
_FINE = 8  # parts of a pixel in the drawing of a camera's motion
_GROUND = 1  # own random numbers, so that pictures without it do not change


@dataclass(frozen=True, eq=False)
class Photograph:
    """One photograph and its truth.

    Attributes:
        station, frame: of the photograph. targets: names of the targets it shows, with their placements.
        image: (height, width, 3) uint8, blue green red.
        things: robots and balls. shadows: of people.
        hidden: target -> curve -> its parts inside the image that a robot or a ball hides, in metres along the curve.
        cover: (height, width) * render.SUBPIXELS, above 0 where a robot or ball is.
    """

    station: str
    frame: str
    targets: Mapping[str, str | None]
    image: Image8
    things: tuple[Thing, ...]
    shadows: tuple[Shadow, ...]
    hidden: Mapping[str, Stretches]
    cover: Image8 = field(repr=False)

    def hides(self, pixels: Array) -> Mask:
        """(N,) whether a robot or a ball hides each pixel (N, 2); False outside the image."""
        return _covered(self.cover, pixels)


def frames(scene: Scene) -> tuple[tuple[str, str], ...]:
    """Station and frame of each photograph of a scene, in the order of its views."""
    return tuple(dict.fromkeys((plan.station, frame) for plan in scene.views for frame in plan.frames))


def photographs(scene: Scene, photography: Photography | None = None, seed: int = 0) -> Iterator[Photograph]:
    """All photographs of a scene, one after the other."""
    for station, frame in frames(scene):
        yield photograph(scene, station, frame, photography, seed)


def photograph(
    scene: Scene, station: str, frame: str, photography: Photography | None = None, seed: int = 0
) -> Photograph:
    """The photograph that a station takes in a frame, with all targets that the scene has there.

    Fields and other custom targets are painted on the floor (only curves with a width; points and bare edges are not
    seen), boards and rings are sheets of paper in front of it. If a target of the world is shown, robots, balls and
    shadows are placed at random on the visible floor. The same arguments give the same picture.

    Args:
        photography: the scene's own by default.
    """
    how = photography or photography_of(scene)
    number = frames(scene).index((station, frame))
    rng = np.random.default_rng([seed, number])
    camera = scene.camera_at(station)
    shown = {plan.target: plan.placement for plan in scene.views if plan.station == station and frame in plan.frames}
    things, shadows = _placed(camera, how, rng) if None in shown.values() else ((), ())
    paint, sheet = _painted(scene, shown, camera)
    drawn = _drawn(things, camera)
    ground = ground_of(camera, how, np.random.default_rng([seed, number, _GROUND]))
    light = _light(camera, shadows, how, rng) + ground.sun
    image = _exposed(light, _reflected(paint, sheet, drawn, ground, how, rng), how, rng)
    hidden = {name: _hidden(scene, name, placement, camera, drawn[1]) for name, placement in shown.items()}
    return Photograph(station, frame, shown, _compressed(image, how), things, shadows, hidden, drawn[1])


# ---- places of things -----------------------------------------------------------------------------------------------


def _placed(camera: Camera, how: Photography, rng: np.random.Generator) -> tuple[tuple[Thing, ...], tuple[Shadow, ...]]:
    robots = [
        Robot(x, y, float(rng.uniform(0.0, 2.0 * np.pi)), int(rng.integers(32)))
        for x, y in _places(camera, how.robots, 0.2, rng)
    ]
    balls = [Ball(x, y) for x, y in _places(camera, how.balls, 0.05, rng)]
    shadows = tuple(
        Shadow(x, y, float(rng.uniform(0.5, 1.0)), float(rng.uniform(0.2, 0.4)), float(rng.uniform(0.0, 2.0 * np.pi)))
        for x, y in _places(camera, how.shadows, 0.0, rng)
    )
    by_distance = sorted(robots, key=lambda robot: -np.hypot(*(camera.position[:2] - (robot.x_m, robot.y_m))))
    return (*balls, *by_distance, *_boxes(camera, how.boxes, rng)), shadows  # robots hide balls


def _boxes(camera: Camera, count: int, rng: np.random.Generator) -> list[Box]:
    """Boxes, the lowest first; one in six is a flat sheet."""
    boxes = []
    for number, (x, y) in enumerate(_places(camera, count, 0.3, rng) if count else ()):
        length, width, height, turn, *colour = rng.uniform((0.15, 0.15, 0.02, 0.0, 0.02, 0.02, 0.02), _LARGEST_BOX)
        if number % 6 == 0:
            length, width, height = 2.5 * length, 2.5 * width, 0.01
        boxes.append(Box(x, y, (length, width), height, turn, (colour[0], colour[1], colour[2])))
    return sorted(boxes, key=lambda box: box.height_m)


def _places(camera: Camera, count: int, apart_m: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """Visible places on the floor, not too near to each other; fewer where there is no room."""
    chosen: list[tuple[float, float]] = []
    pixels = rng.uniform((0.0, 0.0), camera.image_size, size=(_TRIES + 10 * count, 2))
    for x, y in camera.locate(pixels).tolist():
        if len(chosen) == count:
            break
        if np.isfinite(x) and all(np.hypot(x - u, y - v) >= apart_m for u, v in chosen):
            chosen.append((x, y))
    return chosen


def _drawn(things: Sequence[Thing], camera: Camera) -> tuple[Image8, Image8]:
    """The things' colours (height, width, 3) and their cover (height, width), as canvases of bytes."""
    blank = render.blank_canvas(camera.image_size).shape
    colours, cover = np.zeros((*blank, 3), np.uint8), np.zeros(blank, np.uint8)
    for thing in things:
        border = outline(thing, camera)
        if not np.all(np.isfinite(border)):
            continue
        render.fill(cover, render.on_canvas(border))
        for polygon, colour in patches(thing, camera):
            render.fill(colours, render.on_canvas(polygon), [round(255.0 * share) for share in colour])
    return colours, cover


# ---- light ----------------------------------------------------------------------------------------------------------


def _light(camera: Camera, shadows: Sequence[Shadow], how: Photography, rng: np.random.Generator) -> Array32:
    """(height, width) light at each pixel, 1 at the centre of an evenly lit image."""
    width, height = camera.image_size
    y, x = np.mgrid[0:height:_LIGHT_STEP, 0:width:_LIGHT_STEP].astype(np.float32)
    radius = np.hypot(x - camera.principal_point[0], y - camera.principal_point[1]) / camera.corner_radius
    direction, phase = rng.uniform(0.0, 2.0 * np.pi, size=2)
    wave = np.cos((np.cos(direction) * x + np.sin(direction) * y) * (2.0 * np.pi / (1.5 * width)) + phase)
    light = (1.0 - how.vignetting * radius**2) * (1.0 - 0.5 * how.unevenness * (1.0 + wave))
    for shadow in shadows:
        border = shadow_outline(shadow, camera)
        if np.all(np.isfinite(border)):
            dark = np.zeros(light.shape, np.uint8)
            render.fill(dark, (border + 0.5) / _LIGHT_STEP - 0.5, 255)
            soft = cv2.GaussianBlur(dark.astype(np.float32) / 255.0, (0, 0), _PENUMBRA_PX / _LIGHT_STEP)
            light = light * (1.0 - how.shadow_depth * soft)
    return np.asarray(cv2.resize(light.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR))


# ---- surfaces -------------------------------------------------------------------------------------------------------


def _painted(scene: Scene, shown: Mapping[str, str | None], camera: Camera) -> tuple[render.Canvas, Image8]:
    """The canvas of paint and print, and the mask (height, width) of pixels that paper covers."""
    canvas = render.blank_canvas(camera.image_size)
    paper = np.zeros((camera.image_size[1], camera.image_size[0]), np.uint8)
    for name, placement in sorted(shown.items(), key=lambda item: scene.targets[item[0]].paper is not None):
        target = scene.targets[name]
        before = camera.at(camera.cam_from_world @ scene.world_from_target(placement))
        if target.paper is not None:
            paper |= render.print_sheet(canvas, target, before)
        else:
            render.paint_curves(canvas, target, before)
    return canvas, paper


def _reflected(
    canvas: render.Canvas,
    paper: Image8,
    drawn: tuple[Image8, Image8],
    ground: Ground,
    how: Photography,
    rng: np.random.Generator,
) -> Array32:
    """(height, width, 3) reflected share of the light at each pixel, after the lens.

    Args:
        drawn: the things' colours and cover, see `_drawn`.
    """
    colours, cover = drawn
    printed = np.repeat(np.repeat(paper, render.SUBPIXELS, axis=0), render.SUBPIXELS, axis=1) if paper.any() else None
    if how.wear > 0.0:
        kept = 1.0 - _worn(canvas.shape, how.wear, rng)
        canvas = canvas * (kept if printed is None else np.where(printed > 0, np.float32(1.0), kept))
    if cover.any():
        canvas = np.where(cover > 0, np.float32(0.0), canvas)
    paint = render.averaged(_blurred(canvas, render.SUBPIXELS * how.blur_px))
    hidden = _blurred(render.averaged(cover.astype(np.float32)), how.blur_px) if cover.any() else np.float32(0.0)
    sheet = _blurred(paper.astype(np.float32), how.blur_px) if paper.any() else np.float32(0.0)
    floor = np.maximum(1.0 - sheet - hidden - np.where(sheet > 0.0, np.float32(0.0), paint), 0.0)
    carpet = _carpet(paint.shape, how, rng) * floor * ground.carpet
    things = _blurred(render.averaged(colours) / 255.0, how.blur_px) if cover.any() else None
    channels = []
    for channel, (share, painted) in enumerate(zip(how.carpet_colour, how.paint_colour, strict=True)):
        bright = np.where(sheet > 0.5, np.float32(1.0), np.float32(how.paint * painted))
        plane = paint * bright + carpet * np.float32(share)
        channels.append(plane if things is None else plane + things[..., channel])
    return np.asarray(np.dstack(channels) + ground.glare[..., None], dtype=np.float32)


def _blurred(plane: Array32, sigma: float) -> Array32:
    return (
        plane if sigma <= 0.0 else np.asarray(cv2.GaussianBlur(plane, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE))
    )


def _noise(shape: Sequence[int], rng: np.random.Generator, scale_px: float) -> Array32:
    """Random numbers with standard deviation 1 that are correlated over about `scale_px`."""
    small = [int(np.ceil(size / scale_px)) + 3 for size in shape[:2]]
    rough = rng.standard_normal(small, dtype=np.float32)
    fine = cv2.resize(rough, (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return np.asarray(fine / max(float(np.std(fine[::5, ::5])), 1e-6), dtype=np.float32)


def _worn(shape: Sequence[int], share: float, rng: np.random.Generator) -> Array32:
    """1 where the paint is worn off, on a canvas: small patches, denser in some places than in others."""
    fine = _noise(shape, rng, _WEAR_PATCH_PX * render.SUBPIXELS)
    level = fine + 0.5 * _noise(shape, rng, _BLOTCH_PX * render.SUBPIXELS)
    limit = float(np.quantile(level[::7, ::7], 1.0 - share))
    return np.clip(2.0 * (level - limit) + 0.5, 0.0, 1.0)


def _carpet(shape: Sequence[int], how: Photography, rng: np.random.Generator) -> Array32:
    fibres = _blurred(rng.standard_normal(shape, dtype=np.float32), 0.7)  # seen through the lens
    fibres /= max(float(np.std(fibres[::5, ::5])), 1e-6)
    texture = 0.8 * fibres + 0.6 * _noise(shape, rng, _BLOTCH_PX)
    return np.asarray(np.maximum(how.carpet * (1.0 + how.carpet_texture * texture), 0.0), dtype=np.float32)


# ---- the sensor -----------------------------------------------------------------------------------------------------


def _exposed(light: Array32, reflected: Array32, how: Photography, rng: np.random.Generator) -> Image8:
    signal = reflected * (light * np.float32(how.exposure))[..., None]
    if how.motion_px > 0.0:
        signal = _smeared(signal, how.motion_px, rng)
    noise = rng.standard_normal(signal.shape, dtype=np.float32)
    noise *= np.sqrt(np.float32(how.read_noise**2) + np.float32(how.shot_noise) * np.maximum(signal, 0.0))
    image = np.asarray(np.clip(np.round(signal + noise), 0.0, 255.0), dtype=np.uint8)
    return _through_mosaic(image) if how.mosaic else image


def _smeared(signal: Array32, length_px: float, rng: np.random.Generator) -> Array32:
    """The image of a camera that moves uniformly, in a random direction, during the exposure."""
    direction, size = rng.uniform(0.0, np.pi), 2 * int(np.ceil(0.5 * length_px)) + 1
    fine = np.zeros((size * _FINE, size * _FINE), np.float32)
    end = 0.5 * length_px * _FINE * np.array([np.cos(direction), np.sin(direction)])
    places = 0.5 * (size * _FINE - 1) + np.linspace(-1.0, 1.0, 50 * size)[:, None] * end
    np.add.at(fine, tuple(np.round(places[:, ::-1]).astype(np.intp).T), 1.0)
    kernel = cv2.resize(fine, (size, size), interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.filter2D(signal, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE), np.float32)


def _through_mosaic(image: Image8) -> Image8:
    raw = image[..., 1].copy()
    raw[::2, ::2], raw[1::2, 1::2] = image[::2, ::2, 2], image[1::2, 1::2, 0]
    return np.asarray(cv2.demosaicing(raw, cv2.COLOR_BayerRGGB2BGR), dtype=np.uint8)


def _compressed(image: Image8, how: Photography) -> Image8:
    if how.jpeg_quality == 0:
        return image
    _, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, how.jpeg_quality])
    return np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR), dtype=np.uint8)


# ---- truth ----------------------------------------------------------------------------------------------------------


def _covered(cover: Image8, pixels: Array) -> Mask:
    places = np.round(np.nan_to_num(render.on_canvas(pixels), nan=-1.0, posinf=-1.0, neginf=-1.0))
    inside = np.all((places >= 0) & (places < (cover.shape[1], cover.shape[0])), axis=1)
    x, y = np.where(inside[:, None], places, 0.0).astype(np.intp).T
    return np.asarray(inside & (cover[y, x] > 0))


def _hidden(scene: Scene, name: str, placement: str | None, camera: Camera, cover: Image8) -> Stretches:
    target = scene.targets[name]
    before = camera.at(camera.cam_from_world @ scene.world_from_target(placement))
    return {
        curve: stretches for curve in target.curves if (stretches := _hidden_stretches(target, curve, before, cover))
    }


def _hidden_stretches(target: Target, name: str, camera: Camera, cover: Image8) -> tuple[tuple[float, float], ...]:
    if not cover.any():
        return ()
    curve = target.curves[name]
    rough = camera.project(curve_points(curve, 0, 200))
    length_px = float(np.nansum(np.linalg.norm(np.diff(rough, axis=0), axis=1)))
    places = np.linspace(0.0, 1.0, max(int(min(length_px, 1e5) / _TRACE_PX), 200) + 1)
    low, high = curve.parameter_range
    points = along_curve(curve, low + places * (high - low))
    under = np.concatenate([[False], _covered(cover, camera.project(points)), [False]])
    begins, ends = np.flatnonzero(~under[:-1] & under[1:]), np.flatnonzero(under[:-1] & ~under[1:]) - 1
    length = curve.length_m
    return tuple((float(places[i] * length), float(places[j] * length)) for i, j in zip(begins, ends, strict=True))
