"""Write the JSON schemas that the package ships, after a change of its files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ceres_cal.base.files import write_json
from ceres_cal.formats.schema import file_schemas

FOLDER = Path(__file__).parents[2] / "src/ceres_cal/schemas"


def main(arguments: Sequence[str]) -> int:
    for name, schema in file_schemas().items():
        write_json(FOLDER / name, schema)
        print(FOLDER / name)
    return 0
