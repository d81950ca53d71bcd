"""SSL_GeometryData: the league's geometry message as protobuf, and as vision-processor's geometry.yml.

An existing file keeps its field, its ball models and the cameras that are not exported; in a geometry.yml only the
lines of `calib` are replaced.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ceres_cal.base import InputError, attempt, replace
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest, calibration_of
from ceres_cal.formats.loss import field_box
from ceres_cal.formats.opencv import ImageSize
from ceres_cal.formats.ssl_cameras import CameraIds, as_before, to_cameras, to_entries
from ceres_cal.formats.ssl_fields import field_of, target_of
from ceres_cal.formats.ssl_messages import geometry_from_bytes, to_bytes
from ceres_cal.formats.yaml_files import read_yaml, yaml_text
from ceres_cal.scene import still


def geometry_of(request: ExportRequest, camera_id: str, before: Mapping[str, Any]) -> tuple[dict[str, Any], Export]:
    """Return SSL_GeometryData as plain data, with the field and the other cameras of the existing file.

    Raises:
        InputError: neither the calibration nor the existing file has a field.
    """
    targets = still(request.calibration.targets)
    if "field" in before:
        size = dict(before["field"])
        targets = targets or {"field": target_of(size)}
    elif targets:
        size = field_of(next(iter(targets.values())))
    else:
        raise InputError("the message needs a field, but the calibration has none: export into a file with a field, "
                         "such as one that `ceres-cal listen` wrote")  # fmt: skip
    entries, exported = to_entries(request, camera_id, field_box(targets))
    others = {int(entry["camera_id"]): dict(entry) for entry in before.get("calib") or []}
    written = {number: as_before(entry, others.get(number)) for number, entry in entries.items()}
    cameras = dict(sorted({**others, **written}.items()))
    data = {"field": size, "calib": list(cameras.values())}
    if before.get("models"):
        data["models"] = before["models"]
    return data, replace(exported, words=f"{exported.words} of {len(cameras)} in ssl-vision's model")


def _export_packet(request: ExportRequest, *, camera_id: CameraIds = "") -> Export:
    before = {} if request.existing is None else geometry_from_bytes(request.existing)
    data, exported = geometry_of(request, camera_id, before)
    return replace(exported, content=to_bytes("SSL_GeometryData", data))


def _export_yaml(request: ExportRequest, *, camera_id: CameraIds = "") -> Export:
    text = "" if request.existing is None else request.existing.decode("utf-8", errors="replace")
    before = _checked(read_yaml(text)) if text.strip() else {}
    data, exported = geometry_of(request, camera_id, before)
    to_bytes("SSL_GeometryData", data)  # raises InputError for what a reader would refuse
    if "field" not in before:
        return replace(exported, content=yaml_text(data).encode())
    return replace(exported, content=_with_calib(text, yaml_text({"calib": data["calib"]})).encode())


def _with_calib(text: str, block: str) -> str:
    """Replace the block `calib:` of a YAML text, or append it."""
    lines = text.splitlines(keepends=True)
    first = next((n for n, line in enumerate(lines) if line.startswith("calib:")), len(lines))
    last = next((n for n in range(first + 1, len(lines)) if lines[n][0] not in " #-\r\n\t"), len(lines))
    head = "".join(lines[:first])
    head = head if head.endswith("\n") or not head else head + "\n"
    return head + block + "".join(lines[last:])


def _checked(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parts of a geometry.yml that belong to the message."""
    if not isinstance(data.get("field"), dict):
        raise InputError("it has no `field`")
    calib = data.get("calib") or []
    if not isinstance(calib, list) or not all(isinstance(entry, dict) for entry in calib):
        raise InputError("`calib` must be a list of cameras")
    kept: dict[str, Any] = {"field": data["field"], "calib": calib}
    return kept | ({"models": data["models"]} if data.get("models") else {})


# ---- reading --------------------------------------------------------------------------------------------------------


def read_geometry(content: bytes) -> dict[str, Any]:
    """Read a geometry.yml, an SSL_GeometryData or a wrapper packet as plain data; InputError if it is none of them."""
    if b"field:" in content:  # a packet contains no names of fields
        data = _checked(read_yaml(content.decode("utf-8", errors="replace")))
        to_bytes("SSL_GeometryData", {**data, "models": data.get("models", {})})
        return data
    return geometry_from_bytes(content)


def _read(request: ImportRequest, *, image_size: ImageSize = "") -> Any:
    data = read_geometry(request.content)
    cameras, warnings = to_cameras(data.get("calib", []), image_size)
    if not cameras:
        raise InputError("it holds no calibrated camera, only a field: `ceres-cal targets import` takes that")
    warnings.append(
        "a message does not say whether ssl-vision's OpenCV mode wrote it: then its distortion is OpenCV's k1"
    )
    return calibration_of("an SSL geometry", cameras, {"field": target_of(data["field"])}, warnings)


def _recognises_packet(content: bytes) -> bool:
    return isinstance(attempt(lambda: geometry_from_bytes(content)), dict)  # quiet: which format it is, is asked


_NAME, _YAML_NAME, _ENDINGS, _YAML = "ssl-vision", "vision-processor", (".pb", ".bin"), (".yml", ".yaml")
_PACKET, _GEOMETRY_YML = "the league's geometry message", "vision-processor's geometry.yml"
_EDITED = "; a file that is there is edited"
_WRITTEN = f"{_PACKET} (SSL_GeometryData, protobuf){_EDITED}"
FORMATS = (
    ExportFormat(_NAME, _WRITTEN, _ENDINGS, _export_packet, most_stations=None, edits=True),
    ExportFormat(_YAML_NAME, _GEOMETRY_YML + _EDITED, _YAML, _export_yaml, most_stations=None, edits=True),
    ImportFormat(_NAME, _PACKET, _ENDINGS, _recognises_packet, _read),
    ImportFormat(_YAML_NAME, _GEOMETRY_YML, _YAML, lambda content: b"field_length" in content, _read),
)
