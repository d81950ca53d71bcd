"""Calibrations for exports to other formats: every lens above a field, and places that their cameras show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scenery import overhead_pose
from scenes import LENSES, camera

from ceres_cal import Calibration, Camera
from ceres_cal.base.arrays import Array
from ceres_cal.formats.format import calibration_of
from ceres_cal.scene.lens import Brown, Lens, Radial
from ceres_cal.scene.targets import ssl_field

__all__ = ["LENSES", "over_field", "places", "same_camera", "two_cameras", "with_lens"]
_POSES = (overhead_pose(-0.5, -1.2, 5.2, -14.0, -11.5, 4.0), overhead_pose(0.9, 1.1, 5.4, 9.0, 8.0, -94.0))


def with_lens(lens: str | Lens, aspect: float = 1.0, number: int = 0) -> Camera:
    """A camera of `scenes` above its field; the second one has another phi and another pose."""
    one = camera(lens) if isinstance(lens, str) else replace(camera("brown"), lens=lens)
    return replace(one, phi=one.phi * (1.0 + 0.013 * number), aspect=aspect).at(_POSES[number])


def over_field(camera: Camera, name: str = "overhead") -> Calibration:
    """The calibration of one camera above a division B field."""
    return calibration_of("a test", {name: camera}, {"field": ssl_field("B")})


def two_cameras(lens: str | Lens) -> Calibration:
    """A calibration of two cameras, whose names keep their ids."""
    cameras = {f"camera{number}": with_lens(lens, number=number) for number in (0, 1)}
    return calibration_of("a test", cameras, {"field": ssl_field("B")})


def places(camera: Camera, count: int = 1000, margin_px: float = 0.0) -> tuple[Array, Array]:
    """Points (N, 3) m that the camera shows, on the floor and above it, and their pixels."""
    draw = np.random.default_rng(5)
    size = np.array(camera.image_size)
    pixels = draw.uniform(margin_px - 0.5, size - 0.5 - margin_px, (count, 2))
    heights_m = (0.0, 0.15, 0.3)
    parts = np.array_split(pixels, len(heights_m))  # Newton's method is quick on many at once
    found = [np.column_stack([camera.locate(p, h), np.full(len(p), h)]) for p, h in zip(parts, heights_m, strict=True)]
    points = np.concatenate(found)
    good = np.isfinite(points).all(axis=1) & (np.abs(points).max(axis=1) < 100.0)
    return points[good], pixels[good]


def same_camera(one: Camera, other: Camera, tolerance: float = 1e-12) -> bool:
    """Whether all numbers agree up to rounding."""
    if one.image_size != other.image_size or one.lens.names != other.lens.names:
        return False
    first, second = (
        np.array([c.phi, c.aspect, c.skew, *c.principal_point, *c.lens.values, *c.cam_from_world.matrix.ravel()])
        for c in (one, other)
    )
    return bool(np.allclose(first, second, rtol=tolerance, atol=tolerance))


NO_DISTORTION = Brown()
SSL_LENS = Radial((6.0e-7,), (3,))
