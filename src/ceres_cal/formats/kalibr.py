"""Kalibr's camchain: a chain of cameras, each with its pose relative to the one before. It has no world; as in mrcal,
the first camera's T_cn_cnm1 is its pose over the field.

src https://github.com/ethz-asl/kalibr/wiki/yaml-formats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from ceres_cal.base import Array, InputError, Pose, plural, require_rotation
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest, calibration_of
from ceres_cal.formats.loss import as_foreign, loss_words
from ceres_cal.formats.yaml_files import numbers_at, read_yaml, yaml_text
from ceres_cal.scene.foreign import FISHEYE, ForeignCamera, camera_matrix

_MODELS = {"opencv4": "radtan", FISHEYE: "equidistant"}
_PROJECTIONS = {"pinhole": 0, "omni": 1, "ds": 2, "eucm": 2}  # number of parameters before the four of K
_DISTORTIONS = {"none": 0, "radtan": 4, "equidistant": 4, "fov": 1}


def _export(request: ExportRequest) -> Export:
    cameras, losses = as_foreign(request, lambda _: tuple(_MODELS))
    chain, before = {}, Pose.identity()
    for number, (name, foreign) in enumerate(zip(request.stations, cameras, strict=True)):
        between, before = foreign.pose @ before.inverse, foreign.pose
        chain[f"cam{number}"] = {
            "camera_model": "pinhole",
            "intrinsics": [*foreign.focal, *foreign.centre],
            "distortion_model": _MODELS[foreign.model],
            "distortion_coeffs": list(foreign.coefficients),
            "T_cn_cnm1": [*between.matrix.tolist(), [0.0, 0.0, 0.0, 1.0]],
            "resolution": list(foreign.image_size),
            "rostopic": f"/{name}",
        }
    comments = [f"# {line}\n" for loss in losses for line in loss_words(loss)]
    comments.append("# T_cn_cnm1 of cam0 takes points of the field (m) to cam0, as mrcal-to-kalibr writes it\n")
    models = " and ".join(str(one["distortion_model"]) for one in chain.values())
    return Export(("".join(comments) + yaml_text(chain)).encode(), losses, f"{plural(len(chain), 'camera')}, {models}")


def _read(request: ImportRequest) -> Any:
    data = read_yaml(request.text)
    names = sorted((key for key in data if key[:3] == "cam" and key[3:].isdigit()), key=lambda key: int(key[3:]))
    if not names or names != [f"cam{n}" for n in range(len(names))]:
        raise InputError(f"its cameras must be cam0, cam1, ..., not {', '.join(map(str, data)) or 'none'}")
    if wrong := [key for key in names if not isinstance(data[key], dict)]:
        raise InputError(f"{wrong[0]} must have camera_model, intrinsics, ...")
    cameras: dict[str, ForeignCamera] = {}
    pose: Pose | None = None
    for key, name in zip(names, _camera_names(data, names), strict=True):
        entry = data[key]
        if "T_cn_cnm1" in entry:
            pose = _pose(entry, key) @ (pose or Pose.identity())
        elif key != "cam0":
            raise InputError(f"{key} has no T_cn_cnm1, so its pose is unknown")
        cameras[name] = _camera(entry, key, pose)
    return calibration_of("a Kalibr camchain", cameras)


def _camera_names(data: Mapping[str, Any], keys: Sequence[str]) -> Sequence[str]:
    """Return the first part of the topics that differs between all cameras, such as left and right of
    /stereo/left/image_raw and /stereo/right/image_raw; the keys if there is none.
    """
    topics = [str(data[key].get("rostopic") or key).strip("/").split("/") for key in keys]
    parts = zip(*topics, strict=False)  # as far as the shortest reaches
    return next((part for part in parts if len(set(part)) == len(keys)), keys)


def _pose(entry: Mapping[str, Any], key: str) -> Pose:
    matrix = numbers_at(entry["T_cn_cnm1"], f"{key}.T_cn_cnm1", 16).reshape(4, 4)
    return Pose(require_rotation(matrix[:3, :3], f"the turn of {key}.T_cn_cnm1"), matrix[:3, 3])


def _camera(entry: Mapping[str, Any], key: str, pose: Pose | None) -> ForeignCamera:
    model, bent = str(entry.get("camera_model")), str(entry.get("distortion_model", "none"))
    if model not in _PROJECTIONS or bent not in _DISTORTIONS:
        raise InputError(f"{key}: {model!r} with distortion {bent!r} is unknown: one of {', '.join(_PROJECTIONS)} with "
                         f"{', '.join(_DISTORTIONS)}")  # fmt: skip
    extra = _PROJECTIONS[model]
    values = numbers_at(entry.get("intrinsics"), f"{key}.intrinsics", 4 + extra)
    coefficients = numbers_at(entry.get("distortion_coeffs") or [], f"{key}.distortion_coeffs", _DISTORTIONS[bent])
    width, height = numbers_at(entry.get("resolution"), f"{key}.resolution", 2)
    own, (fx, fy, cx, cy) = values[:extra], values[extra:]
    size = int(width), int(height)
    if model == "pinhole" and bent in ("none", "radtan"):
        return ForeignCamera.opencv(size, camera_matrix(fx, fy, cx, cy), coefficients, pose)
    focal, centre = (float(fx), float(fy)), (float(cx), float(cy))
    if model == "pinhole" and bent == "equidistant":
        return ForeignCamera(size, focal, centre, FISHEYE, tuple(coefficients.tolist()), pose)
    return ForeignCamera(
        size, focal, centre, f"{model}-{bent}", (), pose, distort=_distort(model, own, bent, coefficients)
    )


def _distort(model: str, own: Array, bent: str, coefficients: Array) -> Callable[[Array], Array]:
    """Return Kalibr's projection followed by its distortion, at focal length 1."""

    def distort(rays: Array) -> Array:
        x, y, z = rays.T
        away = np.linalg.norm(rays, axis=1)
        if model == "omni":
            depth = z + own[0] * away
        elif model == "ds":
            first = own[0] * away + z
            depth = own[1] * np.sqrt(x * x + y * y + first * first) + (1.0 - own[1]) * first
        elif model == "eucm":
            depth = own[0] * np.sqrt(own[1] * (x * x + y * y) + z * z) + (1.0 - own[0]) * z
        else:
            depth = z
        flat = np.column_stack([x / depth, y / depth, np.ones(len(x))])
        flat[~(depth > 0.0)] = np.nan
        if bent == "fov":
            radius = np.linalg.norm(flat[:, :2], axis=1)
            measured = np.arctan(2.0 * radius * np.tan(0.5 * coefficients[0])) / coefficients[0]
            return np.asarray(flat[:, :2] * np.where(radius > 0.0, measured / radius, 1.0)[:, None])
        kind = FISHEYE if bent == "equidistant" else "opencv4"
        values = tuple(coefficients.tolist()) or (0.0,) * 4
        return ForeignCamera((1, 1), (1.0, 1.0), (0.0, 0.0), kind, values).project_rays(flat)

    return distort


_ABOUT = ("kalibr", "Kalibr's camchain", (".yaml", ".yml"))
FORMATS = (
    ExportFormat(*_ABOUT, _export, most_stations=None),
    ImportFormat(*_ABOUT, lambda content: b"camera_model" in content, _read),
)
