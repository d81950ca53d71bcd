"""What a calibration knows of its own numbers: kept as information, read as standard deviations."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.errors import InputError
from ceres_cal.base.spread import Spread, without
from ceres_cal.model.quantities import Key, pose_keys, sigma_limits
from ceres_cal.solve import Eliminated, Information
from ceres_cal.uncertainty.profile import Profile

_NORMAL_95 = 1.959963984540054  # half width of the 95 % interval of a standard normal


@dataclass(frozen=True, eq=False)
class Posterior:
    """What observations and priors say together, about the solution, at the noise that was estimated.

    It is an information matrix because a covariance does not exist where something is unknown. It holds as far as the
    model does: a lens with too few coefficients or a field painted amiss are not in it.

    Attributes:
        keys: (P) the numbers that are shared. information: (P, P).
        placements: name -> (6, 6) information about each placement that one station alone sees, all else integrated
            out, in the order of `pose_keys`.
        freedom: spare equations behind the estimated noise; infinite where the sigmas were taken as stated.
        profiles: camera -> the valley along its phi, where that is too little known for the quadratic picture.
    """

    keys: tuple[Key, ...]
    information: Array
    placements: Mapping[str, Array] = field(default_factory=dict)
    freedom: float = np.inf
    profiles: Mapping[str, Profile] = field(default_factory=dict)

    @cached_property
    def spread(self) -> Spread:
        """Covariance and unknown directions of the shared numbers."""
        return Spread.of(self.information, sigma_limits(self.keys))

    @cached_property
    def covariance(self) -> Array:
        """(P, P) of the shared numbers; where one is unknown, infinity on the diagonal and NaN beside it."""
        return self.spread.matrix

    @cached_property
    def sd(self) -> Array:
        """(P,) standard deviations in the units of the keys, infinite where unknown."""
        return self.spread.sd

    @property
    def half_width(self) -> float:
        """Standard deviations from the middle to either end of a 95 % interval: Student's t of `freedom`."""
        return student_95(self.freedom)

    @cached_property
    def bounds(self) -> Array:
        """(P, 2) 95 % bounds of the shared numbers, from the estimate; infinite on a side that is open."""
        found = self.half_width * self.sd[:, None] * (-1.0, 1.0)
        for profile in self.profiles.values():
            across = [Spread.of(told, sigma_limits(profile.keys[1:])).sd for told in profile.information]
            sds = np.column_stack([np.zeros(len(across)), across])
            at = [self.keys.index(key) for key in profile.keys]
            found[at] = np.column_stack(profile.bounds(profile.steps, sds, self.half_width))
        return np.asarray(found)

    def place(self, kind: str, owner: str, quantity: str) -> int:
        """Where a number is among the keys.

        Raises:
            InputError: it is not: held, or not there at all.
        """
        for place, key in enumerate(self.keys):
            if key[:3] == (kind, owner, quantity):
                return place
        raise InputError(f"{kind} {owner!r} has no free number {quantity!r}: it was held, or is not there")

    def sd_of(self, kind: str, owner: str, quantity: str) -> float:
        """Standard deviation of one shared number, in its key's unit; 0 is never one, infinity means unknown.

        Raises:
            InputError: it is not a free number.
        """
        return float(self.sd[self.place(kind, owner, quantity)])

    def placement(self, name: str) -> Spread:
        """What is known of a placement's six numbers (`quantities.PLACEMENT_QUANTITIES`).

        Raises:
            InputError: no such placement, or it was held.
        """
        keys = pose_keys("placement", name)
        if name in self.placements:
            return Spread.of(self.placements[name], sigma_limits(keys))
        at = [place for place, key in enumerate(self.keys) if key in keys]
        if len(at) != 6:
            raise InputError(f"placement {name!r} has no free pose: it was held, or is not there")
        return Spread.of(self.marginal(np.array(at)), sigma_limits(keys))

    def marginal(self, places: Indices) -> Array:
        """(n, n) information about the numbers at these places, all others integrated out."""
        others = np.setdiff1d(np.arange(len(self.keys)), places)
        here = self.information[np.ix_(places, places)]
        coupling = self.information[np.ix_(others, places)]
        if not len(others):
            return np.asarray(here)
        limits = sigma_limits([self.keys[place] for place in others])
        return without(here, coupling, self.information[np.ix_(others, others)], limits)


def student_95(freedom: float) -> float:
    """Half width of the 95 % interval of Student's t, by the series of Cornish and Fisher: 0.1 % from 5 degrees on."""
    z, n = _NORMAL_95, max(freedom, 1.0)
    terms = (
        (z**3 + z) / 4.0,
        (5.0 * z**5 + 16.0 * z**3 + 3.0 * z) / 96.0,
        (3.0 * z**7 + 19.0 * z**5 + 17.0 * z**3 - 15.0 * z) / 384.0,
    )
    return z + sum(term / n**power for power, term in enumerate(terms, start=1))


def make_posterior(found: Information, freedom: float) -> Posterior:
    """The posterior of what was told, placements included."""
    shared = Posterior(found.keys, found.matrix, {}, freedom)
    return Posterior(found.keys, found.matrix, _Placements(found.eliminated, shared), freedom)


@dataclass(frozen=True, eq=False)
class _Placements(Mapping[str, Array]):
    """Information about each eliminated placement, worked out when the first one is asked for."""

    eliminated: tuple[Eliminated, ...]
    shared: Posterior

    @cached_property
    def _information(self) -> dict[str, Array]:
        parts = ((part.names, _placement_information(part, self.shared)) for part in self.eliminated)
        return {name: matrix for names, matrices in parts for name, matrix in zip(names, matrices, strict=True)}

    def __getitem__(self, name: str) -> Array:
        return self._information[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._information)

    def __len__(self) -> int:
        return len(self._information)


def _placement_information(part: Eliminated, shared: Posterior) -> Array:
    """(S, 6, 6) information about each placement, everything shared integrated out.

    A placement follows the shared numbers by -G, and deviates from that by what its own observations leave open:
    covariance own^-1 + G C G^T where both exist, else the Schur complement of the two together.
    """
    regular = np.einsum("sij,sji->s", part.own, part.inverses) > 5.5  # the rank of own
    regular &= not shared.spread.unknown.shape[1]
    found, gains = np.empty_like(part.own), part.gains[regular]
    covariance = shared.spread.covariance[np.ix_(part.places, part.places)]
    found[regular] = np.linalg.inv(part.inverses[regular] + gains @ covariance @ np.swapaxes(gains, 1, 2))
    marginal = shared.marginal(part.places)
    limits = sigma_limits([shared.keys[place] for place in part.places])
    for s in np.flatnonzero(~regular):
        own, gain = part.own[s], part.gains[s]
        found[s] = without(own, gain.T @ own, marginal + gain.T @ own @ gain, limits)
    return np.asarray(0.5 * (found + np.swapaxes(found, 1, 2)))
