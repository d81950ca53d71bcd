"""The evidence of random effects, compared with the dense Gaussian likelihood."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from accuracy.diagnostic_scenes import NOISE, overhead
from hypothesis import given
from hypothesis import strategies as st

from ceres_cal.base.arrays import Array
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.effects.aside import measure_offsets
from ceres_cal.effects.columns import EffectColumns, EffectSums, SparseColumns, grouped, score_all
from ceres_cal.effects.effect import Case, half_diagonals
from ceres_cal.effects.evidence import (
    FEATURE_ASIDE,
    OFFSETS_SCATTER,
    RandomEffects,
    SizePrior,
    agreement,
    logsum,
)
from ceres_cal.effects.likelihood import likelihoods
from ceres_cal.effects.linearised import Linearised, equation_weights, make_linear_model
from ceres_cal.effects.smoothness import likeliest_sizes
from ceres_cal.effects.strands import decay, distances_of, families_of, views_or_placements
from ceres_cal.effects.table import EFFECTS
from ceres_cal.observations import Observations
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.problem import Weighting
from ceres_cal.problem.residuals import residuals, write_equations
from ceres_cal.simulate import simulate

SEEDS = st.integers(0, 10_000)


def drawn(seed: int, equations: int = 30, free: int = 4, numbers: int = 5) -> tuple[Array, Array, Array]:
    """A projector (E, E) onto the complement of the free numbers, columns (E, Q) and residuals (E,)."""
    rng = np.random.default_rng(seed)
    taken = np.linalg.qr(rng.standard_normal((equations, free)))[0]
    return (
        np.eye(equations) - taken @ taken.T,
        rng.standard_normal((equations, numbers)),
        rng.standard_normal(equations),
    )


def basis_of(left: Array) -> Array:
    """(E, E - free) orthonormal basis of the range of a projector."""
    values, vectors = np.linalg.eigh(left)
    return np.asarray(vectors[:, values > 0.5])


def restricted(
    left: Array, columns: Array, residuals: Array, covariance: Array, freedom: int | None, basis: Array | None = None
) -> float:
    """Logarithm of the restricted likelihood: the density of the residuals after the free numbers."""
    basis = basis_of(left) if basis is None else basis
    whole = np.eye(basis.shape[1]) + basis.T @ columns @ covariance @ columns.T @ basis
    squares = float(basis.T @ residuals @ np.linalg.solve(whole, basis.T @ residuals))
    fit = -0.5 * squares if freedom is None else -0.5 * freedom * np.log(squares / freedom)
    return float(fit - 0.5 * np.linalg.slogdet(whole)[1])


def effects_of(left: Array, columns: Array, residuals: Array, known_noise: bool) -> RandomEffects:
    slope = columns.T @ left @ residuals
    found = RandomEffects.of(columns.T @ left @ columns, slope, 1e-12)
    rest = float(residuals @ left @ residuals - found.value @ found.value)
    return RandomEffects(found.size, found.value, found.turn, rest, None if known_noise else 26.0)


@given(SEEDS, st.booleans(), st.floats(0.0, 3.0), st.floats(0.0, 5.0))
def test_evidence_is_the_restricted_likelihood(seed: int, known_noise: bool, scatter: float, size: float) -> None:
    """Differences between hypotheses, since constants are left out."""
    left, columns, residuals = drawn(seed)
    root = size * np.random.default_rng(seed + 1).standard_normal((5, 2))
    found = effects_of(left, columns, residuals, known_noise)
    roots = np.stack([np.zeros((5, 2)), root])
    logs = found.log_evidence(found.modes(roots), np.array([0.0, scatter]))[:, 0]
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
    mean, sd = effects_of(left, columns, residuals, True).amounts(root, scatter)
    values, vectors = np.linalg.eigh(left)
    basis = vectors[:, values > 0.5]
    along = basis.T @ columns
    noise = np.eye(basis.shape[1]) + scatter**2 * along @ along.T
    precision = np.eye(2) + (along @ root).T @ np.linalg.solve(noise, along @ root)
    wanted = -np.linalg.solve(precision, (along @ root).T @ np.linalg.solve(noise, basis.T @ residuals))
    np.testing.assert_allclose(mean, wanted, atol=1e-8)
    np.testing.assert_allclose(sd, np.sqrt(np.diag(np.linalg.inv(precision))), atol=1e-8)


def test_likeliest_sizes_are_the_maximum_of_the_evidence() -> None:
    """With least 0; for many numbers the difference of one degree of freedom is small."""
    rng = np.random.default_rng(3)
    columns, truth = rng.standard_normal((600, 120)), np.repeat([0.3, 2.0], 60) * rng.standard_normal(120)
    seen = columns @ truth + rng.standard_normal(600)
    forms = [np.diag(np.repeat([1.0, 0.0], 60)), np.diag(np.repeat([0.0, 1.0], 60))]
    normal, slope = columns.T @ columns, columns.T @ seen
    sigmas, _, _ = likeliest_sizes(normal, slope, forms, np.array([1.0, 1.0]), np.array([1e-3, 1e-3]), 1e-6)
    one = RandomEffects.of(normal, slope, 1e-12)

    def evidence(sigmas: Array) -> float:
        return float(one.log_evidence(one.modes(np.diag(np.repeat(sigmas, 60)))[None])[0, 0, 0])

    best = evidence(sigmas)
    for factor in (0.9, 1.1):
        assert evidence(sigmas * [factor, 1.0]) < best
        assert evidence(sigmas * [1.0, factor]) < best
    np.testing.assert_allclose(sigmas, [0.3, 2.0], rtol=0.2)  # 0.05 measured


def test_agreement_is_of_different_groups_alone() -> None:
    rng = np.random.default_rng(5)
    noise = rng.standard_normal((12, 40))
    assert abs(agreement(noise)) < 3.0  # 0.4 measured
    assert agreement(noise + rng.standard_normal(40)) > 10.0  # 21 measured
    assert agreement(noise[:1]) == 0.0


def test_sum_of_logarithms_far_below_zero() -> None:
    assert logsum(np.array([[-1000.0, -1000.0], [-3.0, -np.inf]])) == pytest.approx([-1000.0 + np.log(2.0), -3.0])


# ---- one evidence for all effects -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class LinearisedCase:
    """A calibration's linear model, and the same in dense form: projector of the free numbers (E, E), and residuals."""

    model: Linearised
    case: Case
    left: Array
    residuals: Array
    basis: Array

    def log(self, columns: Array, covariance: Array) -> float:
        """Restricted likelihood of amounts of columns (E, Q), in standard deviations, with a covariance."""
        return restricted(self.left, columns, self.residuals, covariance, self.model.spare, self.basis)


