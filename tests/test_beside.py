"""Lines beside a field's own lines, and worn lines: neither is taken for the other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from photos import disturbed as disturbed
from photos.shots import Shot, distances_px

from ceres_cal.base.arrays import Array, Indices32
from ceres_cal.base.transforms import Pose
from ceres_cal.detect.courses import predict
from ceres_cal.detect.images import light
from ceres_cal.detect.photographs.beside import among_others
from ceres_cal.detect.photographs.by_hand import unknown_optics
from ceres_cal.detect.photographs.painted import visible_curves
from ceres_cal.detect.photographs.refit import observations_of, refit_camera
from ceres_cal.detect.strokes import find_narrow_strokes, find_strokes
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.targets import ssl_field

FIELD = ssl_field("B")
NAMES = FIELD.curve_names
OUTER = {"TopTouchLine": 1, "BottomTouchLine": -1, "LeftGoalLine": 1, "RightGoalLine": -1}


def off_px(shot: disturbed.DisturbedShot, curve: Indices32, pixels: Array) -> Array:
    """Distances from the true curves."""
    return np.abs(distances_px(Shot(None, shot.camera, FIELD, None, True), curve, pixels))  # type: ignore[arg-type]


def test_a_boundary_line_is_no_touch_line_though_a_camera_is_bent_to_it() -> None:
    """Four lines 10 px outside of the field's own lines are fitted as if they were the field's."""
    shot = disturbed.taken("boundary", 9, FIELD)
    start = replace(shot.camera, lens=Radial((0.0, 1.0e-6, 0.0, 1.4e-12), (2, 3, 4, 5)))
    free = unknown_optics(start, None)
    course = predict(FIELD, shot.camera, NAMES, 12.0, 20.0)
    aside = np.array([10.0 * (NAMES[number] in OUTER) for number in course.curve])
    middle = 0.5 * (np.array(start.image_size) - 1.0)
    outwards = np.sign(np.sum((course.pixels - middle) * course.normals, axis=1))
    wrong = course.pixels + (aside * outwards)[:, None] * course.normals
    seen = observations_of(FIELD, start.image_size, course.curve, wrong, np.full(len(course), 1.0))
    bent = refit_camera(start, seen, ("a3", "phi", "a2"), free.priors)
    assert bent is not None
    here = predict(FIELD, bent[0], NAMES, 12.0, 0.0)
    assert np.median(off_px(shot, here.curve, here.pixels)) > 5.0  # 9.3 px
    other = among_others(light(shot.image), FIELD, bent[0], NAMES, free)
    assert other is not None
    there = predict(FIELD, other[0], NAMES, 12.0, 0.0)
    assert np.max(off_px(shot, there.curve, there.pixels)) < 1.0  # 0.15 px
    assert among_others(light(shot.image), FIELD, other[0], NAMES, free) is None


def test_dashes_too_short_to_be_measured_are_visible() -> None:
    """And none are visible where there is no paint, beside the field."""
    shot = disturbed.taken("worn", 9, FIELD)
    assert set(visible_curves(light(shot.image), FIELD, shot.camera, NAMES)) >= {*OUTER, "LeftPenaltyStretch"}
    aside = shot.camera.at(shot.camera.cam_from_world @ Pose(np.eye(3), np.array([0.55, 0.37, 0.0])))
    assert len(visible_curves(light(shot.image), FIELD, aside, NAMES)) <= 3


def test_stripes_of_sun_are_no_narrow_strokes() -> None:
    shot = disturbed.taken("sun", 6, FIELD)
    grey = light(shot.image)
    course = predict(FIELD, shot.camera, NAMES, 3.0)
    shares = []
    for strokes in (find_strokes(grey), find_narrow_strokes(grey, 58.0)):
        away = np.linalg.norm(strokes.ends.mean(axis=1)[:, None] - course.pixels, axis=2).min(axis=1)
        shares.append(float(np.mean(away < 4.0)))
    assert shares[1] > 0.8 > 0.6 > shares[0]
