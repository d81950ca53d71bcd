"""Accuracy of places that pixels show at a height, in metres, and of a camera's own image, in pixels.

Both are the calibration's own share: the noise of the pixel in question comes on top, and model errors (a lens with too
few coefficients, a field painted off its nominal position) are not included.

A camera that turns slightly shows the same picture with another principal point. So the best turn is subtracted from an
image's errors, by least squares with each place weighted by its accuracy: a corner that nobody observed determines no
turn. What remains is due to the lens and the focal length, whatever the camera's pose; the maps over the field include
the pose.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import numpy as np

from ceres_cal.base import Array, InputError, Mask, Pose, brief, drawn, grid_places, largest
from ceres_cal.base.frozen import Frozen, cached_property, replace
from ceres_cal.posterior.bent import weak_axes
from ceres_cal.posterior.mixture import Mixture, Reading
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import Estimate, PixelSlopes, intrinsic_names, moved, pixel_slopes
from ceres_cal.problem.information import STATION_QUANTITIES, Information, Key, over
from ceres_cal.scene.camera import Camera, in_image


class PointSpread(Frozen):
    """Positions of N located points with their uncertainty.

    Attributes:
        located: (N, 2) m, by the estimate.
        low, high: (N, 2) m, 95 % bounds of x and of y separately; infinite where unknown.
        radius_95_m: (N,) radius within which 95 % of the errors lie. sd_m: (N,) root mean square length of the error.
    """

    located: Array
    low: Array
    high: Array
    radius_95_m: Array
    sd_m: Array


def station_keys(estimate: Estimate, posterior: Posterior, station: str) -> tuple[Key, ...]:
    """Return the keys of a station and of its camera.

    Raises:
        InputError: no such station, or one that was held, so that its pose in the world is unknown.
    """
    if not posterior.knows_station(estimate.station_name(station)):
        raise InputError(f"station {station!r} defines the world, so it has no map of a field: observe a field with it")
    return posterior.keys_of(estimate, station)


def locate_slopes(estimate: Estimate, keys: Sequence[Key], station: str, pixels: Array, height_m: float) -> Array:
    """(N, 2, K) derivatives of the places that pixels (N, 2) show on the plane z = height_m, by each of the keys; NaN
    where a pixel shows none.

    A place moves such that its image stays at the pixel: by the inverse of the image's derivatives by places.
    """
    camera = estimate.camera_at(station)
    located = camera.locate(pixels, height_m)
    by = pixel_slopes(camera, np.column_stack([located, np.full(len(located), height_m)]))
    names = intrinsic_names(camera.lens)
    moving = np.zeros((len(pixels), 2, len(keys)))
    for k, key in enumerate(keys):
        if key[:2] == ("station", station):
            axis = STATION_QUANTITIES.index(key.quantity)
            moving[:, :, k] = -by.places[:, :, axis] if axis < 3 else by.turns[:, :, axis - 3]
        elif key[:2] == ("camera", estimate.stations[station].camera):
            moving[:, :, k] = by.intrinsics[:, :, names.index(key.quantity)]
    slopes, known = np.full(moving.shape, np.nan), np.isfinite(by.places[:, 0, 0])
    slopes[known] = -np.linalg.solve(by.places[known, :, :2], moving[known])
    return slopes


def spread_of_points(
    estimate: Estimate, posterior: Posterior, station: str, pixels: Array, height_m: float
) -> PointSpread:
    """Return the places at a height that pixels (N, 2) show, with their uncertainty.

    Raises:
        InputError: see `station_keys`.
    """
    station_keys(estimate, posterior, station)
    located = estimate.camera_at(station).locate(pixels, height_m)
    places = located_by(estimate, station, pixels, height_m)
    known = read(posterior, estimate, places, estimate.stations[station].camera)
    return PointSpread(located, located + known.low, located + known.high, known.radius_95, known.sd)


def located_by(near: Estimate, station: str, pixels: Array, height_m: float) -> Functional:
    """Return the functional of the places at a height that pixels (N, 2) of a station show; `near` gives its height."""

    def values(there: Estimate) -> Array:
        return there.camera_at(station).locate(pixels, height_m)

    def on_floor(there: Estimate) -> Array:
        """A ray shows at a height what it shows on the floor, nearer to the camera's foot by this share."""
        share = height_m / float(near.camera_at(station).position[2])
        return (1.0 - share) * there.camera_at(station).locate(pixels, 0.0)

    def slopes(there: Estimate, keys: Sequence[Key]) -> Array:
        return locate_slopes(there, keys, station, pixels, height_m)

    return Functional(values, slopes, values if height_m == 0.0 else on_floor)