def linearised(observations: Observations) -> LinearisedCase:
    options = Options(lens="radial", usual_camera=False, loss="trivial", noise_scale="stated")
    calibration = calibrate(observations, options)
    problem, estimate = calibration.problem(observations), calibration.estimate
    there = residuals(problem.sights, estimate)
    equations = write_equations(problem.sights, estimate, there)
    model = make_linear_model(
        problem, estimate, equations, equation_weights(Weighting(loss="trivial"), equations, there)
    )
    taken = [model.private * (equations.sight == sight)[:, None] for sight in range(len(equations.bounds) - 1)]
    values, basis = np.linalg.eigh(sum(part @ part.T for part in (*taken, model.shared)))
    left = np.eye(len(equations)) - basis[:, values > 0.5] @ basis[:, values > 0.5].T
    return LinearisedCase(model, Case(problem, estimate, model), left, model.score, basis_of(left))


@pytest.fixture(scope="module")
def seen() -> LinearisedCase:
    """Lines and points of a field, and two boards."""
    observations = simulate(overhead(frames=1, boards=2), NOISE, 3).observations
    points, curves = (np.arange(len(rows)) % 3 == 0 for rows in (observations.points, observations.curves))
    return linearised(observations.part(points, curves))


def test_a_line_aside(seen: LinearisedCase) -> None:
    """Log odds of each line, with all sizes of its offset and of the scatter summed explicitly."""
    model, equations = seen.model, seen.model.equations
    _, group = grouped(equations.view * 100 + equations.feature, equations.is_curve)
    few = np.where(group < 5, group, -1)
    columns = EffectColumns(np.ones((len(equations), 1)), few, tuple("abcde"))
    offsets = measure_offsets(model, columns, FEATURE_ASIDE)
    lines = (few[:, None] == np.arange(5)).astype(float)

    def log(wrong: Array, sizes: tuple[float, ...]) -> float:
        each = [
            seen.log(lines, tau**2 * np.eye(5) + size**2 * np.diag(wrong)) + np.log(probability / len(sizes))
            for size in sizes
            for tau, probability in zip(OFFSETS_SCATTER.scatter, OFFSETS_SCATTER.probabilities, strict=True)
        ]
        return float(logsum(np.array(each)))

    none, odds = offsets.log_evidence(), offsets.log_evidence_with_each()
    for line in range(5):
        wanted = log(np.eye(5)[line], FEATURE_ASIDE.sizes) - log(np.zeros(5), (0.0,)) + np.log(0.05 / 5)
        assert odds[line] - none == pytest.approx(wanted, abs=1e-6)


