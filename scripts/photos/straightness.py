"""Straightness of a board's rows in undistorted photographs, with OpenCV's: for photographs.py --case straight.

The photographs are real, by a wide-angle camera (udacity_gopro_wide). The camera is calibrated from its boards with
three radial coefficients. Each photograph is undistorted as by `undistort --whole`, corners are measured in the result
(cornerSubPix, as in our own detector), and a line is fitted to every row and column. OpenCV is calibrated from the same
corners and undistorts to the same pinhole.

The sheet is creased: --tolerance shows that its corners are displaced by half a percent of a square (1679 corners of
all photographs agree). In test_image a square has up to 175 px, so that its rows cannot be straight to 0.3 px.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from runner import Row

from ceres_cal.base.arrays import Array, Image, Image8
from ceres_cal.base.transforms import Pose
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.detect.boards import BoardDetections, detect_boards
from ceres_cal.detect.images import read_colour
from ceres_cal.problem.parameters import Options
from ceres_cal.report.pictures.straight import Straightening, straighten
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.targets import checkerboard
from ceres_cal.start.closed_forms import homography_from_points

FOLDER = "udacity_gopro_wide"
COLUMNS, ROWS = 8, 6
THREE = Options(lens="brown", free_aspect=True, fixed={"p1": 0.0, "p2": 0.0}, as_built="as drawn")
CLICKS = ((227.0, 205.0), (1112.0, 188.0), (1005.0, 880.0), (367.0, 908.0))
"""Rough pixels in test_image.jpg of the outer ones of four by four corners, in the area where boards were observed."""
INNER = 4
MOST_PX = 0.3
_WINDOWS_PX = (20, 5)  # large for rough clicks, then as small as in our own detector


def distances_px(grid: Array) -> Array:
    """Signed distances of corners (rows, columns, 2) from the best lines through their rows and columns, px."""
    return np.concatenate([_off_line(line) for line in (*grid, *grid.swapaxes(0, 1))])


def _off_line(pixels: Array) -> Array:
    middle = pixels - pixels.mean(axis=0)
    return np.asarray(middle @ np.linalg.svd(middle, full_matrices=False)[2][1])


def refined(image: Image, grid: Array) -> Array:
    """Corners (rows, columns, 2) measured in an image, from initial values near them."""
    grey: Image8 = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.uint8)
    steps = [np.linalg.norm(np.diff(grid, axis=axis), axis=2).min() for axis in (0, 1)]
    found = grid.reshape(-1, 1, 2).astype(np.float32)
    for widest in _WINDOWS_PX:
        half = int(np.clip(min(steps) / 3.0, 2, widest))
        found = cv2.cornerSubPix(grey, found, (half, half), (-1, -1), (3, 100, 1e-4)).astype(np.float32)
    return found.astype(float).reshape(grid.shape)


def in_straight(camera: Camera, straight: Straightening, photograph: Array) -> Array:
    """Pixels (N, 2) of the photograph mapped to the undistorted image; NaN beyond a fold of the lens."""
    return straight.camera.at(Pose.identity()).project(camera.rays(photograph))


def clicked_grid(camera: Camera, straight: Straightening) -> Array:
    """Approximate corners of test_image in its undistorted image, by a homography from the clicks."""
    ends = np.array([(0.0, 0.0), (INNER - 1.0, 0.0), (INNER - 1.0, INNER - 1.0), (0.0, INNER - 1.0)])
    homography = homography_from_points(ends, in_straight(camera, straight, np.array(CLICKS)))
    places = np.stack(np.meshgrid(np.arange(INNER), np.arange(INNER)), axis=-1).reshape(-1, 2).astype(float)
    seen = np.column_stack([places, np.ones(len(places))]) @ homography.T
    return np.asarray(seen[:, :2] / seen[:, 2:]).reshape(INNER, INNER, 2)


def opencv_calibration(boards: BoardDetections, size: tuple[int, int]) -> tuple[Array, Array]:
    """OpenCV's camera matrix and k1 k2 p1 p2 k3 from the same corners, p1 = p2 = 0."""
    points, views = boards.observations.points, range(len(boards.observations.views))
    places = checkerboard(COLUMNS, ROWS, 1.0).point_array.astype(np.float32)
    objects = [places[points.feature[points.view == view]] for view in views]
    pixels = [points.pixels[points.view == view].astype(np.float32) for view in views]
    flags = cv2.CALIB_ZERO_TANGENT_DIST
    _, matrix, lens, _, _ = cv2.calibrateCamera(objects, pixels, size, np.eye(3), np.zeros(5), flags=flags)
    return np.asarray(matrix, dtype=float), np.asarray(lens, dtype=float)


