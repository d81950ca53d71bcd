"""mrcal's .cameramodel: one camera a file, a Python literal. Files of mrcal's own calibrations contain observations,
too.

src dkogan/mrcal mrcal/cameramodel.py, cameramodel-parser.re, doc/cameramodels.org.
"""

from __future__ import annotations

import ast
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from ceres_cal.base import InputError, Pose, require_room
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest, calibration_of
from ceres_cal.formats.loss import as_foreign, loss_words
from ceres_cal.formats.yaml_files import numbers_at
from ceres_cal.scene.foreign import OPENCV_MODELS, ForeignCamera, camera_matrix

_MODELS = {f"LENSMODEL_OPENCV{count}": model for model, count in OPENCV_MODELS.items()}
_POSES = ("rt_cam_ref", "extrinsics")  # names since mrcal 2.5, and before


def _export(request: ExportRequest) -> Export:
    (name,), ((foreign,), losses) = request.stations, as_foreign(request, lambda _: ("opencv5", "opencv8", "opencv12"))
    model = f"LENSMODEL_{foreign.model.upper()}"
    pose = foreign.pose.log().tolist()
    entries = {
        "lensmodel": model,
        "intrinsics": [*foreign.focal, *foreign.centre, *foreign.coefficients],
        **dict.fromkeys(reversed(_POSES), pose),
        "imagersize": list(foreign.image_size),
    }
    lines = [f"# {line}\n" for line in (f"station {name}; reference: the field, metres", *loss_words(*losses))]
    body = "".join(f"    '{key}': {value!r},\n" for key, value in entries.items())
    return Export(("".join(lines) + "{\n" + body + "}\n").encode(), losses, f"{model}, pose")


def literal_of(content: bytes) -> dict[str, Any]:
    """Return the literal of a .cameramodel; InputError where it is none."""
    bytes_per_comma = 1000  # bytes of memory for a part of the syntax tree
    text = content.decode("utf-8", errors="replace")
    require_room(bytes_per_comma * text.count(",") + 4.0 * len(text), "the file")
    try:
        with warnings.catch_warnings(action="ignore"):  # silences the compiler's warnings on its style
            data = ast.literal_eval(text.strip())
    except (ValueError, TypeError, SyntaxError, RecursionError, MemoryError) as error:
        raise InputError(f"not a .cameramodel (cut short?): {error}") from None
    if not isinstance(data, dict):
        raise InputError("not a .cameramodel: it holds no { names: values }")
    return data


def _read(request: ImportRequest) -> Any:
    data = literal_of(request.content)
    kind = str(data.get("lensmodel", data.get("lens_model", data.get("distortion_model", ""))))
    kind = kind.replace("DISTORTION_", "LENSMODEL_")
    if kind != "LENSMODEL_PINHOLE" and kind not in _MODELS:
        known = ", ".join(("LENSMODEL_PINHOLE", *_MODELS))
        raise InputError(f"its lens model {kind!r} cannot be read here, only {known}")
    count = 0 if kind == "LENSMODEL_PINHOLE" else OPENCV_MODELS[_MODELS[kind]]
    values = numbers_at(data.get("intrinsics"), "intrinsics", 4 + count)
    size = numbers_at(data.get("imagersize"), "imagersize", 2)
    camera = ForeignCamera.opencv([int(s) for s in size], camera_matrix(*values[:4]), values[4:], _pose(data))
    return calibration_of("an mrcal .cameramodel", {request.path.stem: camera})


def _pose(data: Mapping[str, Any]) -> Pose:
    given = [numbers_at(data[name], name, 6) for name in _POSES if name in data]
    if not given:
        raise InputError(f"it has no pose: neither {' nor '.join(_POSES)}")
    if len(given) == 2 and np.max(np.abs(given[0] - given[1])) > 1e-9:
        raise InputError(f"its {' and '.join(_POSES)} differ: correct one")
    return Pose.exp(given[0])


_ABOUT = ("mrcal", "mrcal's .cameramodel", (".cameramodel",))
FORMATS = ExportFormat(*_ABOUT, _export), ImportFormat(*_ABOUT, lambda _: True, _read)