def _plot(self: FieldMap | ImageMap, ax: Any = None) -> Any:
    """Draw the map of 95 % radii into Matplotlib's Axes, in the colours of the report; returns the Axes."""
    return drawn("maps.plot_map", self, ax)


class FieldGrid(Frozen):
    """A grid on the field at one height: all combinations of x_m (X,) and y_m (Y,)."""

    height_m: float
    x_m: Array
    y_m: Array

    @property
    def shape(self) -> tuple[int, int]:
        """(Y, X)."""
        return len(self.y_m), len(self.x_m)

    @property
    def places(self) -> Array:
        """(Y * X, 2) m, row by row."""
        return grid_places(self.x_m, self.y_m)

    def place_of_largest(self, values: Array) -> tuple[float, float]:
        """Return the place of the largest of the non-negative values (Y, X), m; NaN is ignored."""
        x, y = self.places[np.argmax(np.nan_to_num(values, nan=-1.0, posinf=1e300))].tolist()
        return x, y


class ErrorMap(FieldGrid, ABC):
    """Errors of one station over a grid."""

    @property
    @abstractmethod
    def errors_mm(self) -> Array:
        """(Y, X); NaN where the image does not show the place."""

    @property
    def mean_mm(self) -> float:
        """Mean over the places that the image shows; NaN where it shows none."""
        visible = self.errors_mm[~np.isnan(self.errors_mm)]
        return float(np.mean(visible)) if len(visible) else np.nan

    @property
    def worst_mm(self) -> float:
        """Largest error over the places that the image shows."""
        return largest(self.errors_mm)


class FieldMap(ErrorMap):
    """Accuracy of the points that one station locates at one height, over a grid.

    Attributes:
        sd_mm, radius_95_mm: (Y, X) as in `PointSpread`; NaN where the image does not show the place, infinite where it
            is not known.
    """

    station: str
    sd_mm: Array
    radius_95_mm: Array
    __repr__, plot = brief, _plot

    @classmethod
    def of_visible(cls, grid: FieldGrid, station: str, visible: Mask, sd_m: Array, radius_95_m: Array) -> FieldMap:
        """Return the map over a grid, of whose places (Y * X,) the visible ones have these errors."""
        values = np.full((2, len(visible)), np.nan)
        values[:, visible] = 1e3 * sd_m, 1e3 * radius_95_m
        return cls(grid.height_m, grid.x_m, grid.y_m, station, *values.reshape(2, *grid.shape))

    @property
    def errors_mm(self) -> Array:
        return self.sd_mm

    @property
    def worst_place_m(self) -> tuple[float, float]:
        """Place of the largest error."""
        return self.place_of_largest(self.sd_mm)


def visible_pixels(estimate: Estimate, station: str, places: Array, height_m: float) -> Array:
    """Return the pixels (N, 2) of places (N, 2) m at a height; NaN where the station's image does not show them."""
    camera = estimate.camera_at(station)
    pixels = camera.project(np.column_stack([places, np.full(len(places), height_m)]))
    inside = in_image(pixels, camera.image_size)
    # A ray that reaches the plane from below does not show it, and beyond the lens's rim a pixel shows another place.
    back = camera.locate(pixels, height_m)
    with np.errstate(invalid="ignore"):
        inside &= np.linalg.norm(back - places, axis=1) < 1e-6
    return np.where(inside[:, None], pixels, np.nan)


def field_map(estimate: Estimate, posterior: Posterior, station: str, grid: FieldGrid) -> FieldMap:
    """Return a station's map of accuracy over a grid.

    Raises:
        InputError: see `station_keys`.
    """
    station_keys(estimate, posterior, station)
    pixels, camera = visible_pixels(estimate, station, grid.places, grid.height_m), estimate.stations[station].camera
    visible = np.isfinite(pixels[:, 0])
    known = read(posterior, estimate, located_by(estimate, station, pixels[visible], grid.height_m), camera)
    return FieldMap.of_visible(grid, station, visible, known.sd, known.radius_95)


_STEPS = 32  # of the grid along the longer side


class ImageMap(Frozen):
    """Accuracy of one camera's image, over a grid.

    Attributes:
        x_px (X,), y_px (Y,): of the grid. radius_95_px: (Y, X) radius within which 95 % of the errors lie; infinite if
            unknown, NaN beyond the lens's monotone radius.
    """

    camera: str
    x_px: Array
    y_px: Array
    radius_95_px: Array
    __repr__, plot = brief, _plot


