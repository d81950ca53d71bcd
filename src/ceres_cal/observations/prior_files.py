"""Priors as files of observations have them (docs/files.md)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from ceres_cal.base.errors import InputError
from ceres_cal.base.files import convert
from ceres_cal.observations.columns import PRIOR_OWNERS, Prior


def prior_to_json(prior: Prior) -> dict[str, Any]:
    """A prior as the files have it: `{"station": "a", "height_m": 4.02, "sigma_m": 0.01}`; null: nothing is known."""
    value, sigma = (v[0] if len(v) == 1 else list(v) for v in (prior.value, prior.sigma))
    return {prior.owner: prior.name, prior.quantity: value, _sigma_of(prior.owner): None if prior.is_open else sigma}


def _sigma_of(owner: str) -> str:
    return "sigma" if owner == "camera" else "sigma_m"


def prior_from_json(entry: Mapping[str, Any], where: str) -> Prior:
    """The prior that a file describes.

    Raises:
        InputError: naming `where`, when the entry does not name one owner, one quantity and one sigma.
    """
    rest = dict(entry)
    owners = [key for key in PRIOR_OWNERS if key in rest]
    if len(owners) != 1:
        raise InputError(f'{where}: a prior names one "camera" or one "station", or one "target"')
    name, sigma_key = rest.pop(owners[0]), _sigma_of(owners[0])
    sigma = rest.pop(sigma_key, msgspec.UNSET)
    if sigma is None and owners[0] == "target":
        sigma = np.inf
    if sigma in (None, msgspec.UNSET) or len(rest) != 1:
        raise InputError(f'{where}: a prior of a {owners[0]} has one quantity and "{sigma_key}", not {sorted(entry)}')
    ((quantity, value),) = rest.items()
    size = {"position_m": 3, "principal_point": 2}.get(quantity, 1)
    if owners[0] == "station" and quantity not in ("height_m", "position_m"):
        raise InputError(f"{where}: a station's prior is on height_m or position_m, not {quantity!r}")
    values = _numbers(value, size, f"{where}: {quantity}")
    return Prior(owners[0], str(name), quantity, values, _numbers(sigma, size, f"{where}: {sigma_key}", spread=True))


def _numbers(value: Any, size: int, where: str, *, spread: bool = False) -> tuple[float, ...]:
    if isinstance(value, (int, float)) and (size == 1 or spread):
        return (float(value),) * size
    numbers = convert(value, list[float], where)
    if len(numbers) != size:
        raise InputError(f"{where}: {size} numbers are needed, not {len(numbers)}")
    return tuple(numbers)
