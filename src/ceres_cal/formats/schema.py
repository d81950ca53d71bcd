"""JSON schemas of our own files, made of the very types that read them."""

from __future__ import annotations

from typing import Any

import msgspec


def file_schemas() -> dict[str, dict[str, Any]]:
    """Name of the shipped file -> schema: of calibrations and of observations."""
    from ceres_cal.calibration import CalibrationFile
    from ceres_cal.observations.files import ObservationsFile

    kinds = {"calibration": CalibrationFile, "observations": ObservationsFile}
    schemas = {f"{name}.schema.json": msgspec.json.schema(kind) for name, kind in kinds.items()}
    plain: dict[str, dict[str, Any]] = msgspec.json.decode(msgspec.json.encode(schemas))  # defaults are tuples
    return plain
