"""The posterior in calibration files: lower triangles, with every number exact.

Also its form in files of 0.1, before it was a mixture: valleys along phi, and curved ends of weak directions.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from functools import cache
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base import Indices, InputError, convert, replace
from ceres_cal.effects.dependence import Dependence
from ceres_cal.posterior.bent import Ends
from ceres_cal.posterior.mixture import Chain, Mixture
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem import EXACT, Estimate, Information, Key, Station, over, pose_keys
from ceres_cal.problem.quantities import every_key
from ceres_cal.scene.camera import CameraFile, PoseFile


class MixtureFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """A mixture of normal distributions in a calibration's file: see `Mixture`.

    Attributes:
        weights, steps, at: of each component its probability, its position relative to the estimate, and the index of
            its information.
        information: lower triangles, for the keys that are not held. chains: of each the first component, and the
            signed roots of its components along phi.
    """

    keys: list[Key]
    weights: list[float]
    steps: list[list[float]]
    at: list[int]
    information: list[list[float]]
    held: list[Key] = []
    chains: list[ChainFile] = []
    phi_px: float = 0.0
    open_below: bool = False
    open_above: bool = False
    lenses: list[list[int]] = []

    @classmethod
    def of(cls, mixture: Mixture) -> MixtureFile:
        """Return the mixture in the form of a file."""
        known = mixture.information[0].keys
        return cls(
            list(mixture.keys),
            mixture.weights.tolist(),
            mixture.steps.tolist(),
            mixture.at.tolist(),
            [lower_triangle(one.over(known)) for one in mixture.information],
            [key for key in mixture.keys if key not in known],
            [ChainFile(int(chain.at[0]), chain.roots.tolist()) for chain in mixture.chains],
            mixture.phi_px,
            mixture.open_below,
            mixture.open_above,
            [[component, *of] for component, of in mixture.lenses.items()],
        )

    def mixture(self, name: str, known: Collection[Key]) -> Mixture:
        """Return the mixture; raise InputError where its numbers do not fit each other or the known keys."""
        where = f"posterior.mixtures.{name}"
        require_keys(self.keys, known, where)
        held = set(self.held)
        free = [key for key in self.keys if key not in held]
        every = [information_from(row, free, f"{where}.information") for row in self.information]
        require_alike(where, self.keys, self.steps, (self.weights, self.at))
        if not all(0 <= number < len(every) for number in self.at) or not self.weights:
            raise InputError(f"{where}.at names no information: calibrate again")
        chains = tuple(
            Chain(np.arange(one.first, one.first + len(one.roots)), np.array(one.roots)) for one in self.chains
        )
        if any(len(chain.roots) < 2 or not 0 <= chain.at[0] <= chain.at[-1] < len(self.at) for chain in chains):
            raise InputError(f"{where}.chains do not fit its components: calibrate again")
        if chains and self.keys[0][:3] != ("camera", name, "phi"):
            raise InputError(f"{where} does not begin with phi of camera {name!r}: calibrate again")
        numbers = np.array(self.weights), np.array(self.steps).reshape(-1, len(self.keys)), tuple(every)
        valley = self.phi_px, self.open_below, self.open_above
        if any(len(one) not in (2, 3) for one in self.lenses):
            raise InputError(f"{where}.lenses must give each component a lens and a similar one: calibrate again")
        lenses = {one[0]: (one[1], one[2] if one[2:] else 0) for one in self.lenses}  # pairs are in older files
        return Mixture(tuple(self.keys), *numbers, np.array(self.at), chains, *valley, lenses)


class SeenFile(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """Cameras and stations with one of several lenses.

    Attributes:
        keys, information: what is known of their numbers, as a lower triangle, unless it is as with the lens before.
    """

    cameras: dict[str, CameraFile]
    stations: dict[str, tuple[str, PoseFile]]
    keys: list[Key] = []
    information: list[float] = []

    @classmethod
    def every(cls, posterior: Posterior) -> list[SeenFile]:
        """Return the lenses of a posterior in the form of a file."""
        nothing = Information.nothing()
        own, last = [nothing, *posterior.lens_information], nothing
        own += [nothing] * (len(posterior.lenses) - len(own))
        found = []
        for estimate, known in zip(posterior.lenses, own, strict=False):
            stations = {name: (one.camera, PoseFile.of(one.cam_from_world)) for name, one in estimate.stations.items()}
            seen = cls({name: CameraFile.of(one) for name, one in estimate.cameras.items()}, stations)
            if known is not last:
                seen.keys, seen.information, last = list(known.keys), lower_triangle(known), known
            found.append(seen)
        return found

    def estimate(self) -> Estimate:
        """Return the estimate; raise InputError where a camera or a pose is invalid."""
        cameras = {name: one.camera() for name, one in self.cameras.items()}
        stations = {name: Station(camera, pose.pose()) for name, (camera, pose) in self.stations.items()}
        if any(one.camera not in cameras for one in stations.values()):
            raise InputError("posterior.lenses: a station names a camera that is not there: calibrate again")
        return Estimate(cameras, stations, {}, EXACT)


class ChainFile(msgspec.Struct, forbid_unknown_fields=True):
    """Components along phi in a calibration's file: see `Chain`."""

    first: int
    roots: list[float]


