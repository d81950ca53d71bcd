"""Resampling of photographs: every pixel of a new picture is taken from its place in the photograph.

Pixel (0, 0) is the centre of the top-left pixel in both. A photograph extends half a pixel beyond the centres of its
outermost pixels; a new pixel outside it, or where the camera has no answer, is black.

Also the top view: a plane on the field or above it, seen from straight above at any scale. x points right and y up, as
in the field's drawing. What is higher or lower than the plane appears displaced.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from ceres_cal.base import Array, Array32, Image, InputError, Mask
from ceres_cal.scene.camera import Camera

MOST_PIXELS, LONGEST_SIDE = 100_000_000, 32_000  # the limit of OpenCV's remap is 32 767


class Warp(Struct, frozen=True, eq=False):
    """The place in the photograph of each pixel of a new picture.

    Where many pixels of the photograph fall into one of the picture, that pixel is the mean over `fine` x `fine` small
    squares, so that thin lines become fainter there, not broken.

    Attributes:
        size: (width, height) of the picture. photograph_size: (width, height) of the photographs.
        fine: number of squares along a pixel. x, y: (height, width) times `fine`, place of each square in the
            photograph, px.
        seen: (height, width) times `fine`, whether the photograph shows it.
    """

    size: tuple[int, int]
    photograph_size: tuple[int, int]
    fine: int
    x: Array32
    y: Array32
    seen: Mask

    @property
    def black(self) -> int:
        """Number of pixels of the picture that show nothing."""
        width, height = self.size
        squares = self.seen.reshape(height, self.fine, width, self.fine)
        return int(np.count_nonzero(~np.any(squares, axis=(1, 3))))

    def apply(self, photograph: Image) -> Image:
        """Make the picture, with the photograph's depth and channels, by cubic interpolation at places rounded to 1/64
        px.

        Raises:
            ValueError: the photograph has another size.
        """
        if photograph.shape[1::-1] != self.photograph_size:
            raise ValueError(f"a photograph of {self.photograph_size} px is needed, not {photograph.shape[1::-1]}")
        squares = cv2.remap(photograph, self.x, self.y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        squares[~self.seen] = 0
        return squares if self.fine == 1 else cv2.resize(squares, self.size, interpolation=cv2.INTER_AREA)


def require_size(size: tuple[int, int], advice: str) -> None:
    """Raise InputError, with this advice, where a picture would have no pixels, or more than 100 million."""
    width, height = size
    if min(size) < 1 or width * height > MOST_PIXELS or max(size) > LONGEST_SIDE:
        raise InputError(f"the picture would have {width} x {height} px: {advice}")


def make_warp(size: tuple[int, int], photograph_size: tuple[int, int], places: Callable[[Array], Array]) -> Warp:
    """Make the warp of a new picture.

    Args:
        size: (width, height) of the picture, accepted by `require_size`.
        places: pixels (N, 2) of the picture -> pixels (N, 2) of the photograph, NaN where there are none.
    """
    x, y = _placed(size, places)
    fine = _squares_along(x, y)
    x, y = (_divided(plane, fine) for plane in (x, y))
    limit = np.array(photograph_size) - 0.5
    seen = (x >= -0.5) & (x <= limit[0]) & (y >= -0.5) & (y <= limit[1])  # False for NaN
    return Warp(size, photograph_size, fine, np.where(seen, x, -1.0), np.where(seen, y, -1.0), seen)


def _placed(size: tuple[int, int], places: Callable[[Array], Array]) -> tuple[Array32, Array32]:
    """Places of all pixels, and of one more around them on each side."""
    block = 1 << 18  # new pixels processed at a time
    across, down = (np.arange(-1.0, count + 1.0) for count in size)
    there = np.empty((len(down), len(across), 2), dtype=np.float32)
    rows = max(1, block // len(across))
    for top in range(0, len(down), rows):
        part = down[top : top + rows]
        pixels = np.column_stack([np.tile(across, len(part)), np.repeat(part, len(across))])
        there[top : top + rows] = places(pixels).reshape(len(part), len(across), 2)
    return there[..., 0], there[..., 1]


def _divided(plane: Array32, fine: int) -> Array32:
    """Divide each pixel into `fine` x `fine` squares, interpolated between neighbouring pixels; the pixels around are
    removed.
    """
    size = fine * plane.shape[1], fine * plane.shape[0]
    squares = plane if fine == 1 else cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(squares[fine:-fine, fine:-fine])


def _squares_along(x: Array32, y: Array32) -> int:
    """Number of pixels of the photograph that most of the new ones span, limited."""
    usual = 0.9  # quantile of the spans that decides how many squares are needed
    finest = 4  # largest number of small squares along a pixel
    spans = [np.hypot(np.diff(x, axis=axis), np.diff(y, axis=axis)).ravel() for axis in (0, 1)]
    finite = np.concatenate(spans)
    finite = finite[np.isfinite(finite)]
    span = float(np.quantile(finite, usual)) if len(finite) else 1.0
    return int(np.clip(np.ceil(span - 0.25), 1, finest))


# ---- from above -----------------------------------------------------------------------------------------------------


class TopViewGrid(Struct, frozen=True):
    """Which part of which plane a top view shows, and at what scale.

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
        """x0, y0, x1, y1 of the picture's edges, m."""
        x, y = self.corner_m
        return x, y - self.size[1] * self.m_per_px, x + self.size[0] * self.m_per_px, y

    def places(self, pixels: ArrayLike) -> Array:
        """Places (N, 2) on the plane, m, of pixels (N, 2) of the top view."""
        steps = (np.asarray(pixels, dtype=float) + 0.5) * self.m_per_px
        return np.asarray(self.corner_m + steps * [1.0, -1.0])


def make_grid(area_m: tuple[float, float, float, float], m_per_px: float, height_m: float = 0.0) -> TopViewGrid:
    """Make the grid of pixels over an area.

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
    """Return the warp from photographs of a station (a camera posed in the world) to top views.

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
