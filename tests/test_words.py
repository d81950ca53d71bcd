import numpy as np
import pytest

from ceres_cal.base.words import did_you_mean, two_digits, with_sd


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


@pytest.mark.parametrize(
    "value, sd, sign, text",
    [
        (44.13, 0.52, "", "44.13 ± 0.52"),
        (0.0297, 0.0243, "", "0.030 ± 0.024"),  # a board's bow, mm
        (0.0461, 0.0224, "+", "+0.046 ± 0.022"),
        (-1234.4, 130.4, "+", "-1234 ± 130"),
        (868.9123, np.inf, "", "868.9123 ± unknown"),
    ],
)
def test_with_sd(value: float, sd: float, sign: str, text: str) -> None:
    assert with_sd(value, sd, sign) == text


@pytest.mark.parametrize(
    "typed, known, meant",
    [
        ("--force", ["--tolerance", "--once", "--before", "--report"], ""),
        ("--verbose", ["--version", "--report"], ""),
        ("--tol", ["--terms", "--tolerance"], "--tolerance"),
        ("--output-dir", ["--options", "--output"], "--output"),
        ("circle", ["center_circle_radius", "center_circle"], "center_circle"),
        ("no", ["no-browser"], ""),
        ("Sise", ["sizes", "Size"], "Size"),
        ("heigth", ["weight", "height"], "height"),
    ],
)
def test_a_name_is_suggested_where_one_letter_in_four_is_wrong_or_it_is_begun(
    typed: str, known: list[str], meant: str
) -> None:
    assert did_you_mean(typed, known) == (f": did you mean {meant!r}?" if meant else "")
