"""Dataclasses that people fill in from Python: every field is of the type that its annotation says."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, get_type_hints

import numpy as np

from ceres_cal.base.files import convert


def take_types(instance: Any) -> None:
    """Give a new dataclass plain Python values of the types that it annotates: a list for a tuple, and NumPy's numbers,
    are taken for what they hold.

    Raises:
        InputError: a value is of another type: names the field.
    """
    for name, kind in _fields(type(instance)).items():  # type: ignore[arg-type] # a class has a hash
        where = f"{type(instance).__name__}({name}=...)"
        object.__setattr__(instance, name, convert(_plain(getattr(instance, name)), kind, where))


@cache
def _fields(of: type) -> dict[str, Any]:
    return get_type_hints(of)


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's, also inside of lists and mappings."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, Mapping):
        return {name: _plain(entry) for name, entry in value.items()}
    return value
