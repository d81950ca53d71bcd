"""What is known of many numbers together: the posterior of an earlier calibration, as the prior of the next."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose
from ceres_cal.scene.camera import Camera

_TOLD = 1e-11  # eigenvalue, at unit diagonal, from which on a direction counts as told


@dataclass(frozen=True, eq=False)
class JointPrior:
    """A normal distribution of some intrinsics, stations and structure numbers, by its information matrix.

    Where the matrix has null directions nothing is known, and nothing is inverted: the residual is
    root (x - mean) with root^T root = information.

    Attributes:
        keys: (K) the numbers, as `quantities.Key` (kind, owner, quantity, unit). information: (K, K).
        cameras, stations (cam_from_world), structure ("target/feature" -> m): the mean.
    """

    keys: tuple[tuple[str, str, str, str], ...]
    information: Array
    cameras: Mapping[str, Camera]
    stations: Mapping[str, Pose]
    structure: Mapping[str, float]

    @cached_property
    def _decomposed(self) -> tuple[Array, Array, Array]:
        """Scale that makes the diagonal one, eigenvalues and eigenvectors of the scaled matrix."""
        diagonal = np.diagonal(self.information)
        scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0)), 1.0)
        values, vectors = np.linalg.eigh(self.information * scale[:, None] * scale)
        return scale, values, vectors

    @cached_property
    def root(self) -> Array:
        """(R, K) one row for each direction that is told, in standard deviations per unit of the keys."""
        scale, values, vectors = self._decomposed
        told = values > _TOLD
        return np.asarray((vectors[:, told] * np.sqrt(values[told])).T / scale)

    @property
    def rank(self) -> int:
        """Number of directions that are told."""
        return len(self.root)

    @cached_property
    def structure_names(self) -> frozenset[str]:
        """The structure numbers among the keys, as "target/feature"."""
        return frozenset(f"{owner}/{quantity}" for kind, owner, quantity, _ in self.keys if kind == "structure")

    def given(self, kept: Collection[tuple[str, str, str, str]]) -> JointPrior:
        """What it says of the kept numbers when all others are held at their mean."""
        places = [place for place, key in enumerate(self.keys) if key in kept]
        keys = tuple(self.keys[place] for place in places)
        return replace(self, keys=keys, information=self.information[np.ix_(places, places)])