def test_a_bent_board(seen: LinearisedCase) -> None:
    """The probability and the size of its bows."""
    model, prior = seen.model, SizePrior(0.5, (1e-4, 3e-4, 1e-3))
    columns = (seen.model.equations.built[:, 2:4] * model.weight[:, None]) * ~model.equations.is_curve[:, None]
    bows = SparseColumns.of_groups(model, columns, np.zeros(len(columns), dtype=np.int64), 1)
    normal, slope, _ = bows.left_of(model)
    effects = RandomEffects.of(normal, slope, 0.0)
    rest = float(model.left_over @ model.left_over - effects.value @ effects.value)
    sigma, probability = replace(effects, rest=rest, freedom=model.spare).scatter_under(prior)
    logs = np.array([seen.log(columns, size**2 * np.eye(2)) for size in prior.scatter])
    weight = prior.probabilities * np.exp(logs - logs.max())
    assert probability == pytest.approx(1.0 - weight[0] / weight.sum(), abs=1e-9)
    assert sigma == pytest.approx(np.sqrt(weight[1:] @ prior.scatter[1:] ** 2 / weight[1:].sum()), rel=1e-9)


def test_a_rough_lens(seen: LinearisedCase) -> None:
    """The likeliest size of waves along the radius maximises the dense likelihood with known noise."""
    offsets = half_diagonals(seen.case.estimate.cameras["overhead"], seen.model.equations.pixel)
    radius = np.linalg.norm(offsets, axis=1)
    outward = np.sum(seen.model.equations.direction * offsets, axis=1) / radius
    waves = outward[:, None] * np.cos(np.pi * np.arange(4, 64) * radius[:, None]) * seen.model.weight[:, None]
    rough = seen.model.score + waves @ np.random.default_rng(0).normal(0.0, 0.3, 60)
    slope, normal = waves.T @ seen.left @ rough, waves.T @ seen.left @ waves
    sigmas, _, _ = likeliest_sizes(normal, slope, [np.eye(60)], np.array([1.0]), np.array([1e-3]), 1e-6)

    def log(sigma: float) -> float:
        return restricted(seen.left, waves, rough, sigma**2 * np.eye(60), None, seen.basis)

    assert log(float(sigmas[0])) > max(log(0.85 * sigmas[0]), log(1.15 * sigmas[0]))


def test_correlated_errors() -> None:
    """Errors along curves are an effect on every row, with a covariance that decreases with the distance."""
    observations = simulate(overhead(frames=1, boards=0), NOISE, 3).observations
    half = np.arange(len(observations.curves)) % 2 == 0
    seen = linearised(observations.part(np.zeros(len(observations.points), bool), half))
    model, every = replace(seen.model, step=np.zeros(len(seen.model.step))), np.eye(len(seen.residuals))
    family = families_of(model, views_or_placements(model.equations), model.equations.is_curve)[0]
    at = likelihoods([family], False, float(np.sum(model.shared**2)))
    none = seen.log(every, 0.0 * every)
    for place in np.flatnonzero(np.isfinite(at.log))[1::5]:
        together = 0.0 * every
        for strand in family.strands:
            correlation = decay(distances_of(strand.places, strand.places), at.length_m[place], False)
            together[np.ix_(strand.rows, strand.rows)] = at.share[place] * (correlation - np.eye(len(strand.rows)))
        assert at.log[place] - at.log[0] == pytest.approx(seen.log(every, together) - none, abs=1e-6)


def test_the_probability_of_a_diagnostic(seen: LinearisedCase) -> None:
    """A score test gives the amounts with the largest likelihood: those with an unbounded size."""
    for effect in (EFFECTS["skew"], EFFECTS["decentring"], EFFECTS["curve aside"]):
        (columns,) = effect.columns(seen.case)
        for score in score_all(seen.model, [EffectSums.of(seen.model, columns)])[:4]:
            own = score.columns[:, np.any(score.columns != 0.0, axis=0)] * seen.model.weight[:, None]
            one = RandomEffects.of(
                *SparseColumns.of_groups(seen.model, own, np.zeros(len(own), dtype=np.int64), 1).left_of(seen.model)[
                    :2
                ],
                0.0,
            )
            best = 1e9 * one.amounts(1e9 * np.eye(own.shape[1]))[0]
            np.testing.assert_allclose(score.amount[: len(best)], best, rtol=1e-4)
            after = seen.left @ (seen.residuals + own @ best)
            before = seen.left @ seen.residuals
            variance = after @ after / (seen.model.spare - own.shape[1])
            assert score.statistic == pytest.approx((before @ before - after @ after) / variance, rel=1e-6)
