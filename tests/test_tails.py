import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from ceres_cal.base.tails import log_binomial_tail, log_chi2_tail, log_f_tail, quadratic_tail, upper_tail


@pytest.mark.parametrize("degrees", [1, 2, 6, 7, 14])
@pytest.mark.parametrize("tail", [0.05, 0.01, 1e-3, 1e-4])
def test_tails_of_chi_squared(degrees: int, tail: float) -> None:
    assert upper_tail(float(stats.chi2.isf(tail, degrees)), degrees) == pytest.approx(tail, rel=1e-12)  # 3e-15


@pytest.mark.parametrize("freedom", [30.0, 300.0])
@pytest.mark.parametrize("tail", [0.05, 0.01, 1e-3])
def test_tails_of_f(freedom: float, tail: float) -> None:
    value = 7.0 * float(stats.f.isf(tail, 7, freedom))
    assert upper_tail(value, 7, freedom) == pytest.approx(tail, rel=0.03)  # 1.2 %


def test_ends() -> None:
    assert upper_tail(0.0, 6) == 1.0 and upper_tail(5.0, 0) == 1.0
    assert upper_tail(math.inf, 6) == 0.0 and upper_tail(1e6, 6) == 0.0
    assert math.isnan(upper_tail(math.nan, 6))


@given(st.floats(0.01, 1e4), st.integers(1, 30), st.integers(3, 200_000))
def test_tail_of_f(value: float, d1: int, d2: int) -> None:
    expected = stats.f.logsf(value, d1, d2)
    if expected > -600.0:  # scipy's underflows
        assert float(log_f_tail(value, d1, d2)) == pytest.approx(expected, rel=2e-8, abs=2e-8)


@given(st.integers(1, 50), st.integers(0, 100), st.floats(1e-6, 0.999))
def test_tail_of_the_binomial(count: int, more: int, probability: float) -> None:
    expected = stats.binom.logsf(count - 1, count + more, probability)
    assert float(log_binomial_tail(count, count + more, probability)) == pytest.approx(expected, rel=1e-8, abs=1e-8)


@given(st.floats(0.0, 2e4), st.floats(1.0, 1e4))
def test_tail_of_chi_square(value: float, freedom: float) -> None:
    expected = stats.chi2.logsf(value, freedom)
    if expected > -600.0:
        assert float(log_chi2_tail(value, freedom)) == pytest.approx(expected, rel=1e-8, abs=1e-8)


def test_tails_do_not_underflow() -> None:
    assert float(log_f_tail(1e4, 3, 100_000)) == pytest.approx(-13116.0, rel=1e-3)
    assert float(log_chi2_tail(1e5, 10.0)) < -4e4


def test_many_at_once_are_as_each_alone() -> None:
    """The sums continue until all have converged, so that each may have more terms than it needs."""
    values, freedoms = np.array([[0.0], [3.0], [40.0], [np.inf]]), np.array([1.0, 7.5, 300.0])
    for tail in (log_chi2_tail, lambda value, d2: log_f_tail(value, 4.0, d2)):
        together = tail(values, freedoms)
        assert together.shape == (4, 3)
        alone = [[float(tail(value, freedom)) for freedom in freedoms] for value in values[:, 0]]
        np.testing.assert_allclose(together, alone, rtol=1e-13)


@pytest.mark.parametrize("freedom", [np.inf, 60.0])
def test_quadratic_tails(freedom: float) -> None:
    """Compared with scipy's central and noncentral variables, and with a sampled sum of unequal ones."""
    one = np.ones(5)
    expected = stats.chi2.sf(15.0, 5) if np.isinf(freedom) else stats.f.sf(3.0, 5, freedom)
    assert quadratic_tail(15.0, one, 0.0 * one, freedom) == pytest.approx(float(expected), rel=0.02)  # 1e-5; 0.3 %
    shifted = stats.ncx2.sf(30.0, 5, 5.0) if np.isinf(freedom) else stats.ncf.sf(6.0, 5, freedom, 5.0)
    assert quadratic_tail(30.0, one, one, freedom) == pytest.approx(float(shifted), rel=0.15)
    assert quadratic_tail(1.0, one[:0], one[:0], freedom) == 1.0
    rng, variances, squares = np.random.default_rng(0), np.array([0.2, 0.6, 1.0]), np.array([2.0, 1.0, 0.0])
    drawn = np.sum((np.sqrt(variances) * rng.standard_normal((200_000, 3)) + np.sqrt(squares)) ** 2, axis=1)
    assert quadratic_tail(14.0, variances, squares) == pytest.approx(float(np.mean(drawn > 14.0)), rel=0.1)
