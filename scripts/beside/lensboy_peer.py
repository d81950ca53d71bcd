"""lensboy, called as in its calibration guide: https://robertleoj.github.io/lensboy/calibration_guide.html

calibrate_camera with OpenCVConfig (five coefficients) is its quick example; it recommends FULL_14 and
PinholeSplinedConfig where these do not fit. By default it removes outliers and solves for the board's warp. It states
no uncertainty.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np
from benchmarks.peers import Array, Corners

from beside.peer_fit import PeerFit, warp_said
from beside.starts import wide_focal


def _fit(config: Callable[[Any, int, int], Any], corners: Corners) -> PeerFit:
    peer = import_module("lensboy")
    width, height = corners.image_size.tolist()
    cuts = np.searchsorted(corners.view, np.arange(1, corners.frames))
    parts = zip(np.split(corners.feature, cuts), np.split(corners.pixels, cuts), strict=True)
    frames = [peer.Frame(features.astype(int), pixels) for features, pixels in parts]
    chosen = config(peer, height, width)
    chosen.initial_focal_length = wide_focal(corners)  # None, its default, except for a wide lens
    start = time.perf_counter()
    result = peer.calibrate_camera(corners.board, frames, camera_model_config=chosen)
    seconds = time.perf_counter() - start
    model, warp = result.camera_model, result.target_warp
    board = corners.board if warp is None else np.asarray(warp.warp_target(corners.board))

    def project(places: Array, values: Array) -> Array:
        found = np.asarray(model.project_points(np.ascontiguousarray(places, dtype=float)), dtype=float)
        return np.asarray(np.where(places[:, 2:] > 1e-6, found.reshape(-1, 2), np.nan))

    values = np.array([model.fx, model.fy, model.cx, model.cy])
    outliers, left_out = int(result.num_outliers()), sum(one is None for one in result.cameras_from_target)
    said = [f"{outliers} outliers"] * bool(outliers) + [f"{left_out} frames excluded"] * bool(left_out)
    said += warp_said(board)
    noise = float(result.residual_sigma_map())
    return PeerFit(
        ("fx", "fy", "cx", "cy"), values, project, board, noise, said=tuple(said), taken_out=outliers, seconds=seconds
    )


def _opencv(kind: str, peer: Any, height: int, width: int) -> Any:
    lens = getattr(peer.OpenCVConfig, kind)
    return peer.OpenCVConfig(image_height=height, image_width=width, included_distortion_coefficients=lens)


def _splined(knots: tuple[int, int], peer: Any, height: int, width: int) -> Any:
    return peer.PinholeSplinedConfig(image_height=height, image_width=width, num_knots_x=knots[0], num_knots_y=knots[1])


SETTINGS: dict[str, Callable[[Corners], PeerFit]] = {
    "default": partial(_fit, partial(_opencv, "STANDARD")),
    "FULL_14": partial(_fit, partial(_opencv, "FULL_14")),
    "spline 30x20": partial(_fit, partial(_splined, (30, 20))),
    "spline 12x9": partial(_fit, partial(_splined, (12, 9))),
}
