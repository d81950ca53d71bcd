"""Possible ranges of stated numbers: millimetres instead of metres, sigmas finer than any measurement."""

from __future__ import annotations

from dataclasses import replace
from time import process_time
from typing import Any

import numpy as np
import pytest
import scenes
from hypothesis import given, settings
from hypothesis import strategies as st

from ceres_cal.base.errors import InputError
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.moves.refit_plan import RefitOptions
from ceres_cal.moves.refits import refit
from ceres_cal.observations import Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.quantities import require_possible_numbers
from ceres_cal.problem.structure import Tolerance
from ceres_cal.scene.targets import custom
from ceres_cal.simulate import Disturbance, simulate

FIELD = simulate(scenes.SCENES["radial-2-3/field-boards"](), Disturbance(), 0)
SEEN = FIELD.observations


def height(value: float, sigma: float) -> Prior:
    return Prior("station", "overhead", "height_m", (value,), (sigma,))


def phi(value: float, sigma: float = 5.0) -> Prior:
    return Prior("camera", "overhead", "phi", (value,), (sigma,))


def length(value: float, sigma: float = 0.02) -> Prior:
    return Prior("target", "field", "field_length_m", (value,), (sigma,))


# ---- millimetres ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [1e-6, 1e-3, 0.02, 10.0, 20.0, 1e6])
def test_a_height_in_millimetres_is_asked_about_whatever_its_sigma(sigma: float) -> None:
    begun = process_time()
    with pytest.raises(InputError, match=r"height_m of station 'overhead' is 4020 m.*is it in mm\? Give metres"):
        calibrate(SEEN, Options(lens="radial", priors=(height(4020.0, sigma),)))
    assert process_time() - begun < 0.5  # 0.01 measured; a solve takes more


@pytest.mark.parametrize(
    "stated, words",
    [
        ({"priors": (Prior("station", "overhead", "position_m", (-2270.0, -120.0, 4022.0), (20.0,) * 3),)}, "-2270 m"),
        (
            {"priors": (height(-4.02, 0.005),)},
            r"is -4.02 m, but must be at least 1e-06 m: z points upwards, the camera is above",
        ),
        (
            {"priors": (Prior("station", "overhead", "position_m", (0.0, 0.0, 0.0), (0.1,) * 3),)},
            "position_m .* is 0 m",
        ),
        ({"priors": (phi(8.0),)}, r"phi of camera 'overhead' is 8 px.*is it in mm\?"),
        ({"priors": (phi(8.0e5),)}, "phi of camera 'overhead' is 800000 px"),
        ({"priors": (Prior("camera", "overhead", "cy", (1e6,), (5.0,)),)}, "cy of camera 'overhead' is 1e"),
        (  # which took 24 s, and failed numerically
            {"priors": (Prior("camera", "overhead", "principal_point", (9000.0, 240.0), (5.0, 5.0)),)},
            "principal_point of camera 'overhead' is 9000 px, but must be at most",
        ),
        ({"priors": (length(9000.0),)}, r"field_length_m of target 'field' is 9000 m.*states 9 m; is it in mm\?"),
        ({"tolerances": {"field": Tolerance(lines_m=10.0)}}, r"tolerance lines_m of target 'field'.*is it in mm\?"),
        ({"tolerances": {"board": Tolerance(warp_m=2.0)}}, r"tolerance warp_m of target 'board'.*is it in mm\?"),
        ({"tolerances": {"field": Tolerance(curve_m={"CenterLine": 5.0})}}, "tolerance CenterLine of target 'field'"),
        ({"fixed": {"phi": 8.0}}, r"phi, which is held for camera 'overhead', is 8 px.*is it in mm\?"),
        ({"fixed": {"aspect": 100.0}}, "aspect, which is held"),
        ({"fixed": {"a2": 1e9}}, "a2, which is held"),
    ],
)
def test_numbers_that_cannot_be_are_named(stated: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        calibrate(SEEN, replace(Options(lens="radial"), **stated))


def test_they_are_asked_of_a_files_priors_and_of_a_refit_too() -> None:
    with pytest.raises(InputError, match=r"is it in mm\?"):
        calibrate(replace(SEEN, priors=(height(4020.0, 20.0),)))
    known = calibrate(SEEN, Options(lens="radial"))
    later = replace(SEEN, points=replace(SEEN.points, pixels=SEEN.points.pixels + 0.1))
    with pytest.raises(InputError, match=r"is it in mm\?"):
        refit(known, later, options=RefitOptions(priors=(height(4020.0, 20.0),)))


@given(factor=st.floats(0.05, 10.0), sigma=st.floats(1e-6, 1e3), scale=st.floats(1e-3, 1e3))
@settings(max_examples=50)
def test_the_range_of_a_height_goes_with_the_scene(factor: float, sigma: float, scale: float) -> None:
    """A scene of any size accepts heights that its own camera may have, but not a thousand times these."""
    places = {name: tuple((scale * np.array(place)).tolist()) for name, place in SEEN.targets["field"].points.items()}
    points = SEEN.part(np.ones(len(SEEN.points), bool), np.zeros(len(SEEN.curves), bool))
    sized = replace(points, targets={**SEEN.targets, "field": custom(places)})
    true_m = scale * float(FIELD.scene.stations["overhead"].cam_from_world.inverse.translation[2])
    require_possible_numbers(sized, Options(priors=(height(factor * true_m, sigma),)))
    with pytest.raises(InputError, match="height_m"):
        require_possible_numbers(sized, Options(priors=(height(1000.0 * true_m, sigma),)))


# ---- sigmas ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [1e-300, 1e-12, 1e-9])
@pytest.mark.parametrize("prior", [height(4.0, 1.0), phi(868.0), length(9.0)], ids=lambda prior: prior.quantity)
def test_a_sigma_that_nobody_measured_is_named(prior: Prior, sigma: float) -> None:
    with pytest.raises(InputError, match=f"{prior.quantity} of .* has a sigma of {sigma:g}.*give at least 1e-06"):
        calibrate(SEEN, Options(lens="radial", priors=(replace(prior, sigma=(sigma,)),)))


@pytest.mark.parametrize("sigma", [0.0, -1.0, np.nan])
def test_a_sigma_that_is_none_is_refused_where_it_is_stated(sigma: float) -> None:
    with pytest.raises(InputError, match="a sigma above 0"):
        height(4.0, sigma)
