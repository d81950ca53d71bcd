"""By how much what a file says of a camera differs from the calibration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ceres_cal.base.arrays import Array

if TYPE_CHECKING:
    from ceres_cal.scene.camera import Camera


def field_error_mm(
    camera: Camera,
    locate: Callable[[Array, float], Array],
    pixels: Array,
    box_m: tuple[Array, Array],
    heights_m: Sequence[float],
) -> dict[float, tuple[float, float]]:
    """height_m -> root mean square and largest error of located pixels, mm.

    Args:
        camera: that knows better. locate: pixels (N, 2) and a height -> places (N, 2) m, NaN where it knows none.
        pixels: (N, 2); those count that look into the box around the x and y of `box_m`. Infinite where none does.
    """
    errors = {}
    low, high = (np.array([end(axis) for axis in box_m]) for end in (np.min, np.max))
    for height_m in heights_m:
        true = camera.locate(pixels, height_m)
        with np.errstate(invalid="ignore"):
            on_field = np.all((true >= low) & (true <= high), axis=1)
        off = 1e3 * np.linalg.norm(locate(pixels[on_field], height_m) - true[on_field], axis=1)
        off = np.where(np.isfinite(off), off, np.inf)
        errors[height_m] = (float(np.sqrt(np.mean(off**2))), float(np.max(off))) if len(off) else (np.inf, np.inf)
    return errors
