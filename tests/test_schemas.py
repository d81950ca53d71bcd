"""Our own files: the package's schemas are those of the reader, and docs/files.md names every field."""

import json
from pathlib import Path
from typing import Any

import pytest
from data.write_schemas import FOLDER, file_schemas
from foreign_cases import over_field, with_lens

from ceres_cal import Calibration, InputError, Observations

ROOT = Path(__file__).parents[1]


def fields(schema: dict[str, Any]) -> set[str]:
    return {name for part in schema["$defs"].values() for name in part.get("properties", {})}


@pytest.mark.parametrize("name", file_schemas())
def test_the_shipped_schema_is_the_readers(name: str) -> None:
    assert json.loads((FOLDER / name).read_text()) == file_schemas()[name], "run scripts/data/write_schemas.py"


@pytest.mark.parametrize("name", file_schemas())
def test_every_field_is_documented(name: str) -> None:
    text = (ROOT / "docs/files.md").read_text(encoding="utf-8")
    missing = [field for field in sorted(fields(file_schemas()[name])) if field not in text]
    assert not missing, f"docs/files.md does not name {missing}"


def properties(schema: dict[str, Any], data: dict[str, Any]) -> None:
    """What a validator requires at the top of a file: all required fields, none unknown, the stated words."""
    top = schema["$defs"][schema["$ref"].rpartition("/")[2]]
    assert not set(top["required"]) - set(data) and not set(data) - set(top["properties"])
    assert data["units"] in top["properties"]["units"]["enum"] and top["additionalProperties"] is False


def test_what_is_written_obeys_and_what_does_not_is_refused(tmp_path: Path) -> None:
    calibration = over_field(with_lens("brown"))
    noted = Calibration(**{**vars(calibration), "notes": {"lens": "Tamron", "screws": [1, 2]}})
    path = tmp_path / "c.json"
    noted.save(path)
    data = json.loads(path.read_text())
    properties(file_schemas()["calibration.schema.json"], data)
    assert data["cameras"]["overhead"]["camera_matrix"][0][0] == data["cameras"]["overhead"]["phi"]
    assert Calibration.load(path).notes == {"lens": "Tamron", "screws": [1, 2]}
    for change, words in (
        ({"units": "millimetres, radians, pixels"}, r"millimetres.*in units"),
        ({"pixel_origin": "corner of the top-left pixel"}, "in pixel_origin"),
        ({"cameras": {"overhead": {**data["cameras"]["overhead"], "phi": 800.0}}}, "camera_matrix disagrees with"),
    ):
        path.write_text(json.dumps({**data, **change}))
        with pytest.raises(InputError, match=words):
            Calibration.load(path)


OBSERVED = """{"format": "ceres-cal/observations", "version": 1,
 "targets": {"field": {"kind": "ssl-field", "division": "B"}},
 "cameras": {"a": {"image_size": [640, 480]}}, "notes": {"by": "hand"},
 "views": [{"frame": "1", "camera": "a", "target": "field", "curves": {"features": ["TopTouchLine", "CenterCircle"],
 "counts": [2, 1], "pixels": [[1, 2], [3, 4], [5, 6]]}}]}"""


def test_curve_names_stand_once(tmp_path: Path) -> None:
    path = tmp_path / "o.json"
    path.write_text(OBSERVED)
    seen = Observations.load(path)
    assert [seen.feature_name("curve", row) for row in range(3)] == ["TopTouchLine", "TopTouchLine", "CenterCircle"]
    assert seen.notes == {"by": "hand"}
    seen.save(tmp_path / "again.json")
    data = json.loads((tmp_path / "again.json").read_text())
    properties(file_schemas()["observations.schema.json"], data)
    assert data["views"][0]["curves"]["counts"] == [2, 1] and data["notes"] == {"by": "hand"}
    seen.save(tmp_path / "again.npz")
    back = Observations.load(tmp_path / "again.npz")
    assert back.notes == seen.notes and back.digest == seen.digest == Observations.load(tmp_path / "again.json").digest
    old = OBSERVED.replace('"counts": [2, 1], ', "").replace(
        '"TopTouchLine", "Cen', '"TopTouchLine", "TopTouchLine", "Cen'
    )
    path.write_text(old)
    assert Observations.load(path).digest == seen.digest  # as files of today have it
    for counts, words in (
        ("[2]", "counts must be a whole number above 0"),
        ("[2, 2]", "counts add up to 4, but there are 3 pixels"),
    ):
        path.write_text(OBSERVED.replace("[2, 1]", counts))
        with pytest.raises(InputError, match=words):
            Observations.load(path)
