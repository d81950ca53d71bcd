"""The one least-squares problem: everything about it except the estimate at which it is evaluated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any, Protocol

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, cached_property, field, replace
from ceres_cal.observations import Observations, SightKey, Sights
from ceres_cal.problem.information import Information
from ceres_cal.problem.parameters import OF_PIXELS, Estimate, Layout, Options, connected, intrinsic_names, make_layout
from ceres_cal.problem.priors import GaussianPrior, gather_priors
from ceres_cal.problem.quantities import free_keys, intrinsic_keys
from ceres_cal.problem.structure import EXACT
from ceres_cal.scene.lens import Lens

_CONVEX = ("trivial", "huber", "soft_l1")


class Weighting(Frozen, eq=True):
    """The weighting of residuals: how they become costs.

    Attributes:
        point_scale, curve_scale: noise scales, factors on the stated sigmas.
        loss, loss_scale: robust loss of each observation, and its scale in standard deviations.
    """

    point_scale: float = 1.0
    curve_scale: float = 1.0
    loss: str = "huber"
    loss_scale: float = 2.5

    @property
    def scales(self) -> tuple[float, float]:
        """Noise scales of points and of curves."""
        return self.point_scale, self.curve_scale

    @property
    def is_convex(self) -> bool:
        """Whether the loss has only one minimum."""
        return self.loss in _CONVEX


class RemoteObservations(Protocol):
    """Observations of the world that are not in memory here: they answer with sums."""

    @property
    def equations(self) -> int:
        """The number of scalar measurements."""

    def cost(self, run: Any, problem: Problem, estimate: Estimate) -> Any:
        """Their cost function for Ceres. Its `owners` name, by kind and name, the numbers that it depends on."""

    def normals(self, problem: Problem, estimate: Estimate) -> Mapping[tuple[SightKey, int], Array]:
        """Their normal equations by sight and kind, see `problem.reduced`."""


class Problem(Frozen):
    """A least-squares problem: observations, free numbers and prior knowledge.

    Attributes:
        sights: the observations that take part. layout: the numbers that are free.
        priors: all prior knowledge; what it says of held numbers does not count.
        elsewhere: further observations of the world, which are not in memory here.
        smoothness: camera -> standard deviations (px) of its lens's `roughness`; the loose ones if it is not named.
        weighting: of the observations. options: iterations and threads.
        taken_up: degrees of freedom that effects used which were subtracted from the observations.
        feet: (M,) initial foot of each curve observation on its track (see `residuals`), by row.
    """

    sights: Sights
    layout: Layout
    priors: tuple[GaussianPrior, ...] = ()
    weighting: Weighting = Weighting()
    options: Options = Options()
    feet: Array | None = None
    smoothness: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    elsewhere: RemoteObservations | None = None
    taken_up: float = 0.0

    @property
    def observations(self) -> Observations:
        """All observations, including those that take no part."""
        return self.sights.observations

    @cached_property
    def private(self) -> frozenset[str | None]:
        """Free placements that only one sight shows: each can be eliminated by itself."""
        return self.layout.placements & self.sights.seen_once

    def priors_of(self, estimate: Estimate) -> list[GaussianPrior]:
        """The priors and the smoothness of lenses, restricted to free numbers."""
        smooth = (self.smooth_at(estimate, name) for name in estimate.cameras)
        return [*self.stated_at(estimate), *chain.from_iterable(smooth)]

    def priors_at(self, estimate: Estimate) -> list[GaussianPrior]:
        """`priors_of` as normal distributions at an estimate: usual values count less, the farther off they are."""
        return [prior.weighted_at(estimate) for prior in self.priors_of(estimate)]

    def stated_at(self, estimate: Estimate) -> list[GaussianPrior]:
        """The priors on free numbers, given held numbers at their values in the estimate."""
        if not self.priors:
            return []
        free = set(free_keys(estimate, self.layout, self.layout.placements))  # no prior is on placements
        restricted = [prior.given(free, estimate) for prior in self.priors]
        return [prior for prior in restricted if prior.keys]

    def smooth_at(self, estimate: Estimate, camera: str) -> Iterator[GaussianPrior]:
        """The smoothness of a camera's lens as priors of mean 0, unless a posterior includes it already."""
        lens, numbers = estimate.cameras[camera].lens, self.layout.free[camera]
        if not (len(numbers) and (forms := lens.roughness)) or self.knows_lens(camera, lens):
            return
        every = intrinsic_keys(camera, lens)
        keys, free = {key.quantity: key for key in every}, {every[number] for number in numbers.tolist()}
        sigmas = self.smoothness.get(camera, tuple(form.loose for form in forms))
        for form, sigma in zip(forms, sigmas, strict=True):
            own = tuple(keys[quantity] for quantity in form.names)
            if free & set(own):
                yield GaussianPrior(Information(own, form.matrix / sigma**2), np.zeros(len(own))).given(free)

    def knows_lens(self, camera: str, lens: Lens) -> bool:
        """Whether a posterior states all free roughness coefficients of a camera's lens, and so its smoothness."""
        every = intrinsic_names(lens)
        free = {every[number] for number in self.layout.free[camera].tolist()}
        rough = free.intersection(name for form in lens.roughness for name in form.names)
        return bool(rough) and rough <= self._stated_whole.get(camera, frozenset())

    @cached_property
    def _stated_whole(self) -> dict[str, frozenset[str]]:
        """Camera -> the coefficients of its lens, where a prior states them in every direction."""
        stated: dict[str, frozenset[str]] = {}
        for prior in self.priors:
            for name in {key.owner for key in prior.keys if key.kind == "camera" and not prior.is_usual}:
                of_camera = [key for key in prior.keys if key[:2] == ("camera", name)]
                own = [key for key in of_camera if key.quantity not in (*OF_PIXELS, "skew")]
                if own and prior.information.given(own).known_rank == len(own):
                    stated[name] = frozenset(key.quantity for key in own) | stated.get(name, frozenset())
        return stated

    @property
    def equations(self) -> int:
        """The number of scalar measurements: two for each point, one for each curve observation."""
        return self.sights.equations + (self.elsewhere.equations if self.elsewhere else 0)

    def unknowns(self, estimate: Estimate) -> int:
        """Number of free numbers that use up observations; numbers with a prior do not."""
        known = sum(prior.known for prior in self.priors_of(estimate))
        return max(self.layout.size + len(estimate.structure.values) - known, 0)

    def weighted(self, weighting: Weighting) -> Problem:
        """A copy with another weighting."""
        return replace(self, weighting=weighting)

    def rough(self, weighting: Weighting) -> Problem:
        """A copy with a weighting for residuals larger than noise, in which usual values count as much less."""
        loose = tuple(prior.loosened(max(1.0, *weighting.scales)) for prior in self.priors)
        return replace(self, priors=loose, weighting=weighting)

    def used(self, points: Mask, curves: Mask) -> Problem:
        """The problem of the observations in these rows only."""
        return replace(self, sights=self.sights.used(points, curves))

    def of_rows(self, points: Indices, curves: Indices) -> Problem:
        """The problem of some of the observations, in the given order, as if there were no others."""
        sights = self.sights.renumbered(points, curves)
        return replace(self, sights=sights, layout=self.layout.of(sights.keys))

    def of_sights(self, numbers: Indices) -> Problem:
        """The problem of some of the sights. Placements that they do not show are not free."""
        sights = self.sights.take(numbers)
        return replace(self, sights=sights, layout=self.layout.of(sights.keys))

    def about(self, camera: str, estimate: Estimate) -> Problem:
        """The part on which a camera's numbers depend, with everything else held: cameras of a rig that share neither
        placements, nor priors, nor the structure of targets are calibrated as if there were no others.
        """
        if len(self.layout.free) < 2 or self.elsewhere is not None or len(estimate.structure.values):
            return self
        of_station = {name: station.camera for name, station in estimate.stations.items()}
        together = [
            {key.owner if key.kind == "camera" else of_station.get(key.owner, "") for key in prior.keys}
            for prior in self.priors
        ]
        seen = dict[str | None, set[str]]()
        for key in self.sights.keys:
            seen.setdefault(key.placement, set()).add(key.camera)
        together += [cameras for placement, cameras in seen.items() if placement in self.layout.placements]
        linked = connected([camera], together)
        if linked >= {*self.layout.free}:
            return self
        part = self.of_sights(np.flatnonzero([key.camera in linked for key in self.sights.keys]))
        nothing = np.zeros(0, dtype=np.int64)
        free = {name: numbers if name in linked else nothing for name, numbers in self.layout.free.items()}
        stations = frozenset(name for name in self.layout.stations if of_station[name] in linked)
        return replace(part, layout=replace(part.layout, free=free, stations=stations))

    def holding(self, camera: str, number: int) -> Problem:
        """The problem with one of a camera's intrinsics held; `number`: its index in the solver's vector."""
        return replace(self, layout=self.layout.holding(camera, number))

    def built_as(self, estimate: Estimate) -> tuple[Problem, Estimate]:
        """The problem and the estimate of targets drawn as the estimate has them built."""
        sights = estimate.structure.built_into(self.sights)
        return replace(self, sights=sights), replace(estimate, structure=EXACT)


def problem_of(sights: Sights, options: Options, estimate: Estimate) -> Problem:
    """The problem of some sights, before any weighting."""
    priors = gather_priors(sights.observations, options, estimate.structure)
    return Problem(sights, make_layout(sights.observations, options), priors, options=options)
