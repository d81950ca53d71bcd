"""The precision of board corners, estimated from their own pictures."""

import numpy as np
import pytest

from ceres_cal.base.arrays import Array
from ceres_cal.detect.scatter import USUAL_PX, scatter_px
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Brown
from ceres_cal.scene.targets import checkerboard
from ceres_cal.simulate import board_pose

WIDE = Camera((1280, 960), 700.0, (640.0, 480.0), Brown((-0.25, 0.06, 0.0, 0.0, 0.0)))


def grids(columns: int, rows: int, noise_px: float, bow_m: float = 0.0) -> list[Array]:
    """Six boards in front of a wide lens, with a bow."""
    board, rng = checkerboard(columns, rows, 0.05), np.random.default_rng(columns)
    points = board.point_array.copy()
    points[:, 2] += bow_m * np.linspace(-1.0, 1.0, columns)[np.lexsort((points[:, 0], points[:, 1])) % columns] ** 2
    found = []
    for number in range(6):
        pose = board_pose(board, WIDE.rays([(300.0 + 130.0 * number, 400.0)])[0], 0.7, (0.5, number, 0.0))
        pixels = WIDE.at(pose).project(points).reshape(rows, columns, 2)
        found.append(pixels + rng.normal(0.0, noise_px, pixels.shape))
    return found


def places(columns: int, rows: int) -> Array:
    return np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1).astype(float)


@pytest.mark.parametrize(("columns", "rows"), [(9, 6), (8, 6), (6, 4)])
@pytest.mark.parametrize("noise_px", [0.02, 0.2])
def test_the_noise_comes_back(columns: int, rows: int, noise_px: float) -> None:
    found = scatter_px(grids(columns, rows, noise_px), places(columns, rows))
    assert found == pytest.approx(noise_px, rel=0.25)  # 0.02 px: 0.9 to 1.14 times


def test_a_bent_board_is_smooth() -> None:
    assert scatter_px(grids(9, 6, 0.03, bow_m=0.004), places(9, 6)) == pytest.approx(0.03, rel=0.25)


def test_corners_that_were_not_seen_are_no_matter() -> None:
    some = grids(9, 6, 0.05)
    for grid in some:
        grid[0, :4] = grid[3, 2] = np.nan
    assert scatter_px(some, places(9, 6)) == pytest.approx(0.05, rel=0.25)


def test_few_corners_tell_nothing() -> None:
    assert scatter_px(grids(3, 3, 0.05), places(3, 3)) == USUAL_PX == scatter_px([], places(3, 3))
