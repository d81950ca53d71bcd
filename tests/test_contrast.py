"""Two statements about the same numbers."""

import numpy as np
import pytest

from ceres_cal.base.arrays import Array
from ceres_cal.moves.agreement import Contrast, NormalDistribution, contrast
from ceres_cal.problem.information import Information, Key

KEYS = tuple(Key("camera", "a", name, "px") for name in ("phi", "cx", "cy"))


def stated(sd: float, offsets: Array, freedom: float = np.inf) -> NormalDistribution:
    return NormalDistribution(Information(KEYS, np.eye(3) / sd**2), offsets, freedom)


def test_what_differs_in_one_number_is_seen_in_that_number() -> None:
    first, second = stated(1.0, np.array([0.3, 0.1, 2.0])), stated(2.0, np.array([-4.7, 0.1, -1.0]))
    found = contrast(first, second, KEYS[:1])
    # With equal cx and cy, phi's difference of 5 has variance 1 + 4, one fifth of which is the first one's.
    assert found.statistic == pytest.approx(5.0) and found.degrees == 1
    assert found.shares == pytest.approx([0.2])
    assert contrast(first, second, KEYS).statistic == pytest.approx(25.0 / 5.0 + 9.0 / 5.0)


def test_what_either_knows_nothing_of_is_not_tested() -> None:
    nothing = NormalDistribution(Information.nothing(KEYS), np.zeros(3), 10.0)
    found = contrast(stated(1.0, np.ones(3)), nothing, KEYS)
    assert found.degrees == 0 and found.probability == 1.0
    along = np.outer([1.0, 1.0, 0.0], [1.0, 1.0, 0.0])  # phi + cx alone
    found = contrast(
        stated(1.0, np.zeros(3)), NormalDistribution(Information(KEYS, along), np.zeros(3), 10.0), KEYS[:2]
    )
    assert found.degrees == 1


@pytest.mark.parametrize("share", [0.05, 0.3, 0.9])
def test_the_rate_holds_given_the_first_statement(share: float) -> None:
    """For 95 % of 400 first statements, the false alarm rate over true second statements is below about 1 %."""
    rng, freedom = np.random.default_rng(0), 60.0
    error = np.sqrt(share) * rng.standard_normal((400, 1, 7))
    noise = np.sqrt(rng.chisquare(freedom, (400, 500)) / freedom)[..., None]
    seen = np.sum((error + np.sqrt(1.0 - share) * rng.standard_normal((400, 500, 7)) / noise) ** 2, axis=2)
    low, high = 5.0, 100.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        rare = Contrast(middle, np.full(7, share), freedom / (1.0 - share) ** 2).probability < 0.01
        low, high = (low, middle) if rare else (middle, high)
    rates = np.sort(np.mean(seen > high, axis=1))
    assert rates[379] <= 0.02 and np.mean(rates) <= 0.01  # the 95th of 100, of 500 each: 0.010 +- 0.004
