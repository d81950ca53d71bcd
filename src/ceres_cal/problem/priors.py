"""Prior knowledge, all in one form: a joint normal distribution of some numbers.

A tape-measured height, a tolerance of the target as built and the posterior of an earlier calibration differ only in
their keys. Nothing is known in null directions of an information matrix, and nothing is inverted: the residual of a
prior is root (x - mean) with root^T root = information.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from types import MappingProxyType

import numpy as np

from ceres_cal.base import Array, Frozen, Indices, InputError, cached_property, field, replace, rotation_log
from ceres_cal.observations import Observations, Prior
from ceres_cal.problem.information import Information, Key, pose_keys
from ceres_cal.problem.parameters import AUTO, OF_PIXELS, Estimate, Options, intrinsic_names
from ceres_cal.problem.quantities import FINEST, intrinsic_keys, values_of
from ceres_cal.problem.structure import Structure
from ceres_cal.scene import Camera, Lens

USUAL_CENTRE = 0.015
"""Standard deviation of either coordinate of the principal point about the middle of the picture, for pictures that
were not cropped, as a share of the image's diagonal: 24 px of 1600.
"""
# Standard deviations of fy / fx about 1, and of either decentring coefficient. In the public cameras tried, fy / fx is
# up to 0.6 % off, and p1 and p2 are up to 3e-3.
USUAL_ASPECT, USUAL_DECENTRING = 5e-4, 5e-4
# Scale of Cauchy's loss of usual values, in standard deviations: Student's t with 3 degrees of freedom. A picture that
# was cropped or squeezed may be arbitrarily far from usual, at the cost of a few residuals.
USUAL_BENDS = 2.0
ANY_PHI = 1.1, 0.8
"""phi in half image diagonals, and the standard deviation of its logarithm: fisheyes of 0.3 and lenses of cranes and
stands, five half diagonals, are within two of it. Without this prior, solves of a view from straight above, which
determines only phi over height, run away along their valley, to impossible cameras.
"""
VAGUE = 0.1
"""Relative standard deviation to which stated numbers count as known until everything else is explained: enough to stay
in the middle of a valley along phi that frontal views leave open.
"""
_VAGUE_QUANTITIES = (*OF_PIXELS, "principal_point", "height_m", "position_m")
_QUANTITIES = {"principal_point": ("cx", "cy"), "height_m": ("height",), "position_m": ("x", "y", "height")}


class GaussianPrior(Frozen):
    """A normal distribution of some intrinsics, stations and structure numbers.

    Attributes:
        information: on its K numbers. mean: (K,) in the units of the keys; for a turn, from its rotation.
        rotations: station -> rotation (3, 3) of cam_from_world from which its turns are measured.
        gives_way: whether it yields to observations that contradict it: its distribution has heavy tails.
        is_usual: whether it was not stated, but is what is usual of cameras; it then gives way.
        logs: numbers whose logarithms are normal: their offsets are mean log(x / mean).
    """

    information: Information
    mean: Array
    rotations: Mapping[str, Array] = field(default_factory=dict)
    gives_way: bool = False
    is_usual: bool = False
    logs: frozenset[Key] = frozenset()

    @classmethod
    def about(cls, information: Information, estimate: Estimate) -> GaussianPrior:
        """A prior around an estimate.

        Raises:
            ValueError: a number is of a placement; there are no priors on placements.
        """
        if any(key.kind == "placement" for key in information.keys):
            raise ValueError("a prior speaks of cameras, stations and structure, not of placements")
        turning = {key.owner for key in information.keys if key.kind == "station" and key.unit == "rad"}
        rotations = {name: estimate.stations[name].cam_from_world.rotation for name in turning}
        return cls(information, values_of(estimate, information.keys), rotations)

    @property
    def keys(self) -> tuple[Key, ...]:
        return self.information.keys

    @property
    def known(self) -> int:
        """Number of its numbers that use up no observation because of it; of usual values, only square pixels."""
        if not self.is_usual:
            return len(self.information.root)
        return sum(key.quantity == "aspect" for key in self.keys)

    @property
    def is_of_target(self) -> bool:
        """Whether it is only about the offsets of targets from their drawings."""
        return all(key.kind == "structure" for key in self.keys)

    def is_of(self, camera: str) -> bool:
        """Whether it is only about one camera's intrinsics."""
        return all(key[:2] == ("camera", camera) for key in self.keys)

    def given(self, keys: Collection[Key], estimate: Estimate | None = None) -> GaussianPrior:
        """The prior on those of its numbers that are among the keys, given all others: at their values in the estimate,
        or else at their mean.
        """
        own = self.information.among(keys)
        if own == self.keys:
            return self
        given = self._with(self.information.given(own))
        if estimate is None:
            return given
        names, theirs = estimate.structure.names, set(own)
        held = [key for key in self.keys if key not in theirs and (not key.is_structure or key.structure_name in names)]
        across = self.information.matrix[np.ix_(self.information.columns(own), self.information.columns(held))]
        if not np.any(across):
            return given
        off = self._with(self.information.given(held)).offsets(estimate)
        return replace(given, mean=given.mean - given.information.inverse @ across @ off)

    def without(self, keys: Collection[Key]) -> GaussianPrior:
        """The prior with some numbers integrated out: nothing is known of them any more."""
        return self._with(self.information.without(keys)) if set(keys) & set(self.keys) else self

    def widened(self, factors: Array) -> GaussianPrior:
        """A copy with standard deviations multiplied by factors (K,)."""
        information = self.information
        matrix = information.matrix / (factors[:, None] * factors)
        return replace(self, information=replace(information, matrix=matrix))

    def _with(self, information: Information) -> GaussianPrior:
        return replace(self, information=information, mean=self.mean[self.information.columns(information.keys)])

    def offsets(self, estimate: Estimate) -> Array:
        """(K,) estimate minus mean, in the units of the keys."""
        off = values_of(estimate, self.keys) - self.mean
        for name, rotation in self.rotations.items():
            turn = rotation_log(estimate.stations[name].cam_from_world.rotation @ rotation.T)
            for key, angle in zip(pose_keys("station", name)[3:], turn.tolist(), strict=True):
                if key in self.keys:
                    off[self.information.columns([key])] += angle
        return self.bent(off)[0]

    def bent(self, off: Array) -> tuple[Array, Array]:
        """(K,) offsets of numbers that differ from the mean by `off`, and their derivatives by `off`. For numbers with
        normal logarithms, the offset is far below 0 where the number is 0 or less.
        """
        least_ratio = 1e-6  # least ratio of a number to its mean: a step of the solver may go below 0
        slope = np.ones(len(off))
        if self.logs:
            at = self._of_logs
            ratio = np.maximum(1.0 + off[at] / self.mean[at], least_ratio)
            off = off.copy()
            off[at], slope[at] = self.mean[at] * np.log(ratio), 1.0 / ratio
        return off, slope

    @cached_property
    def _of_logs(self) -> Indices:
        return self.information.columns(self.information.among(self.logs))

    def residuals(self, estimate: Estimate) -> Array:
        """(R,) root (x - mean), in standard deviations."""
        return np.asarray(self.information.root @ self.offsets(estimate))

    def cost(self, estimate: Estimate) -> float:
        """Twice its share of the cost: the squares of its residuals, or Cauchy's loss of them if it gives way."""
        squares = self.residuals(estimate) ** 2
        return float(np.sum(USUAL_BENDS**2 * np.log1p(squares / USUAL_BENDS**2) if self.gives_way else squares))

    def weighted_at(self, estimate: Estimate) -> GaussianPrior:
        """The normal distribution with the same gradient at an estimate: a prior that gives way has Cauchy's
        weights.
        """
        if not self.gives_way:
            return self
        off = self.offsets(estimate)
        weights = 1.0 / (1.0 + (off / USUAL_BENDS) ** 2 * np.diagonal(self.information.matrix))
        here = values_of(estimate, self.keys)
        slope = self.bent(here - self.mean)[1]
        return replace(self._times(weights * slope**2), mean=here - off / slope, logs=frozenset())

    def loosened(self, factor: float) -> GaussianPrior:
        """A copy with standard deviations multiplied by a factor, if it gives way: for use beside observations whose
        residuals exceed their noise by that factor.
        """
        return self._times(np.full(len(self.keys), factor**-2)) if self.gives_way else self

    def _times(self, weights: Array) -> GaussianPrior:
        """A copy with its information multiplied by weights; its numbers are independent."""
        return replace(self, information=replace(self.information, matrix=weights[:, None] * self.information.matrix))


