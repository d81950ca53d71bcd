"""YAML of others: read with one line of complaint, written with short rows in one line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError


def read_yaml(text: str) -> dict[str, Any]:
    """A YAML file of names and values.

    Raises:
        InputError: it is none.
    """
    import yaml

    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise InputError(f"not valid YAML (cut short?): {' '.join(str(error).split())}") from None
    if not isinstance(data, dict):
        raise InputError("not a YAML file of names and values")
    return data


def yaml_text(data: Mapping[str, Any]) -> str:
    """Names and values as YAML, in their order; lists of plain numbers in one line."""
    import yaml

    return str(yaml.safe_dump(dict(data), sort_keys=False, default_flow_style=None, width=120))


def numbers_at(values: Any, where: str, count: int | None = None) -> Array:
    """A list of finite numbers, of lists of them, too, as one array (N,).

    Raises:
        InputError: naming `where`: something else, or another count.
    """
    try:
        numbers = np.array(values, dtype=float).ravel()
    except (TypeError, ValueError):
        numbers = np.full(1, np.nan)
    if not np.all(np.isfinite(numbers)) or (count is not None and len(numbers) != count):
        raise InputError(f"{where} must be {count if count is not None else 'some'} finite numbers, not {values}")
    return numbers
