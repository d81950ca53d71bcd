"""The posterior as calibration files have it: lower triangles, every number exactly."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from ceres_cal.errors import InputError
from ceres_cal.quantities import Key
from ceres_cal.transforms import Array
from ceres_cal.uncertainty.posterior import Posterior


class PosteriorFile(msgspec.Struct, forbid_unknown_fields=True):
    """The posterior in a calibration's file; freedom is null where the sigmas were taken as stated."""

    keys: list[Key]
    information: list[float]
    placements: dict[str, list[float]]
    freedom: float | None


def posterior_to_json(posterior: Posterior) -> dict[str, Any]:
    """Lower triangles, row by row."""
    rows, columns = np.tril_indices(6)
    return {
        "keys": [list(key) for key in posterior.keys],
        "information": posterior.information[np.tril_indices(len(posterior.keys))].tolist(),
        "placements": {name: matrix[rows, columns].tolist() for name, matrix in posterior.placements.items()},
        "freedom": posterior.freedom if np.isfinite(posterior.freedom) else None,
    }


def posterior_from_file(data: PosteriorFile) -> Posterior:
    """The posterior of a file.

    Raises:
        InputError: a matrix of the wrong size.
    """
    return Posterior(
        tuple(data.keys),
        _symmetric(data.information, len(data.keys), "posterior.information"),
        {name: _symmetric(row, 6, f"posterior.placements.{name}") for name, row in data.placements.items()},
        np.inf if data.freedom is None else data.freedom,
    )


def _symmetric(triangle: list[float], size: int, where: str) -> Array:
    rows, columns = np.tril_indices(size)
    if len(triangle) != len(rows):
        raise InputError(f"{where} has {len(triangle)} numbers, not {len(rows)}: calibrate again")
    matrix = np.empty((size, size))
    matrix[rows, columns] = triangle
    matrix[columns, rows] = triangle
    return matrix
