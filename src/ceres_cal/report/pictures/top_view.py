"""The metric top view: a plane on the field or above it, seen from straight above at a scale of one's choice.

x points right and y up, as on the field's drawing. What stands higher or lower than the plane is shown displaced.
"""

from __future__ import annotations

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.report.pictures.warp import Warp, make_warp, require_size
from ceres_cal.scene.camera import Camera


class TopViewGrid(Struct, frozen=True):
    """What part of which plane a top view shows, and how large.

    Attributes:
        corner_m: x and y of the picture's upper left corner: the smallest x, the largest y. size: (width, height) px.
        m_per_px: metres along a pixel's side. height_m: of the plane.
    """

    corner_m: tuple[float, float]
    size: tuple[int, int]
    m_per_px: float
    height_m: float

    @property
    def area_m(self) -> tuple[float, float, float, float]:
        """x0, y0, x1, y1 between the picture's edges."""
        x, y = self.corner_m
        return x, y - self.size[1] * self.m_per_px, x + self.size[0] * self.m_per_px, y

    def places(self, pixels: ArrayLike) -> Array:
        """Pixels (N, 2) of the top view -> places (N, 2) on the plane, m."""
        steps = (np.asarray(pixels, dtype=float) + 0.5) * self.m_per_px
        return np.asarray(self.corner_m + steps * [1.0, -1.0])

    def pixels(self, places_m: ArrayLike) -> Array:
        """Places (N, 2) on the plane, m -> pixels (N, 2) of the top view; nothing is cut off."""
        steps = (np.asarray(places_m, dtype=float) - self.corner_m) * [1.0, -1.0]
        return np.asarray(steps / self.m_per_px - 0.5)


def make_grid(area_m: tuple[float, float, float, float], m_per_px: float, height_m: float = 0.0) -> TopViewGrid:
    """The grid of pixels over an area.

    Args:
        area_m: x0, y0, x1, y1; widened to whole pixels at its right and lower edge.

    Raises:
        InputError: an area without extent, no scale, or a picture too large.
    """
    x0, y0, x1, y1 = area_m
    if not (np.all(np.isfinite(area_m)) and x1 > x0 and y1 > y0):
        raise InputError(f"the area must be x0,y0,x1,y1 in metres, x0 below x1 and y0 below y1, not {area_m}")
    if not (np.isfinite(m_per_px) and m_per_px > 0.0):
        raise InputError(f"the scale must be above 0 mm per pixel, not {1e3 * m_per_px:g}")
    count = np.ceil(np.array([x1 - x0, y1 - y0]) / m_per_px - 1e-6)
    size = (int(count[0]), int(count[1]))
    require_size(size, "ask for more mm per pixel, or for a smaller area")
    return TopViewGrid((x0, y1), size, m_per_px, height_m)


def top_view(camera: Camera, grid: TopViewGrid) -> Warp:
    """How the photographs of a station (a camera posed in the world) become top views.

    Raises:
        InputError: the camera sees nothing of the area.
    """

    def places(pixels: Array) -> Array:
        return camera.project(np.column_stack([grid.places(pixels), np.full(len(pixels), grid.height_m)]))

    warp = make_warp(grid.size, camera.image_size, places)
    if not warp.seen.any():
        x0, y0, x1, y1 = grid.area_m
        raise InputError(
            f"the camera sees nothing of x {x0:g} to {x1:g} m, y {y0:g} to {y1:g} m at a height of "
            f"{grid.height_m:g} m: ask for another area"
        )
    return warp
