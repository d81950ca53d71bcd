import numpy as np
import pytest

from ceres_cal.base.words import two_digits


@pytest.mark.parametrize(
    "value, text",
    [
        (0.2149, "0.21"),
        (99.4, "99"),
        (99.5, "100"),
        (-99.7, "-100"),
        (130.4, "130"),
        (3e-5, "3e-05"),
        (3.1e6, "3100000"),
        (np.inf, "inf"),
    ],
)
def test_two_digits(value: float, text: str) -> None:
    assert two_digits(value) == text
