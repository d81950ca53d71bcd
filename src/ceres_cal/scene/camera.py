"""A camera: image size, intrinsics, lens and pose, the maps between world, rays and pixels, and its form in files.

Pixel (0, 0) is the centre of the top-left pixel. The camera frame has x right, y down, z forward,
and x_cam = R (x_world - t) with t the camera's position (paper, section 3).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from importlib import import_module
from numbers import Real
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from ceres_cal.base import Array, Array32, DegenerateError, Frozen, InputError, Mask, drawn, field, html_of, replace
from ceres_cal.base.transforms import Pose, require_rotation
from ceres_cal.base.typed import numbers_in, rows, size_in
from ceres_cal.scene.lens import Lens, make_lens

LARGEST_PX = 10**9  # larger values are no numbers of pixels
LARGEST = 1e100  # upper limit of a camera's numbers: squares and cubes of larger ones overflow
_FOREIGN = "ceres_cal.scene.foreign"  # it imports this module, so it is loaded when it is needed


class OpenCvCamera(Struct, frozen=True, eq=False):
    """A camera in the form that OpenCV's functions take: `K, dist, rvec, tvec = camera.to_opencv()`.

    Attributes:
        matrix: K (3, 3). distortion: its coefficients. rvec, tvec: (3,) pose, from the world to the camera; tvec in
            metres.
        fisheye: whether the coefficients are those of `cv2.fisheye`.
        error_px: root mean square and largest distance over the image from the original camera.
    """

    matrix: Array
    distortion: Array
    rvec: Array
    tvec: Array
    fisheye: bool
    error_px: tuple[float, float]

    def __iter__(self) -> Iterator[Array]:
        return iter((self.matrix, self.distortion, self.rvec, self.tvec))


class Camera(Frozen, eq=True):
    """One camera at one pose.

    Attributes:
        image_size: (width, height) px.
        phi: focal length in pixels along x, at the centre of the image.
        principal_point: (cx, cy) px.
        lens: the lens model with its coefficients.
        aspect: fy / fx, 1 for square pixels.
        cam_from_world: the pose; identity where only the intrinsics matter.
        skew: by how much x grows with y on square pixels, 0 where rows and columns are perpendicular; Zhang's c is
            skew times phi.
    """

    image_size: tuple[int, int]
    phi: float
    principal_point: tuple[float, float]
    lens: Lens
    aspect: float = 1.0
    cam_from_world: Pose = field(default_factory=Pose.identity)
    skew: float = 0.0

    def __post_init__(self) -> None:
        width, height = size_in(self.image_size)
        cx, cy = (float(c) for c in numbers_in(self.principal_point, "principal_point"))
        if max(width, height) > LARGEST_PX:
            raise InputError(f"image_size must be at most {LARGEST_PX} px, not {self.image_size}")
        held = (*self.lens.values, *self.cam_from_world.translation.tolist())
        numbers = (self.phi, self.aspect, cx, cy, self.skew, *held)
        if not all(abs(number) < LARGEST for number in numbers) or self.phi <= 0.0 or self.aspect <= 0.0:
            raise InputError(
                f"intrinsics must be finite and below {LARGEST:g}, phi and aspect positive: phi {self.phi}, "
                f"aspect {self.aspect}, principal point {(cx, cy)}, {self.lens.coefficients}, "
                f"translation {self.cam_from_world.translation}"
            )
        plain = {name: float(getattr(self, name)) for name in ("phi", "aspect", "skew")}
        vars(self).update(plain, image_size=(width, height), principal_point=(cx, cy))

    def __repr__(self) -> str:
        (width, height), place = self.image_size, ", ".join(f"{x:.2f}" for x in self.position)
        return f"Camera({width} x {height} px, phi {self.phi:.1f} px, {self.lens.kind}, at ({place}) m)"

    def _repr_html_(self) -> str:
        (width, height), (cx, cy) = self.image_size, self.principal_point
        rows = [
            ("image", f"{width} x {height} px"),
            ("phi", f"{self.phi:.2f} px"),
            ("principal point", f"{cx:.2f}, {cy:.2f} px"),
            *((name, f"{value:.5g}") for name, value in self.lens.coefficients.items()),
            ("position", ", ".join(f"{one:.3f}" for one in self.position) + " m"),
            ("tilt", f"{self.tilt_deg:.3f} deg"),
        ]
        return html_of((f"Camera with {self.lens.kind} lens", rows))

    def plot(self, ax: Any = None) -> Any:
        """Draw the distortion curve (undistorted against measured radius) into Matplotlib's Axes; returns the Axes."""
        return drawn("solve_pictures.plot_distortion", self, ax)

    @property
    def position(self) -> Array:
        """Position of the camera in the world, (3,) metres: the paper's t. Its third number is the height."""
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
        return np.array([[self.phi, self.skew * self.phi, cx], [0.0, self.phi * self.aspect, cy], [0.0, 0.0, 1.0]])

    def at(self, cam_from_world: Pose) -> Camera:
        """Return the same camera at another pose."""
        return replace(self, cam_from_world=cam_from_world)

    def zoomed(self, phi: float) -> tuple[Camera, Camera]:
        """Return the same camera with another phi, with each of the lenses of `Lens.after_zoom`."""
        by_angle, by_place = self.lens.after_zoom(phi / self.phi)
        return replace(self, phi=phi, lens=by_angle), replace(self, phi=phi, lens=by_place)

    @property
    def corner_radius(self) -> float:
        """Distance (px, square pixels) from the principal point to the farthest image corner."""
        return float(np.max(np.linalg.norm(self._edge, axis=1)))

    @property
    def _edge(self) -> Array:
        """(N, 2) offsets of places along the image's edge, including its corners."""
        return self.offsets(_along_edge(self.image_size))

    @property
    def folds(self) -> bool:
        """Whether the lens stops being monotone inside the image, so that some pixels have no unique ray."""
        return self.folded_edge > 0.0

    @property
    def folded_edge(self) -> float:
        """Share of the image's edge that is past the radius where the lens stops being monotone."""
        return float(np.mean(~np.asarray(self.lens.shows(self._edge, self.phi))))

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
        x, y = rows(pixels, 2, "pixels").T
        cx, cy = self.principal_point
        down = (y - cy) / self.aspect
        return np.column_stack([x - cx - self.skew * down, down])  # by columns: NumPy is slow on rows of two

    def project(self, points_world: ArrayLike) -> Array:
        """Points (N, 3) m -> pixels (N, 2), or one (3,) -> (2,); NaN behind the camera or past the lens's monotone
        radius.

        A pixel may lie outside the image: nothing is cut off.
        """
        given = numbers_in(points_world, "points_world")
        if given.ndim == 1:
            return np.asarray(self.project(given[None])[0])
        with np.errstate(invalid="ignore"):  # infinite points
            rays = self.cam_from_world.transform(rows(given, 3, "points_world"))
        offsets = self.lens.distort(rays, self.phi)
        offsets[:, 0] += self.skew * offsets[:, 1]
        return np.asarray(offsets * (1.0, self.aspect) + self.principal_point)

    def rays(self, pixels: ArrayLike) -> Array:
        """Pixels (N, 2) -> unit directions (N, 3) in the camera frame; NaN past the lens's monotone radius."""
        return self.lens.undistort(self.offsets(pixels), self.phi)

    def locate(self, pixels: ArrayLike, height_m: float = 0.0) -> Array:
        """Pixels (N, 2), or one (2,), -> where their rays meet the plane z = height_m, (N, 2) or (2,) m (paper,
        sections 3.4 and 4).

        NaN for a ray that does not meet the plane in front of the camera. For the accuracy of the place see the
        calibration's uncertainty.

        Raises:
            InputError: a height far above the camera, which is probably in millimetres: heights are in metres.
        """
        if not isinstance(height_m, Real) or not np.isfinite(height_m):
            raise InputError(f"height_m must be a number of metres, such as 0.15, not {height_m!r}")
        far_m = 10.0  # a height above this, and far above the camera, is in millimetres
        if abs(height_m) > max(far_m, 2.0 * abs(self.position[2])):
            raise InputError(
                f"height_m is {height_m:g} m, but the camera's height is {self.position[2]:.2f} m: "
                f"for {height_m:g} mm give {1e-3 * height_m:g}"
            )
        given = numbers_in(pixels, "pixels")
        if given.ndim == 1:
            return np.asarray(self.locate(rows(given[None], 2, "pixels"), height_m)[0])
        directions = self.rays(given) @ self.cam_from_world.rotation
        drop = height_m - self.position[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = drop / directions[:, 2]
            distance = np.where((distance > 0.0) & (distance < np.inf), distance, np.nan)
        return np.asarray(self.position[:2] + distance[:, None] * directions[:, :2])

    def homography(self, height_m: float = 0.0) -> Array:
        """The paper's H (3, 3): (x'', y'', 1) ~ H (x, y, 1) from the plane z = height_m to the image plane at depth 1.

        H = (r1, r2, r3 l - R t) (sections 3 and 4; the paper prints the sign of r3 l wrong, docs/mathematics.md).
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

    def undistort_maps(
        self, matrix: ArrayLike | None = None, size: tuple[int, int] | None = None
    ) -> tuple[Array32, Array32]:
        """Return map_x, map_y (height, width) for `cv2.remap`, for any lens; NaN where it has no answer.

        Args:
            matrix: K (3, 3) of the straight image, by default the camera's own. size: its (width, height), likewise.

        Raises:
            InputError: the matrix or the size is none.
        """
        given = self.matrix if matrix is None else numbers_in(matrix, "matrix")
        if given.shape != (3, 3) or not abs(np.linalg.det(given)) > 0.0:
            raise InputError(f"matrix must be K (3, 3) of a camera, which has an inverse, not {matrix!r:.80}")
        inverse = np.linalg.inv(given)
        width, height = size_in(self.image_size if size is None else size, "size")
        pixels = np.stack([*np.meshgrid(np.arange(width), np.arange(height)), np.ones((height, width))], axis=-1)
        places = self.at(Pose.identity()).project(pixels.reshape(-1, 3) @ inverse.T).reshape(height, width, 2)
        return places[..., 0].astype(np.float32), places[..., 1].astype(np.float32)

    # ---- in the form of other programs -------------------------------------------------------------------------------

    def to_opencv(self) -> OpenCvCamera:
        """Return K, coefficients, rvec and tvec for OpenCV. They are the best fit, with its error, where OpenCV does
        not have the lens, or where there is a skew.
        """
        camera: OpenCvCamera = import_module(_FOREIGN).to_opencv(self)
        return camera

    @classmethod
    def from_opencv(
        cls,
        image_size: tuple[int, int],
        matrix: ArrayLike,
        distortion: ArrayLike,
        rvec: ArrayLike = (0.0, 0.0, 0.0),
        tvec: ArrayLike = (0.0, 0.0, 0.0),
        *,
        fisheye: bool = False,
    ) -> Camera:
        """Return a camera from OpenCV's numbers: `brown`, or `kannala-brandt` from those of its fisheye model.

        Raises:
            InputError: the numbers make no camera.
        """
        others = import_module(_FOREIGN)
        vectors = (numbers_in(one, name).ravel() for one, name in ((rvec, "rvec"), (tvec, "tvec")))
        given = numbers_in(distortion, "distortion").ravel()
        pose = Pose.exp(np.concatenate([*vectors]))
        size, k = size_in(image_size), numbers_in(matrix, "matrix")
        camera: Camera = others.ForeignCamera.opencv(size, k, given, pose, fisheye=fisheye).camera()[0]
        return camera


def in_image(pixels: Array, image_size: tuple[int, int]) -> Mask:
    """(N,) whether pixels (N, 2) lie within half a pixel of one of the image's; False for NaN."""
    return np.asarray(np.all((pixels >= -0.5) & (pixels <= np.array(image_size) - 0.5), axis=-1))


@lru_cache(maxsize=64)
def _along_edge(image_size: tuple[int, int]) -> Array:
    """(N, 2) places along an image's edge, px."""
    along_an_edge = 16  # steps along each side of the image
    along = np.linspace(-0.5, 0.5, along_an_edge + 1)
    ends = [np.full_like(along, end) for end in (-0.5, 0.5)]
    sides = [np.column_stack(one) for end in ends for one in ((along, end), (end, along))]
    size = np.array(image_size)
    return np.asarray(np.vstack(sides) * size + 0.5 * (size - 1.0))


Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


# ---- in our files ---------------------------------------------------------------------------------------------------


class LensFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A lens; only `radial` and `spline` have powers. The names of its coefficients say which terms it has."""

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
    """K, for other programs; redundant with phi, aspect, skew and principal point."""

    @classmethod
    def of(cls, camera: Camera) -> CameraFile:
        """Return a camera in the form of a file."""
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
        """Return the camera, without a particular pose; raise InputError where it is invalid."""
        lens = make_lens(self.lens.kind, self.lens.powers or (2, 3), self.lens.coefficients)
        camera = Camera(self.image_size, self.phi, self.principal_point, lens, self.aspect, skew=self.skew or 0.0)
        if self.camera_matrix and not np.allclose(camera.matrix, self.camera_matrix, rtol=1e-9):
            raise InputError("camera_matrix disagrees with phi, aspect, skew and principal_point: correct one")
        return camera


class PoseFile(msgspec.Struct, forbid_unknown_fields=True):
    """A rotation's rows and a translation."""

    rotation: Matrix
    translation_m: Vector

    @classmethod
    def of(cls, pose: Pose) -> PoseFile:
        """Return a pose in the form of a file."""
        return cls(pose.rotation.tolist(), pose.translation.tolist())

    def pose(self) -> Pose:
        """Return the pose; raise InputError where the rotation is invalid."""
        return Pose(require_rotation(self.rotation, "rotation"), np.array(self.translation_m))


def camera_to_json(camera: Camera) -> dict[str, Any]:
    """Return a camera's intrinsics as plain data."""
    return dict(msgspec.to_builtins(CameraFile.of(camera)))
