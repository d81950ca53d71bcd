"""How well a camera knows its own image: by how many pixels what it makes of each of them may be off.

A camera that turns by a little shows the same picture with another principal point: what a turn makes good is left out,
by least squares over the image, each place as far as it is known: a corner that nobody observed tells no turn. What
remains is the lens's and the focal length's, wherever the camera hangs; what the pose adds is in the maps over the
field. The noise of the pixel that is asked about comes on top.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.cached import cached_property
from ceres_cal.base.errors import InputError
from ceres_cal.base.shown import brief, drawn
from ceres_cal.base.transforms import Pose
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.posterior.reading import Functional, Reading, read
from ceres_cal.problem.information import Key, over
from ceres_cal.problem.parameters import Estimate, intrinsic_names
from ceres_cal.problem.quantities import PixelSlopes, pixel_slopes
from ceres_cal.scene.camera import Camera

_STEPS = 32  # along the longer side
_EXACT_PX = 1e-6  # places that are known better tell a turn alike


@dataclass(frozen=True, eq=False)
class ImageMap:
    """How well one camera knows its image, over a grid.

    Attributes:
        x_px (X,), y_px (Y,): of the grid. radius_95_px: (Y, X) 95 % of the errors are shorter; infinite where it is not
            known, NaN past the lens's monotone radius.
    """

    camera: str
    x_px: Array
    y_px: Array
    radius_95_px: Array

    __repr__ = brief

    def plot(self, ax: Any = None) -> Any:
        """Draw the map of 95 % radii into Matplotlib's Axes, in the colours of the report; returns the Axes."""
        return drawn("plot_map", self, ax)


@dataclass(frozen=True, eq=False)
class Picture:
    """What a camera shows at N pixels, and how that moves when the camera is another one.

    Attributes:
        weights: (N,) of each in the turn that is left out; 0: none is.
    """

    camera: Camera
    pixels: Array
    weights: Array | float = 1.0

    @cached_property
    def _rays(self) -> Array:
        return self.camera.rays(self.pixels)

    @cached_property
    def _by(self) -> PixelSlopes:
        return pixel_slopes(self.camera, self._rays)

    def of(self, camera: Camera) -> Picture:
        """What another one shows at the same pixels."""
        return replace(self, camera=camera.at(Pose.identity()))

    @property
    def shown(self) -> Mask:
        """(N,) which pixels the lens has an answer for."""
        return np.isfinite(self._by.turns[:, 0, 0])

    @property
    def _turns(self) -> Array:
        """(2 N, 3) px per rad about the camera's axes; 0 where the lens shows nothing."""
        return np.nan_to_num(self._by.turns.reshape(-1, 3))

    def shift(self, other: Camera) -> Array:
        """(N, 2) px from where this camera shows its rays to where another one does, turned as well as can be; NaN
        where either shows nothing.
        """
        shift = other.project(self._rays) - self.pixels
        known = np.isfinite(shift[:, 0])
        return shift - self._turned(np.nan_to_num(shift)[:, :, None], known)[:, :, 0]

    def slopes(self, quantities: Sequence[str]) -> Array:
        """(N, 2, K) px per unit of some intrinsics, turned as well as can be; 0 where the lens shows nothing."""
        names = intrinsic_names(self.camera.lens)
        moving = np.nan_to_num(self._by.intrinsics[:, :, [names.index(name) for name in quantities]])
        return moving - self._turned(moving, self.shown)

    def _turned(self, moving: Array, known: Mask) -> Array:
        """(N, 2, K) how much of (N, 2, K) px a turn makes good."""
        weights = np.repeat(self.weights * known, 2)[:, None]
        flat = moving.reshape(len(weights), moving.shape[-1])
        turn = np.linalg.lstsq(weights * self._turns, weights * flat, rcond=None)[0]
        return np.asarray((self._turns @ turn).reshape(moving.shape))


def image_grid(image_size: tuple[int, int]) -> tuple[Array, Array]:
    """x (X,) and y (Y,) of a grid over an image, px, from its first pixels to its last."""
    steps = (max(round(_STEPS * side / max(image_size)), 2) for side in image_size)
    x, y = (np.linspace(0.0, side - 1.0, count + 1) for side, count in zip(image_size, steps, strict=True))
    return x, y


def image_map(estimate: Estimate, posterior: Posterior, camera: str) -> ImageMap:
    """The map over a camera's image.

    Raises:
        InputError: no such camera.
    """
    if camera not in estimate.cameras:
        raise InputError(f"there is no camera {camera!r}: it is one of {', '.join(estimate.cameras)}")
    own = estimate.cameras[camera].at(Pose.identity())
    x, y = image_grid(own.image_size)
    pixels = np.column_stack([part.ravel() for part in np.meshgrid(x, y)])

    def known(picture: Picture) -> Reading:
        shown = Functional(
            lambda there: picture.shift(there.cameras[camera].at(Pose.identity())),
            lambda there, keys: picture_slopes(picture.of(there.cameras[camera]), keys, camera),
        )
        return read(posterior, estimate, shown, camera)

    picture = Picture(own, pixels, 0.0)
    with_turns = known(picture).sd
    picture = replace(picture, weights=1.0 / np.maximum(with_turns, _EXACT_PX))
    radius = known(picture).radius_95
    return ImageMap(camera, x, y, np.where(picture.shown, radius, np.nan).reshape(len(y), len(x)))


def picture_slopes(picture: Picture, keys: Sequence[Key], camera: str) -> Array:
    """(N, 2, K) px per unit of each of the keys: 0 of what is not this camera's."""
    own = [key for key in keys if key[:2] == ("camera", camera)]
    return over(picture.slopes([key.quantity for key in own]), own, keys)
