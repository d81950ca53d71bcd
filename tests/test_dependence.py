"""Correlated errors are counted together."""

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from accuracy.dependent_errors import Errors, along_lines, warped
from accuracy.intervals import CASES, cover, share
from accuracy.scenes import CLEAN_NOISE, RADIAL, SSL_PROBLEMS, boards
from hypothesis import given
from hypothesis import strategies as st
from scenes import corners
from thorough import partly

from ceres_cal.base.arrays import Array
from ceres_cal.base.tails import NORMAL_95, student_95
from ceres_cal.calibration import Calibration
from ceres_cal.calibration.calibrating import calibrate
from ceres_cal.effects.dependence import Correlation, Dependence, Scatter, _freedom_of_mixture
from ceres_cal.effects.groups import GroupScatter, _averaged, _expected
from ceres_cal.effects.likelihood import likelihoods
from ceres_cal.effects.strands import Strand, StrandFamily, _shown, decay, decays, distances_of
from ceres_cal.moves.refits import refit
from ceres_cal.observations import Observations
from ceres_cal.observations.sights import gather_sights
from ceres_cal.problem.information import Information, Key
from ceres_cal.problem.parameters import Options
from ceres_cal.problem.residuals import residuals
from ceres_cal.simulate import Disturbance, simulate
from ceres_cal.start.initialise import initialise

HALF = SSL_PROBLEMS["half, paper's lens"]()
TEN = boards(868.0, RADIAL, 10)
POINTS = Disturbance(points_sigma_px=0.3)


def half_a_field(errors: Errors, seed: int = 0) -> Observations:
    observations = simulate(HALF.scene, POINTS, seed).observations
    return errors(replace(observations, priors=HALF.priors), HALF.scene, seed)


def ten_boards(errors: Errors | None, seed: int = 0) -> Observations:
    observations = simulate(TEN.scene, CLEAN_NOISE, seed).observations
    return observations if errors is None else errors(observations, TEN.scene, seed)


def factors(calibration: Calibration) -> Array:
    posterior = calibration.uncertainty.posterior
    return posterior.factors[[key.kind != "structure" for key in posterior.keys]]


# ---- what is found --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length_m", partly([0.3, 0.6], [0.3]))
def test_a_length_along_lines_is_recovered(length_m: float) -> None:
    """Over five runs; the grid of lengths has factors of two."""
    lengths, shares = [], []
    for seed in range(5):
        calibration = calibrate(half_a_field(partial(along_lines, length_m=length_m), seed), HALF.options)
        found = calibration.uncertainty.posterior.dependence
        assert found is not None
        (curves,) = found.correlations
        assert curves.kind == "curves" and curves.probability > 0.9 and curves.length_m is not None
        lengths.append(curves.length_m)
        shares.append(curves.share)
    assert np.exp(np.mean(np.log(lengths))) == pytest.approx(length_m, rel=0.5)
    assert np.median(shares) >= 0.9  # all of the noise is correlated


def test_white_noise_stays_white() -> None:
    every = np.concatenate([factors(calibrate(ten_boards(None, seed), TEN.options)) for seed in range(12)])
    assert np.mean(every) == pytest.approx(1.03, abs=0.03) and np.max(every) < 1.4  # 1.03, 1.29 in one run


def test_distorted_views_widen_everything() -> None:
    """If one view alone is distorted, it is rejected as a whole, or everything widens: accuracy/intervals.py."""
    errors = partial(warped, sigma_px=1.0, views=3)
    assert np.median([factors(calibrate(ten_boards(errors, seed), TEN.options)) for seed in range(6)]) > 1.1


def test_lines_that_are_each_aside_are_named() -> None:
    calibration = calibrate(half_a_field(partial(along_lines, length_m=50.0), 1), HALF.options)
    assert np.median(factors(calibration)) > 1.3
    assert "errors are correlated along lines" in calibration.uncertainty.widening


@pytest.mark.thorough
def test_what_all_frames_share_does_not_shrink_with_them() -> None:
    """The same errors in six frames of a static camera: the uncertainty is that of one frame, not
    smaller by root six.
    """
    one = half_a_field(partial(along_lines, length_m=0.5), 3)
    rng, count = np.random.default_rng(0), len(one.curves)
    views = tuple(replace(one.views[0], frame=f"{n}") for n in range(6))
    pixels = np.tile(one.curves.pixels, (6, 1)) + 0.05 * rng.standard_normal((6 * count, 2))
    curves = replace(
        one.curves,
        view=np.repeat(np.arange(6, dtype=np.int32), count),
        feature=np.tile(one.curves.feature, 6),
        pixels=pixels,
        sigma_px=np.ones(6 * count),
        side=np.tile(one.curves.side, 6),
    )
    points = replace(one.points, view=np.zeros(len(one.points), np.int32))
    six = calibrate(replace(one, views=views, curves=curves, points=points), HALF.options)
    alone = calibrate(one, HALF.options)
    ratio = six.uncertainty.posterior.sd / alone.uncertainty.posterior.sd
    assert six.posterior is not None and six.posterior.dependence is not None
    assert six.posterior.dependence.correlations[0].lasting
    assert np.median(ratio) == pytest.approx(1.0, abs=0.35)  # the model alone: 0.4 and less


