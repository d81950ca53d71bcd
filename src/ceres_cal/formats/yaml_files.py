"""YAML files of other programs: read with errors of one line, written with short rows on one line."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np

from ceres_cal.base import Array, InputError, require_room
from ceres_cal.scene.camera import LARGEST


def read_yaml(text: str) -> dict[str, Any]:
    """Read a YAML file of names and values.

    Raises:
        InputError: it is none.
    """
    bytes_per_value = 100
    bytes_per_letter = 200  # bytes of memory for each letter while YAML is read, which also takes 10 us
    import yaml

    require_room(float(bytes_per_letter * len(text)), "its YAML")
    try:
        data = yaml.load(text, _loader())
        size = _size(data, {})
    except (yaml.YAMLError, ValueError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"not valid YAML (cut short?): {' '.join(str(error).split())}") from None
    if not (isinstance(data, dict) and all(isinstance(name, str) for name in data)):
        raise InputError("not a YAML file of names and values")
    if math.isinf(size):
        raise InputError("its YAML contains a reference to itself: remove it")
    require_room(bytes_per_value * size, "its YAML")
    return data


@cache
def _loader() -> Any:
    """PyYAML's safe loader with three restrictions: no duplicate keys, no merged keys, which may multiply without end,
    and no numbers in base 60 such as 1:30:00, which are text since YAML 1.2 and whose sum takes the square of their
    length.
    """
    import yaml

    def number(loader: Any, node: Any) -> Any:
        text = loader.construct_scalar(node)
        return text if ":" in text else loader.construct_yaml_int(node)

    loader: Any = type("Loader", (yaml.SafeLoader,), {"flatten_mapping": _require_unique_keys})
    loader.add_constructor("tag:yaml.org,2002:int", number)
    return loader


def _require_unique_keys(_: Any, node: Any) -> None:
    keys = [str(key.value) for key, _ in node.value]
    if len(set(keys)) < len(keys) or "<<" in keys:
        again = next((key for key, count in Counter(keys).items() if count > 1), "<<")
        raise InputError(f"{again[:100]!r} is given twice or merged in one place: keep one of them")


def _size(value: Any, known: dict[int, float]) -> float:
    """Number of values, counting those behind an alias each time; infinite where a value contains itself."""
    if not isinstance(value, dict | list | tuple):
        return 1.0
    if id(value) not in known:
        known[id(value)] = math.inf
        parts = value.values() if isinstance(value, dict) else value
        known[id(value)] = 1.0 + sum(_size(part, known) for part in parts)
    return known[id(value)]


def yaml_text(data: Mapping[str, Any]) -> str:
    """Format names and values as YAML, in their order; lists of plain numbers on one line."""
    import yaml

    return str(yaml.safe_dump(dict(data), sort_keys=False, default_flow_style=None, width=120))


def numbers_at(values: Any, where: str, count: int | None = None, given: str = "") -> Array:
    """Return a list of finite numbers, possibly nested, as one array (N,); `given`: how the file writes them.

    Raises:
        InputError: naming `where`: something else, or another count.
    """
    some = count if count is not None else "some"
    refused = InputError(f"{where} must be {some} finite numbers, not {given or values}")
    try:
        numbers = np.array(values, dtype=float).ravel()
    except (TypeError, ValueError, OverflowError):
        raise refused from None
    if not np.all(np.abs(numbers) < LARGEST) or (count is not None and len(numbers) != count):
        raise refused
    return numbers
