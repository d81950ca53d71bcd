"""One evidence of random effects, against the dense Gaussian likelihood that it stands for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ceres_cal.base.arrays import Array
from ceres_cal.effects.evidence import RandomEffects, agreement, likeliest_sizes, logsum

SEEDS = st.integers(0, 10_000)


def drawn(seed: int, equations: int = 30, free: int = 4, numbers: int = 5) -> tuple[Array, Array, Array]:
    """A projector (E, E) onto what the free numbers leave, columns (E, Q) and residuals (E,)."""
    rng = np.random.default_rng(seed)
    taken = np.linalg.qr(rng.standard_normal((equations, free)))[0]
    return (
        np.eye(equations) - taken @ taken.T,
        rng.standard_normal((equations, numbers)),
        rng.standard_normal(equations),
    )


def restricted(left: Array, columns: Array, residuals: Array, covariance: Array, freedom: int | None) -> float:
    """Logarithm of the restricted likelihood, written down: the density of what the free numbers leave."""
    values, vectors = np.linalg.eigh(left)
    basis = vectors[:, values > 0.5]  # (E, E - free) orthonormal
    whole = np.eye(basis.shape[1]) + basis.T @ columns @ covariance @ columns.T @ basis
    squares = float(basis.T @ residuals @ np.linalg.solve(whole, basis.T @ residuals))
    fit = -0.5 * squares if freedom is None else -0.5 * freedom * np.log(squares / freedom)
    return float(fit - 0.5 * np.linalg.slogdet(whole)[1])


def effects(left: Array, columns: Array, residuals: Array, known_noise: bool) -> RandomEffects:
    slope = columns.T @ left @ residuals
    found = RandomEffects.of(columns.T @ left @ columns, slope, 1e-12)
    rest = float(residuals @ left @ residuals - found.value @ found.value)
    return RandomEffects(found.size, found.value, found.turn, rest, None if known_noise else 26.0)


@given(SEEDS, st.booleans(), st.floats(0.0, 3.0), st.floats(0.0, 5.0))
def test_evidence_is_the_restricted_likelihood(seed: int, known_noise: bool, scatter: float, size: float) -> None:
    """Differences between hypotheses, as constants are left out."""
    left, columns, residuals = drawn(seed)
    root = size * np.random.default_rng(seed + 1).standard_normal((5, 2))
    found = effects(left, columns, residuals, known_noise)
    roots = np.stack([np.zeros((5, 2)), root])
    logs = found.log_evidence(found.modes(roots), np.array([0.0, scatter]))
    freedom = None if known_noise else 26
    for hypothesis, own in enumerate(roots):
        for place, tau in enumerate((0.0, scatter)):
            wanted = restricted(left, columns, residuals, tau**2 * np.eye(5) + own @ own.T, freedom)
            none = restricted(left, columns, residuals, np.zeros((5, 5)), freedom)
            assert logs[hypothesis, place] - logs[0, 0] == pytest.approx(wanted - none, abs=1e-7)


@given(SEEDS, st.floats(0.0, 3.0))
def test_amounts_are_the_posterior_mean_and_standard_deviation(seed: int, scatter: float) -> None:
    left, columns, residuals = drawn(seed)
    root = np.random.default_rng(seed + 1).standard_normal((5, 2))
    mean, sd = effects(left, columns, residuals, True).amounts(root, scatter)
    values, vectors = np.linalg.eigh(left)
    basis = vectors[:, values > 0.5]
    along = basis.T @ columns
    noise = np.eye(basis.shape[1]) + scatter**2 * along @ along.T
    precision = np.eye(2) + (along @ root).T @ np.linalg.solve(noise, along @ root)
    wanted = -np.linalg.solve(precision, (along @ root).T @ np.linalg.solve(noise, basis.T @ residuals))
    np.testing.assert_allclose(mean, wanted, atol=1e-8)
    np.testing.assert_allclose(sd, np.sqrt(np.diag(np.linalg.inv(precision))), atol=1e-8)


def test_likeliest_sizes_are_the_maximum_of_the_evidence() -> None:
    """Without the one direction that counts along (least 0 does not take it away): of many numbers it is little."""
    rng = np.random.default_rng(3)
    columns, truth = rng.standard_normal((600, 120)), np.repeat([0.3, 2.0], 60) * rng.standard_normal(120)
    seen = columns @ truth + rng.standard_normal(600)
    forms = [np.diag(np.repeat([1.0, 0.0], 60)), np.diag(np.repeat([0.0, 1.0], 60))]
    normal, slope = columns.T @ columns, columns.T @ seen
    found = likeliest_sizes(normal, slope, forms, np.array([1.0, 1.0]), np.array([1e-3, 1e-3]), 1e-6)
    one = RandomEffects.of(normal, slope, 1e-12)

    def evidence(sigmas: Array) -> float:
        return float(one.log_evidence(one.modes(np.diag(np.repeat(sigmas, 60)))[None])[0, 0])

    best = evidence(found.sigmas)
    for factor in (0.9, 1.1):
        assert evidence(found.sigmas * [factor, 1.0]) < best
        assert evidence(found.sigmas * [1.0, factor]) < best
    np.testing.assert_allclose(found.sigmas, [0.3, 2.0], rtol=0.2)  # 0.05 measured


def test_agreement_is_of_different_groups_alone() -> None:
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((12, 40))
    assert abs(agreement(noise)) < 3.0  # 0.4 measured
    assert agreement(noise + rng.standard_normal(40)) > 10.0  # 21 measured
    assert agreement(noise[:1]) == 0.0


def test_sum_of_logarithms_far_below_zero() -> None:
    assert logsum(np.array([[-1000.0, -1000.0], [-3.0, -np.inf]])) == pytest.approx([-1000.0 + np.log(2.0), -3.0])
