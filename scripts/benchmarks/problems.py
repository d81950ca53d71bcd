"""Problems of the benchmark, from a fixed seed: a board in front of a wide lens, and a field below a static camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scenery import field_scene, overhead_pose

from benchmarks.peers import Corners
from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import rotation_exp
from ceres_cal.observations import NO_CURVES, Columns, Curves, Observations, Points, Prior, View
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown, Radial
from ceres_cal.scene.targets import checkerboard, ssl_field
from ceres_cal.simulate import Scene, Station, simulate

WIDE = Camera((1280, 960), 600.0, (645.0, 470.0), Brown((-0.28, 0.07, 0.0, 0.0, 0.0)))
COLUMNS, ROWS, SQUARE_M = 10, 10, 0.1
CORNERS_PX = 0.3
_LEAST_CORNERS = 20  # in a frame

OVERHEAD = Camera((1280, 960), 600.0, (646.5, 473.8), Radial((-5.2e-5, 6.1e-7)))
HEIGHT_M, HEIGHT_SIGMA_M, TILT_DEG = 4.0, 0.005, 3.0
_SPACING_M = 0.075  # about a thousand line points a frame
_LINES_PX, _CROSSINGS_PX = 0.3, 0.5


@dataclass(frozen=True, eq=False)
class Problem:
    """Corners of a board, and their truth: rotations (F, 3, 3) of cam_from_board."""

    corners: Corners
    rotations: Array


def wide_lens(frames: int, seed: int = 0) -> Problem:
    """The wide lens in front of a board at random poses; corners outside the image are not seen."""
    rng = np.random.default_rng(seed)
    number = np.arange(COLUMNS * ROWS)
    board = np.column_stack([number % COLUMNS - 4.5, number // COLUMNS - 4.5, 0.0 * number]) * SQUARE_M
    rotations: list[Array] = []
    seen, pixels = [], []
    while len(rotations) < frames:
        rotation = rotation_exp(rng.normal(size=3) * (0.4, 0.4, 0.5))
        shift = (rng.uniform(-0.4, 0.4), rng.uniform(-0.3, 0.3), rng.uniform(0.7, 1.5))
        measured = WIDE.project(board @ rotation.T + shift) + rng.normal(size=(len(board), 2)) * CORNERS_PX
        inside = np.flatnonzero(np.all((measured > 0.0) & (measured < np.array(WIDE.image_size) - 1.0), axis=1))
        if len(inside) >= _LEAST_CORNERS:
            rotations.append(rotation)
            seen.append(inside)
            pixels.append(measured[inside])
    corners = Corners(
        np.array(WIDE.image_size),
        np.array([COLUMNS, ROWS]),
        np.array(SQUARE_M),
        np.repeat(np.arange(frames, dtype=np.int32), [len(part) for part in seen]),
        np.concatenate(seen).astype(np.int32),
        np.concatenate(pixels),
    )
    return Problem(corners, np.array(rotations))


def corner_observations(corners: Corners) -> Observations:
    """The corners as our observations."""
    return Observations(
        {"board": checkerboard(COLUMNS, ROWS, SQUARE_M)},
        {"camera": WIDE.image_size},
        tuple(View(str(frame), "camera", "camera", "board", str(frame)) for frame in range(corners.frames)),
        Points(corners.view, corners.feature, corners.pixels, np.ones(len(corners.view))),
        NO_CURVES,
    )


def field_observations(line_points: int, seed: int = 0) -> Observations:
    """A division B field in as many frames of a static overhead camera as needed; its height is known to 5 mm.

    The scene is projected once, and the frames differ in their noise. The last frame ends when the number of line
    points is reached.
    """
    clean = simulate(_field()).observations
    frames = -(-line_points // len(clean.curves))
    rng = np.random.default_rng(seed)

    def repeated(columns: Columns, count: int, sigma_px: float) -> dict[str, Any]:
        view, place = np.divmod(np.arange(count, dtype=np.int32), np.int32(len(columns)))
        pixels = columns.pixels[place]
        pixels += sigma_px * rng.standard_normal(pixels.shape)
        return {"view": view, "feature": columns.feature[place], "pixels": pixels, "sigma_px": np.full(count, sigma_px)}

    return replace(
        clean,
        views=tuple(View(str(frame), "overhead", "overhead", "field") for frame in range(frames)),
        points=Points(**repeated(clean.points, frames * len(clean.points), _CROSSINGS_PX)),
        curves=Curves(**repeated(clean.curves, line_points, _LINES_PX), side=np.zeros(line_points, np.int8)),
        priors=(Prior("station", "overhead", "height_m", (HEIGHT_M,), (HEIGHT_SIGMA_M,)),),
    )


def _field() -> Scene:
    station = Station("overhead", overhead_pose(0.1, -0.05, HEIGHT_M, tilt_x_deg=TILT_DEG))
    return field_scene(ssl_field("B"), {"overhead": OVERHEAD}, {"overhead": station}, spacing_m=_SPACING_M)