def test_lengths_that_halve_are_squares() -> None:
    distance = np.linspace(0.0, 9.0, 50)
    places = [(160.0, False), (8.0, True), (8.0, False), (4.0, False), (1.0, True), (0.5, False)]
    for place, correlation in zip(places, decays(distance, places), strict=True):
        assert correlation == pytest.approx(decay(distance, *place), rel=1e-13, abs=1e-29)  # 4e-14 measured


def test_what_all_frames_share_of_points_does_not_shrink_either() -> None:
    """Corners in six frames of a static camera with the same errors in each of them."""
    one = simulate(corners("radial-2-3"), Disturbance(points_sigma_px=0.5), 0).observations
    rng, pixels = np.random.default_rng(1), one.points.pixels
    frames = [
        replace(
            one,
            views=(replace(one.views[0], frame=f"{n}"),),
            points=replace(one.points, pixels=pixels + 0.3 * rng.standard_normal(pixels.shape)),
        )
        for n in range(6)
    ]
    several, alone = (
        calibrate(observations, Options(lens="radial", powers=(2, 3))).uncertainty.posterior.sd
        for observations in (sum(frames[1:], frames[0]), one)
    )
    assert np.median(several / alone) == pytest.approx(1.0, abs=0.2)  # without this 0.4


# ---- it does not depend on the representation -----------------------------------------------------------------------


def test_the_order_of_views_does_not_matter() -> None:
    observations = ten_boards(partial(warped, sigma_px=0.3, views=None))
    order = np.arange(len(observations.views))[::-1]
    points = observations.points
    rows = np.argsort(order[points.view], kind="stable")
    turned = replace(
        observations,
        views=tuple(observations.views[i] for i in order),
        points=replace(
            points,
            view=order[points.view][rows].astype(np.int32),
            feature=points.feature[rows],
            pixels=points.pixels[rows],
            sigma_px=points.sigma_px[rows],
        ),
    )
    first, second = (calibrate(o, TEN.options).uncertainty.posterior for o in (observations, turned))
    assert second.sd == pytest.approx(first.sd, rel=1e-3)


def test_a_tenth_of_the_stated_sigma_is_the_same_data() -> None:
    observations = ten_boards(partial(warped, sigma_px=0.3, views=None))
    points = replace(observations.points, sigma_px=0.1 * observations.points.sigma_px)
    first, second = (
        calibrate(o, TEN.options).uncertainty.posterior for o in (observations, replace(observations, points=points))
    )
    assert second.sd == pytest.approx(first.sd, rel=1e-3)


def test_what_was_stated_and_does_not_scatter_may_be_shared() -> None:
    """One picture whose lines have stated sigmas 2.5 times their scatter: the rest may be an error that they share. If
    all have one sigma, it is only a unit.
    """
    one = half_a_field(partial(along_lines, length_m=1e-3))
    count = len(one.curves)
    each = np.exp(np.random.default_rng(1).uniform(-0.05, 0.05, count))  # of each by itself, as detection states it

    def sd(stated: Array) -> Array:
        curves = replace(one.curves, sigma_px=stated * one.curves.sigma_px)
        return calibrate(replace(one, curves=curves), HALF.options).uncertainty.posterior.sd

    assert 1.5 < np.median(sd(2.5 * each) / sd(each)) < 2.3  # 1.98 measured
    assert (
        np.median(sd(np.full(count, 2.5)) / sd(np.ones(count))) < 1.05
    )  # 0.67: four points borrow from the lines' scale


# ---- who reads it ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def correlated() -> tuple[Calibration, Observations]:
    observations = half_a_field(partial(along_lines, length_m=0.5))
    return calibrate(observations, HALF.options), observations


