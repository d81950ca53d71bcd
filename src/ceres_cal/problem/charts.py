"""A camera's numbers as Ceres moves them, where phi and height trade off along a straight line.

A picture taken straight down tells phi over height alone: with another phi everything looks the same from another
height, through a lens whose coefficients of tan^n have grown with phi^(n - 1). Along this curve Gauss-Newton creeps. In
coefficients over phi^(n - 1), which act on pixels as the paper's do, it is a line.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyceres

from ceres_cal.base.arrays import Array, Indices
from ceres_cal.problem.costs import Run
from ceres_cal.problem.parameters import unit_px
from ceres_cal.scene.camera import Camera

_PHI = 0  # of the intrinsics


class Chart:
    """What of a camera's free numbers Ceres moves in their stead; Ceres' own word is a manifold, which pyceres cannot
    have made in Python.
    """

    def __init__(self, camera: Camera, free: Indices) -> None:
        powers = np.array([0.0] * 4 + [order - 1.0 for order in camera.lens.orders] + [0.0])
        self._powers, self._phi, self._unit = powers[free], free.tolist().index(_PHI), unit_px(camera)

    def moved(self, numbers: Array) -> Array:
        """(K,) what Ceres moves, of the free numbers (K,)."""
        return np.asarray(numbers / self._scales(numbers))

    def numbers(self, moved: Array) -> Array:
        """(K,) the free numbers again."""
        return np.asarray(moved * self._scales(moved))

    def chained(self, jacobian: Array, numbers: Array) -> Array:
        """(N, K) derivatives by what Ceres moves, from those by the free numbers (K,)."""
        chained = jacobian * self._scales(numbers)
        chained[:, self._phi] += jacobian @ (self._powers * numbers) / numbers[self._phi]
        return np.asarray(chained)

    @np.errstate(all="ignore")  # phi may be 0 on the way: no camera, which shows nothing
    def _scales(self, numbers: Array) -> Array:
        return np.asarray((numbers[self._phi] / self._unit) ** self._powers)


def chart_of(camera: Camera, free: Indices) -> Chart | None:
    """None where the numbers are moved as they are."""
    return Chart(camera, free) if camera.lens.acts_on_tangents and _PHI in free else None


_CostFunction: Any = pyceres.CostFunction  # which has no types


class ChartedCost(_CostFunction):
    """A cost function over what Ceres moves, of one over the numbers themselves."""

    def __init__(self, run: Run, cost: Any, charts: Sequence[Chart | None]) -> None:
        super().__init__()
        self._run, self._cost, self._charts = run, cost, charts
        self.set_num_residuals(cost.num_residuals())
        self.set_parameter_block_sizes(cost.parameter_block_sizes())

    def Evaluate(self, parameters: Sequence[Array], residuals: Array, jacobians: Sequence[Array] | None) -> bool:
        with self._run:
            numbers = [
                chart.numbers(block) if chart else block for chart, block in zip(self._charts, parameters, strict=True)
            ]
            if not self._cost.Evaluate(numbers, residuals, jacobians):
                return False
            for chart, jacobian, block in zip(self._charts, jacobians or (), numbers, strict=False):
                if chart:
                    jacobian[:] = chart.chained(jacobian.reshape(len(residuals), -1), block).reshape(-1)
            return True
        return False
