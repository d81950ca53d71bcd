"""The posterior of a calibration's numbers, stored as information and read as standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np

from ceres_cal.base import Array, Frozen, InputError, Mask, Spread, cached_property, field, replace, without
from ceres_cal.base.tails import NORMAL_95, student_95
from ceres_cal.base.words import did_you_mean
from ceres_cal.effects.dependence import Dependence, Scatter, scattered
from ceres_cal.posterior.mixture import FARTHER, Mixture
from ceres_cal.problem import (
    Estimate,
    Information,
    Key,
    Layout,
    layout_of,
    over,
    pose_keys,
    sigma_limits,
)
from ceres_cal.problem.quantities import difference
from ceres_cal.problem.reduced import PrivatePlacements, ReducedInformation

LEAST_PROBABILITY = 0.02
"""Probability from which on an alternative counts; below it, it makes no difference."""


class Posterior(Frozen):
    """The posterior: what observations and priors determine at the solution, with the estimated noise.

    It is stored as information because a covariance does not exist where something is unknown. Correlated errors are
    included as far as the residuals show them (`dependence`). Errors that all views have in common, such as a field
    painted off its nominal position, are not.

    Attributes:
        information: about the P shared numbers: the normal distribution of the normal equations with the second moments
            of the alternatives, which advice uses. A refit and a check use `normal`.
        placements: name -> information about each placement that one station alone sees, all else integrated out.
        degrees_of_freedom: spare equations behind the estimated noise; infinite where the sigmas were taken as stated.
        mixtures: camera -> distribution of its and its stations' numbers, where its phi was followed along its profile
            or a refit kept them; "" -> distribution of everything else, where it is no single normal distribution.
            Standard deviations, bounds and maps are computed from these.
        lenses: estimate with the chosen lens, and those with others that predict as well, from the same observations;
            components of the mixtures that are another lens show these. lens_information: about each of the others.
        stated: the part of the information that was known beforehand. It is never widened: see `wider`.
        by_model: information about the shared numbers by the model alone, with independent errors; None where that is
            `information` itself. dependence: basis of the difference; None where it was not estimated.
    """

    information: Information
    placements: Mapping[str, Information] = field(default_factory=dict)
    degrees_of_freedom: float = np.inf
    mixtures: Mapping[str, Mixture] = field(default_factory=dict)
    by_model: Information | None = None
    dependence: Dependence | None = None
    stated: Information = field(default_factory=Information.nothing)
    lenses: tuple[Estimate, ...] = ()
    lens_information: tuple[Information, ...] = ()

    @property
    def keys(self) -> tuple[Key, ...]:
        """(P) the shared numbers."""
        return self.information.keys

    @property
    def followed(self) -> tuple[str, ...]:
        """Cameras whose phi was followed along its profile."""
        return tuple(name for name, mixture in self.mixtures.items() if mixture.is_followed)

    @property
    def followed_phi(self) -> frozenset[Key]:
        """Keys of the phi of these cameras."""
        return frozenset(self.mixtures[name].keys[0] for name in self.followed)

    def mixture(self, camera: str = "") -> Mixture:
        """Return the distribution of a camera and its stations, or of everything but cameras whose phi was followed."""
        found = self.mixtures.get(camera) or self.mixtures.get("")
        return found or Mixture.of_one(self.information)

    def of(self, own: Mask) -> Posterior:
        """Return the posterior if one of these components (C,) of its only mixture is right."""
        return replace(self, mixtures={"": self.mixture().of(own)})

    def with_alternatives(
        self, keys: Sequence[Key], shifts: Sequence[Array], weights: Sequence[float], lenses: tuple[Estimate, ...] = ()
    ) -> Posterior:
        """Return the posterior with alternatives: shifts (S, K) of some numbers, with the probability of each.

        Where these follow other lenses, `lenses` are the estimate with the chosen one and those with each of them.
        Alternatives become components of the mixtures, each a shifted copy of all components, and enter the information
        by their second moments.
        """
        if not len(shifts):
            return self
        whole, likely = over(np.array(shifts), keys, self.keys), np.asarray(weights, dtype=float)
        limited = self._beside_stated(whole)
        numbers = range(1, len(lenses))
        mixtures = {"": self.mixture().shifted_also(likely, limited[:, None], numbers)}
        for name in self.followed:
            mine = self.mixtures[name]
            off = mine.off_valley(over(limited, self.keys, mine.keys))
            mixtures[name] = mine.shifted_also(likely, off[:, None])
        information = self.wider(self.information, lambda seen: seen.widened(np.sqrt(likely)[:, None] * whole))
        return replace(self._known_by(information, mixtures), lenses=self.lenses or lenses)

    def beside(self, known: Information, step: Array, weight: float, let_go: Collection[Key] = ()) -> Posterior:
        """Return the posterior with an alternative that has its own information about all numbers.

        Args:
            known: about all numbers under the alternative. step: (P,) their shift there. weight: its probability.
            let_go: statements that it does not accept.
        """
        mixtures = {"": self.mixture().beside(Mixture.of_one(known.given(self.keys), step), weight)}
        for name in self.followed:
            mine = self.mixtures[name]
            there = over(step, self.keys, mine.keys)
            mixtures[name] = mine.beside(_along_phi(mine, known.marginal(mine.keys), there), weight)
        loose = replace(self, stated=self.stated.without(let_go))
        return loose._known_by(loose._as_wide_as(self.information, [mixtures[""]]), {**self.mixtures, **mixtures})

    def widened(self, keys: Sequence[Key], shifts: Sequence[Array]) -> Posterior:
        """Return the posterior with further scatter of its numbers, by shifts (S, K) of some of them: each adds d d^T
        to the covariance of what the observations say, in every component.
        """
        if not len(shifts):
            return self
        whole = over(np.array(shifts), keys, self.keys)

        def wider(one: Information) -> Information:
            return self.wider(one, lambda seen: seen.widened(over(whole, self.keys, seen.keys)))

        mixtures = {name: mixture.with_information(wider) for name, mixture in self.mixtures.items()}
        return self._known_by(wider(self.information), mixtures)

    def _known_by(self, information: Information, mixtures: Mapping[str, Mixture]) -> Posterior:
        """Return a copy with other mixtures and the information that has their second moments."""
        placements = self.placements
        if isinstance(placements, _Placements):
            placements = replace(placements, shared=information)
        return replace(self, information=information, placements=placements, mixtures=mixtures)

    def _beside_stated(self, shifts: Array) -> Array:
        """(S, P) shifts, limited by what was stated: none is larger than its standard deviation."""
        if not np.any(self.stated.matrix):
            return shifts
        stated = self.stated.over(self.keys)
        moved = np.concatenate([self.information.beside(stated, shift[None]) for shift in shifts])
        with np.errstate(invalid="ignore"):  # if nearly all of it is stated, this is rounding
            room = np.sqrt(np.maximum(np.nan_to_num(self.stated_sd**2 - self.spread.sd**2, nan=np.inf), 0.0))
        return np.asarray(np.clip(moved, -room, room))

    def wider(self, information: Information, how: Callable[[Information], Information]) -> Information:
        """Return information about some of the numbers in which what observations say is widened, and what was stated
        is unchanged: so nothing is known worse than it was stated.

        Args:
            information: of everything. how: widens what the observations alone say.
        """
        stated = self.stated.over(self.keys).marginal(information.keys)
        return how(information.less(stated)) + stated

    def repeated(self, added: Information) -> Information:
        """Return what more observations of the same kind add to the information: they average out the noise that varies
        from one to the next, by the model alone, but not what widens the posterior.

        Args:
            added: about all of the numbers, from these observations by themselves.
        """
        if self.by_model is None:
            return added
        stated = self.stated.over(self.keys)
        seen, model = self.information.less(stated), self.by_model.less(stated)
        factor, excess = model.beyond(seen.spread.covariance)
        more = Information(self.keys, model.matrix / factor + added.over(self.keys).matrix)
        return Information(self.keys, more.widened(excess).matrix - seen.matrix)

    @cached_property
    def stated_sd(self) -> Array:
        """(P,) standard deviations by the statements alone, infinite where nothing was stated."""
        sd = np.full(len(self.keys), np.inf)
        sd[self.information.columns(self.stated.keys)] = self.stated.spread.sd
        return sd

    @property
    def spread(self) -> Spread:
        """Covariance and unknown directions of the shared numbers."""
        return self.information.spread

    @cached_property
    def normal(self) -> Information:
        """The normal distribution that represents all of it as a prior: in every direction at least as wide as the
        mixtures. With the normal equations alone, other observations of a valley with the same bend would agree with it
        only at the estimate, and would seem to determine phi.
        """
        return self._as_wide_as(self.information, self._read)

    @cached_property
    def normal_of_lens(self) -> Information:
        """`normal` if the chosen lens is right, for callers that evaluate the other lenses themselves."""
        if len(self.lenses) < 2:
            return self.normal
        return self._as_wide_as(self.of_lens, (mixture.chosen for mixture in self._read))

    @property
    def of_lens(self) -> Information:
        """The information by the normal equations if the chosen lens is right."""
        if len(self.lenses) < 2:
            return self.information
        alone = self.mixture().chosen
        return alone.information[int(alone.at[0])]

    def _as_wide_as(self, whole: Information, mixtures: Iterable[Mixture]) -> Information:
        for mixture in mixtures:
            shifts = whole.marginal(mixture.keys).beyond(mixture.covariance, 1.0)[1]
            whole = self.wider(whole, partial(Information.widened, shifts=over(shifts, mixture.keys, self.keys)))
        return whole

    def lens_weights(self, camera: str = "") -> tuple[float, ...]:
        """Return the probabilities of the lenses other than the chosen one, for a camera or for everything."""
        mixture = self.mixture(camera)
        of_lens = np.array([lens for lens, _ in mixture.lenses.values()], dtype=np.int64)
        weights = mixture.weights[np.array(list(mixture.lenses), dtype=np.int64)]
        return tuple(np.bincount(of_lens, weights, max(len(self.lenses), 1))[1:].tolist())

    @property
    def across(self) -> Information:
        """The information with phi held for cameras where it was followed: correlated numbers may be as open."""
        return self.information.given([key for key in self.keys if key not in self.followed_phi])

    @cached_property
    def covariance(self) -> Array:
        """(P, P) of the shared numbers; where one is unknown, infinity on the diagonal and NaN beside it."""
        return self.spread.matrix

    @cached_property
    def sd(self) -> Array:
        """(P,) standard deviations in the units of the keys, infinite where unknown."""
        sd = self.spread.sd.copy()
        for mixture in self._numbers:
            sd[self.information.columns(mixture.keys)] = mixture.sd
        return np.minimum(sd, self.stated_sd)

    @property
    def _read(self) -> Iterator[Mixture]:
        """The mixtures, those of single cameras last."""
        yield from (self.mixtures[name] for name in sorted(self.mixtures, key=bool))

    @cached_property
    def _numbers(self) -> tuple[Mixture, ...]:
        """The mixtures for reading single numbers: a component with another lens has that lens's own phi and poses, and
        coefficients if it is of the same kind. With the numbers by which the chosen lens shows the same, phi was known
        to 0.2 %, 20 standard deviations off, where a coefficient that the chosen lens lacks leaves it open to 5 %; and
        k1 to 0.7 %, 11 standard deviations off.
        """
        found = []
        for mixture in self._read:
            steps, numbers = mixture.steps.copy(), range(len(self.lenses) if mixture.lenses else 0)
            off = [self._off(lens, mixture.keys) for lens in numbers]
            for component, (lens, alike) in mixture.lenses.items():
                steps[component] = np.where(np.isfinite(off[lens]), steps[alike] + off[lens], steps[component])
            found.append(replace(mixture, steps=steps))
        return tuple(found)

    def _off(self, lens: int, keys: Sequence[Key]) -> Array:
        """(K,) phi, stations' poses and coefficients with a lens, relative to the chosen one; NaN for all else: for
        coefficients that this lens lacks, or of another kind; for numbers that are followed; for poses where phi is
        held, because lenses were compared with it free; and beside boards that several cameras see, because each lens
        was solved for without the other cameras. Phi is the focal length on the axis with every kind of lens, but one
        without a formula does not tell it: it was 953 px beside 685 and 720 with two formulas.
        """
        chosen, other, off = self.lenses[0], self.lenses[lens], np.full(len(keys), np.nan)
        if any(key.kind == "placement" for key in self.keys):
            return off
        alike = {name for name, one in other.cameras.items() if one.lens.kind == chosen.cameras[name].lens.kind}
        own = {("camera", name, "phi") for name in other.cameras}
        own |= {("camera", name, coefficient) for name in alike for coefficient in other.cameras[name].lens.names}
        own -= {key[:3] for key in self.followed_phi}
        for phi, stated in zip(self.keys, self.stated_sd.tolist(), strict=True):
            if phi.quantity == "phi" and (phi.owner in alike or not other.cameras[phi.owner].lens.roughness):
                owners = {("station", name) for name, one in other.stations.items() if one.camera == phi.owner}
                at = [i for i, key in enumerate(keys) if key[:2] in owners or (key[:2] == phi[:2] and key[:3] in own)]
                away = abs(other.cameras[phi.owner].phi - chosen.cameras[phi.owner].phi)
                share = min(1.0, stated / away) if away else 1.0  # its phi is no farther away than was stated
                off[at] = share * difference(other, chosen, [keys[i] for i in at])
        return off

    @cached_property
    def factors(self) -> Array:
        """(P,) standard deviations over those by the model alone; 1 where either is infinite."""
        if self.by_model is None:
            return np.ones(len(self.keys))
        return widths_over(self.spread, self.by_model.spread)

    @property
    def half_width(self) -> float:
        """Standard deviations from the middle to either end of a 95 % interval: Student's t, with the degrees of
        freedom of the noise and of the estimated dependence.
        """
        inverse = 1.0 / max(self.degrees_of_freedom, 1.0)
        inverse += 0.0 if self.dependence is None else self.dependence.inverse_freedom
        return student_95(1.0 / inverse if inverse > 0.0 else np.inf)

    @cached_property
    def bounds(self) -> Array:
        """(P, 2) 95 % bounds of the shared numbers, relative to the estimate; infinite on an open side."""
        limit = NORMAL_95 * self.stated_sd[:, None]  # a statement does not depend on the estimated noise
        return np.clip(self.bounds_at(self.half_width), -limit, limit)

    def bounds_at(self, width: float) -> Array:
        """(P, 2) bounds at so many standard deviations, at most three."""
        bounds = width * self.spread.sd[:, None] * (-1.0, 1.0)
        for mixture in self._numbers:
            bounds[self.information.columns(mixture.keys)] = mixture.bounds(width)
        limit = width * self.stated_sd[:, None]
        return np.clip(bounds, -limit, limit)

    def layout(self, estimate: Estimate) -> Layout:
        """Return the layout of all numbers that it knows."""
        return layout_of(self.keys, estimate, self.placements)

    def keys_of(self, estimate: Estimate, station: str) -> tuple[Key, ...]:
        """Return the keys of a station and of its camera."""
        owners = {("station", station), ("camera", estimate.stations[station].camera)}
        return tuple(key for key in self.keys if key[:2] in owners)

    def knows_station(self, station: str) -> bool:
        """Return whether it knows a station's pose: not if the station was held as the world."""
        return any(key[:2] == ("station", station) for key in self.keys)

    def column(self, kind: str, owner: str, quantity: str) -> int:
        """Return the index of a number among the keys.

        Raises:
            InputError: the number was held, or does not exist.
        """
        for column, key in enumerate(self.keys):
            if key[:3] == (kind, owner, quantity):
                return column
        meant = did_you_mean(quantity, [key.quantity for key in self.keys if key[:2] == (kind, owner)])
        raise InputError(f"{kind} {owner!r} has no free number {quantity!r}{meant or ': it was held, or is not there'}")

    def sd_of(self, kind: str, owner: str, quantity: str) -> float:
        """Standard deviation of one shared number, in its key's unit; never 0, infinite where unknown.

        Raises:
            InputError: it is not a free number.
        """
        return float(self.sd[self.column(kind, owner, quantity)])

    def placement(self, name: str) -> Spread:
        """Return the distribution of a placement's six numbers (`keys.PLACEMENT_QUANTITIES`).

        Raises:
            InputError: no such placement, or it was held.
        """
        if name in self.placements:
            return self.placements[name].spread
        keys = self.information.among(pose_keys("placement", name))
        if not keys:
            raise InputError(f"placement {name!r} has no free pose: it was held, or is not there")
        return self.information.marginal(keys).spread


