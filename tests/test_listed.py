"""Points listed in another order than their target's are named before anything is solved for."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scenes import RADIAL

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError, SolutionError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations, combine
from ceres_cal.scene.targets import Target, checkerboard, circle_grid, custom
from ceres_cal.start.listed import require_as_listed

COLUMNS, ROWS, SIZE = 9, 6, (1280, 960)
BOARD = checkerboard(COLUMNS, ROWS, 0.025)
PINHOLE = np.array([[900.0, 0.0, 655.3], [0.0, 900.0, 471.1], [0.0, 0.0, 1.0]])
FISHEYE = np.array([[300.0, 0.0, 640.0], [0.0, 300.0, 480.0], [0.0, 0.0, 1.0]])
Shown = dict[str, Array]


def shown(target: Target, count: int = 12, right_m: float = 0.0, *, is_fisheye: bool = False) -> Shown:
    """Pixels of a target by frame, as OpenCV projects it, for a camera `right_m` to the right."""
    rng, places, frames = np.random.default_rng(4), target.point_array, Shown()
    near, far = (0.1, 0.25) if is_fisheye else (0.35, 0.5)
    while len(frames) < count:
        turn = rng.normal(size=3) * (0.4, 0.4, 0.3)
        middle = np.array([rng.uniform(-0.05, 0.13), rng.uniform(-0.09, 0.09), rng.uniform(near, far)])
        shift = middle - cv2.Rodrigues(turn)[0] @ places.mean(axis=0)
        noise = 0.15 * rng.standard_normal((len(places), 2))
        own = []
        for x in (0.0, 0.1):  # both cameras of a rig see all
            to = shift - [x, 0.0, 0.0]
            if is_fisheye:
                own.append(cv2.fisheye.projectPoints(places[None], turn, to, FISHEYE, np.zeros(4))[0].reshape(-1, 2))
            else:
                own.append(cv2.projectPoints(places, turn, to, PINHOLE, np.array([-0.22, 0.08, 0.0, 0.0]))[0][:, 0])
        if all(np.all((one > 5.0) & (one < np.array(SIZE) - 6.0)) for one in own):
            frames[f"v{len(frames)}"] = own[int(right_m > 0.0)] + noise
    return frames


def by_columns(grid: Array) -> Array:
    return grid.transpose(1, 0, 2)


def columns_from_the_right(grid: Array) -> Array:
    return grid[:, ::-1].transpose(1, 0, 2)


def there_and_back(grid: Array) -> Array:
    return np.stack([row[::-1] if number % 2 else row for number, row in enumerate(grid)])


def reordered(frames: Shown, order: Callable[[Array], Array], chosen: Callable[[int], bool] = lambda n: True) -> Shown:
    """Every chosen frame as a list that goes through rows (R, C, 2) in another order."""
    return {
        frame: order(pixels.reshape(ROWS, COLUMNS, 2)).reshape(-1, 2) if chosen(number) else pixels
        for number, (frame, pixels) in enumerate(frames.items())
    }


def said_of(frames: Shown, target: Target = BOARD) -> str:
    """The message about the order, "" where there is none."""
    try:
        require_as_listed(Observations.from_points(frames, target, SIZE))
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("is_fisheye", [False, True])
@pytest.mark.parametrize(
    "order, words",
    [
        (by_columns, "column by column"),
        (columns_from_the_right, "column by column"),
        (there_and_back, "row by row, there and back"),
    ],
)
def test_views_in_another_order_are_named(order: Callable[[Array], Array], words: str, is_fisheye: bool) -> None:
    """It took 17 to 80 s to refuse views listed by columns, without naming the cause; with one such view, two thirds of
    its points were rejected. For fisheyes the right order leaves 0.2 to 0.4 of the distance between neighbours, wrong
    ones 1.5 and more (`_CLEARLY`).
    """
    frames = shown(BOARD, is_fisheye=is_fisheye)
    assert said_of(frames) == ""
    told = said_of(reordered(frames, order))
    assert f"target 'board': its points are listed {words} in 12 of 12 views ('v0', 'v1', 'v2' and 9 more)" in told
    assert f"listed {words} in 1 of 12 views ('v3')" in said_of(reordered(frames, order, lambda number: number == 3))
    assert f"listed {words} in 6 of 12 views" in said_of(reordered(frames, order, lambda number: number % 2 == 0))


def test_columns_and_rows_exchanged_are_named_by_calibrate() -> None:
    observations = Observations.from_points(shown(BOARD), checkerboard(ROWS, COLUMNS, 0.025), SIZE)
    with pytest.raises(InputError, match=r"listed column by column in 12 of 12 views.*correct its numbers"):
        calibrate(observations)


@pytest.mark.parametrize("order", [lambda grid: grid[::-1], lambda grid: grid[:, ::-1], lambda grid: grid[::-1, ::-1]])
def test_what_a_grid_looks_like_turned_or_mirrored_is_no_other_order(order: Callable[[Array], Array]) -> None:
    """Mirrored views are named after the solve (`test_calibration`); rotated ones matter only for a rig."""
    assert said_of(reordered(shown(BOARD), order, lambda number: number == 3)) == ""


def test_lists_in_reverse_are_named_where_they_make_another_picture() -> None:
    """Zhang's squares of four corners in one view of five: 129 of 1280 corners were rejected without a name."""
    squares = [(x, y) for row in range(8) for x0 in range(8) for x, y in _square(x0, row)]
    target = custom({str(number): (x, y, 0.0) for number, (x, y) in enumerate(squares)}, movable=True)
    uneven = circle_grid(8, 5, 0.012, 0.008, asymmetric=True)
    for one in (target, uneven):
        frames = shown(one, count=5)
        assert said_of(frames, one) == ""
        told = said_of({frame: pixels[::-1] if frame == "v1" else pixels for frame, pixels in frames.items()}, one)
        assert "listed in reverse order in 1 of 5 views ('v1')" in told


def _square(column: int, row: int) -> list[tuple[float, float]]:
    x, y = 0.02 * column, -0.02 * row
    return [(x, y - 0.01), (x + 0.01, y - 0.01), (x + 0.01, y), (x, y)]


def test_strays_are_no_other_order() -> None:
    frames, rng = shown(BOARD), np.random.default_rng(0)
    for pixels in frames.values():
        pixels[rng.integers(0, len(pixels), 2)] = rng.uniform(0.0, 950.0, (2, 2))
    assert said_of(frames) == ""
    assert "column by column in 12 of 12" in said_of(reordered(frames, by_columns))


@pytest.mark.parametrize(
    "order, words", [(lambda grid: grid[::-1, ::-1], "turned"), (lambda grid: grid[:, ::-1], "mirrored")]
)
def test_boards_that_one_camera_of_a_rig_lists_otherwise_are_named(order: Callable[[Array], Array], words: str) -> None:
    left, right = shown(BOARD), shown(BOARD, right_m=0.1)

    def rig(chosen: Callable[[int], bool]) -> Observations:
        each = {"left": left, "right": reordered(right, order, chosen)}
        return combine([Observations.from_points(px, BOARD, SIZE, camera=name) for name, px in each.items()])

    said = f"its points are {words} relative to those of other cameras: list them in the same order"
    (warning,) = calibrate(rig(lambda number: number == 3), RADIAL).warnings
    assert "station 'right', placement 'v3'" in warning and said in warning
    with pytest.raises(SolutionError, match=f"station 'right', placement 'v0' and at 11 others: {said}"):
        calibrate(rig(lambda number: True), RADIAL)
