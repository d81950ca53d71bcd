"""Cameras and poses as all our files have them."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.transforms import Pose, require_rotation
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import make_lens

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


class LensFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A lens; only `radial` and `spline` have powers. Which terms it has, its coefficients' names say."""

    kind: str
    powers: tuple[int, ...] | None = None
    coefficients: dict[str, float] = {}


class CameraFile(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """A camera's intrinsics."""

    image_size: tuple[int, int]
    phi: float
    principal_point: tuple[float, float]
    aspect: float = 1.0
    skew: float | msgspec.UnsetType = msgspec.UNSET
    lens: LensFile
    camera_matrix: Matrix | msgspec.UnsetType = msgspec.UNSET
    """K, for other programs: phi, aspect, skew and principal point once more."""

    @classmethod
    def of(cls, camera: Camera) -> CameraFile:
        """As a file has it."""
        lens = LensFile(camera.lens.kind, camera.lens.powers or None, camera.lens.coefficients)
        size, centre = camera.image_size, camera.principal_point
        k = camera.matrix.tolist()
        return cls(
            image_size=size,
            phi=camera.phi,
            principal_point=centre,
            aspect=camera.aspect,
            skew=camera.skew or msgspec.UNSET,
            lens=lens,
            camera_matrix=k,
        )

    def camera(self) -> Camera:
        """The camera, at no particular pose; InputError where it is none."""
        lens = make_lens(self.lens.kind, self.lens.powers or (2, 3), self.lens.coefficients)
        camera = Camera(self.image_size, self.phi, self.principal_point, lens, self.aspect, skew=self.skew or 0.0)
        if self.camera_matrix and not np.allclose(camera.matrix, self.camera_matrix, rtol=1e-9):
            raise InputError("camera_matrix is another than that of phi, aspect, skew and principal_point: correct one")
        return camera


class PoseFile(msgspec.Struct, forbid_unknown_fields=True):
    """A rotation's rows and a translation."""

    rotation: Matrix
    translation_m: Vector

    @classmethod
    def of(cls, pose: Pose) -> PoseFile:
        """As a file has it."""
        return cls(pose.rotation.tolist(), pose.translation.tolist())

    def pose(self) -> Pose:
        """The pose; InputError where the rotation is none."""
        return Pose(require_rotation(self.rotation, "rotation"), np.array(self.translation_m))


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """A camera's intrinsics as plain data."""
    return dict(msgspec.to_builtins(CameraFile.of(camera)))