def test_everybody_reads_the_wider_one(correlated: tuple[Calibration, Observations]) -> None:
    calibration, _ = correlated
    known, posterior = calibration.uncertainty, calibration.uncertainty.posterior
    assert posterior.by_model is not None and np.median(posterior.factors) > 1.4
    straight = replace(known, posterior=replace(posterior, mixtures={}))
    alone = replace(posterior, information=posterior.by_model, by_model=None, mixtures={})
    narrow = replace(known, posterior=alone)
    assert straight.map_sd_mm().mean_mm > 1.3 * narrow.map_sd_mm().mean_mm
    verdict = straight.verdict("camera", "overhead", "phi")
    assert verdict.sd == pytest.approx(verdict.factor * narrow.verdict("camera", "overhead", "phi").sd)
    again = refit(calibration, half_a_field(partial(along_lines, length_m=0.5), 1))
    assert again.refitted is not None and again.refitted.prior is not None
    prior = again.refitted.prior.information
    assert prior.spread.sd == pytest.approx(posterior.normal.marginal(prior.keys).spread.sd)
    assert np.all(prior.spread.sd > 0.999 * posterior.information.marginal(prior.keys).spread.sd)


def test_the_file_says_what_was_used_and_old_files_load(
    correlated: tuple[Calibration, Observations], tmp_path: Path
) -> None:
    calibration, _ = correlated
    path = tmp_path / "calibration.json"
    calibration.save(path)
    back = Calibration.load(path).uncertainty.posterior
    assert back.dependence == calibration.uncertainty.posterior.dependence
    assert back.factors == pytest.approx(factors(calibration), rel=1e-12)
    data = json.loads(path.read_text())
    for name in ("by_model", "dependence"):
        del data["posterior"][name]
    path.write_text(json.dumps(data))
    old = Calibration.load(path).uncertainty.posterior
    assert old.by_model is None and np.all(old.factors == 1.0) and old.sd == pytest.approx(back.sd)


# ---- parts ----------------------------------------------------------------------------------------------------------


def test_few_groups_hardly_move_what_is_known() -> None:
    """A ratio of four over two degrees of freedom is no evidence, over a hundred it is."""
    few, likely = _averaged(4.0, 2.0, 1.0)
    assert few < 2.6 and likely < 0.5
    many, certain = _averaged(4.0, 100.0, 1.0)
    assert many == pytest.approx(4.0, rel=0.1) and certain > 0.999
    assert _averaged(1.0, 100.0, 1.0)[0] == pytest.approx(1.0, abs=0.03)


def test_a_mixture_has_the_tails_of_its_widest_part() -> None:
    assert _freedom_of_mixture(np.ones(1), np.ones(1)) > 1e5
    weights, variances = np.array([0.5, 0.5]), np.array([1.0, 4.0])
    degrees = _freedom_of_mixture(weights, variances)
    rng = np.random.default_rng(0)
    draws = rng.standard_normal(200_000) * np.sqrt(rng.choice(variances, 200_000))
    half = student_95(degrees) * np.sqrt(weights @ variances)
    assert np.mean(np.abs(draws) <= half) == pytest.approx(0.95, abs=0.003)
    assert student_95(degrees) > NORMAL_95


# ---- what is summed first -------------------------------------------------------------------------------------------


def _family(rng: np.random.Generator) -> tuple[StrandFamily, Array]:
    """Nine strands of three shapes over three views, and the columns of all rows: private, two shared, residuals."""
    places = [np.column_stack([rng.uniform(0.0, 1.0, (count, 2)), np.zeros(count)]) for count in (20, 28, 20)]
    strands, first = [], 0
    for number in (0, 1, 0, 2, 0, 1, 1, 0, 2):
        strands.append(Strand(np.arange(first, first + len(places[number])), places[number]))
        first += len(places[number])
    group = np.repeat([0, 0, 0, 1, 1, 1, 2, 2, 2], [len(strand.rows) for strand in strands])
    columns = np.zeros((first, 9))
    for view in range(3):
        own = group == view
        columns[own, :6] = np.linalg.qr(rng.standard_normal((np.count_nonzero(own), 6)))[0]
    columns[:, 6:8] = 0.02 * rng.standard_normal((first, 2))
    columns[:, 8] = rng.standard_normal(first)
    return StrandFamily.of(strands, False, columns, group), columns


