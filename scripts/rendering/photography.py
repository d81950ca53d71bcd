"""How a photograph of a scene is taken: light, carpet, paint, things, lens blur and sensor."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import convert
from ceres_cal.simulate.scene import Scene

MOST_THINGS = 100


@dataclass(frozen=True)
class Photography:
    """What a photograph shows in addition to the targets, and the properties of lens and sensor.

    Attributes:
        blur_px: standard deviation of the lens's Gaussian point spread (defocus), in addition to the pixel's square.
        vignetting: share of the light that is lost in the farthest image corner.
        unevenness: share by which the lamps' light varies over the image.
        shadows: number of people's shadows on the floor. shadow_depth: share of the light that each takes.
        robots: number of robots on the field, balls: number of balls; both hide what is behind them.
        boxes: number of boxes, mats and people that hide a part of the field.
        wear: share of the paint that is worn off.
        carpet: brightness of the carpet, paint: of paint and paper, as shares of white.
        carpet_colour, paint_colour: blue, green and red of each, times its brightness.
        sun: light of the sun in stripes, as through windows, times that of the lamps.
        strips: share by which strips of carpet, with seams between them, differ in brightness.
        glare: share of white that the floor's reflection of a lamp adds at its brightest place.
        carpet_texture: standard deviation of the carpet's brightness, as a share of it.
        exposure: grey level of white in full light.
        read_noise: standard deviation of the sensor's noise in the dark, grey levels.
        shot_noise: variance that each grey level of signal adds, in grey levels squared (photon noise).
        mosaic: whether each pixel of the sensor sees one colour (red and green in every other row, green and blue in
            the others), with the other two interpolated.
        motion_px: length of the camera's motion during the exposure.
        jpeg_quality: 1 to 100; 0: no compression.

    Raises:
        InputError: on construction: a number that is not in its range.
    """

    blur_px: float = 0.6
    vignetting: float = 0.2
    unevenness: float = 0.1
    shadows: int = 0
    shadow_depth: float = 0.5
    robots: int = 0
    balls: int = 0
    boxes: int = 0
    wear: float = 0.0
    carpet: float = 0.2
    paint: float = 0.85
    carpet_colour: tuple[float, float, float] = (0.55, 1.25, 0.65)  # a green one
    paint_colour: tuple[float, float, float] = (1.0, 1.0, 1.0)
    carpet_texture: float = 0.05
    exposure: float = 230.0
    read_noise: float = 1.0
    shot_noise: float = 0.01
    sun: float = 0.0
    strips: float = 0.0
    glare: float = 0.0
    motion_px: float = 0.0
    mosaic: bool = False
    jpeg_quality: int = 0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not np.all(np.isfinite(value) & np.greater_equal(value, 0.0)):
                raise InputError(f"photography: {name} must be a number from 0 on, not {value}")
        for name in ("vignetting", "unevenness", "shadow_depth", "wear", "carpet", "paint", "strips"):
            if getattr(self, name) > 1.0:
                raise InputError(f"photography: {name} is a share and at most 1, not {getattr(self, name)}")
        for name in ("shadows", "robots", "balls", "boxes"):
            if getattr(self, name) > MOST_THINGS:
                raise InputError(f"photography: at most {MOST_THINGS} {name}, not {getattr(self, name)}")
        if self.jpeg_quality > 100:
            raise InputError(f"photography: jpeg_quality is at most 100 (0: none), not {self.jpeg_quality}")


def photography_of(scene: Scene) -> Photography:
    """The photography that a scene defines.

    Raises:
        InputError: an unknown property, or a number out of its range.
    """
    known = [field.name for field in fields(Photography)]
    for name in scene.photography:
        if name not in known:
            raise InputError(f"photography: {name!r} is unknown: there are {', '.join(known)}")
    return convert(dict(scene.photography), Photography, "photography")


def taken_as(scene: Scene, how: Photography) -> Scene:
    """The scene with this photography."""
    return replace(scene, photography=vars(how).copy())
