"""Displacements of thin lines by the pixel grid, estimated from the picture itself."""

import numpy as np
import pytest
from rendering.photograph import photograph
from rendering.photography import Photography
from scenery import field_scene, overhead_pose

from ceres_cal.detect.courses import predict
from ceres_cal.detect.images import light
from ceres_cal.detect.lines import SPACING_PX, measure
from ceres_cal.detect.sampling import drawn_aside
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import Segment, custom
from ceres_cal.simulate import Station


@pytest.mark.parametrize("jpeg_quality", [0, 90])
@pytest.mark.parametrize("degrees", [0.0, 45.0, 90.0])
def test_thin_lines_are_not_drawn_aside(degrees: float, jpeg_quality: int) -> None:
    """Two thirds of a pixel wide, sharp, through a colour sensor: errors of 0.11 px that hardly change along a line; in
    a JPEG file, which stores one colour for two by two pixels, all lines were 0.02 px to one side.
    """
    angles = np.deg2rad(np.linspace(0.3, 3.0, 12))
    lines = {}
    for k, (y, angle) in enumerate(zip(np.linspace(-5.0, 4.0, 12), angles, strict=True)):
        start, end = (-6.0, y, 0.0), (6.0, y + 12.0 * np.tan(angle), 0.0)
        ends = [complex(*one[:2]) * np.exp(1j * np.deg2rad(degrees)) for one in (start, end)]
        turned = [(float(one.real), float(one.imag), 0.0) for one in ends]
        lines[f"line {k}"] = Segment(turned[0], turned[1], 0.03)
    optics, pose = Camera((320, 320), 100.0, (159.5, 159.5), Radial((0.0,), (3,))), overhead_pose(0.0, 0.0, 5.0)
    scene = field_scene(custom(curves=lines), {"overhead": optics}, {"overhead": Station("overhead", pose)})
    how = Photography(blur_px=0.0, mosaic=True, jpeg_quality=jpeg_quality)
    image = photograph(scene, "overhead", "0001", how, 1).image
    course = predict(scene.targets["field"], scene.camera_at("overhead"), tuple(lines), SPACING_PX, 12.0)
    found = measure(light(image), course, 3.0)
    assert np.mean(found.found) > 0.9
    off = found.offset_px[found.found]
    assert np.sqrt(np.mean(off**2)) < 0.04  # 0.031 at most; at 45 degrees in a JPEG file 0.09 before
    assert abs(np.mean(off)) < 0.005  # 0.0017 at most; 0.021 before
    assert 0.4 < np.std(off / found.sigma_px[found.found]) < 1.2  # 0.5 to 0.86


def test_too_few_places_tell_nothing() -> None:
    course = predict(custom(curves={"line": Segment((-1.0, 0.0, 0.0), (1.0, 0.1, 0.0), 0.03)}), _CAMERA, ("line",), 8.0)
    aside, sigma = drawn_aside(course, np.zeros(len(course)), np.array([[0, 1, 2]]), 3)
    assert np.all(aside == 0.0) and np.all(sigma == 0.0)


_CAMERA = Camera((320, 240), 100.0, (159.5, 119.5), Radial((0.0,), (3,)), 1.0, overhead_pose(0.0, 0.0, 5.0))