def observed_boards(real: Path) -> BoardDetections:
    """The boards of all photographs."""
    return detect_boards(sorted((real / FOLDER).glob("GOPR*.jpg")), checkerboard(COLUMNS, ROWS, 1.0))


def straight_rows(real: Path, boards: BoardDetections, keep_scale: bool = False, every: int = 1) -> Iterator[Row]:
    """Distances of the corners of test_image.jpg and of the boards from straight rows and columns, ours and OpenCV's.

    Args:
        keep_scale: use a larger undistorted image that keeps the scale at the centre.
        every: use only every so manieth board.
    """
    camera = calibrate(boards.observations, THREE).station()
    straight = straighten(camera, whole=True, phi=camera.phi if keep_scale else None)
    pinhole = (straight.camera.matrix, straight.camera.image_size)
    matrix, lens = opencv_calibration(boards, camera.image_size)
    peer_maps = cv2.initUndistortRectifyMap(matrix, lens, np.eye(3), *pinhole, cv2.CV_32FC1)  # as cv2.undistort does
    case = f"straight, phi {straight.camera.phi:.0f} px"
    starts = {real / FOLDER / "test_image.jpg": clicked_grid(camera, straight)}
    points = boards.observations.points
    for view, path in list(enumerate(boards.found))[::every]:
        grid = np.empty((ROWS * COLUMNS, 2))
        grid[points.feature[points.view == view]] = points.pixels[points.view == view]
        starts[Path(path)] = in_straight(camera, straight, grid).reshape(ROWS, COLUMNS, 2)
    ours, theirs = [], []
    for image, start in starts.items():
        if not np.all(np.isfinite(start)):
            yield Row(case, f"{image.stem}: has corners past the lens's fold", float(np.sum(np.isnan(start[..., 0]))))
            continue
        photograph = read_colour(image)
        theirs_straight = cv2.remap(photograph, *peer_maps, cv2.INTER_CUBIC)
        ours.append(distances_px(refined(straight.warp.apply(photograph), start)))
        theirs.append(distances_px(refined(theirs_straight, start)))
    for what, own, other in (("test_image", ours[:1], theirs[:1]), ("boards, median", ours[1:], theirs[1:])):
        for name, size in (("rms", _rms), ("worst", _worst)):
            value, peer = (float(np.median([size(one) for one in every])) for every in (own, other))
            limit = MOST_PX if name == "rms" and what != "test_image" and not keep_scale else np.inf
            yield Row(
                case, f"{what}: rows off straight, {name}, px", value, most=limit, note=f"cv2.undistort {peer:.3f}"
            )
    good = float(np.mean([_rms(one) <= MOST_PX for one in ours[1:]]))
    peer = float(np.mean([_rms(one) <= MOST_PX for one in theirs[1:]]))
    yield Row(
        case, f"boards straight to {MOST_PX} px rms, share", good, note=f"of {len(ours) - 1}; cv2.undistort {peer:.2f}"
    )


def _rms(distances: Array) -> float:
    return float(np.sqrt(np.mean(distances**2)))


def _worst(distances: Array) -> float:
    return float(np.max(np.abs(distances)))


def all_straight_rows(real: Path) -> Iterator[Row]:
    """With the scale at the centre kept, and without."""
    boards = observed_boards(real)
    for keep_scale in (False, True):
        yield from straight_rows(real, boards, keep_scale)
