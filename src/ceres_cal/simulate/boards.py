"""Poses of boards before a camera, and whether the camera shows them whole."""

from __future__ import annotations

import numpy as np

from ceres_cal.base import Array, Mask, Pose, rotation_exp
from ceres_cal.scene import Camera, Target


def board_pose(board: Target, line_of_sight: Array, distance_m: float, turn_rad: tuple[float, float, float]) -> Pose:
    """Return cam_from_board with the board's middle on a line of sight (3,) of length 1, at a distance from the camera.

    Its normal points away from the camera, so that columns run right and rows down. The board is then turned: by the
    spin about its own normal, then by the tilt about an axis across the line of sight. The tilt brings its upper edge
    nearer to the camera at direction 0, its right edge at a quarter turn.

    Args:
        turn_rad: tilt, direction of the tilt, spin.
    """
    tilt, direction, spin = turn_rad
    across = np.array([-line_of_sight[1], line_of_sight[0], 0.0])  # z x line of sight
    sine = np.linalg.norm(across)
    facing = rotation_exp(across / max(sine, 1e-12) * np.arctan2(sine, line_of_sight[2]))
    leaning = rotation_exp((tilt * np.cos(direction), tilt * np.sin(direction), 0.0))
    rotation = facing @ leaning @ rotation_exp((0.0, 0.0, spin))
    middle = board.point_array.mean(axis=0)
    return Pose(rotation, line_of_sight * distance_m - rotation @ middle)


def well_inside(camera: Camera, points_world: Array) -> Mask:
    """(N,) whether points (N, 3) are in front of the camera, and so far inside the image that noise moves none out."""
    margin_px = 5.0  # a board stays this far inside the image, so that noise moves no corner out
    pixels = camera.project(points_world)
    with np.errstate(invalid="ignore"):
        inside = np.all((pixels >= margin_px) & (pixels <= np.array(camera.image_size) - 1.0 - margin_px), axis=1)
    return np.asarray(inside & (camera.cam_from_world.transform(points_world)[:, 2] > 0.0))
