"""The one least-squares problem: everything about it but the place where it stands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import chain
from typing import Any, Protocol

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, Mask, cached_property, field, replace
from ceres_cal.observations import Observations, SightKey, Sights
from ceres_cal.problem.information import Information
from ceres_cal.problem.parameters import OF_PIXELS, Estimate, Layout, Options, intrinsic_names, make_layout
from ceres_cal.problem.priors import GaussianPrior, gather_priors
from ceres_cal.problem.quantities import free_keys, intrinsic_keys
from ceres_cal.problem.structure import EXACT
from ceres_cal.scene.lens import Lens

_CONVEX = ("trivial", "huber", "soft_l1")


class Weighting(Frozen, eq=True):
    """How residuals become costs.

    Attributes:
        point_scale, curve_scale: noise scales, factors on the stated sigmas.
        loss, loss_scale: robust loss of each observation, its scale in standard deviations.
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
        """Whether the loss has one minimum."""
        return self.loss in _CONVEX


class RemoteObservations(Protocol):
    """Observations of the world that are not at hand: they answer with sums."""

    @property
    def equations(self) -> int:
        """How many measured numbers they are."""

    def cost(self, run: Any, problem: Problem, estimate: Estimate) -> Any:
        """What Ceres sees of them: its `owners` say by kind and name which numbers it depends on."""

    def normals(self, problem: Problem, estimate: Estimate) -> Mapping[tuple[SightKey, int], Array]:
        """Their normal equations by sight and kind, see `problem.reduced`."""


class Problem(Frozen):
    """What is minimised, over what, under what was known before.

    Attributes:
        sights: the observations that take part. layout: the numbers that are free.
        priors: all that is known beforehand; of numbers that are held they say nothing.
        elsewhere: more observations of the world, which are not at hand.
        smoothness: camera -> standard deviations (px) of its lens's `roughness`; its loose ones where it is not named.
        weighting: of the observations. options: iterations and threads.
        taken_up: equations that effects use up which were taken off the observations.
        feet: (M,) where on its track each curve observation's foot is sought first (see `residuals`), by row.
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
        """All of them, also those that take no part."""
        return self.sights.observations

    @cached_property
    def private(self) -> frozenset[str | None]:
        """Free placements that a single sight shows: each can be eliminated by itself."""
        return self.layout.placements & self.sights.seen_once

    def priors_of(self, estimate: Estimate) -> list[GaussianPrior]:
        """The priors and the smoothness of lenses, of numbers that are free."""
        smooth = (self.smooth_at(estimate, name) for name in estimate.cameras)
        return [*self.stated_at(estimate), *chain.from_iterable(smooth)]

    def priors_at(self, estimate: Estimate) -> list[GaussianPrior]:
        """What these say at an estimate: what is usual counts less, the farther off it is."""
        return [prior.weighted_at(estimate) for prior in self.priors_of(estimate)]

    def stated_at(self, estimate: Estimate) -> list[GaussianPrior]:
        """What the priors say of numbers that are free, with those that are held where the estimate has them."""
        if not self.priors:
            return []
        free = set(free_keys(estimate, self.layout, self.layout.placements))  # of placements nothing is known before
        restricted = [prior.given(free, estimate) for prior in self.priors]
        return [prior for prior in restricted if prior.keys]

    def smooth_at(self, estimate: Estimate, camera: str) -> Iterator[GaussianPrior]:
        """What its smoothness says of a camera's lens, of mean nought, where no posterior says so already."""
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
        """Whether a posterior states all that is free of a camera's lens: how smooth it is, is in there."""
        every = intrinsic_names(lens)
        free = {every[number] for number in self.layout.free[camera].tolist()}
        rough = free.intersection(name for form in lens.roughness for name in form.names)
        return bool(rough) and rough <= self._stated_whole.get(camera, frozenset())

    @cached_property
    def _stated_whole(self) -> dict[str, frozenset[str]]:
        """Camera -> the coefficients of its lens, where a prior states these in every direction."""
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
        """Measured numbers: two of each point, one of each curve observation."""
        return self.sights.equations + (self.elsewhere.equations if self.elsewhere else 0)

    def unknowns(self, estimate: Estimate) -> int:
        """Number of free numbers that use up observations: what is known beforehand does not."""
        known = sum(prior.known for prior in self.priors_of(estimate))
        return max(self.layout.size + len(estimate.structure.values) - known, 0)

    def weighted(self, weighting: Weighting) -> Problem:
        """The same with other weights."""
        return replace(self, weighting=weighting)

    def rough(self, weighting: Weighting) -> Problem:
        """The same with the weights of residuals that are more than noise, and what is usual known as much less."""
        loose = tuple(prior.loosened(max(1.0, *weighting.scales)) for prior in self.priors)
        return replace(self, priors=loose, weighting=weighting)

    def used(self, points: Mask, curves: Mask) -> Problem:
        """The problem of these rows of the observations alone."""
        return replace(self, sights=self.sights.used(points, curves))

    def of_rows(self, points: Indices, curves: Indices) -> Problem:
        """The problem of some of the observations, in their order, as if there were no others."""
        sights = self.sights.renumbered(points, curves)
        return replace(self, sights=sights, layout=self.layout.of(sights.keys))

    def of_sights(self, numbers: Indices) -> Problem:
        """The problem of some of the sights: no placement that they do not show is free."""
        sights = self.sights.take(numbers)
        return replace(self, sights=sights, layout=self.layout.of(sights.keys))

    def holding(self, camera: str, number: int) -> Problem:
        """The problem with one of a camera's intrinsics held, by its place in the solver's vector."""
        return replace(self, layout=self.layout.holding(camera, number))

    def built_as(self, estimate: Estimate) -> tuple[Problem, Estimate]:
        """The problem and the estimate of targets that are drawn as the estimate has them built."""
        sights = estimate.structure.built_into(self.sights)
        return replace(self, sights=sights), replace(estimate, structure=EXACT)


def problem_of(sights: Sights, options: Options, estimate: Estimate) -> Problem:
    """What is minimised, before anything was weighed."""
    priors = gather_priors(sights.observations, options, estimate.structure)
    return Problem(sights, make_layout(sights.observations, options), priors, options=options)
