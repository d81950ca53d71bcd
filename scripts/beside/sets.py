"""The real sets of boards as corners that every peer takes, with their public names and sources."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.peers import Corners
from photos.held_out import SETS as REAL
from photos.real_data import real_place

from ceres_cal.detect.boards import detect_boards
from ceres_cal.observations import Observations
from ceres_cal.scene.targets import checkerboard

SAMPLE = "opencv left"
"""The set that is in the repository."""
_SAMPLE = Path(__file__).resolve().parents[2] / "data" / "opencv_left"


@dataclass(frozen=True)
class Source:
    """Source of a set, and its licence."""

    what: str
    where: str
    licence: str


SOURCES: Mapping[str, Source] = {
    "opencv left": Source(
        "OpenCV's sample stereo pair, left camera: 13 photographs, 640 x 480", "github.com/opencv/opencv, samples/data",
        "Apache-2.0",
    ),
    "opencv right": Source(
        "the same, right camera: 13 photographs", "github.com/opencv/opencv, samples/data", "Apache-2.0"
    ),
    "sony": Source(
        "BoofCV's Sony DSC-HX5V: 13 photographs, 640 x 480",
        "github.com/lessthanoptimal/BoofCV-Data, example/calibration/mono/Sony_DSC-HX5V_Chess", "CC BY 4.0",
    ),
    "gopro": Source(
        "Udacity's wide GoPro: 36 photographs, 1280 x 960",
        "github.com/udacity/CarND-Camera-Calibration, calibration_wide", "MIT",
    ),
    "ov plane": Source(
        "BabelCalib's OV-Plane: 18 and 7 views of 484 corners to 93 degrees, 1280 x 800",
        "github.com/ylochman/babelcalib", "MIT",
    ),
    "stereo left": Source(
        "a public stereo set, left camera: corners of 29 views, 640 x 360",
        "`cases/stereo_left.json` of the real data", "not stated"
    ),
    "squeezed": Source(
        "a public stereo set, squeezed pictures: corners of 28 views, 270 x 180",
        "`cases/squeezed.json` of the real data", "not stated"
    ),
    "fisheye": Source(
        "a public fisheye set: corners of 17 views, 640 x 720",
        "`cases/stray_corner.json` of the real data", "not stated"
    ),
}  # fmt: skip


def corners_of(observations: Observations) -> Corners:
    """Corners of one camera and one checkerboard; its views are numbered in order."""
    ((width, height),) = observations.cameras.values()
    (target,) = observations.targets.values()
    places = target.point_array
    square = float(places[1, 0] - places[0, 0])
    column, row = np.rint(places[:, :2] / square).astype(int).T
    columns = int(column.max()) + 1
    points = observations.points
    order = np.lexsort((points.feature, points.view))
    _, view = np.unique(points.view[order], return_inverse=True)
    return Corners(
        np.array([width, height]), np.array([columns, int(row.max()) + 1]), np.array(square), view.astype(np.int32),
        (row * columns + column)[points.feature[order]].astype(np.int32), points.pixels[order],
    )  # fmt: skip


def is_there(name: str) -> bool:
    return name == SAMPLE or real_place().is_dir()


def real_corners(name: str) -> Corners:
    """The corners that `detect board` finds, or those stored with a set."""
    if name == SAMPLE:
        return corners_of(detect_boards(sorted(_SAMPLE.glob("*.jpg")), checkerboard(9, 6, 0.025)).observations)
    return corners_of(REAL[name]())


def of_views(corners: Corners, chosen: Any) -> Corners:
    """Some of the views, with new numbers."""
    rows = chosen[corners.view]
    _, view = np.unique(corners.view[rows], return_inverse=True)
    return Corners(
        corners.image_size, corners.grid, corners.square_m, view.astype(np.int32), corners.feature[rows],
        corners.pixels[rows],
    )  # fmt: skip