def gather_priors(
    observations: Observations,
    options: Options,
    structure: Structure,
    carried: GaussianPrior | None = None,
    cameras: Mapping[str, Camera] | None = None,
) -> tuple[GaussianPrior, ...]:
    """Collect all prior knowledge: an old posterior, the priors of observations and options, usual values, tolerances.

    Args:
        cameras: those whose lenses differ from the lens of the options.

    Raises:
        InputError: a prior names a camera, a station or a quantity that does not exist.
    """
    lenses = {name: camera.lens for name, camera in (cameras or {}).items()}
    stated = [*stated_priors(observations, options, lenses).values()]
    if carried:
        return (carried, *stated, *tolerances(structure, carried.keys))
    known = {key for prior in stated for key in prior.keys}
    usual = usual_cameras(observations, options, known, lenses) if options.usual_camera else ()
    return (*stated, *usual, *tolerances(structure))


def stated_priors(
    observations: Observations, options: Options, lenses: Mapping[str, Lens] = MappingProxyType({})
) -> dict[Prior, GaussianPrior]:
    """The priors that observations and options state on numbers, each once; see `gather_priors`."""
    stated = {}
    for prior in dict.fromkeys((*observations.priors, *options.priors)):  # a repeated statement counts once
        observations.require_owner(prior)
        is_effect = prior.is_coma and prior in observations.priors
        if not (prior.is_open or prior.curve or is_effect):  # open dimensions have no prior; curves have tolerances
            stated[prior] = stated_prior(prior, lenses.get(prior.name) or options.of_camera(prior.name).blank_lens)
    return stated


