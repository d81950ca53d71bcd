"""arrays: replacements for functions of NumPy whose import is slow."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from ceres_cal.base.arrays import (
    AnyArray,
    distinct,
    eigh,
    inverse_of,
    inverse_root_of,
    median,
    medians,
    quantile,
    ridged_root_of,
)

AUTO = ["--target", "ssl-b", "--auto", "--facing", "LeftGoalLine=top"]
SAMPLE = Path(__file__).parents[1] / "data" / "ssl_field"


@pytest.mark.parametrize("count", range(1, 9))
def test_median_is_numpys(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    assert median(values) == np.median(values)
    rows = np.stack([values, -2.0 * values])
    assert np.array_equal(medians(rows), np.median(rows, axis=1))


def test_median_of_what_is_not_finite() -> None:
    assert median(np.array([1.0, np.inf, 2.0])) == 2.0 and median(np.array([1.0, np.inf])) == np.inf
    assert np.isnan(median(np.array([1.0, np.nan, 2.0]))) and np.isnan(median(np.zeros(0)))


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("count", [1, 2, 3, 40])
def test_quantile_is_numpys(count: int, kind: type) -> None:
    values: AnyArray = np.random.default_rng(count).normal(size=count).astype(kind)
    assert all(quantile(values, share) == np.quantile(values, share) for share in (0.0, 0.25, 0.7, 0.99, 1.0))
    assert np.isnan(quantile(values[:0], 0.5))


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


def test_a_ridged_root_takes_negative_eigenvalues_for_rounding() -> None:
    """What a field of a few rejected clicks tells of its floor is rounding: a calibration "failed numerically"."""
    turn = np.linalg.qr(np.random.default_rng(0).standard_normal((4, 4)))[0]
    for values, counted in (((3.0, 2.0, 1.0, 0.5),) * 2, ((3.0, 1.0, 0.0, -5e-7), (3.0, 1.0, 0.0, 0.0))):
        root = ridged_root_of((turn * values) @ turn.T, 1e-7)
        inverse = (turn / (np.array(counted) + 1e-7)) @ turn.T
        assert np.allclose(root.T @ root, inverse, rtol=1e-6, atol=1e-6 * np.max(inverse))


def test_they_import_no_masked_arrays() -> None:
    call = "distinct(np.arange(3)), distinct(np.eye(3), axis=0), median(np.arange(3.0)), quantile(np.arange(3.0), 0.4)"
    code = f"import sys, numpy as np; from ceres_cal.base.arrays import *; {call}; print('numpy.ma' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False"]


def test_nor_do_commands(tmp_path: Path) -> None:
    """One after the other in one process."""
    commands = [
        ["calibrate", str(SAMPLE / "observations.json"), "--lens", "auto"],
        ["calibrate", str(SAMPLE / "observations.json"), "--lens", "spline"],
        ["detect", "field", str(SAMPLE / "photographs/0001.jpg"), *AUTO],
    ]
    every = [[*words, "-o", str(tmp_path / "made.json"), "--quiet"] for words in commands]
    run = "codes = [main(words) for words in " + repr(every) + "]"
    code = f"import sys; from ceres_cal.cli import main; {run}; print(*codes, 'numpy.ma' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-4:] == ["0", "0", "0", "False"]


@pytest.mark.parametrize("shape", [(5, 5), (3, 4, 4)])
def test_eigenvalues_where_lapack_does_not_converge(shape: tuple[int, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """A matrix of 24 frames from one pose, with 114 rows, failed in a quarter of the orders of its rows."""

    def fails(_: AnyArray) -> None:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")

    roots = np.random.default_rng(1).normal(size=shape)
    symmetric = roots @ np.swapaxes(roots, -1, -2) - 2.0 * np.eye(shape[-1])
    values, vectors = np.linalg.eigh(symmetric)
    monkeypatch.setattr(np.linalg, "eigh", fails)
    again, turned = eigh(symmetric)
    assert np.allclose(again, values, atol=1e-13) and np.allclose(np.abs(turned), np.abs(vectors), atol=1e-12)
    with pytest.raises(np.linalg.LinAlgError):
        eigh(np.full((2, 2), np.nan))
