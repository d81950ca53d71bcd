"""The search for the place of a camera: few features and a known camera, ambiguous views, and open directions."""

import re
from collections.abc import Collection
from dataclasses import replace

import numpy as np
import pytest
from accuracy.as_built import Board, observed
from scenery import field_scene, overhead_pose
from thorough import partly

from ceres_cal.base.errors import DegenerateError, InputError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.calibration.renaming import relabelled
from ceres_cal.moves.checks import check
from ceres_cal.observations import Observations, Prior
from ceres_cal.observations.columns import taken
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.parameters import Options
from ceres_cal.report.grounds import judge_quality
from ceres_cal.report.quality import quality_of
from ceres_cal.scene.camera import Camera
from ceres_cal.scene.lens import Radial
from ceres_cal.scene.symmetry import TURNED
from ceres_cal.scene.targets import ssl_field
from ceres_cal.simulate import Station, simulate
from ceres_cal.start.initialise import initialise
from ceres_cal.start.search import _searched_once

CAMERA = Camera((1280, 960), 700.0, (640.0, 480.0), Radial((-5e-5, 6e-7)))
KNOWN = Options(lens="radial", fixed={"phi": 700.0, "cx": 640.0, "cy": 480.0, "a2": -5e-5, "a3": 6e-7})
HEIGHT = Prior("station", "hall", "height_m", (4.0,), (0.003,))
PLACE = np.array([2.8, 0.5, 4.0])


def seen(features: Collection[str], tilt_deg: float = 20.0) -> Observations:
    """Observations of some lines, arcs and crossings, with 0.3 px of noise on lines and 0.5 px on points."""
    station = Station("overhead", overhead_pose(PLACE[0], PLACE[1], PLACE[2], tilt_x_deg=tilt_deg))
    every = simulate(field_scene(ssl_field("B"), {"overhead": CAMERA}, {"hall": station}, spacing_m=0.1)).observations
    field = every.targets["field"]
    points, curves = (
        np.array([name in features for name in names]) for names in (field.point_names, field.curve_names)
    )
    assert np.count_nonzero(points) + np.count_nonzero(curves) == len(features)
    return replace(
        every,
        points=taken(every.points, points[every.points.feature]),
        curves=taken(every.curves, curves[every.curves.feature]),
    )


def off_in_sd(calibration: Calibration) -> float:
    """Error of the camera's position over its standard deviation."""
    where, posterior = calibration.estimate.stations["hall"].cam_from_world.position, calibration.uncertainty.posterior
    sd = [posterior.sd_of("station", "hall", quantity) for quantity in ("x", "y", "height")]
    return float(np.linalg.norm(where - PLACE) / np.linalg.norm(sd))


@pytest.mark.parametrize(
    "features",
    [
        ("BottomTouchLine", "TopTouchLine", "CenterCircle"),
        pytest.param(("BottomTouchLine", "RightGoalLine", "CenterCircle"), marks=pytest.mark.thorough),
        ("RightGoalLine", "CenterCircle", "BottomRightCorner"),
        ("CenterCircle", "BottomRightCorner"),
    ],
)
def test_lines_and_an_arc(features: tuple[str, ...]) -> None:
    assert off_in_sd(calibrate(seen(features, 3.0), KNOWN)) < 3.0  # at most 1.9


def test_seen_alike_after_half_a_turn() -> None:
    """The halfway line, the centre line and the circle are symmetric; a roughly known place resolves the symmetry."""
    middle = seen(("HalfwayLine", "CenterLine", "CenterCircle"), 3.0)
    calibration = calibrate(middle, KNOWN)
    (said,) = calibration.ambiguities
    assert "with other places on the floor" in said and "rough position (position_m)" in said  # heights are equal
    assert judge_quality(quality_of(calibration, middle)).level == "no"
    position = Prior("station", "hall", "position_m", tuple((PLACE + 0.2).tolist()), (0.3, 0.3, 0.3))
    told = calibrate(replace(middle, priors=(position,)), KNOWN)
    assert told.ambiguities == () and off_in_sd(told) < 3.0  # 3e-4


