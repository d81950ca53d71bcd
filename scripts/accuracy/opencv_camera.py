"""A camera that projects with OpenCV's functions, to find errors that the package's lenses and simulations share."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.frozen import replace
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown
from ceres_cal.simulate import Scene

_PLACES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y")
"""Names of the coefficients in the vector of `cv2.projectPoints`, in order."""
_PRECISE = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
_STEPS = np.append(np.linspace(0.0, 0.97, 32), [1.0 - 1e-6, 1.0])[:, None, None]
"""Fractions of a ray's distance from the axis, at which the lens must not fold; the last ones test the ray itself."""


@dataclass(frozen=True)
class TiltedSensor(Brown):
    """Coefficients of Brown's lens for a sensor that is tilted by tau_x and tau_y, rad, which only OpenCV models."""

    values: tuple[float, ...] = (0.0,) * 7
    kind: ClassVar[str] = "tilted sensor"

    @property
    def names(self) -> tuple[str, ...]:
        return ("k1", "k2", "p1", "p2", "k3", "tau_x", "tau_y")


class OpenCvCamera(Camera, eq=True):
    """A camera that maps places to pixels, and pixels to rays, with OpenCV; its lens only stores the coefficients."""

    @property
    def _by_angle(self) -> bool:
        return self.lens.kind == "kannala-brandt"

    @property
    def _distortion(self) -> Array:
        if self._by_angle:
            return np.array(self.lens.values)
        vector = np.zeros(len(_PLACES))
        vector[[_PLACES.index(name) for name in self.lens.names]] = self.lens.values
        return vector

    def _pixels(self, places: Array, turn: Array, shift: Array) -> Array:
        if self._by_angle:
            found = cv2.fisheye.projectPoints(places[None], turn, shift, self.matrix, self._distortion)[0]
        else:
            found = cv2.projectPoints(places, turn, shift, self.matrix, self._distortion)[0]
        return np.array(found, dtype=float).reshape(-1, 2)

    def project(self, points_world: ArrayLike) -> Array:
        """Points (N, 3) m -> pixels (N, 2); NaN behind the camera and beyond a fold of the lens."""
        places = np.array(points_world, dtype=float).reshape(-1, 3)
        rotation, shift = self.cam_from_world.rotation, self.cam_from_world.translation
        rays = places @ rotation.T + shift
        shown = np.flatnonzero(rays[:, 2] > 0.0)
        shown = shown[self._unfolded(rays[shown])]
        pixels = np.full((len(places), 2), np.nan)
        if len(shown):  # OpenCV needs at least one
            pixels[shown] = self._pixels(places[shown], np.array(cv2.Rodrigues(rotation)[0], dtype=float), shift)
        return pixels

    def _unfolded(self, rays: Array) -> Mask:
        """(N,) whether the image radius increases all the way from the axis to a ray."""
        if not len(rays):
            return np.zeros(0, dtype=bool)
        depths = np.broadcast_to(rays[:, 2:], (len(_STEPS), len(rays), 1))
        way = np.concatenate([_STEPS * rays[:, :2], depths], axis=2).reshape(-1, 3)
        pixels = self._pixels(way, np.zeros(3), np.zeros(3)).reshape(len(_STEPS), -1, 2)
        return np.asarray(np.all(np.diff(np.linalg.norm(pixels - self.principal_point, axis=2), axis=0) > 0.0, axis=0))

    def rays(self, pixels: ArrayLike) -> Array:
        """Pixels (N, 2) -> unit directions (N, 3) in the camera's frame."""
        seen = np.array(pixels, dtype=float).reshape(-1, 1, 2)
        if self._by_angle:
            flat = cv2.fisheye.undistortPoints(seen, self.matrix, self._distortion, criteria=_PRECISE)
        else:
            flat = cv2.undistortPoints(seen, self.matrix, self._distortion, criteria=_PRECISE)
        rays = np.column_stack([flat.reshape(-1, 2), np.ones(len(seen))])
        return np.asarray(rays / np.linalg.norm(rays, axis=1)[:, None])


def in_opencv(scene: Scene) -> Scene:
    """The scene with cameras that project with OpenCV."""
    return replace(scene, cameras={name: OpenCvCamera(**vars(camera)) for name, camera in scene.cameras.items()})
