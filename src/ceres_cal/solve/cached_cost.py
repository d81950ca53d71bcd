"""What Ceres calls: the last answer is kept, and an exception ends the solve instead of travelling through C++."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pyceres

from ceres_cal.base.arrays import Array


@dataclass(eq=False)
class Run:
    """What the callbacks of one solve share: the first exception in any of them (Ctrl-C too) ends the solve."""

    failure: BaseException | None = None
    history: list[float] = field(default_factory=list)


class Answer(NamedTuple):
    """The residuals (N,) in a place, and the flat Jacobians (N, size) of each block there."""

    at: Array
    residuals: Array
    jacobians: Sequence[Array]


class CachedCost(pyceres.CostFunction):
    """A cost function; what it costs is `_evaluated`."""

    def __init__(self, run: Run) -> None:
        super().__init__()
        self._run = run
        self._known: Answer | None = None

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        try:
            at = np.concatenate(parameters)
            # Ceres asks for the cost of a step first, then for the Jacobian in the same place: once is enough.
            if self._known is None or not np.array_equal(self._known.at, at):
                self._known = self._evaluated(at, parameters)
        except BaseException as error:  # quiet: raised again when Ceres has returned
            self._run.failure = self._run.failure or error
            return False
        if self._known is None:
            return False
        residuals[:] = self._known.residuals
        for jacobian, known in zip(jacobians or (), self._known.jacobians, strict=False):
            jacobian[:] = known
        if jacobians is not None:
            self._accept()
        return True

    def _evaluated(self, at: Array, parameters: Sequence[Array]) -> Answer | None:
        """The answer in a place, whole and by blocks; None where an observation cannot be projected from there.

        For every cost function to say: pyceres' own class has a metaclass that none with abstract methods can join.
        """
        raise NotImplementedError

    def _accept(self) -> None:
        """Jacobians are asked for where a step was accepted, and nowhere else."""
