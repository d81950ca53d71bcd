"""arrays: what stands in for functions of NumPy's that import more than they need."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ceres_cal.base.arrays import distinct, inverse_of, inverse_root_of, median, medians

SAMPLE = Path(__file__).parents[1] / "data" / "ssl_field" / "observations.json"


@pytest.mark.parametrize("count", range(1, 9))
def test_median_is_numpys(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    assert median(values) == np.median(values)
    rows = np.stack([values, -2.0 * values])
    assert np.array_equal(medians(rows), np.median(rows, axis=1))


def test_median_of_what_is_not_finite() -> None:
    assert median(np.array([1.0, np.inf, 2.0])) == 2.0 and median(np.array([1.0, np.inf])) == np.inf
    assert np.isnan(median(np.array([1.0, np.nan, 2.0]))) and np.isnan(median(np.zeros(0)))


def test_distinct_is_numpys_unique() -> None:
    values = np.random.default_rng(1).integers(0, 3, (20, 2))
    np.testing.assert_array_equal(distinct(values), np.unique(values))
    np.testing.assert_array_equal(distinct(values, axis=0), np.unique(values, axis=0))


@pytest.mark.parametrize("shape", [(5, 6), (48,), (49,), (130,), (2, 211)])
def test_inverses_by_halves_are_numpys(shape: tuple[int, ...]) -> None:
    root = np.random.default_rng(0).standard_normal((*shape, shape[-1]))
    matrix = root @ np.swapaxes(root, -1, -2) + shape[-1] * np.eye(shape[-1])
    inverse, half = np.linalg.inv(matrix), inverse_root_of(matrix)
    for one in (inverse_of(matrix), np.swapaxes(half, -1, -2) @ half):
        assert np.allclose(one, inverse, rtol=1e-10, atol=1e-13)
    assert np.array_equal(half, np.tril(half))


def test_they_import_no_masked_arrays() -> None:
    call = "distinct(np.arange(3)), distinct(np.eye(3), axis=0), median(np.arange(3.0))"
    code = f"import sys, numpy as np; from ceres_cal.base.arrays import *; {call}; print('numpy.ma' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


@pytest.mark.parametrize("lens", ["auto", "spline"])
def test_nor_does_a_calibration(tmp_path: Path, lens: str) -> None:
    command = ["calibrate", str(SAMPLE), "--lens", lens, "-o", str(tmp_path / "calibration.json"), "--quiet"]
    code = f"import sys; from ceres_cal.cli import main; main({command}); print('numpy.ma' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == "False"
