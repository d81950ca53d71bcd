"""Observations that answer with sums, as the solve and its information see them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.base.transforms import Poses
from ceres_cal.observations.sights import SightKey
from ceres_cal.problem.costs import CachedCost, CostValue, Run
from ceres_cal.problem.engines import Engine
from ceres_cal.problem.parameters import Estimate
from ceres_cal.problem.problem import Problem
from ceres_cal.problem.shares import Share, ShareRequest, owners_of


@dataclass(frozen=True, eq=False)
class SharedObservations:
    """The observations of an engine's shares, judged at an estimate; see `problem.Elsewhere`."""

    engine: Engine
    keys: tuple[SightKey, ...]
    equations: int
    judged_at: tuple[str, Estimate]
    bounds: tuple[float, float]
    feet_along: tuple[tuple[str, Estimate], ...]

    def asked(self, problem: Problem, estimate: Estimate) -> ShareRequest:
        """What the shares are asked about a problem at an estimate."""
        return ShareRequest(
            of_world(estimate), problem.layout, problem.weighting, self.judged_at, self.bounds, self.feet_along
        )

    def cost(self, run: Run, problem: Problem, estimate: Estimate) -> SharedCost:
        """What Ceres sees of them."""
        return SharedCost(run, self, problem, estimate)

    def normals(self, problem: Problem, estimate: Estimate) -> Mapping[SightKey, Mapping[int, Array]]:
        """Their normal equations by sight and kind."""
        return self.engine.ask(Share.normals, self.asked(problem, estimate)).of


class SharedCost(CachedCost):
    """The compressed blocks of all sights of the shares: a round trip for each place that Ceres looks at.

    Attributes:
        owners: by kind and name, of the numbers that it depends on.
    """

    def __init__(self, run: Run, judged: SharedObservations, problem: Problem, estimate: Estimate) -> None:
        super().__init__(run)
        self._judged, self._asked = judged, judged.asked(problem, estimate)
        layout, sizes = problem.layout, dict[tuple[str, str], int]()
        self._of: dict[SightKey, list[tuple[str, str]]] = {}
        for key in judged.keys:
            own = (
                len(layout.free[key.camera]),
                6 * (key.station in layout.stations),
                0,
                len(estimate.structure.values),
            )
            slots = [slot for slot in range(4) if own[slot]]
            self._of[key] = owners_of(key, slots)
            sizes |= dict(zip(self._of[key], (own[slot] for slot in slots), strict=True))
        self.owners: list[tuple[str, str]] = list(sizes)
        ends = np.cumsum([0, *sizes.values()])
        self._columns = {owner: np.arange(*ends[n : n + 2]) for n, owner in enumerate(sizes)}
        rows = sum(1 + sum(sizes[owner] for owner in own) for own in self._of.values())
        self._shape = rows, int(ends[-1])
        self.set_num_residuals(rows)
        self.set_parameter_block_sizes(list(sizes.values()))

    def _evaluated(self, at: Array, parameters: Sequence[Array]) -> CostValue | None:
        numbers = {owner: at[columns] for owner, columns in self._columns.items()}
        blocks = self._judged.engine.ask(Share.blocks, self._asked, numbers).of
        if blocks is None:
            return None
        residuals, jacobian, row = np.zeros(self._shape[0]), np.zeros(self._shape), 0
        for key, block in blocks.items():
            columns, rows = self._columns_of(key), slice(row, row + len(block))
            jacobian[rows, columns], residuals[rows], row = block[:, :-1], block[:, -1], row + len(block)
        return CostValue(at, residuals, [jacobian[:, columns].reshape(-1) for columns in self._columns.values()])

    def _columns_of(self, key: SightKey) -> Indices:
        """Columns of the numbers that a sight depends on."""
        return np.concatenate([np.empty(0, np.int64), *(self._columns[owner] for owner in self._of[key])])


def of_world(estimate: Estimate) -> Estimate:
    """The estimate without placements, which the shares do not show."""
    return replace(estimate, placements=Poses.of({}))
