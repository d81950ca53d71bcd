"""The posterior as calibration files have it: lower triangles, every number exactly."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from functools import cache

import msgspec
import numpy as np

from ceres_cal.base.arrays import Indices
from ceres_cal.base.errors import InputError
from ceres_cal.effects.dependence import Dependence
from ceres_cal.posterior.bent import Bends
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.posterior.profile import PhiProfile
from ceres_cal.problem.information import Information, Key, pose_keys


class ProfileFile(msgspec.Struct, forbid_unknown_fields=True):
    """A valley in a calibration's file; at each of its nodes the steps and the lower triangle of the information."""

    keys: list[Key]
    phi_px: float
    steps: list[list[float]]
    rises: list[float]
    information: list[list[float]]
    open_below: bool
    open_above: bool

    @classmethod
    def of(cls, profile: PhiProfile) -> ProfileFile:
        """As a file has it."""
        steps, rises = profile.steps.tolist(), profile.rises.tolist()
        across = [lower_triangle(information) for information in profile.across]
        return cls(list(profile.keys), profile.phi_px, steps, rises, across, profile.open_below, profile.open_above)

    def profile(self, camera: str, known: Collection[Key]) -> PhiProfile:
        """The valley along phi of a camera; InputError where its numbers do not fit each other, or those known."""
        where = f"posterior.profiles.{camera}"
        require_keys(self.keys, known, where)
        if not self.keys or self.keys[0][:3] != ("camera", camera, "phi"):
            raise InputError(f"{where} does not begin with phi of camera {camera!r}: calibrate again")
        counts = {len(self.steps), len(self.rises), len(self.information)}
        if len(counts) != 1 or any(len(row) != len(self.keys) for row in self.steps):
            raise InputError(f"{where}: steps, rises and information do not fit each other: calibrate again")
        steps, rises = np.array(self.steps), np.array(self.rises)
        across = tuple(information_from(row, self.keys[1:], f"{where}.information") for row in self.information)
        return PhiProfile(camera, tuple(self.keys), self.phi_px, steps, rises, across, self.open_below, self.open_above)


class BendsFile(msgspec.Struct, forbid_unknown_fields=True):
    """What leaves the quadratic picture, in a calibration's file: see `Bends`."""

    keys: list[Key]
    steps: list[list[float]]
    ends: list[list[float]]
    half_width: float

    @classmethod
    def of(cls, bends: Bends) -> BendsFile:
        """As a file has it."""
        return cls(list(bends.keys), bends.steps.tolist(), bends.ends.tolist(), bends.half_width)

    def bends(self, known: Collection[Key]) -> Bends:
        """The bends; InputError where their numbers do not fit each other, or those that are known."""
        rows = [*self.steps, *self.ends]
        if len(self.steps) != len(self.ends) or any(len(row) != len(self.keys) for row in rows):
            raise InputError("posterior.bends: steps, ends and keys do not fit each other: calibrate again")
        require_keys(self.keys, known, "posterior.bends")
        return Bends(tuple(self.keys), np.array(self.steps), np.array(self.ends), self.half_width)


class PosteriorFile(msgspec.Struct, forbid_unknown_fields=True):
    """The posterior in a calibration's file; freedom is null where the sigmas were taken as stated."""

    keys: list[Key]
    information: list[float]
    placements: dict[str, list[float]]
    freedom: float | None
    profiles: dict[str, ProfileFile]
    by_model: list[float] | None = None
    dependence: Dependence | None = None
    bends: BendsFile | None = None
    stated_keys: list[Key] = []
    stated: list[float] = []

    @classmethod
    def of(cls, posterior: Posterior) -> PosteriorFile:
        """As a file has it."""
        degrees = posterior.degrees_of_freedom
        return cls(
            list(posterior.keys),
            lower_triangle(posterior.information),
            {name: lower_triangle(information) for name, information in posterior.placements.items()},
            degrees if np.isfinite(degrees) else None,
            {name: ProfileFile.of(profile) for name, profile in posterior.profiles.items()},
            None if posterior.by_model is None else lower_triangle(posterior.by_model),
            posterior.dependence,
            None if posterior.bends is None else BendsFile.of(posterior.bends),
            list(posterior.stated.keys),
            lower_triangle(posterior.stated),
        )

    def posterior(self, known: Collection[Key]) -> Posterior:
        """The posterior; InputError where a matrix has the wrong size, or a number is none of those known."""
        require_keys(self.keys, known, "posterior.keys")
        for name in self.placements:
            require_keys(pose_keys("placement", name), known, "posterior.placements")
        placements = {
            name: information_from(row, pose_keys("placement", name), f"posterior.placements.{name}")
            for name, row in self.placements.items()
        }
        information = information_from(self.information, self.keys, "posterior.information")
        profiles = {name: entry.profile(name, self.keys) for name, entry in self.profiles.items()}
        by_model = self.by_model and information_from(self.by_model, self.keys, "posterior.by_model")
        freedom = np.inf if self.freedom is None else self.freedom
        bends = None if self.bends is None else self.bends.bends(self.keys)
        require_keys(self.stated_keys, self.keys, "posterior.stated_keys")
        stated = information_from(self.stated, self.stated_keys, "posterior.stated")
        return Posterior(information, placements, freedom, profiles, by_model or None, self.dependence, bends, stated)


def lower_triangle(information: Information) -> list[float]:
    """Row by row, the diagonal included."""
    return list(information.matrix[_lower_triangle(len(information.keys))].tolist())


@cache
def _lower_triangle(size: int) -> tuple[Indices, Indices]:
    rows, columns = np.tril_indices(size)
    return rows, columns


def require_keys(keys: Sequence[Key], known: Collection[Key], where: str) -> None:
    """Raise InputError where a key of a file is there twice, or is none of those known."""
    for key, count in Counter(keys).items():
        if count > 1:
            raise InputError(f"{where} names {key.quantity!r} of {key.whose} twice: calibrate again")
        if key not in known:
            raise InputError(f"{where} names {key.quantity!r} of {key.whose}, which is not there: calibrate again")


def information_from(triangle: Sequence[float], keys: Sequence[Key], where: str) -> Information:
    """Information about the keys from the lower triangle of its matrix.

    Raises:
        InputError: not as many numbers as it takes.
    """
    needed = len(keys) * (len(keys) + 1) // 2
    if len(triangle) != needed:
        raise InputError(f"{where} has {len(triangle)} numbers, not {needed}: calibrate again")
    rows, columns = np.tril_indices(len(keys))
    matrix = np.empty((len(keys), len(keys)))
    matrix[rows, columns] = triangle
    matrix[columns, rows] = triangle
    return Information(tuple(keys), matrix)
