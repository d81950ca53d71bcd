"""Derivatives of pixels with respect to the camera's numbers, compared with differences."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest
import scenes
from scenery import overhead_pose

from ceres_cal.base.arrays import Array
from ceres_cal.base.transforms import Pose
from ceres_cal.problem.parameters import intrinsic_names, unit_px
from ceres_cal.problem.quantities import camera_moved, pixel_slopes
from ceres_cal.scene.camera import Camera

_STEP = 1e-6
_PLACES = np.array([(x, y, z) for x in (-2.0, -0.3, 1.1) for y in (-1.5, 0.2, 1.7) for z in (0.0, 0.15)])


def _camera(lens: str) -> Camera:
    return scenes.camera(lens).at(overhead_pose(-0.5, -0.2, 4.2, tilt_x_deg=-9.0, tilt_y_deg=6.0, yaw_deg=20.0))


def _between(cameras: Iterable[Camera], step: float = _STEP) -> Array:
    one, other = cameras
    return np.asarray((one.project(_PLACES) - other.project(_PLACES)) / (2.0 * step))


@pytest.mark.parametrize("lens", scenes.EVERY_LENS)
def test_slopes_are_those_of_what_is_shown(lens: str) -> None:
    camera = _camera(lens)
    by, names = pixel_slopes(camera, _PLACES), intrinsic_names(camera.lens)
    sizes = [*[1.0] * 4, *camera.lens.natural_sizes(camera.phi, unit_px(camera)), 1.0]
    for number, (name, size) in enumerate(zip(names, sizes, strict=True)):
        if name in camera.lens.set_at_start:
            continue
        step = _STEP * size
        ends = (camera_moved(camera, [name], np.array([change])) for change in (step, -step))
        found = _between(ends, step)
        assert np.abs(by.intrinsics[:, :, number] - found).max() < 1e-5 * (1.0 + np.abs(found).max())
    for axis in range(3):
        along = _STEP * np.eye(3)[axis]
        turned = (camera.at(Pose.exp((*turn, 0.0, 0.0, 0.0)) @ camera.cam_from_world) for turn in (along, -along))
        assert by.turns[:, :, axis] == pytest.approx(_between(turned), abs=1e-4)
        there = (camera.project(_PLACES + along) - camera.project(_PLACES - along)) / (2.0 * _STEP)
        assert by.places[:, :, axis] == pytest.approx(there, abs=1e-4)


def test_what_is_not_shown_moves_nowhere() -> None:
    """Behind the camera, beyond the end of its lens, or NaN; other places are not affected."""
    camera = _camera("brown")
    above = camera.position + np.array([0.3, 0.0, 1.0])
    places = np.array([_PLACES[0], above, (np.nan, 0.0, 0.0), _PLACES[1]])
    by = pixel_slopes(camera, places)
    for slopes in by:
        assert np.isnan(slopes).all(axis=(1, 2)).tolist() == [False, True, True, False]
    assert by.intrinsics[[0, 3]] == pytest.approx(pixel_slopes(camera, _PLACES[:2]).intrinsics, abs=1e-12)
