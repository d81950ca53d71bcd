"""Sums by group."""

from __future__ import annotations

from typing import Any

import numpy as np

from ceres_cal.kernels.jit import jit


@jit
def grouped_scatter(values: Any, bounds: Any, scatter: Any) -> None:
    """Mean of (v - mean)(v - mean)^T over values[bounds[g]:bounds[g + 1]] for every group g, to `scatter`, (groups, k,
    k).
    """
    size = values.shape[1]
    mean = np.empty(size)
    for g in range(len(bounds) - 1):
        count = bounds[g + 1] - bounds[g]
        mean[:] = 0.0
        scatter[g] = 0.0
        for n in range(bounds[g], bounds[g + 1]):
            for i in range(size):
                mean[i] += values[n, i]
        mean /= count
        for n in range(bounds[g], bounds[g + 1]):
            for i in range(size):
                for j in range(i + 1):
                    scatter[g, i, j] += (values[n, i] - mean[i]) * (values[n, j] - mean[j])
        for i in range(size):
            for j in range(i + 1):
                scatter[g, i, j] /= count
                scatter[g, j, i] = scatter[g, i, j]
