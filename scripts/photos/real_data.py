"""Folder of the real photographs, which are not part of the repository."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ceres_cal.observations import NO_CURVES, Observations, Points, View
from ceres_cal.scene.targets import checkerboard


def real_place() -> Path:
    """$CERES_CAL_REAL, or shared/real beside the repository; it need not exist."""
    return Path(os.environ.get("CERES_CAL_REAL") or Path(__file__).resolve().parents[3] / "shared" / "real")


def real_folder() -> Path:
    """The same; if it is missing, the program prints a message and ends with 1."""
    folder = real_place()
    if not folder.is_dir():
        raise SystemExit(f"real photographs are needed, and {folder} is not there: set CERES_CAL_REAL to their folder")
    return folder


def ov_plane(part: str) -> Observations:
    """BabelCalib's corners of the "train" or the "test" views of its OV camera, which are published as numbers."""
    with np.load(real_folder() / "babelcalib_ov_plane" / f"{part}.npz") as data:
        board, view, point, pixels, size = (data[n] for n in ("board_m", "view", "point", "pixels", "image_size"))
    pitch_m = float(board[0, 0])
    column, row = np.rint(board[:, :2] / pitch_m).astype(np.int32).T - 1
    views = tuple(View(f"{n:02d}", "camera", "camera", "board", f"{n:02d}") for n in range(int(view.max()) + 1))
    points = Points(view.astype(np.int32), (22 * row + column)[point], pixels, np.ones(len(pixels)))
    board_target, sizes = {"board": checkerboard(22, 22, pitch_m)}, {"camera": (int(size[0]), int(size[1]))}
    return Observations(board_target, sizes, views, points, NO_CURVES)
