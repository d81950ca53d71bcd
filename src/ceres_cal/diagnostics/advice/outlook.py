"""A station's map if more were known: the worst and the mean error, in mm, at one height."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Spread, cached_property, evenly, inverse_root_of, thin_root
from ceres_cal.posterior import FieldMap, Mixture, Posterior, locate_slopes, station_keys, visible_pixels
from ceres_cal.problem import Estimate, Information, Key, moved

BENT = 0.05  # relative sigma of phi up to which the quadratic model holds; `posterior.assess` follows phi beyond it


class Errors(Frozen):
    """Largest and mean standard deviation of located points over what the image shows, mm; infinite where unknown."""

    worst_mm: float
    mean_mm: float


class Outlook(Frozen):
    """The map of one station at one height.

    Attributes:
        today: its map now. keys: (K) of the posterior on which it depends. slopes: (N, 2, K) derivatives by these of
            the N places that the image shows.
    """

    estimate: Estimate
    posterior: Posterior
    today: FieldMap
    keys: tuple[Key, ...]
    slopes: Array

    @classmethod
    def of(cls, estimate: Estimate, posterior: Posterior, today: FieldMap) -> Outlook:
        """Return the outlook from today's map.

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
    def valley(self) -> Mixture | None:
        """The valley along phi that today's map follows; None where it follows none."""
        found = self.posterior.mixture(self.estimate.stations[self.today.station].camera)
        return found if found.is_followed else None

    def after(self, added: Information) -> Errors:
        """Return the errors with information added, by the quadratic model at the estimate.

        Where phi was followed along its profile and would still have to be, see `shrunk`.
        """
        known = self._known(added)
        bent = self.valley is not None and self._phi_sd(self.estimate, known) > BENT
        return self.shrunk(added) if bent else _errors(known, self.slopes)

    def after_each(self, known: Information, informations: Sequence[Information]) -> list[Errors]:
        """Return the errors with each of some informations added, beside what is `known` by then of all numbers.

        A measurement determines few directions. With R its root and C the covariance before it, the covariance of
        places with slopes J falls by J C R^T (1 + R C R^T)^-1 R C J^T.
        """
        whole = self.posterior.information + known
        spread = whole.spread
        if self.valley is not None or spread.unknown.shape[1]:
            return [self.after(known + one) for one in informations]
        slopes = np.zeros((*self.slopes.shape[:2], len(whole.keys)))
        slopes[:, :, whole.columns(self.keys)] = self.slopes
        along, sd = np.tensordot(slopes, spread.covariance, axes=1), spread.sd
        variances = np.sum(along * slopes, axis=(1, 2))
        along = np.ascontiguousarray(along.reshape(-1, len(whole.keys)).T)

        def after(added: Information) -> Errors:
            told = np.flatnonzero(np.diagonal(added.matrix))  # a measurement sees few of the nodes of a surface
            root = thin_root(added.matrix[np.ix_(told, told)], sd[told])
            covariance = spread.covariance[np.ix_(told, told)]
            half = inverse_root_of(np.eye(len(root)) + root @ covariance @ root.T)
            taken = np.sum(((half @ root) @ along[told]) ** 2, axis=0)
            return _errors_of(variances - np.sum(taken.reshape(len(variances), -1), axis=1))

        return list(map(after, informations))

    def shrunk(self, added: Information) -> Errors:
        """Return today's errors, reduced by the factor by which the information reduces the quadratic model's."""
        today = Information.nothing(added.keys)
        now, then = (_errors(self._known(more), self.slopes) for more in (today, added))
        if not np.isfinite(now.worst_mm):
            return then
        worst = self.before.worst_mm * min(then.worst_mm / now.worst_mm, 1.0)
        return Errors(worst, self.before.mean_mm * min(then.mean_mm / now.mean_mm, 1.0))

    def _phi_sd(self, estimate: Estimate, known: Spread) -> float:
        """Return the relative standard deviation of phi by the distribution of the K numbers; 0 where it is held."""
        camera = estimate.stations[self.today.station].camera
        column = next((i for i, key in enumerate(self.keys) if key[:3] == ("camera", camera, "phi")), None)
        return 0.0 if column is None else float(known.sd[column]) / estimate.cameras[camera].phi

    def _known(self, added: Information) -> Spread:
        """Return the distribution of the K numbers with information added."""
        own = set(self.keys)
        others = [key for key in added.keys if key not in own]
        if not np.any(added.matrix[added.columns(others)]):  # no information about others: integrate these out once
            return (self._own + added.given(self.keys)).spread
        whole = self.posterior.information + added
        return _part(whole.spread, whole.columns(self.keys))

    @cached_property
    def _own(self) -> Information:
        return self.posterior.information.marginal(self.keys)

    @cached_property
    def possible(self) -> tuple[tuple[int, Estimate], ...]:
        """Some nodes of the valley within its 95 % bounds, with their numbers; none where phi is not followed."""
        nodes = 7  # of a valley at which a promise is evaluated
        if self.valley is None:
            return ()
        keys, steps, (at, roots) = self.valley.keys, self.valley.steps, self.valley.chains[0]
        within = at[np.abs(roots) <= self.posterior.half_width]
        some = within[evenly(len(within), nodes)]
        return tuple((int(node), moved(self.estimate, keys, steps[node])) for node in some)

    @cached_property
    def _possible_slopes(self) -> tuple[Array, ...]:
        """`slopes` at each of the possible estimates."""
        return tuple(_slopes(there, self.today, self.keys) for _, there in self.possible)

    def along_valley(self, information_at: Callable[[Estimate], Information]) -> Iterator[tuple[float, float, Errors]]:
        """Yield phi (px), its relative standard deviation and the errors, if this is phi and the information there is
        added, for values of phi within its 95 % bounds.

        There, today's observations determine everything but phi as in the valley, and phi by the parabola that fits the
        valley best. Where nothing of the addition would be seen, the standard deviation and the errors are infinite.
        """
        valley = self.valley
        assert valley is not None
        at, roots = valley.chains[0]
        phi, steps = valley.phi[at], valley.steps[at]
        tangents = np.gradient(steps[:, 1:], steps[:, 0], axis=0)
        bend = max(float(np.polyfit(np.log(phi), roots**2, 2)[0]), 0.0) if len(phi) > 2 else 0.0
        for (node, there), slopes in zip(self.possible, self._possible_slopes, strict=True):
            added = information_at(there).given(valley.keys)
            if not np.any(added.matrix):
                yield float(phi[node]), np.inf, Errors(np.inf, np.inf)
                continue
            across, along = valley.information[valley.at[node]].matrix, tangents[node]
            coupling = -across @ along
            of_phi = along @ across @ along + bend / phi[node] ** 2
            matrix = np.block([[np.atleast_2d(of_phi), coupling[None]], [coupling[:, None], across]])
            whole = Information(valley.keys, matrix) + added
            known = _part(whole.spread, whole.columns(self.keys))
            yield float(phi[node]), self._phi_sd(there, known), _errors(known, slopes)


def _part(known: Spread, at: Indices) -> Spread:
    """Return the distribution of some of the numbers."""
    return Spread(known.covariance[np.ix_(at, at)], known.unknown[at], known.scale[at])


def _errors(known: Spread, slopes: Array) -> Errors:
    """Return the errors of places with slopes (N, 2, K) by numbers with this distribution."""
    return _errors_of(np.trace(known.through(slopes), axis1=1, axis2=2))


def _errors_of(variances: Array) -> Errors:
    """Return the errors of places with variances (N,) of x and y together, m^2; far up a valley none is visible."""
    if not len(variances):
        return Errors(np.inf, np.inf)
    sd = 1e3 * np.sqrt(variances)
    return Errors(float(np.max(sd)), float(np.mean(sd)))


def _slopes(estimate: Estimate, grid: FieldMap, keys: tuple[Key, ...]) -> Array:
    """(N, 2, K) slopes of the N places of the grid that the image shows."""
    pixels = visible_pixels(estimate, grid.station, grid.places, grid.height_m)
    return locate_slopes(estimate, keys, grid.station, pixels[np.isfinite(pixels[:, 0])], grid.height_m)
