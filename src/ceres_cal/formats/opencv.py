"""OpenCV's FileStorage, as YAML, XML or JSON: one camera under the names of OpenCV's calibration sample, two under
those of its stereo sample.

src opencv/opencv samples/cpp/calibration.cpp, stereo_calib.cpp.
"""

from __future__ import annotations

import re
from typing import Annotated, Any

import numpy as np

from ceres_cal.base import Array, InputError, Pose, replace, two_digits
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest, calibration_of
from ceres_cal.formats.loss import as_foreign, loss_words
from ceres_cal.scene import FISHEYE, LARGEST, ForeignCamera, image_grid, opencv_models

_ENDINGS = (".yml", ".yaml", ".xml", ".json")
_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "M1", "K")
_COEFFICIENTS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D1", "D")
_FOUR = "its four coefficients are read as k1, k2, p1, p2: if they are of cv2.fisheye, add `distortion_model: fisheye`"
ImageSize = Annotated[str, "WIDTHxHEIGHT px, where the file does not say it"]
"""An option of several formats."""
_WIDTH, _HEIGHT = ("image_width", "image_Width"), ("image_height", "image_Height")


# ---- writing --------------------------------------------------------------------------------------------------------


def _export(request: ExportRequest) -> Export:
    import cv2

    cameras, losses = as_foreign(request, opencv_models)
    entries = _mono(cameras[0], loss_words(losses[0])) if len(cameras) == 1 else _stereo(cameras)
    storage = cv2.FileStorage(request.ending, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    for key, value in {"stations": " ".join(request.stations), **entries}.items():
        storage.write(key, value)
    content = storage.releaseAndGetString()
    if request.ending in (".yml", ".yaml"):  # the version that readers older than OpenCV 5 accept
        content = re.sub(r"^%YAML[^\n]*", "%YAML:1.0", content)
    models_used = " and ".join(camera.model for camera in cameras)
    named = zip(request.stations, cameras, strict=True)
    warnings = [f"station {name!r}: {text}" for name, camera in named for text in _reader_traps(camera)]
    return Export(content.encode(), losses, f"K, {models_used}, pose", {}, tuple(warnings))


def _reader_traps(camera: ForeignCamera) -> list[str]:
    """Return what OpenCV may get wrong about a camera."""
    rough_px = 0.05  # error of OpenCV's own inverse from which on it is mentioned
    import cv2

    if camera.model == FISHEYE:
        return ["its coefficients are for cv2.fisheye: OpenCV does not read this from the file, see `distortion_model`"]
    pixels, coefficients = image_grid(camera.image_size), np.array(camera.coefficients)
    straight = cv2.undistortPoints(pixels[:, None], camera.matrix, coefficients)[:, 0]
    rays = np.column_stack([straight, np.ones(len(straight))])
    worst = float(np.max(np.linalg.norm(camera.project_rays(rays) - pixels, axis=1)))
    if worst <= rough_px:
        return []
    end = "criteria=(cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-9)"
    return [f"cv2.undistortPoints stops after five rounds, here up to {two_digits(worst)} px off: call it with {end}"]


def _entries(camera: ForeignCamera, *names: str) -> dict[str, Any]:
    """Return K, coefficients (1, N) and the pose (1, 6), rvec and tvec, under these names."""
    numbers = camera.matrix, np.array([camera.coefficients]), camera.pose.log()[None]
    return dict(zip(names, numbers, strict=True))


def _common(camera: ForeignCamera) -> dict[str, Any]:
    width, height = camera.image_size
    return {"image_width": width, "image_height": height, "distortion_model": camera.model}


def _mono(camera: ForeignCamera, lost: list[str]) -> dict[str, Any]:
    named = _entries(camera, "camera_matrix", "distortion_coefficients", "extrinsic_parameters")
    return _common(camera) | named | {"loss": "; ".join(lost)}


def _stereo(cameras: list[ForeignCamera]) -> dict[str, Any]:
    """Return the entries of intrinsics.yml and extrinsics.yml for one file; R, T map the first camera to the second."""
    import cv2

    first, second = cameras
    if first.image_size != second.image_size or (first.model == FISHEYE) != (second.model == FISHEYE):
        raise InputError("OpenCV's stereo files hold two cameras of one image size and one kind of lens")
    entries = _common(first)
    for number, camera in enumerate(cameras, start=1):
        entries |= _entries(camera, f"M{number}", f"D{number}", f"extrinsic_parameters{number}")
    between = second.pose @ first.pose.inverse
    turn, shift = between.rotation, between.translation[:, None]
    given = (entries["M1"], entries["D1"].T, entries["M2"], entries["D2"].T, first.image_size, turn, shift)
    rectified: Any = cv2.fisheye.stereoRectify(*given, flags=0) if first.model == FISHEYE else cv2.stereoRectify(*given)
    names = ("R1", "R2", "P1", "P2", "Q")
    return entries | {"R": turn, "T": shift} | dict(zip(names, rectified[:5], strict=True))


# ---- reading --------------------------------------------------------------------------------------------------------


def _require_shallow(text: str) -> None:
    """Raise InputError for deeply nested elements: OpenCV reads them by recursion, and crashes on thousands."""
    deepest, depth = 32, 0
    for tag in re.finditer(r"<(/?)\w[^<>]*?(/?)>", text):
        depth += -1 if tag[1] else not tag[2]
        if depth > deepest:
            raise InputError(f"not a FileStorage of OpenCV: more than {deepest} elements within each other")


def _read(
    request: ImportRequest,
    *,
    image_size: ImageSize = "",
    camera: Annotated[str, "name for the camera; default: camera"] = "camera",
) -> Any:
    import cv2

    _require_shallow(request.text)
    try:
        storage = cv2.FileStorage(request.text, cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY)
        names = storage.root().keys()
    except (cv2.error, SystemError, UnicodeDecodeError) as error:
        raise InputError(f"not a FileStorage of OpenCV (cut short?): {str(error).splitlines()[0]}") from None
    if not any(name in names for name in _MATRIX):
        raise InputError(f"it has no camera matrix: none of {', '.join(_MATRIX)}")
    stereo = "M1" in names and "M2" in names
    stations = _text(storage, "stations").split()
    if stereo:
        stations = stations if len(stations) == 2 else ["left", "right"]
        cameras = {name: _camera(storage, image_size, str(n)) for n, name in enumerate(stations, start=1)}
        if cameras[stations[1]].cam_from_world is None:
            first = cameras[stations[0]].pose
            between = Pose(_mat(storage, ("R",), (3, 3)), _mat(storage, ("T",), (3, 1)).ravel())
            cameras[stations[1]] = replace(cameras[stations[1]], cam_from_world=between @ first)
        return calibration_of("OpenCV", cameras)
    name = stations[0] if stations else camera
    one = _camera(storage, image_size, "")
    unsaid = one.model != FISHEYE and not {"distortion_model", "fisheye_model"} & {*names}
    told = [_FOUR] if unsaid and _mat(storage, _COEFFICIENTS, None).size == 4 and any(one.coefficients) else []
    return calibration_of("OpenCV", {name: one}, warnings=told)


def _camera(storage: Any, image_size: str, number: str) -> ForeignCamera:
    matrix = _mat(storage, (f"M{number}",) if number else _MATRIX, (3, 3))
    coefficients = _mat(storage, (f"D{number}",) if number else _COEFFICIENTS, None).ravel()
    poses = _mat(storage, (f"extrinsic_parameters{number}",), None, needed=False)
    pose = None
    if poses.shape == (1, 6):  # several poses would be those of views of a board
        pose = Pose.exp(poses[0])
        pose = pose if np.any(poses) else None
    # `distortion_model` is this package's name, `fisheye_model` that of OpenCV's tutorial (camera_calibration.cpp).
    fisheye = _text(storage, "distortion_model") == FISHEYE or bool(_real(storage, ("fisheye_model",)))
    return ForeignCamera.opencv(_size(storage, image_size), matrix, coefficients, pose, fisheye=fisheye)


def _size(storage: Any, image_size: str) -> tuple[int, int]:
    sizes = [_real(storage, names) for names in (_WIDTH, _HEIGHT)]
    if all(size is not None and size.is_integer() and size > 0.0 for size in sizes):
        return int(sizes[0] or 0), int(sizes[1] or 0)
    return parse_size(image_size)


def parse_size(text: str) -> tuple[int, int]:
    """Parse WIDTHxHEIGHT; InputError where it is invalid."""
    found = re.fullmatch(r"\s*(\d+)\s*[xX,]\s*(\d+)\s*", text)
    if not found:
        raise InputError(
            "the image size is not there: give image_size (--image-size) as WIDTHxHEIGHT, such as 1280x960"
        )
    return int(found[1]), int(found[2])


def _text(storage: Any, name: str) -> str:
    node = storage.getNode(name)
    try:
        return str(node.string()) if node.isString() else ""
    except UnicodeDecodeError:
        raise InputError(f"{name} is not UTF-8") from None


def _real(storage: Any, names: tuple[str, ...]) -> float | None:
    nodes = [node for node in map(storage.getNode, names) if node.isInt() or node.isReal()]
    return float(nodes[0].real()) if nodes else None


def _mat(storage: Any, names: tuple[str, ...], shape: tuple[int, int] | None, *, needed: bool = True) -> Array:
    for name in names:
        node = storage.getNode(name)
        if not node.isMap():
            continue
        matrix = _matrix(node, name)
        if (shape is not None and matrix.shape != shape) or not np.all(np.abs(matrix) < LARGEST):
            raise InputError(f"{name} must be {shape or 'finite'} numbers, not {matrix.tolist()}")
        return matrix
    if needed:
        raise InputError(f"it has no matrix {names[0]!r}")
    return np.empty((0, 0))


def _matrix(node: Any, name: str) -> Array:
    """Return the matrix of a node; InputError where its rows and cols, which OpenCV does not check, do not fit its
    data.
    """
    import cv2

    refused = InputError(f"{name} must be a matrix: its rows and cols do not fit its data")
    rows, cols = (_real(node, (size,)) or 0.0 for size in ("rows", "cols"))
    try:
        if not (rows > 0.0 and cols > 0.0 and rows * cols == node.getNode("data").size()):
            raise refused
        return np.asarray(node.mat(), dtype=float)
    except cv2.error:
        raise refused from None


def _recognises(content: bytes) -> bool:
    return b"opencv-matrix" in content or b"opencv_storage" in content


_WRITTEN = "OpenCV's FileStorage of one camera, or of two as stereo"
FORMATS = (
    ExportFormat("opencv", _WRITTEN, _ENDINGS, _export, most_stations=2),
    ImportFormat("opencv", "OpenCV's FileStorage", _ENDINGS, _recognises, _read),
)
