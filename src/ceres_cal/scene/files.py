"""Cameras and poses as all our files have them."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.transforms import Pose
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import make_lens

Vector = tuple[float, float, float]


class LensFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A lens; only `radial` has powers."""

    kind: str
    powers: tuple[int, ...] | None = None
    coefficients: dict[str, float] = {}


class CameraFile(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """A camera's intrinsics."""

    image_size: tuple[int, int]
    phi: float
    principal_point: tuple[float, float]
    aspect: float = 1.0
    lens: LensFile

    def camera(self) -> Camera:
        """The camera, at no particular pose; InputError where it is none."""
        lens = make_lens(self.lens.kind, self.lens.powers or (2, 3), self.lens.coefficients)
        return Camera(self.image_size, self.phi, self.principal_point, lens, self.aspect)


class PoseFile(msgspec.Struct, forbid_unknown_fields=True):
    """A rotation's rows and a translation."""

    rotation: tuple[Vector, Vector, Vector]
    translation_m: Vector

    def pose(self) -> Pose:
        """The pose; InputError where the rotation is none."""
        return Pose(np.array(self.rotation), np.array(self.translation_m))


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """A camera's intrinsics as plain data."""
    file = CameraFile(
        image_size=camera.image_size,
        phi=camera.phi,
        principal_point=camera.principal_point,
        aspect=camera.aspect,
        lens=LensFile(camera.lens.kind, camera.lens.powers or None, camera.lens.coefficients),
    )
    return dict(msgspec.to_builtins(file))


def pose_to_json(pose: Pose) -> dict[str, Any]:
    """A pose as plain data."""
    return {"rotation": pose.rotation.tolist(), "translation_m": pose.translation.tolist()}
