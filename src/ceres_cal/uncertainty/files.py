"""The posterior as calibration files have it: lower triangles, every number exactly."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.model.information import Information
from ceres_cal.model.keys import Key, pose_keys
from ceres_cal.uncertainty.posterior import Posterior
from ceres_cal.uncertainty.profile import PhiProfile


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


def posterior_to_file(posterior: Posterior) -> PosteriorFile:
    """Lower triangles, row by row."""
    degrees = posterior.degrees_of_freedom
    return PosteriorFile(
        list(posterior.keys),
        lower_triangle(posterior.information),
        {name: lower_triangle(information) for name, information in posterior.placements.items()},
        degrees if np.isfinite(degrees) else None,
        {name: _profile_to_file(profile) for name, profile in posterior.profiles.items()},
    )


def _profile_to_file(profile: PhiProfile) -> ProfileFile:
    return ProfileFile(
        list(profile.keys),
        profile.phi_px,
        profile.steps.tolist(),
        profile.rises.tolist(),
        [lower_triangle(information) for information in profile.across],
        profile.open_below,
        profile.open_above,
    )


def posterior_from_file(data: PosteriorFile) -> Posterior:
    """The posterior of a file.

    Raises:
        InputError: a matrix of the wrong size.
    """
    placements = {
        name: information_from(row, pose_keys("placement", name), f"posterior.placements.{name}")
        for name, row in data.placements.items()
    }
    return Posterior(
        information_from(data.information, data.keys, "posterior.information"),
        placements,
        np.inf if data.freedom is None else data.freedom,
        {name: _profile_from_file(name, entry) for name, entry in data.profiles.items()},
    )


def _profile_from_file(name: str, data: ProfileFile) -> PhiProfile:
    where, size = f"posterior.profiles.{name}", len(data.keys)
    counts = {len(data.steps), len(data.rises), len(data.information)}
    if len(counts) != 1 or any(len(row) != size for row in data.steps):
        raise InputError(f"{where}: steps, rises and information do not fit each other: calibrate again")
    return PhiProfile(
        name,
        tuple(data.keys),
        data.phi_px,
        np.array(data.steps),
        np.array(data.rises),
        tuple(information_from(row, data.keys[1:], f"{where}.information") for row in data.information),
        data.open_below,
        data.open_above,
    )


def lower_triangle(information: Information) -> list[float]:
    """Row by row, the diagonal included."""
    return list(information.matrix[np.tril_indices(len(information.keys))].tolist())


def information_from(triangle: Sequence[float], keys: Sequence[Key], where: str) -> Information:
    """Information about the keys from the lower triangle of its matrix.

    Raises:
        InputError: not as many numbers as it takes.
    """
    rows, columns = np.tril_indices(len(keys))
    if len(triangle) != len(rows):
        raise InputError(f"{where} has {len(triangle)} numbers, not {len(rows)}: calibrate again")
    matrix = np.empty((len(keys), len(keys)))
    matrix[rows, columns] = triangle
    matrix[columns, rows] = triangle
    return Information(tuple(keys), matrix)
