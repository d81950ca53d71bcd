"""A prior's block: root (x - mean) over every camera, station and structure number that it speaks of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose, left_jacobian, rotation_exp, rotation_log, skew
from ceres_cal.problem.costs import CachedCost, CostValue, Run
from ceres_cal.problem.information import STATION_QUANTITIES, columns_by_owner
from ceres_cal.problem.parameters import Estimate, Layout, intrinsic_names, intrinsics_scales
from ceres_cal.problem.priors import USUAL_BENDS, GaussianPrior, logarithmic


class _Linear(NamedTuple):
    """Numbers that stand in a solver's block themselves, one of them for each column of the prior."""

    columns: list[int]
    slots: list[int]
    scales: Array
    size: int

    def values(self, block: Array) -> Array:
        """(n,) in the units of the keys."""
        return np.asarray(block[self.slots] * self.scales)

    def slopes(self, block: Array, root: Array) -> Array:
        """(R, size) derivatives by the block of root (R, n) times the values."""
        slopes = np.zeros((len(root), self.size))
        slopes[:, self.slots] = root * self.scales
        return slopes


class _StationCoordinates(NamedTuple):
    """A station's position, and its turn from the prior's rotation about its own axes."""

    columns: list[int]
    rows: list[int]
    rotation: Array
    size: int = 6

    def values(self, block: Array) -> Array:
        """(n,) in the units of the keys."""
        pose = Pose.exp(block)
        turn = rotation_log(pose.rotation @ self.rotation.T)
        return np.concatenate([pose.position, turn])[self.rows]

    def slopes(self, block: Array, root: Array) -> Array:
        """(R, 6) derivatives of root (R, n) times the values by the rotation vector and the translation."""
        inverse, left = rotation_exp(block[:3]).T, left_jacobian(block[:3])
        slopes = np.zeros((6, 6))
        slopes[:3] = np.hstack([-inverse @ skew(block[3:]) @ left, -inverse])
        turn = rotation_log(inverse.T @ self.rotation.T)
        slopes[3:, :3] = np.linalg.solve(left_jacobian(turn), left)
        return np.asarray(root @ slopes[self.rows])


class PriorCost(CachedCost):
    """root (x - mean), in standard deviations, of a prior on free numbers alone.

    Attributes:
        owners: whose blocks the solver hands over, as ("camera" or "station", name), or ("structure", "").
    """

    def __init__(self, run: Run, prior: GaussianPrior, estimate: Estimate, layout: Layout) -> None:
        super().__init__(run)
        self._is_usual, self._is_log = prior.is_usual, prior.is_log
        self._root, self._mean = prior.information.root, prior.mean
        parts = dict(_parts(prior, estimate, layout))
        self._parts = list(parts.values())
        self.owners: list[tuple[str, str]] = list(parts)
        self.set_num_residuals(len(self._root))
        self.set_parameter_block_sizes([part.size for part in self._parts])

    def evaluated(self, at: Array, parameters: Sequence[Array]) -> CostValue:
        off, blocks = -self._mean, list(zip(self._parts, parameters, strict=True))
        for part, block in blocks:
            off[part.columns] += part.values(block)
        root = self._root
        if self._is_log:
            off, slope = logarithmic(off, self._mean)
            root = root * slope
        residuals = self._root @ off
        if self._is_usual:
            residuals, slope = _bent(residuals)
            root = slope[:, None] * root
        slopes = [part.slopes(block, root[:, part.columns]).reshape(-1) for part, block in blocks]
        return CostValue(at, residuals, slopes)


def _bent(residuals: Array) -> tuple[Array, Array]:
    """(R,) residuals whose squares are Cauchy's loss of these, and their derivatives by them: each for itself."""
    least = 1e-12  # over where it bends: Cauchy's loss leaves that as it is
    squares = np.maximum((residuals / USUAL_BENDS) ** 2, least**2)
    lengths = np.sqrt(np.log1p(squares))
    return USUAL_BENDS * np.copysign(lengths, residuals), np.sqrt(squares) / (lengths * (1.0 + squares))


def _parts(
    prior: GaussianPrior, estimate: Estimate, layout: Layout
) -> Sequence[tuple[tuple[str, str], _Linear | _StationCoordinates]]:
    """The blocks that a prior depends on, by owner."""
    parts: list[tuple[tuple[str, str], _Linear | _StationCoordinates]] = []
    for (kind, owner), columns in columns_by_owner(prior.keys).items():
        quantities = [prior.keys[column].quantity for column in columns]
        if kind == "camera":
            camera, free = estimate.cameras[owner], layout.free[owner].tolist()
            numbers = [intrinsic_names(camera.lens).index(quantity) for quantity in quantities]
            slots, scales = [free.index(number) for number in numbers], 1.0 / intrinsics_scales(camera)[numbers]
            parts.append(((kind, owner), _Linear(columns, slots, scales, len(free))))
        elif kind == "station":
            rows = [STATION_QUANTITIES.index(quantity) for quantity in quantities]
            # Without turns among its numbers any rotation will do.
            rotation = prior.rotations.get(owner, estimate.stations[owner].cam_from_world.rotation)
            parts.append(((kind, owner), _StationCoordinates(columns, rows, rotation)))
    structure = [column for column, key in enumerate(prior.keys) if key.is_structure]
    if structure:
        names = estimate.structure.names
        slots = [names.index(prior.keys[column].structure_name) for column in structure]
        parts.append((("structure", ""), _Linear(structure, slots, np.ones(len(slots)), len(names))))
    return parts
