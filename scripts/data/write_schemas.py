"""Write the JSON schemas that are part of the package, after a change of its files."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from ceres_cal.base.files import write_json
from ceres_cal.calibration import CalibrationFile
from ceres_cal.observations.files import ObservationsFile

FOLDER = Path(__file__).parents[2] / "src/ceres_cal/schemas"


def file_schemas() -> dict[str, dict[str, Any]]:
    """Name of the schema file -> schema, of calibrations and of observations."""
    kinds = {"calibration": CalibrationFile, "observations": ObservationsFile}
    schemas = {f"{name}.schema.json": msgspec.json.schema(kind) for name, kind in kinds.items()}
    plain: dict[str, dict[str, Any]] = _alike(msgspec.json.decode(msgspec.json.encode(schemas)))  # defaults are tuples
    return plain


def _alike(part: Any) -> Any:
    """A part of a schema, the same for every version of msgspec: 0.23 removes the indentation of docstrings, and writes
    empty defaults.
    """
    if isinstance(part, list):
        return [_alike(one) for one in part]
    if not isinstance(part, dict):
        return part
    kept = {name: _alike(one) for name, one in part.items() if (name, one) != ("default", {})}
    words = kept.get("description")
    return {**kept, "description": inspect.cleandoc(words)} if isinstance(words, str) else kept


def main(arguments: Sequence[str]) -> int:
    for name, schema in file_schemas().items():
        write_json(FOLDER / name, schema)
        print(FOLDER / name)
    return 0
