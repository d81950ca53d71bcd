"""Unevenness of the ground in a photograph: stripes of sun, strips of carpet with seams, glare of a lamp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Array32
from ceres_cal.scene.camera import Camera
from rendering.photography import Photography

_PERIOD_M, _SUNNY = (0.7, 2.0), (0.2, 0.6)  # period of stripes of sun, and the sunny share of it
_STRIP_M, _SEAM_M, _SEAM = (0.8, 2.0), 0.012, (-0.5, 0.8)  # widths of strips and seams; relative brightness of a seam
_GLARE_M, _GLARE_PLACE_M = (0.2, 0.6), 2.5
_EDGE_M = 0.01
_NONE = np.zeros((), np.float32)


@dataclass(frozen=True, eq=False)
class Ground:
    """Planes (height, width), or one number for all pixels: sunlight in addition to the lamps', factor of the carpet's
    brightness, and mirrored light, as a share of white.
    """

    sun: Array32
    carpet: Array32
    glare: Array32


def ground_of(camera: Camera, how: Photography, rng: np.random.Generator) -> Ground:
    """The ground that a camera sees; pixels that show no floor are unchanged."""
    if max(how.sun, how.strips, how.glare) == 0.0:
        return Ground(_NONE, _NONE + np.float32(1.0), _NONE)
    width, height = camera.image_size
    columns, rows = np.meshgrid(np.arange(float(width)), np.arange(float(height)))
    place = camera.locate(np.column_stack([columns.ravel(), rows.ravel()])).reshape(height, width, 2)
    floor = np.isfinite(place).all(axis=2)
    place[~floor] = 0.0
    return Ground(
        (how.sun * _stripes(place, rng) * floor).astype(np.float32),
        np.where(floor, _strips(place, how.strips, rng), 1.0).astype(np.float32),
        (how.glare * _spot(place, rng) * floor).astype(np.float32),
    )


def _stripes(place: Array, rng: np.random.Generator) -> Array:
    """1 in the sun, which falls through a row of windows."""
    direction, period = rng.uniform(0.0, np.pi), rng.uniform(*_PERIOD_M)
    along = place @ (np.cos(direction), np.sin(direction)) + rng.uniform(0.0, period)
    away = np.abs(np.mod(along, period) - 0.5 * period)
    return np.asarray(np.clip(0.5 + (0.5 * rng.uniform(*_SUNNY) * period - away) / _EDGE_M, 0.0, 1.0))


def _strips(place: Array, uneven: float, rng: np.random.Generator) -> Array:
    """Brightness of strips of carpet along or across the field, with a faint line where they meet."""
    along, wide = place[..., int(rng.integers(2))] + rng.uniform(0.0, 1.0), rng.uniform(*_STRIP_M)
    number = np.floor(along / wide)
    tone = 1.0 + uneven * rng.uniform(-1.0, 1.0, 64)
    seam = np.clip((0.5 * _SEAM_M - np.abs(along - wide * np.round(along / wide))) / _EDGE_M + 0.5, 0.0, 1.0)
    line = 1.0 + rng.uniform(*_SEAM) * seam * (uneven > 0.0)
    return np.asarray(tone[np.mod(number, 64).astype(np.intp)] * line)


def _spot(place: Array, rng: np.random.Generator) -> Array:
    middle, size = rng.uniform(-_GLARE_PLACE_M, _GLARE_PLACE_M, 2), rng.uniform(*_GLARE_M)
    return np.asarray(np.exp(-0.5 * np.sum((place - middle) ** 2, axis=-1) / size**2))