def test_strands_of_one_shape_are_multiplied_as_one_matrix() -> None:
    family, columns = _family(np.random.default_rng(0))
    matrices = np.where(np.isfinite(family.distance), decay(family.distance, 0.3, False), 0.0)
    product, squared = family.applied(matrices), np.zeros((3, 28, 28))
    for number, strand in enumerate(family.strands):
        shape, size = int(np.searchsorted(family.bounds, number, side="right")) - 1, len(strand.rows)
        own = columns[strand.rows]
        np.testing.assert_allclose(product[number, :size], matrices[shape, :size, :size] @ own, atol=1e-12)
        squared[shape, :size, :size] += own[:, 6:8] @ own[:, 6:8].T
    np.testing.assert_allclose(family.squared(slice(6, 8)), squared, atol=1e-12)
    np.testing.assert_allclose(family.products, columns.T @ columns, atol=1e-10)


def test_the_likelihood_is_that_of_the_whole_covariance() -> None:
    """Of all rows at once; columns are private placements and shared numbers, the latter with unit information."""
    family, columns = _family(np.random.default_rng(1))
    at = likelihoods([family], False, float(np.sum(columns[:, 6:8] ** 2)))
    group = np.concatenate([np.full(len(s.rows), g) for s, g in zip(family.strands, family.group, strict=True)])
    rows = np.concatenate([strand.rows for strand in family.strands])
    private = np.hstack([columns[rows, :6] * (group == view)[:, None] for view in range(3)])
    shared, left = columns[rows, 6:8], columns[rows, 8]
    known, slope = np.eye(2) - shared.T @ shared, -shared.T @ left  # of what was not looked at, as it is at the optimum

    def log(length: float, share: float) -> float:
        inverses, log_of = [], 0.0
        for strand in family.strands:
            distance = np.linalg.norm(strand.places[:, None] - strand.places, axis=2)
            covariance = (1.0 - share) * np.eye(len(distance)) + share * decay(distance, length, False)
            inverses.append(np.linalg.inv(covariance))
            log_of -= 0.5 * np.linalg.slogdet(covariance)[1]
        weighted = [i @ part for i, part in zip(inverses, _split(family, np.hstack([private, shared])), strict=True)]
        both, weighted_all = np.hstack([private, shared]), np.concatenate(weighted)
        normal, gradient = both.T @ weighted_all, weighted_all.T @ left
        normal[-2:, -2:] += known
        gradient[-2:] += slope
        weighted_left = np.concatenate([i @ part for i, part in zip(inverses, _split(family, left), strict=True)])
        squares = left @ weighted_left - gradient @ np.linalg.solve(normal, gradient)
        freedom = len(left) - 18 - np.sum(shared**2)
        return float(log_of - 0.5 * (np.linalg.slogdet(normal)[1] + freedom * np.log(squares / freedom)))

    assert len(at.log) > 20
    expected = [log(max(length, 1e-9), share) for length, share in zip(at.length_m, at.share, strict=True)]
    np.testing.assert_allclose(at.log - at.log[0], np.array(expected) - expected[0], atol=1e-7)


def _split(family: StrandFamily, values: Array) -> list[Array]:
    """Values of the rows, strand by strand."""
    return np.split(values, np.cumsum([len(strand.rows) for strand in family.strands])[:-1])


@given(st.integers(0, 2**32 - 1), st.integers(0, 5))
def test_what_observations_say_alone_is_what_their_scores_leave(seed: int, seen: int) -> None:
    """A^T C^-1 A for any prior and any number of observations; it is never negative."""
    rng = np.random.default_rng(seed)
    half, prior = rng.standard_normal((seen, 5)), rng.standard_normal((5, 5)) * 10.0 ** rng.uniform(-2, 2)
    root = np.linalg.inv(np.linalg.cholesky(half.T @ half + prior.T @ prior + 1e-9 * np.eye(5))).T
    spread = (spread := rng.standard_normal((seen, seen))) @ spread.T + 0.1 * np.eye(seen)
    keys = tuple(Key("camera", "camera", f"k{n}", "") for n in range(5))
    alone = Information(keys, np.asarray(half.T @ half))
    whole = np.eye(5) + root.T @ half.T @ (spread - np.eye(seen)) @ half @ root
    scatter = Scatter(root, whole, Dependence())
    found = scatter.widened(alone).matrix
    expected = half.T @ np.linalg.inv(spread) @ half
    assert np.allclose(found, expected, rtol=1e-5, atol=1e-6 * np.abs(alone.matrix).max(initial=1.0))
    assert np.linalg.eigvalsh(found).min() > -1e-9 * max(1.0, np.abs(found).max())


