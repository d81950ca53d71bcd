"""COLMAP's text model, by pycolmap: all stations as one rig in one frame. Its pixel coordinates have their origin at
the corner of the first pixel, so half a pixel is added on export and subtracted on import.

src colmap/colmap doc/format.rst.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ceres_cal.base import Array, InputError, Pose, kept_signals, plural, read_bytes
from ceres_cal.formats.format import Export, ExportFormat, ExportRequest, ImportFormat, ImportRequest, calibration_of
from ceres_cal.formats.loss import as_foreign
from ceres_cal.scene.foreign import FISHEYE, THIN_PRISM_FISHEYE, ForeignCamera, camera_matrix

_MODELS = {
    "opencv4": "OPENCV",
    "opencv5": "FULL_OPENCV",
    "opencv8": "FULL_OPENCV",
    FISHEYE: "OPENCV_FISHEYE",
    THIN_PRISM_FISHEYE: THIN_PRISM_FISHEYE,
}
# Number of coefficients after fx fy cx cy; the other models have four.
_COUNTS = {"FULL_OPENCV": 8, THIN_PRISM_FISHEYE: 8}
_HALF = 0.5


def _library() -> Any:
    with kept_signals():
        import pycolmap

    return pycolmap


def _export(request: ExportRequest) -> Export:
    pycolmap = _library()
    cameras, losses = as_foreign(request, lambda _: tuple(_MODELS))
    model, rig, frame = pycolmap.Reconstruction(), pycolmap.Rig(rig_id=1), pycolmap.Frame(frame_id=1, rig_id=1)
    first, images = cameras[0].pose, []
    for number, (name, foreign) in enumerate(zip(request.stations, cameras, strict=True), start=1):
        model.add_camera(_camera(foreign, number))
        sensor = model.camera(number).sensor_id
        if number == 1:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, _rigid(foreign.pose @ first.inverse))
        image = pycolmap.Image(name=name, camera_id=number, image_id=number)
        image.frame_id = 1
        frame.add_data_id(image.data_id)
        images.append(image)
    frame.rig_from_world = _rigid(first)
    model.add_rig(rig)
    model.add_frame(frame)
    for image in images:
        model.add_image(image)
    with tempfile.TemporaryDirectory() as folder:
        model.write_text(folder)
        content = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    models = " and ".join(_MODELS[one.model] for one in cameras)
    return Export(content, losses, f"{plural(len(cameras), 'camera')}, {models}, one rig, one frame")


def _camera(foreign: ForeignCamera, number: int) -> Any:
    (width, height), name = foreign.image_size, _MODELS[foreign.model]
    values = [*foreign.coefficients, *[0.0] * 8][: _COUNTS.get(name, 4)]
    (cx, cy), focal = foreign.centre, foreign.focal
    camera = _library().Camera(model=name, width=width, height=height, params=[*focal, cx + _HALF, cy + _HALF, *values])
    camera.camera_id = number
    return camera


def _rigid(pose: Pose) -> Any:
    return _library().Rigid3d(_library().Rotation3d(pose.rotation), pose.translation)


# ---- reading --------------------------------------------------------------------------------------------------------


def read_model(folder: Path) -> Any:
    """Read COLMAP's model; InputError where the folder holds none, a pipe or a device, or too much."""
    if not folder.is_dir():
        raise InputError("COLMAP's model is a folder: name that")
    for name in ("rigs", "cameras", "frames", "images", "points3D"):
        for path in (folder / f"{name}.bin", folder / f"{name}.txt"):
            if path.exists():
                read_bytes(path)  # the library opens the files itself; files on which it would wait are refused here
    try:
        return _library().Reconstruction(folder)
    except (ValueError, RuntimeError, IndexError) as error:
        raise InputError(f"not a model of COLMAP (cut short?): {str(error).splitlines()[0]}") from None


def _read(request: ImportRequest) -> Any:
    model = read_model(request.path)
    if not model.num_images():
        raise InputError("the model has no images, so the poses of its cameras are unknown")
    cameras, warnings = {}, []
    for _, image in sorted(model.images.items()):  # the library has them in an order of its own
        name = _name(image)
        if not image.has_pose:
            warnings.append(f"image {image.name!r} has no pose and was left out")
            continue
        pose = image.cam_from_world()
        cameras[name] = _foreign(image.camera, Pose(pose.rotation.matrix(), pose.translation))
    if not cameras:
        raise InputError("none of its images has a pose")
    stems = {Path(name).stem if Path(name).suffix else name: camera for name, camera in cameras.items()}
    # Otherwise images in different folders have the same name: whole names distinguish them.
    if len(stems) == len(cameras):
        cameras = stems
    warnings.append("COLMAP models have no unit of length: these lengths are read as metres")
    return calibration_of("COLMAP", cameras, warnings=warnings)


def _name(image: Any) -> str:
    try:
        return str(image.name)
    except UnicodeDecodeError:
        raise InputError(f"the name of image {image.image_id} is not UTF-8: rename it") from None


def _foreign(camera: Any, pose: Pose) -> ForeignCamera:
    size, name = (int(camera.width), int(camera.height)), str(camera.model_name)
    focal = (float(camera.focal_length_x), float(camera.focal_length_y))
    centre = (float(camera.principal_point_x) - _HALF, float(camera.principal_point_y) - _HALF)
    extra = np.array(camera.params)[camera.extra_params_idxs()]
    if name.removeprefix("SIMPLE_") in ("PINHOLE", "RADIAL", "OPENCV", "FULL_OPENCV"):
        values = np.concatenate([extra, np.zeros(4 - len(extra))]) if len(extra) < 4 else extra
        return ForeignCamera.opencv(size, camera_matrix(*focal, *centre), values, pose)
    if name == "OPENCV_FISHEYE":
        return ForeignCamera(size, focal, centre, FISHEYE, tuple(extra.tolist()), pose)
    bare = _library().Camera(model=name, width=2, height=2, params=_at_focal_length_1(camera))

    def distort(rays: Array) -> Array:
        return np.asarray(bare.img_from_cam(rays))

    return ForeignCamera(size, focal, centre, name, tuple(extra.tolist()), pose, distort=distort)


def _at_focal_length_1(camera: Any) -> list[float]:
    params = np.array(camera.params)
    params[camera.focal_length_idxs()], params[camera.principal_point_idxs()] = 1.0, 0.0
    return [float(value) for value in params]


FORMATS = (
    ExportFormat("colmap", "COLMAP's text model: cameras, rig, frame, images", (), _export, most_stations=None),
    ImportFormat("colmap", "a folder with COLMAP's model", (), lambda content: not content, _read),
)