class PosteriorFile(msgspec.Struct, forbid_unknown_fields=True):
    """The posterior in a calibration's file; freedom is null where the sigmas were taken as stated.

    Attributes:
        profiles, bends: in older files in place of mixtures (`as_mixtures`).
    """

    keys: list[Key]
    information: list[float]
    placements: dict[str, list[float]]
    freedom: float | None
    profiles: dict[str, Any] = {}
    by_model: list[float] | None = None
    dependence: Dependence | None = None
    bends: Any = None
    stated_keys: list[Key] = []
    stated: list[float] = []
    mixtures: dict[str, MixtureFile] = {}
    lenses: list[SeenFile] = []

    @classmethod
    def of(cls, posterior: Posterior) -> PosteriorFile:
        """Return the posterior in the form of a file."""
        degrees = posterior.degrees_of_freedom
        return cls(
            list(posterior.keys),
            lower_triangle(posterior.information),
            {name: lower_triangle(information) for name, information in posterior.placements.items()},
            degrees if np.isfinite(degrees) else None,
            {},
            None if posterior.by_model is None else lower_triangle(posterior.by_model),
            posterior.dependence,
            None,
            list(posterior.stated.keys),
            lower_triangle(posterior.stated),
            {name: MixtureFile.of(mixture) for name, mixture in posterior.mixtures.items()},
            SeenFile.every(posterior),
        )

    def posterior(self, known: Collection[Key]) -> Posterior:
        """Return the posterior; raise InputError where a matrix has the wrong size, or where a key is unknown."""
        require_keys(self.keys, known, "posterior.keys")
        for name in self.placements:
            require_keys(pose_keys("placement", name), known, "posterior.placements")
        placements = {
            name: information_from(row, pose_keys("placement", name), f"posterior.placements.{name}")
            for name, row in self.placements.items()
        }
        information = information_from(self.information, self.keys, "posterior.information")
        mixtures = {name: entry.mixture(name, self.keys) for name, entry in self.mixtures.items()}
        by_model = self.by_model and information_from(self.by_model, self.keys, "posterior.by_model")
        freedom = np.inf if self.freedom is None else self.freedom
        require_keys(self.stated_keys, self.keys, "posterior.stated_keys")
        stated = information_from(self.stated, self.stated_keys, "posterior.stated")
        lenses, each = tuple(one.estimate() for one in self.lenses), [Information.nothing()]
        for seen, there in zip(self.lenses, lenses, strict=True):
            require_keys(seen.keys, every_key(there), "posterior.lenses.keys")
            own = information_from(seen.information, seen.keys, "posterior.lenses.information")
            each.append(own if seen.keys else each[-1])
        if any(
            not (0 < lens < len(lenses) and {component, alike} <= set(range(len(mixture.weights))))
            for mixture in mixtures.values()
            for component, (lens, alike) in mixture.lenses.items()
        ):
            raise InputError("posterior.mixtures names lenses that are not in posterior.lenses: calibrate again")
        seen_by = lenses, tuple(each[2:])
        return Posterior(
            information, placements, freedom, mixtures, by_model or None, self.dependence, stated, *seen_by
        )


def require_alike(
    where: str, keys: Sequence[Key], rows: Sequence[Sequence[float]], others: Sequence[Sequence[Any]]
) -> None:
    """Raise InputError where a row is not as long as the keys, or where the others are not as many as the rows."""
    if any(len(row) != len(keys) for row in rows) or any(len(other) != len(rows) for other in others):
        raise InputError(f"{where}: its numbers do not fit each other: calibrate again")