class Picture(Frozen):
    """The rays of a camera at N pixels, and the pixels at which other cameras show them.

    Attributes:
        weights: (N,) of the pixels in the turn that is subtracted; 0: no turn is subtracted.
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
        """Return what another camera shows at the same pixels."""
        camera = camera.at(Pose.identity())
        return self if camera == self.camera else replace(self, camera=camera)

    def weighted(self, weights: Array) -> Picture:
        """Return a copy with other weights."""
        picture = replace(self, weights=weights)
        vars(picture).update({"_rays": self._rays, "_by": self._by})  # expensive to compute
        return picture

    @property
    def shown(self) -> Mask:
        """(N,) whether the lens has a ray for the pixel."""
        return np.isfinite(self._by.turns[:, 0, 0])

    @property
    def _turns(self) -> Array:
        """(2 N, 3) px per rad about the camera's axes; 0 where the lens has no ray."""
        return np.nan_to_num(self._by.turns.reshape(-1, 3))

    def shift(self, other: Camera) -> Array:
        """(N, 2) px from where this camera shows its rays to where another one shows them, minus the best turn; NaN
        where either shows nothing.
        """
        if other == self.camera:
            return np.where(np.isfinite(self._rays[:, :2]), 0.0, np.nan)
        shift = other.project(self._rays) - self.pixels
        known = np.isfinite(shift[:, 0])
        return shift - self._turned(np.nan_to_num(shift)[:, :, None], known)[:, :, 0]

    def slopes(self, quantities: Sequence[str]) -> Array:
        """(N, 2, K) px per unit of some intrinsics, minus the best turn; 0 where the lens shows nothing."""
        names = intrinsic_names(self.camera.lens)
        moving = np.nan_to_num(self._by.intrinsics[:, :, [names.index(name) for name in quantities]])
        return moving - self._turned(moving, self.shown)

    def _turned(self, moving: Array, known: Mask) -> Array:
        """(N, 2, K) the part of displacements (N, 2, K) px that a turn explains."""
        turns, weights = self._turns, np.repeat(self.weights * known, 2)[:, None]
        flat, weighted = moving.reshape(len(weights), moving.shape[-1]), weights**2 * turns
        turn = np.linalg.lstsq(weighted.T @ turns, weighted.T @ flat, rcond=None)[0]
        return np.asarray((turns @ turn).reshape(moving.shape))


def image_grid(image_size: tuple[int, int]) -> tuple[Array, Array]:
    """Return x (X,) and y (Y,) of a grid over an image, px, from its first pixels to its last."""
    steps = (max(round(_STEPS * side / max(image_size)), 2) for side in image_size)
    x, y = (np.linspace(0.0, side - 1.0, count + 1) for side, count in zip(image_size, steps, strict=True))
    return x, y


def image_map(estimate: Estimate, posterior: Posterior, camera: str) -> ImageMap:
    """Return the map of accuracy over a camera's image.

    Raises:
        InputError: no such camera.
    """
    exact_px = 1e-6  # places known better than this have equal weight in the turn
    if camera not in estimate.cameras:
        raise InputError(f"there is no camera {camera!r}: it is one of {', '.join(estimate.cameras)}")
    own = estimate.cameras[camera].at(Pose.identity())
    x, y = image_grid(own.image_size)
    pixels = grid_places(x, y)

    picture = Picture(own, pixels, 0.0)
    with_turns = read(posterior, estimate, shown_by(camera, picture), camera).sd
    picture = picture.weighted(1.0 / np.maximum(with_turns, exact_px))
    radius = read(posterior, estimate, shown_by(camera, picture), camera).radius_95
    return ImageMap(camera, x, y, np.where(picture.shown, radius, np.nan).reshape(len(y), len(x)))


def shown_by(camera: str, picture: Picture) -> Functional:
    """Return the functional of the px by which a camera shows its rays elsewhere than a picture of it does."""

    def slopes(there: Estimate, keys: Sequence[Key]) -> Array:
        own = [key for key in keys if key[:2] == ("camera", camera)]
        return over(picture.of(there.cameras[camera]).slopes([key.quantity for key in own]), own, keys)

    return Functional(lambda there: picture.shift(there.cameras[camera].at(Pose.identity())), slopes)


# ---- distributions of functions of an estimate ---------------------------------------------------------------------

# The same code serves places on the field, pixels, and the seam of two cameras: each component of the mixture gives a
# value and its covariance.


class Functional(Frozen):
    """A function of an estimate: N pairs of numbers, and their derivatives.

    Attributes:
        values: returns (N, 2) at an estimate; NaN where nothing is shown. slopes: returns (N, 2, K) at an estimate, by
            some keys (K).
        on_floor: returns (N, 2) the part of the values that phi does not change along a valley; None: there is none.
    """

    values: Callable[[Estimate], Array]
    slopes: Callable[[Estimate, Sequence[Key]], Array]
    on_floor: Callable[[Estimate], Array] | None = None


