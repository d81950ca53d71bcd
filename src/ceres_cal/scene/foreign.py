"""A camera as other programs describe it: K, their lens model with its coefficients, and a pose.

Where their model is one of our lenses, both directions are exact. Otherwise the best fit over the image is used, and
`error_px` says how far it is off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from ceres_cal.base import Array, Frozen, InputError, Mask, grid_places, replace, rms_and_largest
from ceres_cal.base.least_squares import least_squares
from ceres_cal.base.transforms import Pose, require_rotation, rotation_log
from ceres_cal.scene.camera import LARGEST, LARGEST_PX, Camera, OpenCvCamera
from ceres_cal.scene.lens import Brown, KannalaBrandt, Lens, Radial, make_lens

OPENCV_MODELS = {"opencv4": 4, "opencv5": 5, "opencv8": 8, "opencv12": 12}
"""Number of coefficients of OpenCV's models, in its order: k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]."""
FISHEYE = "fisheye"
"""OpenCV's fisheye model: k1 to k4."""
THIN_PRISM_FISHEYE = "THIN_PRISM_FISHEYE"
"""COLMAP's model: a fisheye with decentring and a thin prism."""
_OPENCV = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4")
_NAMES = {
    **{model: (Brown.kind, _OPENCV[:count]) for model, count in OPENCV_MODELS.items()},
    FISHEYE: (KannalaBrandt.kind, KannalaBrandt.above),
    THIN_PRISM_FISHEYE: (KannalaBrandt.kind, ("k1", "k2", "p1", "p2", "k3", "k4", "", "")),
}
"""Model -> the kind of our lenses that it is, and the names of its coefficients there; "" where we have none."""
_FISHEYES = (FISHEYE, THIN_PRISM_FISHEYE)  # models of angles, which also show rays across the axis
TO_HOLD = ("opencv12", THIN_PRISM_FISHEYE)
"""Models that are only used for lenses that they hold exactly: no other lens is fitted by them."""
_GRID = (41, 31)  # of pixels of the image over which a fit is made
_LENSES = (Brown(), KannalaBrandt(), Radial.blank((2, 3)), Radial.blank((3, 5, 7)))