def freed(observations: Observations, options: Options) -> Options:
    """The options with their held camera numbers replaced by priors of the least sigma. Held coefficients, which have
    no size for a relative sigma, get a sigma of a tenth of the solver's unit.
    """
    held = {name: (value,) for name, value in options.fixed.items() if name in OF_PIXELS}
    each = list[Prior]()
    for name, size in observations.cameras.items():
        middle = () if options.free_principal_point else tuple(0.5 * (side - 1.0) for side in size)
        own = {**held, "principal_point": middle} if middle else held
        each += [Prior("camera", name, one, value, (FINEST,) * len(value)) for one, value in own.items()]
        sizes = {} if options.lens == AUTO else _loose(options.of_camera(name).blank_lens, size)
        loose = {one: (value, sizes[one]) for one, value in options.fixed.items() if one in sizes}
        each += [Prior("camera", name, one, (value,), (sigma,), True) for one, (value, sigma) in loose.items()]
    if not each:
        return options
    loosened = {one.quantity for one in each}
    fixed = {name: value for name, value in options.fixed.items() if name not in loosened}
    free_aspect, priors = "aspect" in held or options.free_aspect, (*options.priors, *each)
    return replace(options, fixed=fixed, free_principal_point=True, free_aspect=free_aspect, priors=priors)


def _loose(lens: Lens, image_size: tuple[int, int]) -> dict[str, float]:
    """The sigmas to which held coefficients count as known until everything else is explained, by name."""
    units = 1.0 / lens.scales(0.5 * float(np.hypot(*image_size)))
    own = {name: VAGUE * unit for name, unit in zip(lens.names, units.tolist(), strict=True)}
    own |= dict.fromkeys(lens.tangential, USUAL_DECENTRING)
    return {name: sigma for name, sigma in own.items() if name not in lens.set_at_start}


