"""How well a camera knows its own image: by how many pixels what it makes of each of them may be off.

A camera that turns by a little shows the same picture with another principal point: what a turn makes good is left out,
by least squares over the image. What remains is the lens's and the focal length's, wherever the camera hangs; what the
pose adds is in the maps over the field. The noise of the pixel that is asked about comes on top.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.cached import cached_property
from ceres_cal.base.errors import InputError
from ceres_cal.base.tails import NORMAL_95
from ceres_cal.base.transforms import Pose
from ceres_cal.posterior.maps import radius_95
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.posterior.profile import PhiProfile
from ceres_cal.problem.information import Key, over
from ceres_cal.problem.parameters import Estimate, intrinsic_names
from ceres_cal.problem.quantities import PixelSlopes, moved, pixel_slopes
from ceres_cal.scene.camera import Camera

_STEPS = 32  # along the longer side


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


@dataclass(frozen=True, eq=False)
class Picture:
    """What a camera shows at N pixels, and how that moves when the camera is another one."""

    camera: Camera
    pixels: Array

    @cached_property
    def _rays(self) -> Array:
        return self.camera.rays(self.pixels)

    @cached_property
    def _by(self) -> PixelSlopes:
        return pixel_slopes(self.camera, self._rays)

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
        known = np.repeat(np.isfinite(shift[:, 0]), 2)
        turn = np.linalg.lstsq(self._turns[known], shift.ravel()[known], rcond=None)[0]
        return np.asarray(shift - (self._turns @ turn).reshape(-1, 2))

    def slopes(self, quantities: Sequence[str]) -> Array:
        """(N, 2, K) px per unit of some intrinsics, turned as well as can be; 0 where the lens shows nothing."""
        names = intrinsic_names(self.camera.lens)
        moving = np.nan_to_num(self._by.intrinsics[:, :, [names.index(name) for name in quantities]])
        flat = moving.reshape(2 * len(moving), len(quantities))
        turn = np.linalg.lstsq(self._turns, flat, rcond=None)[0]
        return np.asarray((flat - self._turns @ turn).reshape(moving.shape))


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
    picture = Picture(own, pixels)
    if camera in posterior.profiles:
        radius = _by_profile(picture, estimate, posterior, camera)
    else:
        radius = _by_covariance(picture, estimate, posterior, camera)
    return ImageMap(camera, x, y, np.where(picture.shown, radius, np.nan).reshape(len(y), len(x)))


def picture_slopes(picture: Picture, keys: Sequence[Key], camera: str) -> Array:
    """(N, 2, K) px per unit of each of the keys: 0 of what is not this camera's."""
    own = [key for key in keys if key[:2] == ("camera", camera)]
    return over(picture.slopes([key.quantity for key in own]), own, keys)


def _by_covariance(picture: Picture, estimate: Estimate, posterior: Posterior, camera: str) -> Array:
    """(N,) px, with what leaves the quadratic picture."""
    slopes = picture_slopes(picture, posterior.keys, camera)
    covariance, width = posterior.spread.through(slopes), posterior.half_width
    bends = posterior.bends
    if bends is not None:
        taken = over(bends.steps, bends.keys, posterior.keys)
        for step, end in zip(taken, bends.ends, strict=True):
            off = np.full(picture.pixels.shape, np.inf)
            with suppress(InputError):  # reads: "unknown" at these places of the map
                there = moved(estimate, bends.keys, end).cameras[camera].at(Pose.identity())
                off = np.nan_to_num(picture.shift(there) - slopes @ step, nan=np.inf)
            lost = np.isinf(off).any(axis=1)
            off[lost] = 0.0
            covariance += off[:, :, None] * off[:, None, :] / width**2
            covariance[lost] = np.diag([np.inf, np.inf])
    return np.asarray(radius_95(covariance) * width / NORMAL_95)


def _by_profile(picture: Picture, estimate: Estimate, posterior: Posterior, camera: str) -> Array:
    """(N,) px along the valley: where each of its nodes shows what this camera shows, and how sure it is of that."""
    profile: PhiProfile = posterior.profiles[camera]
    shifts, sds = [], []
    for step, across in zip(profile.steps, profile.across, strict=True):
        there = moved(estimate, profile.keys, step)
        shifts.append(picture.shift(there.cameras[camera].at(Pose.identity())).ravel())
        node = Picture(there.cameras[camera].at(Pose.identity()), picture.pixels)
        variance = across.spread.through(picture_slopes(node, across.keys, camera))
        sds.append(np.sqrt(np.diagonal(variance, axis1=1, axis2=2)).ravel())
    values = np.array(shifts)
    lost = np.isnan(values).any(axis=0)
    low, high = profile.bounds(np.nan_to_num(values), np.array(sds), posterior.half_width)
    reach = np.where(lost, np.inf, np.maximum(np.abs(low), np.abs(high)))
    return np.asarray(np.hypot(*reach.reshape(-1, 2).T))
