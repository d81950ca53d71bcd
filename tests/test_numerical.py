"""Odd but valid input ends in one line: numerical failure, exact data, files and options of another kind."""

from __future__ import annotations

import json
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scenes
from scenes import RADIAL

from ceres_cal.base.arrays import numerical
from ceres_cal.base.errors import CalibrationError, InputError, SolutionError
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.observations import Prior
from ceres_cal.problem.parameters import Options
from ceres_cal.simulate import Disturbance, simulate
from ceres_cal.start.closed_forms import fit_lines, point_lines

EXACT = simulate(scenes.SCENES["radial-2-3/field-boards"](), Disturbance(), 0).observations
NOISY = simulate(scenes.SCENES["radial-2-3/corners"](), Disturbance(0.5, 0.3), 0).observations


@pytest.mark.parametrize(
    "failure", [np.linalg.LinAlgError("Singular"), ZeroDivisionError("by zero"), FloatingPointError(), OverflowError()]
)
def test_numerical_failure_names_its_step(failure: Exception) -> None:
    with pytest.raises(SolutionError, match="the solve failed numerically"), numerical("the solve"):
        raise failure


def test_other_errors_pass() -> None:
    for error in (InputError("a"), ValueError("b"), KeyError("c")):
        with pytest.raises(type(error)), numerical("the solve"):
            raise error


def test_what_numpy_warns_of_stays_off_the_screen() -> None:
    with warnings.catch_warnings(), numerical("the solve"):
        warnings.simplefilter("error")
        assert np.isnan(np.zeros(2) / np.zeros(2)).all()


def test_exact_observations_agree_with_exact_statements() -> None:
    """Residuals, and the part of a prior in their squares, are rounding errors."""
    station = scenes.SCENES["radial-2-3/field-boards"]().stations["overhead"]
    height_m = float(station.cam_from_world.inverse.translation[2])
    for sigma in (1e-5, 0.01):
        prior = Prior("station", "overhead", "height_m", (height_m,), (sigma,))
        found = calibrate(EXACT, replace(RADIAL, priors=(prior,)))
        assert not found.conflicts and abs(found.cameras["overhead"].phi - 868.0) < 1e-4  # 1e-9 measured


def test_a_plane_through_what_nearly_fits_exactly() -> None:
    """Nine rows for eight numbers: the median distance is a rounding error, and must not decide which rows are used."""
    rng = np.random.default_rng(0)
    homography = np.array([[200.0, 30.0, 400.0], [10.0, 180.0, 300.0], [0.02, 0.05, 1.0]])
    places = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 2.0], [3.0, 2.0], [1.5, 1.0]])
    seen = np.column_stack([places, np.ones(5)]) @ homography.T
    pixels = seen / seen[:, 2:] + np.column_stack([rng.normal(0.0, 0.5, (5, 2)), np.zeros(5)])
    rows = np.r_[:9]
    found, _ = fit_lines(point_lines(places)[rows], np.vstack([pixels, pixels])[rows], rounds=6)
    assert found is not None
    there = np.column_stack([places, np.ones(5)]) @ found.T
    assert np.max(np.abs(there[:, :2] / there[:, 2:] - pixels[:, :2])[:4]) < 5.0  # px; noise is 0.5


@pytest.mark.parametrize("pixel", [1e7, -1e7, 1e200])
def test_a_pixel_that_nobody_measured_is_named(pixel: float) -> None:
    pixels = NOISY.points.pixels.copy()
    pixels[3, 1] = pixel
    with pytest.raises(InputError, match=r"point '.*': pixel \(.*\) lies 10 image diagonals away"):
        calibrate(replace(NOISY, points=replace(NOISY.points, pixels=pixels)), RADIAL)


@pytest.mark.parametrize("factor", [1e-11, 1e-5, 2e4, 1e11])
def test_a_sigma_that_decides_alone_is_named(factor: float) -> None:
    sigma_px = NOISY.points.sigma_px.copy()
    sigma_px[3] *= factor
    odd = replace(NOISY, points=replace(NOISY.points, sigma_px=sigma_px))
    with pytest.raises(InputError, match=r"its sigma_px is .* usual: sigmas may differ by a factor of 10000 at most"):
        calibrate(odd, RADIAL)


@pytest.mark.parametrize("place_m", [1e6, 9e6])
def test_targets_far_away_are_answered_or_refused(place_m: float) -> None:
    """Points in geographic coordinates, and boards that appear to be there."""
    from ceres_cal.scene.targets import custom

    far = {name: (x + place_m, y, z) for name, (x, y, z) in NOISY.targets["field"].points.items()}
    odd = replace(NOISY, targets={**NOISY.targets, "field": custom(far)})
    points = odd.part(np.ones(len(odd.points), bool), np.zeros(len(odd.curves), bool))
    tiny = replace(EXACT, points=replace(EXACT.points, pixels=600.0 + 1e-6 * EXACT.points.pixels))
    for observations in (points, tiny.part(np.ones(len(tiny.points), bool), np.zeros(len(tiny.curves), bool))):
        with suppress(CalibrationError):  # one line of ours
            assert np.isfinite(calibrate(observations, RADIAL).cameras["overhead"].phi)


def test_an_image_size_that_no_observation_fills_is_named() -> None:
    large = replace(EXACT, cameras={"overhead": (1920, 1080)})
    (words,) = [text for text in calibrate(large, RADIAL).warnings if "image_size" in text]
    assert "of its image of 1920 x 1080 px, of which observations reach" in words
    assert not [text for text in calibrate(EXACT, RADIAL).warnings if "image_size" in text]


@pytest.mark.parametrize(
    "given",
    [
        {"priors": "x"},
        {"priors": (3,)},
        {"powers": "23", "lens": "radial"},
        {"fixed": 3},
        {"fixed": {"phi": "x"}},
        {"tolerances": {"field": 0.01}},
        {"loss_scale": "x"},
        {"threads": None},
        {"terms": 3},
    ],
)
def test_options_of_another_kind_are_refused(given: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"Options\("):
        Options(**given)


def test_a_posterior_of_somebody_else_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "calibration.json"
    calibrate(NOISY, RADIAL).save(file)
    data = json.loads(file.read_text())
    for number, owner in ((0, "nobody"), (-1, "nowhere")):
        odd = json.loads(json.dumps(data))
        odd["posterior"]["keys"][number][1] = owner
        file.write_text(json.dumps(odd))
        with pytest.raises(InputError, match=f"{owner}.* is not there: calibrate again"):
            Calibration.load(file)