def widths_over(spread: Spread, other: Spread) -> Array:
    """(n,) standard deviations of one spread over those of another of the same numbers; 1 where either is infinite."""
    both = np.isfinite(spread.sd) & np.isfinite(other.sd)
    return np.where(both, spread.sd, 1.0) / np.where(both, other.sd, 1.0)


def _along_phi(valley: Mixture, known: Information, step: Array) -> Mixture:
    """Return a normal distribution, so far (K,) from the estimate, as components along phi like those of a valley."""
    phi, along = valley.phi_px + step[0], known.spread.covariance[0]
    sd = np.sqrt(along[0])
    roots = min(FARTHER, 0.5 * phi / sd) * np.array([-1.0, 0.0, 1.0])  # phi changes by at most half of itself
    steps, across = step + roots[:, None] * along / sd, known.given(valley.keys[1:])
    return Mixture.along_phi(valley.keys, valley.phi_px, steps, roots**2, [across] * 3, (False, False))


def make_posterior(reduced: ReducedInformation, degrees_of_freedom: float, scatter: Scatter | None = None) -> Posterior:
    """Return the posterior of all shared numbers, and of the placements that were eliminated.

    Args:
        degrees_of_freedom: spare equations behind the estimated noise, infinite where the sigmas were taken as stated.
        scatter: how the data scatter; without it errors count as independent.
    """
    model, stated = reduced.shared, reduced.stated
    if scatter is None:
        return Posterior(model, _Placements(reduced.eliminated, model), degrees_of_freedom, stated=stated)
    shared, dependence = scattered(reduced, scatter), scatter.dependence
    placements = _Placements(reduced.eliminated, shared, dependence.private)
    return Posterior(shared, placements, degrees_of_freedom, by_model=model, dependence=dependence, stated=stated)