def loosely(observations: Observations, options: Options) -> tuple[Observations, Options]:
    """Both with statements on cameras and stations loosened, so that nothing else absorbs what is wrong with them."""
    every, options_too = (tuple(map(_vague, one.priors)) for one in (observations, options))
    of_views = observations if every == observations.priors else replace(observations, priors=every)
    return of_views, options if options_too == options.priors else replace(options, priors=options_too)


def _vague(prior: Prior) -> Prior:
    least = VAGUE * max(map(abs, prior.value))
    if prior.owner == "target" or prior.quantity not in _VAGUE_QUANTITIES or min(prior.sigma) >= least:
        return prior
    return replace(prior, sigma=tuple(max(sigma, least) for sigma in prior.sigma), gives_way=True)


def stated_prior(prior: Prior, lens: Lens) -> GaussianPrior:
    """A stated prior as a normal distribution of independent numbers.

    Raises:
        InputError: the lens has no such number.
    """
    if prior.owner == "target":
        sigma = {Key.of_structure(prior.dimension, "dimension"): prior.sigma[0]}
        return GaussianPrior(Information.of_sigmas(sigma), np.array(prior.value))
    names = intrinsic_names(lens)
    if prior.owner == "camera" and prior.quantity not in (*names, "principal_point"):
        raise InputError(f"prior on camera {prior.name!r}: it has no {prior.quantity!r}, only {', '.join(names)}")
    wanted = _QUANTITIES.get(prior.quantity, (prior.quantity,))
    every = intrinsic_keys(prior.name, lens) if prior.owner == "camera" else pose_keys("station", prior.name)
    keys = {key.quantity: key for key in every}
    sigmas = {keys[quantity]: sigma for quantity, sigma in zip(wanted, prior.sigma, strict=True)}
    return GaussianPrior(Information.of_sigmas(sigmas), np.asarray(prior.value, dtype=float), gives_way=prior.gives_way)


def usual_cameras(
    observations: Observations, options: Options, stated: Collection[Key], lenses: Mapping[str, Lens]
) -> Iterator[GaussianPrior]:
    """Priors by what is usual of cameras, except on numbers that are stated or set free: a principal point near the
    middle of the image, square pixels, little decentring, and a phi that common lenses have.
    """
    for name, size in observations.cameras.items():
        lens = lenses.get(name) or options.of_camera(name).blank_lens
        keys = {key.quantity: key for key in intrinsic_keys(name, lens) if key not in stated}
        centre = 0.5 * (np.array(size, dtype=float) - 1.0)
        off_centre = USUAL_CENTRE * float(np.hypot(*size))
        usual = {"cx": (centre[0], off_centre), "cy": (centre[1], off_centre)}
        if not options.free_aspect:
            usual["aspect"] = 1.0, USUAL_ASPECT
        usual |= dict.fromkeys(lens.tangential, (0.0, USUAL_DECENTRING))
        phi = ANY_PHI[0] * 0.5 * float(np.hypot(*size))
        usual["phi"] = phi, ANY_PHI[1] * phi
        about = {keys[quantity]: known for quantity, known in usual.items() if quantity in keys}
        if about:
            information = Information.of_sigmas({key: sigma for key, (_, sigma) in about.items()})
            logs = frozenset(key for key in about if key.quantity == "phi")
            means = np.array([mean for mean, _ in about.values()])
            yield GaussianPrior(information, means, gives_way=True, is_usual=True, logs=logs)


def tolerances(structure: Structure, known: Collection[Key] = ()) -> Iterator[GaussianPrior]:
    """The prior on how far targets may be off their drawings, without numbers that are known already."""
    stated = dict(zip(structure.keys[: structure.own], structure.sigma_m.tolist(), strict=False))
    sigmas = {key: sigma for key, sigma in stated.items() if key not in set(known)}
    if sigmas:
        yield GaussianPrior(Information.of_sigmas(sigmas), np.zeros(len(sigmas)))
