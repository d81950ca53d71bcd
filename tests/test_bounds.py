"""Pixels outside their image: many are refused with the likely cause, a few are reported and counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scenes import RADIAL, SCENES

from ceres_cal.base.arrays import Array
from ceres_cal.base.errors import InputError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Observations
from ceres_cal.simulate import Disturbance, simulate

Change = Callable[[Array], Array]


@cache
def seen() -> Observations:
    """Lines and arcs in an image of 1280 x 960 px."""
    return simulate(SCENES["radial-2-3/lines-arcs"](), Disturbance(0.3, 0.3)).observations


def with_pixels(change: Change) -> Observations:
    return replace(seen(), curves=replace(seen().curves, pixels=change(seen().curves.pixels)))


def with_moved(rows: int, pixel: tuple[float, float]) -> Observations:
    """The first curve observations moved to this pixel, each a pixel lower than the one before."""
    pixels = seen().curves.pixels.copy()
    pixels[:rows] = np.add(pixel, np.column_stack([np.zeros(rows), np.arange(rows)]))
    return with_pixels(lambda _: pixels)


@pytest.mark.parametrize(
    "size, change, words",
    [
        ((640, 480), lambda p: p, "but image_size is 640 x 480: give the size of the pictures"),
        ((960, 1280), lambda p: p, "but image_size is 960 x 1280: width and height, or x and y, are swapped"),
        ((1280, 960), lambda p: p[:, ::-1], "but image_size is 1280 x 960: width and height, or x and y, are swapped"),
        ((1280, 960), lambda p: 2.0 * p, "but image_size is 1280 x 960: give the size of the pictures"),
        ((1280, 960), lambda p: p * (1.0, -1.0), "but (0, 0) is the centre of the top-left pixel"),
        ((1280, 960), lambda p: p - (640.0, 480.0), "but (0, 0) is the centre of the top-left pixel"),
    ],
)
def test_another_image_size_is_refused(tmp_path: Path, size: tuple[int, int], change: Change, words: str) -> None:
    """The message names the cause, and view, feature and pixel of the first one; from a file, its name, too."""
    wrong = replace(with_pixels(change), cameras={"overhead": size})
    with pytest.raises(InputError) as refused:
        calibrate(wrong, RADIAL)
    text = str(refused.value)
    assert text.startswith("camera 'overhead': ") and "\n" not in text and words in text
    assert "view 0 (frame '0001'), curve 'TopTouchLine': pixel (" in text
    wrong.save(tmp_path / "wrong.json")
    with pytest.raises(InputError) as refused:
        Observations.load(tmp_path / "wrong.json")
    assert str(refused.value) == f"{tmp_path / 'wrong.json'}: {text}"


@pytest.mark.parametrize("rows, refused", [(2, False), (3, True)])
def test_more_than_one_in_a_hundred_are_refused(rows: int, refused: bool) -> None:
    """Of 223 observations; fewer are reported, and do not influence the result."""
    wrong = with_moved(rows, (1300.0, 200.0))
    assert len(wrong.curves) == 223
    if refused:
        with pytest.raises(InputError, match=r"^camera 'overhead': 3 of 223 observations lie outside its image: "):
            wrong.require_inside()
        return
    calibration = calibrate(wrong, RADIAL)
    assert calibration.warnings[0] == (
        "camera 'overhead': 2 of 223 observations lie outside its image of 1280 x 960 px, the first is "
        "view 0 (frame '0001'), curve 'TopTouchLine': pixel (1300.0, 200.0): correct or remove what lies outside"
    )
    assert {0, 1} <= {entry.row for entry in calibration.rejected}


def test_one_of_few_is_no_reason_to_refuse() -> None:
    rows = np.arange(8)
    few = replace(seen(), curves=type(seen().curves)(**{n: c[rows] for n, c in vars(seen().curves).items()}))
    pixels = few.curves.pixels.copy()
    pixels[3] = 100.0, -7.0
    assert len(replace(few, curves=replace(few.curves, pixels=pixels)).require_inside()) == 1


@pytest.mark.parametrize(
    "pixel, outside",
    [
        ((-1.5, -1.5), False),
        ((1280.5, 960.5), False),
        ((-1.51, 0.0), True),
        ((0.0, -1.51), True),
        ((1280.51, 0.0), True),
        ((0.0, 960.51), True),
    ],
)
def test_a_detection_may_lie_one_pixel_beyond_the_edge(pixel: tuple[float, float], outside: bool) -> None:
    assert bool(with_moved(1, pixel).require_inside()) == outside


def test_each_camera_has_its_own_image() -> None:
    both = simulate(SCENES["brown/two-cameras"](), Disturbance(0.3, 0.3)).observations
    assert both.require_inside() == ()
    with pytest.raises(InputError, match=r"^camera 'east': .* image_size is 1000 x 960: give .* the first is view"):
        replace(both, cameras=dict(both.cameras) | {"east": (1000, 960)}).require_inside()
    larger = replace(both, cameras=dict(both.cameras) | {"east": (2000, 2000)})
    assert larger.require_inside() == ()
