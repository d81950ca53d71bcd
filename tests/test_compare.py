"""Comparison of two calibrations."""

from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from accuracy.moves import CAMERA, DAY, HOME, MOVED, seen
from accuracy.moves import calibrated as calibrated_at_home

from ceres_cal import Options, calibrate
from ceres_cal.base.errors import InputError
from ceres_cal.calibration import Calibration
from ceres_cal.formats import export, import_calibration
from ceres_cal.moves.comparisons import compare, compare_cameras
from ceres_cal.moves.refits import refit
from ceres_cal.report.maps import comparison_svg


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrated_at_home(0)


def test_equals_differ_nowhere(calibration: Calibration) -> None:
    found = compare(calibration, calibration, 0.15)["overhead"]
    assert found.change is not None and found.change.moved_mm == 0.0 and found.change.turned_deg < 1e-6
    assert found.change.maps[0].worst_mm < 1e-6
    assert found.holds and found.probability == pytest.approx(1.0)


@pytest.mark.thorough
def test_repetitions_differ_as_expected(calibration: Calibration) -> None:
    """Differences of two calibrations of the same camera over the expected ones: their mean is 1, and probabilities are
    uniform.
    """
    every = [calibrated_at_home(seed) for seed in range(1, 25)]
    pairs = [compare(a, b)["overhead"] for a, b in zip(every[::2], every[1::2], strict=True)]
    maps = [pair.change.maps[0] for pair in pairs if pair.change is not None]
    ratio = [np.nanmean(one.errors_mm**2) / np.nanmean(one.expected_mm**2) for one in maps]
    assert 0.4 < np.mean(ratio) < 2.0  # 0.9
    probabilities = np.sort([pair.probability for pair in pairs])
    assert len(probabilities) == 12
    assert np.max(np.abs(probabilities - (np.arange(12) + 0.5) / 12)) < 0.45  # 0.2


def test_another_lens_is_compared_on_the_field_alone(calibration: Calibration) -> None:
    """Numbers of different lenses cannot be compared: this was a KeyError wherever the choice of lens differed."""
    other = calibrate(seen(HOME, DAY, 1).observations, Options(lens="brown", coefficients=("k1", "k2")))
    answer = compare(calibration, other)["overhead"]
    assert answer.holds is None and answer.change is not None and answer.change.maps[0].rms_mm < 40.0  # 5 mm
    assert compare_cameras(calibration, other)["overhead"].holds is None


def test_a_move_is_found(calibration: Calibration) -> None:
    moved = refit(calibration, seen(MOVED, DAY, 1).observations)
    answer = compare(calibration, moved)["overhead"]
    assert answer.change is not None and answer.holds is False
    (found,) = answer.change.maps
    moved_mm = 1e3 * np.linalg.norm(MOVED.position - HOME.position)
    assert answer.change.moved_mm == pytest.approx(moved_mm, abs=5.0)  # 1.2 mm off
    row, column = 12, 8  # halfway up, in what both see
    place = np.array([[found.x_m[column], found.y_m[row], 0.0]])
    pixel = calibration.station().project(place)
    expected = 1e3 * (moved.station().locate(pixel) - place[:, :2])
    np.testing.assert_allclose(found.difference_mm[row, column], expected[0], rtol=1e-9)
    assert np.isnan(found.errors_mm[:, -1]).all()  # the far end of the field is not in the picture


def test_without_uncertainty_nothing_is_explained(calibration: Calibration) -> None:
    found = compare(calibration, replace(calibration, posterior=None))["overhead"]
    assert found.holds is None and found.change is not None and np.isnan(found.change.maps[0].expected_mm).all()


def test_no_station_in_common(calibration: Calibration) -> None:
    there = calibration.estimate.stations["overhead"]
    others = replace(calibration.estimate, stations={"elsewhere": there, "nowhere": there})
    with pytest.raises(InputError, match="no station is in both"):
        compare(calibration, replace(calibration, estimate=others))
    with pytest.raises(InputError, match="station 'elsewhere' is not in both calibrations: one has 'overhead'"):
        compare(calibration, calibration, station="elsewhere")


def test_the_only_station_of_each_may_be_called_otherwise(calibration: Calibration, tmp_path: Path) -> None:
    """For example after an export to a format without names, and an import."""
    export(calibration, "mrcal", tmp_path / "elsewhere.cameramodel")
    back = import_calibration(tmp_path / "elsewhere.cameramodel")
    assert list(back.stations) == ["elsewhere"]
    found = compare(calibration, back)["overhead"]
    assert found.holds is None and found.change is not None
    assert found.change.maps[0].worst_mm < 0.3  # 0.04 measured


def test_the_picture_is_svg(calibration: Calibration) -> None:
    moved = replace(calibration.estimate.cameras["overhead"], phi=1.01 * CAMERA.phi)
    zoomed = replace(calibration, estimate=replace(calibration.estimate, cameras={"overhead": moved}))
    found = compare(calibration, zoomed)["overhead"]
    assert found.change is not None
    root = ElementTree.fromstring(comparison_svg(found, calibration))
    assert root.tag.endswith("svg")
    paths = [path for path in root.iter("{http://www.w3.org/2000/svg}path") if "stroke" in path.get("style", "")]
    assert len(paths) > 2 * len(calibration.targets["field"].curves)  # each on a lighter ground
    texts = " ".join("".join(text.itertext()) for text in root.iter("{http://www.w3.org/2000/svg}text"))
    assert (
        "overhead, on the floor: difference, mm" in texts and f"{found.change.maps[0].mean_mm:.2f} on average" in texts
    )