class _Placements(Frozen, Mapping[str, Information]):
    """Information about each eliminated placement, computed when the first one is used.

    Attributes:
        shared: about the numbers on which they depend. inflation: factor on the variance by their own observations.
    """

    eliminated: tuple[PrivatePlacements, ...]
    shared: Information
    inflation: float = 1.0

    @cached_property
    def _informations(self) -> dict[str, Information]:
        parts = ((part.names, _placement_information(part, self.shared, self.inflation)) for part in self.eliminated)
        return {
            name: Information(tuple(pose_keys("placement", name)), matrix)
            for names, matrices in parts
            for name, matrix in zip(names, matrices, strict=True)
        }

    def __getitem__(self, name: str) -> Information:
        return self._informations[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._informations)

    def __len__(self) -> int:
        return len(self._informations)


def _placement_information(part: PrivatePlacements, shared: Information, inflation: float) -> Array:
    """(S, 6, 6) information about each placement, all shared numbers integrated out.

    A placement moves with the shared numbers by -G, and scatters about that by what its own observations leave open:
    covariance own^-1 + G C G^T where both exist, else the Schur complement of the two together.
    """
    regular = part.ranks > 5.5
    regular &= not shared.spread.unknown.shape[1]
    informations, gains = np.empty_like(part.own), part.gains[regular]
    at = shared.columns(part.keys)
    covariance = shared.spread.covariance[np.ix_(at, at)]
    informations[regular] = np.linalg.inv(
        inflation * part.inverses[regular] + gains @ covariance @ np.swapaxes(gains, 1, 2)
    )
    if np.all(regular):
        return np.asarray(0.5 * (informations + np.swapaxes(informations, 1, 2)))
    marginal, limits = shared.marginal(part.keys).matrix, sigma_limits(part.keys)
    for s in np.flatnonzero(~regular):
        own, gain = part.own[s] / inflation, part.gains[s]
        informations[s] = without(own, gain.T @ own, marginal + gain.T @ own @ gain, limits)
    return np.asarray(0.5 * (informations + np.swapaxes(informations, 1, 2)))
