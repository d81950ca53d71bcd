"""COLMAP's bundle adjustment through pycolmap, with the board's corners fixed.

https://colmap.github.io/cameras.html lists its lenses, https://colmap.github.io/pycolmap/ its calls; COLMAP has no
command for calibration with boards. "default" uses every default of BundleAdjustmentOptions, with a fixed principal
point, and SIMPLE_RADIAL, the default lens of its reader. The other settings free the principal point, as its FAQ
recommends for calibration. The stated uncertainty is estimate_ba_covariance times the estimated noise.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
from benchmarks.peers import Array, Corners, _seed

from beside.opencv_peer import fisheye
from beside.peer_fit import PeerFit
from beside.starts import wide_focal, wide_poses

HALF = 0.5  # the centre of its first pixel is (0.5, 0.5)
_NAMES = {
    "SIMPLE_RADIAL": ("fx", "cx", "cy", "k1"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
}


def _scene(model: str, corners: Corners) -> Any:
    """The corners as a reconstruction at OpenCV's initial estimate, or at that of a wide lens."""
    peer = import_module("pycolmap")
    width, height = corners.image_size.tolist()
    focal, middle = wide_focal(corners), (0.5 * width, 0.5 * height)
    poses: Any
    if focal is not None and model == "OPENCV_FISHEYE":
        start, poses = {"fx": focal, "fy": focal, "cx": middle[0], "cy": middle[1]}, wide_poses(corners, focal)
    else:
        matrix, poses = _seed(corners)
        start = {"fx": matrix[0, 0], "fy": matrix[1, 1], "cx": matrix[0, 2] + HALF, "cy": matrix[1, 2] + HALF}
    numbers = [start.get(name, 0.0) for name in _NAMES[model]]
    scene = peer.Reconstruction()
    scene.add_camera_with_trivial_rig(peer.Camera(camera_id=1, model=model, width=width, height=height, params=numbers))
    tracks = [peer.Track() for _ in corners.board]
    cuts = np.searchsorted(corners.view, np.arange(1, corners.frames))
    parts = zip(np.split(corners.feature, cuts), np.split(corners.pixels, cuts), poses, strict=True)
    for number, (features, pixels, pose) in enumerate(parts):
        image = peer.Image(name=str(number), keypoints=pixels + HALF, camera_id=1, image_id=number + 1)
        scene.add_image_with_trivial_frame(image, peer.Rigid3d(pose))
        for place, feature in enumerate(features.tolist()):
            tracks[feature].add_element(number + 1, place)
    for place_m, track in zip(corners.board, tracks, strict=True):
        if track.length() > 1:  # its bundle adjustment does not accept a point in a single picture
            scene.add_point3D(place_m, track)
    return scene


def _fit(model: str, loss: str, principal_point: bool, corners: Corners) -> PeerFit:
    peer = import_module("pycolmap")
    scene = _scene(model, corners)
    options = peer.BundleAdjustmentOptions(
        refine_principal_point=principal_point, refine_points3D=False, print_summary=False,
        refine_sensor_from_rig=False,
    )  # fmt: skip
    options.ceres.loss_function_type = getattr(peer.LossFunctionType, loss)
    config = peer.BundleAdjustmentConfig()
    for number in scene.images:
        config.add_image(number)
    adjuster = peer.create_default_ceres_bundle_adjuster(options, config, scene)
    start = time.perf_counter()
    adjuster.solve()
    seconds = time.perf_counter() - start
    names = _NAMES[model]
    values = np.array(scene.cameras[1].params) - [HALF * (name in ("cx", "cy")) for name in names]

    def project(places: Array, values: Array) -> Array:
        if model == "OPENCV_FISHEYE":  # the same lens, which also projects places beside the camera
            return fisheye(places, values)
        raised = values + [HALF * (name in ("cx", "cy")) for name in names]
        width, height = corners.image_size.tolist()
        camera = peer.Camera(camera_id=1, model=model, width=width, height=height, params=raised)
        found = np.asarray(camera.img_from_cam(np.ascontiguousarray(places, dtype=float)), dtype=float)
        return np.where(places[:, 2:] > 1e-6, found.reshape(-1, 2) - HALF, np.nan)

    noise, sd, covariance = _stated(peer, adjuster, scene, corners, names, principal_point, project, values)
    return PeerFit(names, values, project, corners.board, noise, sd, covariance, seconds=seconds)


def _stated(
    peer: Any, adjuster: Any, scene: Any, corners: Corners, names: tuple[str, ...], principal_point: bool,
    project: Callable[[Array, Array], Array], values: Array,
) -> tuple[float, Array | None, Array | None]:  # fmt: skip
    """Its covariance of the camera times the variance of the residuals."""
    left = []
    for number, (on_board, pixels) in enumerate(zip(*corners.by_frame(), strict=True)):
        pose = scene.images[number + 1].cam_from_world().matrix()
        left.append(project(on_board @ pose[:, :3].T + pose[:, 3], values) - pixels)
    free = len(names) - (0 if principal_point else 2)
    squares = float(np.nansum(np.concatenate(left) ** 2))
    noise = float(np.sqrt(squares / (2 * len(corners.view) - 6 * corners.frames - free)))
    options = peer.BACovarianceOptions(params=peer.BACovarianceOptionsParams.ALL)
    found = peer.estimate_ba_covariance(options, scene, adjuster)
    unit = None if found is None else found.get_other_params_cov(scene.cameras[1].params)
    if unit is None or len(unit) != free:
        return noise, None, None
    at = [k for k, name in enumerate(names) if principal_point or name not in ("cx", "cy")]
    covariance = np.zeros((len(names), len(names)))
    covariance[np.ix_(at, at)] = noise**2 * np.asarray(unit)
    return noise, np.sqrt(np.diag(covariance)), covariance


SETTINGS: dict[str, Callable[[Corners], PeerFit]] = {
    "default": partial(_fit, "SIMPLE_RADIAL", "TRIVIAL", False),
    "OPENCV": partial(_fit, "OPENCV", "TRIVIAL", True),
    "FULL_OPENCV": partial(_fit, "FULL_OPENCV", "TRIVIAL", True),
    "OPENCV_FISHEYE": partial(_fit, "OPENCV_FISHEYE", "TRIVIAL", True),
    "OPENCV, Cauchy": partial(_fit, "OPENCV", "CAUCHY", True),
}
