"""ROS camera_info as YAML, as read by camera_calibration_parsers. It has no pose; the pose is stored beside it as a
static transform from the optical frame to the field.

src ros-perception/image_common camera_calibration_parsers/src/parse_yml.cpp.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any

import numpy as np

from ceres_cal.base import Array, InputError, Pose, quaternion, rotation_of
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest, calibration_of
from ceres_cal.formats.loss import as_foreign, loss_words
from ceres_cal.formats.yaml_files import numbers_at, read_yaml, yaml_text
from ceres_cal.scene.foreign import FISHEYE, ForeignCamera

_ECHOED = {"width": "image_width", "height": "image_height", "k": "camera_matrix", "d": "distortion_coefficients"}
"""Names in the message itself, as `rostopic echo` and `ros2 topic echo` print it: names in a file of the parsers."""
_MODELS = {"opencv5": "plumb_bob", "opencv8": "rational_polynomial", FISHEYE: "equidistant"}


def _export(
    request: ExportRequest,
    *,
    world_frame: Annotated[str, "parent of the static transform; default: field"] = "field",
) -> Export:
    (name,), ((foreign,), losses) = request.stations, as_foreign(request, lambda _: tuple(_MODELS))
    projection = np.column_stack([foreign.matrix, np.zeros(3)])
    (width, height), pose = foreign.image_size, foreign.pose.inverse
    frames = {"frame_id": world_frame, "child_frame_id": f"{name}_optical_frame"}
    x, y, z = pose.translation.tolist()
    qx, qy, qz, qw = quaternion(pose.rotation).tolist()
    data = {
        "image_width": width,
        "image_height": height,
        "camera_name": name,
        "camera_matrix": _matrix(foreign.matrix),
        "distortion_model": _MODELS[foreign.model],
        "distortion_coefficients": _matrix(np.array([foreign.coefficients])),
        "rectification_matrix": _matrix(np.eye(3)),
        "projection_matrix": _matrix(projection),
        "static_transform": frames | {"x": x, "y": y, "z": z, "qx": qx, "qy": qy, "qz": qz, "qw": qw},
        "loss": "; ".join(loss_words(*losses)),
    }
    words = f"{_MODELS[foreign.model]}, and the pose as static_transform, whose names are static_transform_publisher's"
    warnings = ["equidistant is unknown to installations before 2021"] if foreign.model == FISHEYE else []
    facts = {"static_transform": data["static_transform"]}
    return Export(yaml_text(data).encode(), losses, words, facts, (*warnings,))


def _matrix(values: Array) -> dict[str, Any]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


def _read(request: ImportRequest) -> Any:
    first = next(filter(str.strip, re.split(r"(?m)^---.*$", request.text)), "")  # of messages that were echoed
    echoed = read_yaml(first)
    data = {_ECHOED.get(name.lower(), name): value for name, value in echoed.items()}
    sizes = [data.get(name) for name in ("image_width", "image_height")]
    if not all(isinstance(size, int) and size > 0 for size in sizes):
        raise InputError(f"image_width and image_height must be whole numbers above 0, not {sizes}")
    matrix = _values(data, "camera_matrix", 9).reshape(3, 3)
    if matrix[0, 0] == 0.0:
        raise InputError("its K is 0: this is how ROS says that a camera was never calibrated")
    coefficients = _values(data, "distortion_coefficients", None)
    model = data.get("distortion_model", "plumb_bob")
    if model not in _MODELS.values():
        raise InputError(f"distortion_model {model!r} is unknown: one of {', '.join(_MODELS.values())}")
    size, fisheye = (sizes[0] or 0, sizes[1] or 0), model == _MODELS[FISHEYE]
    camera = ForeignCamera.opencv(size, matrix, coefficients, _pose(data), fisheye=fisheye)
    name = str(data.get("camera_name") or "camera")
    return calibration_of("a ROS camera_info", {name: camera})


def _values(data: Mapping[str, Any], name: str, count: int | None) -> Array:
    entry = data.get(name)
    if isinstance(entry, list):
        return numbers_at(entry, name, count)
    if not isinstance(entry, dict):
        raise InputError(f"it has no {name} with rows, cols and data, or as a list")
    return numbers_at(entry.get("data"), f"{name}.data", count)


def _pose(data: Mapping[str, Any]) -> Pose | None:
    entry = data.get("static_transform")
    if not isinstance(entry, dict):
        return None
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    values = numbers_at([entry.get(name) for name in names], "static_transform", 7)
    return Pose(rotation_of(values[3:]), values[:3]).inverse


def _recognises(content: bytes) -> bool:
    others = (b"opencv-matrix", b"camera_model")  # OpenCV's and Kalibr's
    return b"distortion_model" in content and not any(mark in content for mark in others)


FORMATS = (
    ExportFormat("ros", "ROS camera_info, the pose beside it", (".yaml", ".yml"), _export),
    ImportFormat("ros", "ROS camera_info", (".yaml", ".yml"), _recognises, _read),
)
