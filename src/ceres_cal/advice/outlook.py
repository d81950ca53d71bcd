"""What a station's map would be if more were known: the worst and the mean error, in mm, at one height."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ceres_cal.parameters import Estimate
from ceres_cal.quantities import Key, moved, sigma_limits
from ceres_cal.spread import Spread
from ceres_cal.transforms import Array
from ceres_cal.uncertainty import FieldMap, Posterior, Profile
from ceres_cal.uncertainty.maps import locate_slopes, shown_pixels, station_keys

_BENT = 0.05  # relative sigma of phi up to which the quadratic picture holds (`uncertainty.assess` leaves it there)
_PLACES = 7  # of a valley at which a promise is worked out


@dataclass(frozen=True, eq=False)
class Errors:
    """Largest and mean standard deviation of located points over what the image shows, mm; infinite where unknown."""

    worst_mm: float
    mean_mm: float


@dataclass(frozen=True, eq=False)
class Outlook:
    """One station at one height.

    Attributes:
        today: its map. keys: (K) the posterior's own that it depends on. slopes: (N, 2, K) by them of where the N
            places that the image shows are located.
    """

    estimate: Estimate
    posterior: Posterior
    today: FieldMap
    keys: tuple[Key, ...]
    slopes: Array

    @classmethod
    def of(cls, estimate: Estimate, posterior: Posterior, today: FieldMap) -> Outlook:
        """The outlook from today's map.

        Raises:
            InputError: see `maps.station_keys`.
        """
        keys = station_keys(estimate, posterior, today.station)
        return cls(estimate, posterior, today, keys, _slopes(estimate, today, keys))

    @property
    def before(self) -> Errors:
        """Today's errors."""
        return Errors(self.today.worst_mm, self.today.mean_mm)

    @property
    def profile(self) -> Profile | None:
        """The valley along phi that today's map follows, where it does."""
        return self.posterior.profiles.get(self.estimate.stations[self.today.station].camera)

    def after(self, added: Array) -> Errors:
        """The errors with information (P, P) added.

        By the quadratic picture at the estimate. Where phi was followed along its profile and would have to be still,
        today's errors shrink as the quadratic ones do.
        """
        quadratic = _errors(self.posterior.information + added, self.posterior.keys, self.keys, self.slopes)
        if self.profile is None or self.settles_phi(added):
            return quadratic
        now = _errors(self.posterior.information, self.posterior.keys, self.keys, self.slopes)
        with np.errstate(invalid="ignore"):
            worst = self.before.worst_mm * min(float(np.divide(quadratic.worst_mm, now.worst_mm)), 1.0)
            mean = self.before.mean_mm * min(float(np.divide(quadratic.mean_mm, now.mean_mm)), 1.0)
        return Errors(worst, mean) if np.isfinite(now.worst_mm) else quadratic

    def settles_phi(self, added: Array) -> bool:
        """Whether information (P, P) added leaves phi well enough known for the quadratic picture."""
        camera = self.estimate.stations[self.today.station].camera
        place = next((i for i, k in enumerate(self.posterior.keys) if k[:3] == ("camera", camera, "phi")), None)
        if place is None:
            return True
        sd = Spread.of(self.posterior.information + added, sigma_limits(self.posterior.keys)).sd[place]
        return bool(sd <= _BENT * self.estimate.cameras[camera].phi)

    @cached_property
    def possible(self) -> tuple[tuple[int, Estimate], ...]:
        """Some places of the valley within its 95 % bounds, by number; none where phi is not followed."""
        if self.profile is None:
            return ()
        keys, steps = self.profile.keys, self.profile.steps
        within = np.flatnonzero(self.profile.rises <= self.posterior.half_width**2)
        some = within[np.unique(np.linspace(0, len(within) - 1, _PLACES).round().astype(int))]
        return tuple((int(place), moved(self.estimate, keys, steps[place])) for place in some)

    def along_valley(self, told_at: Callable[[Estimate], Array]) -> Iterator[tuple[float, Errors]]:
        """phi, px, and the errors there with information `told_at` added, over what phi may be by its 95 % bounds.

        There the field itself is taken to tell phi nothing but the valley's direction, which is on the careful side.
        """
        profile = self.profile
        assert profile is not None
        at = [self.posterior.keys.index(key) for key in profile.keys]
        tangents = np.gradient(profile.steps[:, 1:], profile.steps[:, 0], axis=0)
        for place, there in self.possible:
            across, along = profile.information[place], tangents[place]
            coupling = -across @ along
            told = np.block([[np.atleast_2d(along @ across @ along), coupling[None]], [coupling[:, None], across]])
            slopes = _slopes(there, self.today, self.keys)
            errors = _errors(told + told_at(there)[np.ix_(at, at)], profile.keys, self.keys, slopes)
            yield float(profile.phi[place]), errors


def _errors(information: Array, every: tuple[Key, ...], keys: tuple[Key, ...], slopes: Array) -> Errors:
    """The errors by slopes (N, 2, K), of information about all the keys, those of the slopes among them."""
    whole, at = Spread.of(information, sigma_limits(every)), [every.index(key) for key in keys]
    own = Spread(whole.covariance[np.ix_(at, at)], whole.unknown[at], whole.scale[at])
    covariance = own.through(slopes)
    sd = 1e3 * np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    return Errors(float(np.max(sd)), float(np.mean(sd)))


def _slopes(estimate: Estimate, grid: FieldMap, keys: tuple[Key, ...]) -> Array:
    """(N, 2, K) of the N places of the grid that the image shows."""
    x, y = np.meshgrid(grid.x_m, grid.y_m)
    pixels = shown_pixels(estimate, grid.station, np.column_stack([x.ravel(), y.ravel()]), grid.height_m)
    return locate_slopes(estimate, keys, grid.station, pixels[np.isfinite(pixels[:, 0])], grid.height_m)
