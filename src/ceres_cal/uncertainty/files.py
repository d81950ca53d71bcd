"""The posterior as calibration files have it: lower triangles, every number exactly."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.model.quantities import Key
from ceres_cal.uncertainty.posterior import Posterior
from ceres_cal.uncertainty.profile import Profile


class ProfileFile(msgspec.Struct, forbid_unknown_fields=True):
    """A valley in a calibration's file; of each place the steps and the lower triangle of the information."""

    keys: list[Key]
    phi_px: float
    steps: list[list[float]]
    rises: list[float]
    information: list[list[float]]
    open_below: bool
    open_above: bool


class PosteriorFile(msgspec.Struct, forbid_unknown_fields=True):
    """The posterior in a calibration's file; freedom is null where the sigmas were taken as stated."""

    keys: list[Key]
    information: list[float]
    placements: dict[str, list[float]]
    freedom: float | None
    profiles: dict[str, ProfileFile]


def posterior_to_json(posterior: Posterior) -> dict[str, Any]:
    """Lower triangles, row by row."""
    rows, columns = np.tril_indices(6)
    return {
        "keys": [list(key) for key in posterior.keys],
        "information": lower_triangle(posterior.information),
        "placements": {name: matrix[rows, columns].tolist() for name, matrix in posterior.placements.items()},
        "freedom": posterior.freedom if np.isfinite(posterior.freedom) else None,
        "profiles": {name: _profile_to_json(profile) for name, profile in posterior.profiles.items()},
    }


def _profile_to_json(profile: Profile) -> dict[str, Any]:
    rows, columns = np.tril_indices(len(profile.keys) - 1)
    return {
        "keys": [list(key) for key in profile.keys],
        "phi_px": profile.phi_px,
        "steps": profile.steps.tolist(),
        "rises": profile.rises.tolist(),
        "information": profile.information[:, rows, columns].tolist(),
        "open_below": profile.open_below,
        "open_above": profile.open_above,
    }


def posterior_from_file(data: PosteriorFile) -> Posterior:
    """The posterior of a file.

    Raises:
        InputError: a matrix of the wrong size.
    """
    return Posterior(
        tuple(data.keys),
        symmetric(data.information, len(data.keys), "posterior.information"),
        {name: symmetric(row, 6, f"posterior.placements.{name}") for name, row in data.placements.items()},
        np.inf if data.freedom is None else data.freedom,
        {name: _profile_from_file(name, entry) for name, entry in data.profiles.items()},
    )


def _profile_from_file(name: str, data: ProfileFile) -> Profile:
    where, size = f"posterior.profiles.{name}", len(data.keys)
    counts = {len(data.steps), len(data.rises), len(data.information)}
    if len(counts) != 1 or any(len(row) != size for row in data.steps):
        raise InputError(f"{where}: steps, rises and information do not fit each other: calibrate again")
    told = [symmetric(row, size - 1, f"{where}.information") for row in data.information]
    return Profile(
        name,
        tuple(data.keys),
        data.phi_px,
        np.array(data.steps),
        np.array(data.rises),
        np.array(told),
        data.open_below,
        data.open_above,
    )


def lower_triangle(matrix: Array) -> list[float]:
    """Row by row, the diagonal included."""
    return list(matrix[np.tril_indices(len(matrix))].tolist())


def symmetric(triangle: list[float], size: int, where: str) -> Array:
    """The matrix of a lower triangle.

    Raises:
        InputError: not as many numbers as it takes.
    """
    rows, columns = np.tril_indices(size)
    if len(triangle) != len(rows):
        raise InputError(f"{where} has {len(triangle)} numbers, not {len(rows)}: calibrate again")
    matrix = np.empty((size, size))
    matrix[rows, columns] = triangle
    matrix[columns, rows] = triangle
    return matrix