def test_the_spread_of_scores_is_that_over_all_pairs_of_views() -> None:
    rng = np.random.default_rng(0)
    roots = rng.standard_normal((2, 5, 4, 3))
    informations, scatter = roots @ np.swapaxes(roots, 2, 3) / 40.0
    whole = scatter.sum(axis=0) + np.eye(4)
    values, vectors = np.linalg.eigh(whole)
    white = (vectors * values**-0.5) @ vectors.T
    own, spread = _expected(informations, scatter, whole, white)
    total = 0.0
    for i, (a, m) in enumerate(zip(informations, scatter, strict=True)):
        for j, (b, n) in enumerate(zip(informations, scatter, strict=True)):
            covariance = white @ ((i == j) * m - a @ n - m @ b + a @ whole @ b) @ white
            total += 2.0 * np.sum(covariance**2)
            if i == j:
                np.testing.assert_allclose(own[i], covariance, atol=1e-12)
    assert spread == pytest.approx(total, rel=1e-10)


# ---- coverage, by small samples -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", partly(["lines together over 0.5 m", "ten boards, smooth errors"], ["ten boards, smooth errors"])
)
def test_intervals_hold_where_errors_go_together(name: str) -> None:
    """scripts/accuracy/intervals.py has more runs; without this, coverage is 62 % and 68 %."""
    found = cover(CASES[name], range(15))
    assert found.far == 0 and found.failed == 0
    assert 0.88 < share(found.parameters)[0] < 0.995
    for held in found.points.values():
        assert 0.88 < share(held)[0] < 0.995


def test_rows_without_a_residual_take_no_part() -> None:
    """A lens in the middle of its valley may not project all of them; their scores would be NaN."""
    observations = Observations.load(Path(__file__).parents[1] / "data" / "ssl_field" / "observations.json")
    sights = gather_sights(observations)
    there = residuals(sights, initialise(sights, Options(lens="radial")).estimate)
    assert _shown(sights, there) is sights
    points = there.points.copy()
    points[5] = np.nan
    shown = _shown(sights, replace(there, points=points))
    assert len(shown.point_rows) == len(sights.point_rows) - 1 and 5 not in shown.point_rows


def test_places_far_apart_have_no_correlation_at_all() -> None:
    """A line every 0.2 m in two frames, at about the same places. With correlations of 1e-155 among its entries, LAPACK
    found no eigenvalues of this matrix, and a refit was refused.
    """
    first = "0 .19911 .4 .60031 .80303 .99905 1.20013 1.39871 1.5986 1.79864 1.99939 2.19921 2.40065 2.59749 2.79885"
    last = ".0031 .39843 .60204 .80493 1.00232 1.20281 1.40094 1.60028 1.80157 2.40083 2.80022 3.00347 3.19654 3.19674"
    more = "3.60109 3.77682 3.79786 3.99964 4.19946 4.20242 4.79925"
    places = np.zeros((36, 3))
    places[:, 0] = np.sort(np.array(" ".join((first, last, more)).split(), dtype=float))
    kernel = decay(distances_of(places, places), 0.0135, smooth=False)
    assert np.min(kernel[kernel > 0.0]) > 1e-31
    values, vectors = np.linalg.eigh(kernel)
    assert values[0] > 0.01 and np.max(np.abs((vectors * values) @ vectors.T - kernel)) < 1e-14  # 1.3e-15 measured


def test_rounding_widens_nothing_that_priors_alone_know() -> None:
    """A direction with a share of 3e-10 from observations: the covariance of a score has rounding
    errors of this size.
    """
    seen = Information((Key("camera", "one", "phi", "px"), Key("camera", "one", "cx", "px")), np.diag([1.0, 3e-10]))
    rounded = Scatter(np.eye(2), np.eye(2) - np.diag([0.0, 2.9e-10]), Dependence())
    np.testing.assert_allclose(rounded.widened(seen).matrix, seen.matrix, atol=1e-12)


@pytest.mark.parametrize(
    ("variance", "probability", "widens"), [(4.0, 0.9, True), (0.2, 0.9, False), (4.0, 0.1, False)]
)
def test_what_takes_width_back_is_no_reason_for_it(variance: float, probability: float, widens: bool) -> None:
    """Views that scatter less than expected from within them are no cause of a larger deviation."""
    between = GroupScatter(12, variance, probability, 10.0)
    dependence = Dependence(between=between)
    assert dependence.is_likely == (probability > 0.5)
    assert bool(dependence.causes) == widens


@pytest.mark.parametrize(
    "length_m, said", [(None, "as a whole"), (0.0099, "over 0.0099 m"), (1.3e-8, "over less than 1 mm")]
)
def test_no_length_is_shorter_than_a_millimetre(length_m: float | None, said: str) -> None:
    repeated = Dependence((Correlation("curves", 0.9, length_m, 0.5, True),))
    assert repeated.causes == (f"errors are correlated along lines {said}, the same in all views",)
