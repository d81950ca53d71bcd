"""A camera: image size, intrinsics, lens and pose, and the maps between world, rays and pixels.

Pixel (0, 0) is the centre of the top-left pixel. The camera frame has x right, y down, z forward, and
x_cam = R (x_world - t) with t the camera's position (paper, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base.arrays import Array, Mask
from ceres_cal.base.errors import DegenerateError, InputError
from ceres_cal.base.transforms import Pose
from ceres_cal.scene.lens import Lens


def _rows(values: ArrayLike, columns: int, name: str) -> Array:
    rows = np.asarray(values, dtype=float)
    if rows.ndim != 2 or rows.shape[1] != columns:
        raise ValueError(f"{name} must have shape (N, {columns}), not {rows.shape}")
    return rows


@dataclass(frozen=True)
class Camera:
    """One camera at one pose.

    Attributes:
        image_size: (width, height) px.
        phi: focal length in pixels along x, at the centre of the image.
        principal_point: (cx, cy) px.
        lens: the lens model with its coefficients.
        aspect: fy / fx, 1 for square pixels.
        cam_from_world: the pose; identity where only the intrinsics matter.
    """

    image_size: tuple[int, int]
    phi: float
    principal_point: tuple[float, float]
    lens: Lens
    aspect: float = 1.0
    cam_from_world: Pose = field(default_factory=Pose.identity)

    def __post_init__(self) -> None:
        width, height = (int(s) for s in self.image_size)
        cx, cy = (float(c) for c in self.principal_point)
        if width < 1 or height < 1:
            raise InputError(f"image size must be two positive whole numbers, not {self.image_size}")
        numbers = (self.phi, self.aspect, cx, cy, *self.lens.values)
        if not np.all(np.isfinite(numbers)) or self.phi <= 0.0 or self.aspect <= 0.0:
            raise InputError(
                f"intrinsics must be finite, phi and aspect positive: phi {self.phi}, aspect {self.aspect}, "
                f"principal point {(cx, cy)}, {self.lens.coefficients}"
            )
        object.__setattr__(self, "image_size", (width, height))
        object.__setattr__(self, "phi", float(self.phi))
        object.__setattr__(self, "aspect", float(self.aspect))
        object.__setattr__(self, "principal_point", (cx, cy))

    @property
    def position(self) -> Array:
        """Where the camera is in the world, (3,) metres: the paper's t. Its third number is the height."""
        return self.cam_from_world.position

    @property
    def tilt_deg(self) -> float:
        """Angle between the camera's axis and straight down."""
        x, y, z = self.cam_from_world.rotation[2]
        return float(np.degrees(np.arctan2(np.hypot(x, y), -z)))

    @property
    def matrix(self) -> Array:
        """The camera matrix K (3, 3) of the undistorted image (paper, section 3.4)."""
        cx, cy = self.principal_point
        return np.array([[self.phi, 0.0, cx], [0.0, self.phi * self.aspect, cy], [0.0, 0.0, 1.0]])

    def at(self, cam_from_world: Pose) -> Camera:
        """The same camera at another pose."""
        return replace(self, cam_from_world=cam_from_world)

    @property
    def corner_radius(self) -> float:
        """Distance (px, square pixels) from the principal point to the farthest image corner."""
        width, height = self.image_size
        corners = np.array([[-0.5, -0.5], [width - 0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, height - 0.5]])
        return float(np.max(np.linalg.norm(self.offsets(corners), axis=1)))

    @property
    def folds(self) -> bool:
        """Whether the lens stops being monotone inside the image, so that some pixels have no single answer."""
        return self.lens.monotone_radius(self.phi) < self.corner_radius

    def require_monotone(self, name: str) -> None:
        """Raise InputError naming the camera where its lens folds over inside the image."""
        if self.folds:
            radius = self.lens.monotone_radius(self.phi)
            raise InputError(
                f"camera {name!r}: the {self.lens.kind} lens folds over at {radius:.1f} px from the principal point, "
                f"inside the image (its corner is at {self.corner_radius:.1f} px): "
                "use other coefficients, fewer of them, or observations that reach the image's corners"
            )

    def offsets(self, pixels: ArrayLike) -> Array:
        """Pixels (N, 2) as offsets (N, 2) from the principal point on square pixels."""
        x, y = _rows(pixels, 2, "pixels").T
        cx, cy = self.principal_point
        return np.column_stack([x - cx, (y - cy) / self.aspect])  # by columns: rows of two are slow to walk

    def project(self, points_world: ArrayLike) -> Array:
        """Points (N, 3) m -> pixels (N, 2); NaN behind the camera or past the lens's monotone radius.

        A pixel may lie outside the image: nothing is cut off.
        """
        with np.errstate(invalid="ignore"):  # infinite points
            rays = self.cam_from_world.transform(_rows(points_world, 3, "points_world"))
        return np.asarray(self.lens.distort(rays, self.phi) * (1.0, self.aspect) + self.principal_point)

    def rays(self, pixels: ArrayLike) -> Array:
        """Pixels (N, 2) -> unit directions (N, 3) in the camera frame; NaN past the lens's monotone radius."""
        return self.lens.undistort(self.offsets(pixels), self.phi)

    def locate(self, pixels: ArrayLike, height_m: float = 0.0) -> Array:
        """Pixels (N, 2) -> where their rays meet the plane z = height_m, (N, 2) m (paper, sections 3.4 and 4).

        NaN for a ray that does not meet the plane in front of the camera. How well the answer is known the number does
        not tell: see the calibration's uncertainty.
        """
        directions = self.rays(pixels) @ self.cam_from_world.rotation
        drop = height_m - self.position[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = drop / directions[:, 2]
            distance = np.where((distance > 0.0) & (distance < np.inf), distance, np.nan)
        return np.asarray(self.position[:2] + distance[:, None] * directions[:, :2])

    def homography(self, height_m: float = 0.0) -> Array:
        """The paper's H (3, 3): (x'', y'', 1) ~ H (x, y, 1) from the plane z = height_m to the image plane at depth 1.

        H = (r1, r2, r3 l - R t) (sections 3 and 4; the paper prints the sign of r3 l wrong, design section 2).
        """
        pose = self.cam_from_world
        return np.column_stack([pose.rotation[:, :2], pose.translation + height_m * pose.rotation[:, 2]])

    def inverse_homography(self, height_m: float = 0.0) -> Array:
        """The paper's G (3, 3), the inverse of `homography`: from the image plane at depth 1 to the field (its 3.1).

        Raises:
            DegenerateError: the camera lies in that plane.
        """
        if abs(self.position[2] - height_m) < 1e-9:  # the determinant of H
            raise DegenerateError(f"the camera lies in the plane z = {height_m} m, edge-on: ask for another height")
        return np.asarray(np.linalg.inv(self.homography(height_m)))


def in_image(pixels: Array, image_size: tuple[int, int]) -> Mask:
    """(N,) whether pixels (N, 2) lie within half a pixel of one of the image's; False for NaN."""
    return np.asarray(np.all((pixels >= -0.5) & (pixels <= np.array(image_size) - 0.5), axis=-1))
