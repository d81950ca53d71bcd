import pytest
from scipy import stats

from ceres_cal.chi_squared import upper_bound, upper_tail


@pytest.mark.parametrize("degrees", [1, 2, 6, 7, 14])
@pytest.mark.parametrize("tail", [0.05, 0.01, 1e-3, 1e-4])
def test_tails_of_chi_squared(degrees: int, tail: float) -> None:
    value = float(stats.chi2.isf(tail, degrees))
    assert upper_tail(value, degrees) == pytest.approx(tail, rel=1e-12)
    assert upper_bound(tail, degrees) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize("freedom", [30.0, 300.0])
@pytest.mark.parametrize("tail", [0.05, 0.01, 1e-3])
def test_tails_of_f(freedom: float, tail: float) -> None:
    value = 7.0 * float(stats.f.isf(tail, 7, freedom))
    assert upper_tail(value, 7, freedom) == pytest.approx(tail, rel=0.03)  # 1.2 %


def test_ends() -> None:
    assert upper_tail(0.0, 6) == 1.0 and upper_tail(5.0, 0) == 1.0