def test_a_camera_of_which_it_is_not_known_where_it_stood_did_not_move() -> None:
    """Calibrated at the other one of two places, it was reported to have moved by 5.7 m."""
    calibration = calibrate(seen(("HalfwayLine", "CenterLine", "CenterCircle"), 3.0), KNOWN)
    place = calibration.station("hall").position[0]
    assert abs(place) == pytest.approx(2.8, abs=0.1)  # rounding decides which of the two
    told = ("TopTouchLine", "BottomTouchLine", "RightGoalLine", "CenterLine", "CenterCircle", "BottomRightCorner")
    other = relabelled(seen(told, 3.0), TURNED) if place > 0.0 else seen(told, 3.0)
    assert other is not None
    with pytest.raises(InputError, match=r"fit equally well from .* until then a move cannot be detected"):
        check(calibration, other)


def test_seen_alike_from_two_places() -> None:
    """Three points have up to four poses (Grunert): the other one is named and in the sd; the height resolves it."""
    three = seen(("BottomRightCorner", "CenterMark", "RightCircleCrossing"))
    calibration = calibrate(three, KNOWN)
    (warning,) = calibration.warnings
    places = re.match(
        r"station 'hall': its observations fit equally well from (\(.*\)) m and from (\(.*\)) m,", warning
    )
    assert places is not None and "(2.80, 0.50, 4.00)" in places.groups()
    assert calibration.ambiguities == (warning,) and "or the camera's height as a prior" in warning
    judged = judge_quality(quality_of(calibration, three))
    assert judged.level == "no" and "fit equally well from another position" in judged.headline
    assert off_in_sd(calibration) < 1.0  # 0.7
    assert off_in_sd(calibrate(replace(three, priors=(HEIGHT,)), KNOWN)) < 3.0  # 0.4


def test_few_boards_tell_nothing_of_a_place_in_the_world() -> None:
    """Every set with fewer than 300 equations was "seen alike from (0.00, 0.00, 0.00) m", and not trusted."""
    few = observed(Board(views=3, columns=6), 0)[1]
    calibration = calibrate(few)
    assert calibration.ambiguities == ()
    assert "fit equally well" not in judge_quality(quality_of(calibration, few)).headline


def test_what_is_open_is_named() -> None:
    with pytest.raises(DegenerateError, match="cannot fix its pose: direction, x of the camera cannot be determined"):
        calibrate(seen(("BottomTouchLine", "TopTouchLine")), KNOWN)


def test_too_few_stay_too_few() -> None:
    posterior = calibrate(seen(("BottomTouchLine", "RightGoalLine")), KNOWN).uncertainty.posterior
    assert np.isinf([posterior.sd_of("station", "hall", quantity) for quantity in ("x", "y", "height")]).all()


@pytest.mark.parametrize("tilt_deg", partly([3.0, 20.0], [3.0]))
def test_a_circle_tells_the_height(tilt_deg: float) -> None:
    """It does not determine the direction: the camera is above the floor, and its x and y are unknown."""
    calibration = calibrate(seen(("CenterCircle",), tilt_deg), KNOWN)
    position = calibration.estimate.stations["hall"].cam_from_world.position
    assert position[2] == pytest.approx(4.0, abs=0.02)  # 0.004
    assert np.hypot(*position[:2]) == pytest.approx(np.hypot(*PLACE[:2]), abs=0.02)
    posterior = calibration.uncertainty.posterior
    assert min(posterior.sd_of("station", "hall", quantity) for quantity in ("x", "y")) > 3.0  # 5 m, or infinite
    assert posterior.sd_of("station", "hall", "height") < 0.02


def test_a_search_is_made_once() -> None:
    """The same question has the same answer, and is not searched again: lenses and other starts ask it repeatedly."""
    sights = gather_sights(seen(("BottomTouchLine", "TopTouchLine", "CenterCircle")))
    _searched_once.cache_clear()
    first, again = (initialise(sights, KNOWN).estimate for _ in range(2))
    asked = _searched_once.cache_info()
    assert asked.hits >= asked.misses >= 1
    assert first.stations == again.stations and first.cameras == again.cameras
    initialise(gather_sights(seen(("BottomTouchLine", "TopTouchLine", "CenterCircle"), 21.0)), KNOWN)
    assert _searched_once.cache_info().misses > asked.misses  # other observations are another question
