"""The posterior as calibration files had it before it was a mixture (0.1): valleys along phi, and ends that bend."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import msgspec
import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import convert
from ceres_cal.posterior.bent import Ends
from ceres_cal.posterior.files import PosteriorFile, information_from, require_alike, require_keys
from ceres_cal.posterior.mixture import Mixture
from ceres_cal.posterior.posterior import Posterior
from ceres_cal.problem.information import Information, Key, over


def as_mixtures(file: PosteriorFile, posterior: Posterior) -> Posterior:
    """The posterior of a file with what it has in place of mixtures; InputError where numbers do not fit each other."""
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
        """The valley along phi of a camera; InputError where its numbers do not fit each other, or those known."""
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
    """What leaves the quadratic picture: one end of each weak direction."""

    keys: list[Key]
    steps: list[list[float]]
    ends: list[list[float]]
    half_width: float

    def mixture(self, information: Information) -> Mixture | None:
        """Its components; InputError where its numbers do not fit each other, or those that are known."""
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
            mixture = (mixture or Mixture.of_one(information)).with_alternatives(likely, minima, information)
        return mixture