def read(posterior: Posterior, estimate: Estimate, shown: Functional, camera: str = "") -> Reading:
    """Return the distribution of a functional by the posterior.

    Args:
        camera: the only camera that it depends on; "" where it depends on several.
    """
    mixture, width = posterior.mixture(camera), posterior.half_width
    values, covariances = of_components(mixture, estimate, shown, posterior.lenses, width, camera)
    # Components that show nothing at a place: with so small a share of all they do not change its 95 % radius by 2 %.
    negligible = 0.005
    hidden = np.isnan(values).any(axis=2) | np.isnan(covariances).any(axis=(2, 3))
    lost = np.asarray(mixture.weights @ hidden > negligible * np.sum(mixture.weights))
    values[hidden | lost], covariances[hidden | lost] = 0.0, 0.0
    return Reading(*mixture.refined(values, covariances), lost, width, mixture.is_followed)


def of_components(
    mixture: Mixture, estimate: Estimate, shown: Functional, lenses: Sequence[Estimate], width: float, camera: str
) -> tuple[Array, Array]:
    """(C, N, 2) values of each component, relative to the estimate's, and (C, N, 2, 2) covariances.

    Values with another lens differ from those of the same component with the chosen lens as the lens does, wherever it
    shows anything. What changes along a valley changes with a lens's phi, too, which the valley already includes: there
    the numbers of the component say it, and the lens says only what it shows on the floor.
    """
    here, known = shown.values(estimate), dict[int, Array]()
    values = np.full((len(mixture.at), *here.shape), np.nan)
    part = shown.on_floor if mixture.is_followed else shown.values
    as_lenses = {} if part is None else mixture.lenses
    off = [part(lens) - part(lenses[0]) for lens in lenses] if part and as_lenses else []

    owners = {camera} | {name for name, one in estimate.stations.items() if one.camera == camera}
    own = np.array([not camera or key.owner in owners for key in mixture.keys], dtype=bool)

    def there(component: int) -> Estimate:
        step = mixture.steps[component]
        return moved(estimate, mixture.keys, step) if np.any(step) else estimate

    def once(function: Callable[[Estimate], Array]) -> Callable[[int], Array]:
        """Components of a rig may differ by other cameras' numbers alone."""
        found = dict[bytes, Array]()

        def at(component: int) -> Array:
            step = mixture.steps[component, own].tobytes()
            if step not in found:
                found[step] = function(there(component))
            return found[step]

        return at

    shown_at, part_at = once(shown.values), once(part or shown.values)
    for component, number in enumerate(mixture.at.tolist()):
        like_lens = part is shown.values and component in as_lenses and np.isfinite(off[as_lenses[component][0]]).all()
        if like_lens and number in known:
            continue
        near = estimate
        with suppress(InputError):  # reads: "unknown" at these places of the map
            values[component] = shown_at(component) - here
            near = there(component) if number not in known else near
        if number not in known:
            far = width if mixture.is_followed else 0.0
            known[number] = _covariance(mixture.information[number], near, shown, far)
    for component, (lens, alike) in as_lenses.items():
        as_lens = values[alike]
        if part and part is not shown.values:
            as_lens = np.full_like(here, np.nan)
            with suppress(InputError):  # reads: "unknown" at these places of the map
                as_lens = values[component] - part_at(component) + part_at(alike)
        values[component] = np.where(np.isfinite(off[lens]), as_lens + off[lens], values[component])
    return values, np.array([known[number] for number in mixture.at.tolist()])


def _covariance(information: Information, there: Estimate, shown: Functional, width: float) -> Array:
    """(N, 2, 2) covariance within a component; at a node of a valley including curvature across it.

    Args:
        width: standard deviations at which curvature is evaluated; 0 for none.
    """
    slopes = shown.slopes(there, information.keys)
    covariance = information.spread.through(slopes)
    if width > 0.0:
        axes = width * weak_axes(information, there, information.keys).T
        here = shown.values(there)
        for step in (*axes, *-axes):
            off = np.full(here.shape, np.inf)
            with suppress(InputError):  # reads: "unknown" at these places of the map
                there_too = shown.values(moved(there, information.keys, step))
                off = np.nan_to_num(there_too - here - slopes @ step, nan=np.inf)
            far = np.isinf(off).any(axis=1)
            off[far] = 0.0
            covariance = covariance + 0.5 * off[:, :, None] * off[:, None, :] / width**2
            covariance[far] = np.diag([np.inf, np.inf])
    return covariance