class ForeignCamera(Frozen):
    """A camera in the form of another program.

    Attributes:
        image_size: (width, height) px. focal: fx, fy. centre: cx, cy, with (0, 0) at the centre of the first pixel.
        model: one of OPENCV_MODELS, FISHEYE, or a name that only its own program knows. coefficients: of the model.
        cam_from_world: None where the file has none.
        error_px: root mean square and largest distance, over the image, from the camera to which it was fitted.
        distort: for a model that is not known here, rays (N, 3) -> measured places (N, 2) at focal length 1.
    """

    image_size: tuple[int, int]
    focal: tuple[float, float]
    centre: tuple[float, float]
    model: str
    coefficients: tuple[float, ...]
    cam_from_world: Pose | None = None
    error_px: tuple[float, float] = (0.0, 0.0)
    distort: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        place = np.empty(0)
        if self.cam_from_world is not None:
            require_rotation(self.cam_from_world.rotation, "the camera's rotation")
            place = self.cam_from_world.translation
        numbers = (*self.focal, *self.centre, *self.coefficients, *place)
        if (
            not np.all(np.abs(numbers) < LARGEST)
            or min(self.focal) <= 0.0
            or not all(1 <= size <= LARGEST_PX for size in self.image_size)
        ):
            raise InputError(
                f"a camera needs an image size, focal lengths above 0 and finite numbers below {LARGEST:g}, not "
                f"{self.image_size} px, fx, fy {self.focal}, cx, cy {self.centre}, coefficients {self.coefficients}, "
                f"translation {place}: correct them"
            )

    @classmethod
    def opencv(
        cls,
        image_size: Sequence[int],
        matrix: ArrayLike,
        coefficients: ArrayLike,
        pose: Pose | None = None,
        *,
        fisheye: bool = False,
    ) -> ForeignCamera:
        """Return a camera from OpenCV's K (3, 3) and 0, 4, 5, 8, 12 or 14 coefficients, or the four of its fisheye.

        Raises:
            InputError: another number of coefficients, a skew, or a sensor that is tilted in its camera.
        """
        k, values = np.asarray(matrix, dtype=float), np.asarray(coefficients, dtype=float).ravel()
        if k.shape != (3, 3) or abs(k[0, 1]) > 1e-9 * abs(k[0, 0]) or np.any(k[2] != (0.0, 0.0, 1.0)):
            raise InputError(f"the camera matrix must be (fx 0 cx; 0 fy cy; 0 0 1), not {k.tolist()}")
        if fisheye and len(values) != 4:
            raise InputError(f"a fisheye has 4 coefficients, not {len(values)}")
        if len(values) not in (0, 4, 5, 8, 12, 14):
            raise InputError(f"OpenCV's models have 4, 5, 8, 12 or 14 coefficients, not {len(values)}")
        if np.any(values[12:]):
            raise InputError("a sensor that is tilted in its camera (coefficients 13 and 14) cannot be read here")
        if not fisheye:
            values = values[: 12 if np.any(values[8:]) else 8 if np.any(values[5:]) else 5]
            values = np.concatenate([values, np.zeros(max(0, 5 - len(values)))])
        model = FISHEYE if fisheye else f"opencv{len(values)}"
        (width, height), focal, centre = image_size, np.diag(k)[:2], k[:2, 2]
        return cls((int(width), int(height)), _two(focal), _two(centre), model, tuple(values.tolist()), pose)

    @classmethod
    def of(cls, camera: Camera, *models: str) -> ForeignCamera:
        """Return a camera of ours in one of these models: exactly where one holds its lens, else as the best fit over
        the image.
        """
        blanks = []
        for model in models:
            exact = cls.coefficients_of(camera.lens, model)
            numbers = exact or (0.0,) * (4 if model == FISHEYE else OPENCV_MODELS.get(model, 0))
            one = cls(camera.image_size, _focal(camera), camera.principal_point, model, numbers, camera.cam_from_world)
            if exact is not None and camera.skew == 0.0:
                return one
            blanks += [] if model in TO_HOLD else [replace(one, coefficients=(0.0,) * len(numbers))]
        pixels = image_grid(camera.image_size)
        rays = camera.rays(pixels)
        known, ahead = np.isfinite(rays[:, 0]), _ahead(rays)
        fits = [cls.fitted(blank, rays[known], pixels[known]) for blank in blanks]
        # Most models cannot show rays across the axis or behind it: they are compared by the others.
        return min(fits, key=lambda fit: _error(fit.project_rays(rays[ahead]), pixels[ahead])[0])

    @property
    def pose(self) -> Pose:
        """The pose; the identity where the file has none."""
        return self.cam_from_world or Pose.identity()

    @property
    def matrix(self) -> Array:
        """K, (3, 3)."""
        return camera_matrix(*self.focal, *self.centre)

    @property
    def lens(self) -> Lens | None:
        """The same lens of ours; None where there is none."""
        if self.model not in _NAMES:
            return None
        kind, names = _NAMES[self.model]
        named = [(name, value) for name, value in zip(names, self.coefficients, strict=True) if value != 0.0]
        return None if any(not name for name, _ in named) else make_lens(kind, coefficients=dict(named))

    @staticmethod
    def coefficients_of(lens: Lens, model: str) -> tuple[float, ...] | None:
        """Return the coefficients of a lens of ours in a model; None where the model does not hold it."""
        kind, names = _NAMES[model]
        given = {name: value for name, value in lens.coefficients.items() if value != 0.0}
        if lens.kind != kind or not set(given) <= set(names):
            return None
        return tuple(given.get(name, 0.0) for name in names)

    def project_rays(self, rays: Array) -> Array:
        """Rays (N, 3) in the camera's frame -> pixels (N, 2); NaN where the model has no answer."""
        with np.errstate(all="ignore"):
            if self.distort is not None:
                places = self.distort(rays)
            else:
                lens = self.lens
                assert lens is not None  # else it came with its own map
                places = lens.unlimited(rays) if isinstance(lens, Brown) else lens.distort(rays, 1.0)
        return np.asarray(places * self.focal + self.centre)

    # ---- fitted ------------------------------------------------------------------------------------------------------

    @classmethod
    def fitted(cls, start: ForeignCamera, rays: Array, pixels: Array) -> ForeignCamera:
        """Return the camera of the start's model that shows rays (N, 3) closest to pixels (N, 2)."""
        count = len(start.coefficients)
        numbers = np.array([*start.focal, *start.centre, *start.coefficients])
        sizes = np.array([start.focal[0]] * 2 + [start.focal[0]] * 2 + [1.0] * count)
        ahead = np.full(len(rays), fill_value=True) if start.model in _FISHEYES else _ahead(rays)

        def made(v: Array) -> ForeignCamera:
            return replace(start, focal=_two(v[:2]), centre=_two(v[2:4]), coefficients=tuple(v[4:].tolist()))

        def residuals(v: Array) -> Array:
            if min(v[:2]) <= 0.0 or not np.all(np.isfinite(v)):
                return np.full(2 * np.count_nonzero(ahead), np.inf)
            return np.asarray((made(v).project_rays(rays[ahead]) - pixels[ahead]).ravel())

        end = made(least_squares(residuals, numbers, sizes))
        return replace(end, error_px=_error(end.project_rays(rays), pixels))

    @np.errstate(over="ignore", invalid="ignore")  # where it shows nothing
    def camera(self) -> tuple[Camera, tuple[float, float]]:
        """Return the camera as ours, and how far that is off over the image: root mean square and largest distance, px,
        0 where the lens is one of ours.

        Raises:
            InputError: it shows nothing of its image, or no lens of ours is near it.
        """
        pose, lens, (fx, fy) = self.pose, self.lens, self.focal
        if lens is not None:
            return Camera(self.image_size, fx, self.centre, lens, fy / fx, pose), (0.0, 0.0)
        width, height = self.image_size
        rays = _all_directions()
        seen = self.project_rays(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
        radius = np.linalg.norm(seen - self.centre, axis=2)
        growing = np.logical_and.accumulate(np.diff(radius, axis=1, prepend=-1.0) > 0.0, axis=1)
        inside = np.all((seen >= -0.5) & (seen <= np.array([width, height]) - 0.5), axis=2)
        chosen = growing & inside
        if np.count_nonzero(chosen) < 20:
            raise InputError(f"its {self.model} model projects nothing into its image: correct its numbers")
        pixels, shown = seen[chosen], rays[chosen]
        fits = [fit for lens in _LENSES if (fit := lens_fitted(self, lens, shown, pixels)) is not None]
        if not fits:
            raise InputError(f"no lens of ceres-cal approximates its {self.model} model: correct its numbers")
        camera, error_px = min(fits, key=lambda fit: fit[1][0])
        return camera.at(pose), error_px


def camera_matrix(fx: float, fy: float, cx: float, cy: float) -> Array:
    """K, (3, 3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _focal(camera: Camera) -> tuple[float, float]:
    return camera.phi, camera.phi * camera.aspect


def _two(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _error(pixels: Array, wanted: Array) -> tuple[float, float]:
    """Root mean square and largest distance; infinite where there is no pixel."""
    return rms_and_largest(np.linalg.norm(pixels - wanted, axis=1))


def _all_directions() -> Array:
    """(directions, angles, 3) rays from the axis outwards to 89 degrees."""
    angles, directions = 120, 24  # numbers of rays, to see what a foreign model shows
    angle = np.radians(np.linspace(0.0, 89.0, angles))
    turn = np.linspace(0.0, 2.0 * np.pi, directions, endpoint=False)[:, None]
    across = np.sin(angle)
    depth = np.broadcast_to(np.cos(angle), (directions, angles))
    return np.stack([across * np.cos(turn), across * np.sin(turn), depth], axis=-1)


def lens_fitted(
    foreign: ForeignCamera, lens: Lens, rays: Array, pixels: Array
) -> tuple[Camera, tuple[float, float]] | None:
    """Return the camera with a lens of ours that is closest to a foreign one, and how far it is off; None where it has
    no answer for some of what the foreign one shows.
    """
    unit = 0.5 * float(np.hypot(*foreign.image_size))
    scales = lens.scales(unit)
    (fx, fy), centre = foreign.focal, foreign.centre

    def project(v: Array) -> Array:
        model = lens.with_values(v[4:] / scales)
        return np.asarray(model.distort(rays, v[0]) * (1.0, v[1]) + v[2:4])

    def residuals(v: Array) -> Array:
        if min(v[:2]) <= 0.0:
            return np.full(pixels.size, np.inf)
        off = (project(v) - pixels).ravel()
        return np.where(np.isfinite(off), off, 1e6)

    start = np.array([fx, fy / fx, *centre, *np.zeros(len(scales))])
    sizes = np.array([fx, 1.0, fx, fx, *np.ones(len(scales))])
    end = least_squares(residuals, start, sizes)
    model = lens.with_values(end[4:] / scales)
    reach = float(np.max(np.hypot(pixels[:, 0] - end[2], (pixels[:, 1] - end[3]) / end[1])))
    if model.monotone_radius(end[0]) < reach:
        return None
    camera = Camera(foreign.image_size, float(end[0]), _two(end[2:4]), model, float(end[1]))
    return camera, _error(project(end), pixels)


def nearest(camera: Camera, lens: Lens) -> Camera:
    """Return a camera with another lens, with its coefficients and the other intrinsics fitted over the image.

    Raises:
        InputError: that lens would fold inside the image.
    """
    if (lens.kind, lens.names, camera.skew) == (camera.lens.kind, camera.lens.names, 0.0):
        return camera
    start = ForeignCamera(camera.image_size, _focal(camera), camera.principal_point, FISHEYE, (0.0,) * 4)
    pixels = image_grid(camera.image_size)
    rays = camera.rays(pixels)
    known = rays[:, 2] > 0.0
    fit = lens_fitted(start, lens, rays[known], pixels[known])
    if fit is None:
        raise InputError(f"no {lens.kind} lens approximates this camera: it would fold over inside the image")
    return fit[0].at(camera.cam_from_world)


def opencv_models(camera: Camera) -> tuple[str, ...]:
    """Return OpenCV's models that may fit a camera: its fisheye where that is our lens or rays across are seen."""
    is_one = ForeignCamera.coefficients_of(camera.lens, FISHEYE) is not None
    rays = camera.rays(image_grid(camera.image_size))
    fisheye = is_one or bool(np.any(np.isfinite(rays[:, 0]) & ~_ahead(rays)))
    return (FISHEYE,) if fisheye else ("opencv5", "opencv8", "opencv12")


def _ahead(rays: Array) -> Mask:
    """(N,) which unit rays models of tangents can show: the tangents of shallower ones grow beyond all functions."""
    shallowest = 0.1
    return np.asarray(rays[:, 2] > shallowest)


def image_grid(image_size: tuple[int, int], steps: tuple[int, int] = _GRID) -> Array:
    """(N, 2) pixels evenly over an image, up to its edges."""
    return grid_places(*(np.linspace(-0.5, size - 0.5, count) for size, count in zip(image_size, steps, strict=True)))


def to_opencv(camera: Camera) -> OpenCvCamera:
    """See `Camera.to_opencv`."""
    foreign, pose = ForeignCamera.of(camera, *opencv_models(camera)), camera.cam_from_world
    vector, distortion = rotation_log(pose.rotation), np.array(foreign.coefficients)
    fisheye = foreign.model == FISHEYE
    return OpenCvCamera(foreign.matrix, distortion, vector, pose.translation.copy(), fisheye, foreign.error_px)