def lower_triangle(information: Information) -> list[float]:
    """Return the lower triangle row by row, including the diagonal."""
    return list(information.matrix[_lower_triangle(len(information.keys))].tolist())


@cache
def _lower_triangle(size: int) -> tuple[Indices, Indices]:
    return np.tril_indices(size)


def require_keys(keys: Sequence[Key], known: Collection[Key], where: str) -> None:
    """Raise InputError where a file names a key twice, or an unknown key."""
    for key, count in Counter(keys).items():
        if count > 1:
            raise InputError(f"{where} names {key.quantity!r} of {key.whose} twice: calibrate again")
        if key not in known:
            raise InputError(f"{where} names {key.quantity!r} of {key.whose}, which is not there: calibrate again")


def information_from(triangle: Sequence[float], keys: Sequence[Key], where: str) -> Information:
    """Return information about the keys from the lower triangle of its matrix.

    Raises:
        InputError: the triangle has the wrong number of entries.
    """
    needed = len(keys) * (len(keys) + 1) // 2
    if len(triangle) != needed:
        raise InputError(f"{where} has {len(triangle)} numbers, not {needed}: calibrate again")
    rows, columns = np.tril_indices(len(keys))
    matrix = np.empty((len(keys), len(keys)))
    matrix[rows, columns] = triangle
    matrix[columns, rows] = triangle
    return Information(tuple(keys), matrix)


def as_mixtures(file: PosteriorFile, posterior: Posterior) -> Posterior:
    """Return the posterior of an older file with mixtures; raise InputError where numbers do not fit each other."""
    mixtures, information = dict[str, Mixture](), posterior.information
    for camera, entry in file.profiles.items():
        valley = convert(entry, ProfileFile, f"posterior.profiles.{camera}")
        mixtures[camera] = valley.mixture(camera, information.keys)
    if file.bends and (bent := convert(file.bends, BendsFile, "posterior.bends").mixture(information)) is not None:
        mixtures[""] = bent
    return replace(posterior, mixtures={**mixtures, **posterior.mixtures})


class ProfileFile(msgspec.Struct, forbid_unknown_fields=True):
    """A valley along phi: at each node the steps and the lower triangle of the information."""

    keys: list[Key]
    phi_px: float
    steps: list[list[float]]
    rises: list[float]
    information: list[list[float]]
    open_below: bool
    open_above: bool

    def mixture(self, camera: str, known: Collection[Key]) -> Mixture:
        """Return the valley along a camera's phi; raise InputError where numbers do not fit each other or keys."""
        where = f"posterior.profiles.{camera}"
        require_keys(self.keys, known, where)
        if not self.keys or self.keys[0][:3] != ("camera", camera, "phi"):
            raise InputError(f"{where} does not begin with phi of camera {camera!r}: calibrate again")
        require_alike(where, self.keys, self.steps, (self.rises, self.information))
        if len(self.steps) < 2:
            raise InputError(f"{where} has no valley: calibrate again")
        across = tuple(information_from(row, self.keys[1:], f"{where}.information") for row in self.information)
        is_open = self.open_below, self.open_above
        steps, rises = np.array(self.steps), np.array(self.rises)
        return Mixture.along_phi(tuple(self.keys), self.phi_px, steps, rises, across, is_open)


class BendsFile(msgspec.Struct, forbid_unknown_fields=True):
    """Deviations from the quadratic model: one end of each weak direction."""

    keys: list[Key]
    steps: list[list[float]]
    ends: list[list[float]]
    half_width: float

    def mixture(self, information: Information) -> Mixture | None:
        """Return its components; raise InputError where its numbers do not fit each other or the known keys."""
        require_alike("posterior.bends", self.keys, self.steps, (self.ends,))
        require_alike("posterior.bends", self.keys, self.ends, ())
        require_keys(self.keys, information.keys, "posterior.bends")
        steps, ends = np.array(self.steps), np.array(self.ends)
        bent = np.any(steps != 0.0, axis=1)
        mixture, own = None, information.marginal(self.keys)
        if bent.any():
            near, far = (np.concatenate([part[bent], -part[bent]]) for part in (steps, ends))
            mixture = Ends(tuple(self.keys), near, far, self.half_width, own).mixture(information)
        minima = over(ends[~bent], self.keys, information.keys)
        if len(minima):
            likely = np.full(len(minima), 1.0 / (len(minima) + 1.0))
            mixture = (mixture or Mixture.of_one(information)).shifted_also(likely, minima[:, None])
        return mixture
